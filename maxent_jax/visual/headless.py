"""Checks, before MuJoCo is loaded, what drawing needs: bodies, and OpenGL without a screen."""

import functools
import importlib
import os
import subprocess
import sys

from maxent_jax.config.registry import MUJOCO_ENVS
from maxent_jax.errors import RunError

VARIABLE = "MUJOCO_GL"
BACKENDS = {"darwin": ("cgl",), "win32": ("wgl",)}.get(sys.platform, ("egl", "osmesa"))
PACKAGES = "libegl1 and libgl1 (egl), or libosmesa6 (osmesa)"  # as Debian and Ubuntu name them
READS_VARIABLE = "mujoco.rendering.classic.gl_context"  # once, when MuJoCo is loaded
PROBE = """
import mujoco
log = mujoco.MjLogConfig.get()
log.logto_file = False  # see envs.physics.keep_no_log
mujoco.MjLogConfig.set(log)
with mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8) as renderer:
    renderer.render()
"""
PROBE_SECONDS = 20


class RenderingError(RunError):
    """A run cannot be drawn here."""


def check_drawable(env: str) -> None:
    """Rejects environments without MuJoCo bodies, as far as their names tell.

    Raises:
      RenderingError: a classic environment, or one of brax.
    """
    if env not in MUJOCO_ENVS and not env.startswith("user:"):
        raise RenderingError(
            f"environment '{env}' cannot be drawn: only MuJoCo's robots can be "
            f"({', '.join(MUJOCO_ENVS)}, and user:NAME made by maxent_jax.envs.from_xml)."
        )


def draw_nothing() -> None:
    """Turns off MuJoCo's rendering, for commands that draw no robots, before MuJoCo is loaded.

    MuJoCo cannot be loaded with an unknown MUJOCO_GL, or without the system packages that it needs.
    """
    if "mujoco" not in sys.modules:
        os.environ[VARIABLE] = "disable"


@functools.cache
def choose_backend() -> str:
    """Sets and returns MUJOCO_GL: the user's value, or the first of egl and osmesa that draws.

    Call it before MuJoCo is loaded if possible; afterwards, it makes MuJoCo read the choice again.

    Raises:
      RenderingError: nothing draws without a screen here, or the user's value does not.
    """
    wanted = os.environ.get(VARIABLE)
    found = next(filter(_draws, [wanted] if wanted else BACKENDS), None)
    if found is None and wanted:
        raise RenderingError(
            f"{VARIABLE} is '{wanted}', which does not draw here: unset it, or install the system "
            f"packages {PACKAGES}."
        )
    if found is None:
        raise RenderingError(
            f"nothing draws without a screen here: install the system packages {PACKAGES}."
        )
    os.environ[VARIABLE] = found
    if READS_VARIABLE in sys.modules:
        importlib.reload(sys.modules[READS_VARIABLE])
    return found


def _draws(backend: str) -> bool:
    """Tries a backend in another process: one that fails leaves its process without any."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROBE],
            env=os.environ | {VARIABLE: backend},
            capture_output=True,
            timeout=PROBE_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0
