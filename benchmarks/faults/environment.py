"""Do a user's variables, streams, limits and paths lead to a traceback, or to damage?

Each fault is a command of ours in a shell. It must end with the expected exit code, print at most
one sentence on standard error in addition to its progress, and never a traceback.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import common
from benchmarks.faults import smoke
from maxent_jax.config import preset
from maxent_jax.runs import files, locks

COMMAND = '"$@"'
UNLIMITED_SECONDS = 600
REFUSAL_SECONDS = 5.0  # some are known only after jax is loaded; 3 s if nothing else runs
# A smoke run that takes seconds.
TRAIN = "train --preset smoke --env pendulum --out {new}"
# A command that loads no array library, on an existing run.
VERIFY = "verify {run}"
TOO_LARGE = "train --preset smoke --env pendulum --replay-size 2000000000"
LEAVING = "cd {gone}; rmdir {gone}; "  # the working folder is gone
READ_ONLY = "mount --bind {run} {run} && mount -o remount,ro,bind {run} && "

# What a run prints without a fault; a path in it may contain a line break.
PROGRESS = re.compile(
    r"^(\w+ on \w+, preset .*? Ctrl-C saves the run|compiled[^\n]*|iteration \d[^\n]*)\n",
    re.MULTILINE | re.DOTALL,
)


class Fault(NamedTuple):
    """A command in a wrong environment, and the result that it must have."""

    arguments: str  # of maxent_jax
    code: int  # expected exit code
    says: str = ""  # expected words on standard error; "" if it must be empty
    shell: str = COMMAND  # what runs it
    variables: str = ""  # of the environment, NAME=VALUE; -NAME removes one
    same: bool = False  # it must train, bit-identical to an undisturbed run
    apart: bool = False  # in its own namespace, in which it may mount


def refused(variables: str, says: str) -> Fault:
    """A variable with which jax cannot start."""
    return Fault(TRAIN, 2, says, variables=variables)


def harmless(variables: str, says: str = "") -> Fault:
    """A variable that changes no result."""
    return Fault(TRAIN, 0, says, variables=variables, same=True)


def shown(variables: str) -> Fault:
    """A variable that affects printing."""
    return Fault("train --help", 0, variables=variables)


def to(out: str, code: int, says: str = "") -> Fault:
    """A run into a directory with a special name or place."""
    return Fault(f"train --preset smoke --env pendulum --out {out}", code, says)


GROUPS: dict[str, tuple[Fault, ...]] = {
    "variables that jax cannot start with": (
        refused("JAX_PLATFORMS=cuda", "JAX_PLATFORMS is 'cuda'"),
        refused("JAX_PLATFORMS=bogus", "JAX_PLATFORMS is 'bogus'"),
        refused("JAX_PLATFORMS=tpu", "JAX_PLATFORMS is 'tpu'"),
        refused("JAX_PLATFORM_NAME=gpu", "jax finds no device"),
        refused("JAX_DEFAULT_DEVICE=gpu", "JAX_DEFAULT_DEVICE is 'gpu'"),
        refused("JAX_DEFAULT_DEVICE=7", "jax cannot be loaded"),
        refused("JAX_ENABLE_X64=maybe", "JAX_ENABLE_X64"),
        refused("JAX_DEFAULT_MATMUL_PRECISION=best", "jax_default_matmul_precision"),
        refused("JAX_DEFAULT_PRNG_IMPL=dice", "jax_default_prng_impl"),
        refused("JAX_NUM_CPU_DEVICES=many", "jax_num_cpu_devices"),
        refused("JAX_NUM_CPU_DEVICES=0", "jax finds no device"),
        refused("XLA_FLAGS=--no_such_flag", "Unknown flag in XLA_FLAGS"),
        refused("XLA_FLAGS=--xla_cpu_enable_fast_math=maybe", "but XLA cannot start with it"),
        refused("XLA_FLAGS=/no/such/file", "but XLA cannot start with it"),
        Fault("evaluate {run}", 2, "'bogus'", variables="JAX_PLATFORMS=bogus"),
        Fault("report {run}", 2, "'bogus'", variables="JAX_PLATFORMS=bogus"),
        Fault("theory --toy --out {new}", 2, "'bogus'", variables="JAX_PLATFORMS=bogus"),
        Fault(TRAIN, 0, shell='JAX_PLATFORMS=cuda "$@" 2>&-; "$@"', same=True),
    ),
    "variables that must change no result": (
        harmless("JAX_ENABLE_X64=1"),
        harmless("JAX_DEBUG_NANS=1"),
        harmless("JAX_DEBUG_INFS=1"),
        harmless("JAX_DISABLE_JIT=1"),
        harmless("JAX_DEBUG_KEY_REUSE=1"),
        harmless("JAX_CHECK_TRACER_LEAKS=1"),
        harmless("JAX_NUMPY_RANK_PROMOTION=raise"),
        harmless("JAX_NUMPY_DTYPE_PROMOTION=strict"),
        harmless("JAX_TRANSFER_GUARD=disallow"),
        harmless("JAX_RAISE_PERSISTENT_CACHE_ERRORS=1 JAX_COMPILATION_CACHE_DIR={empty}"),
        Fault("evaluate {run}", 0, "/proc/none", variables="JAX_COMPILATION_CACHE_DIR=/proc/none"),
        harmless("XDG_CACHE_HOME={file}", "compiled again"),
        harmless("-HOME -XDG_CACHE_HOME"),
        Fault("evaluate {run}", 0, "again", variables="HOME=/proc/none -XDG_CACHE_HOME"),
        harmless("TMPDIR=/no/such/folder"),
        harmless("MPLBACKEND=bogus"),
        harmless("MPLCONFIGDIR={file}"),
        harmless("MUJOCO_GL=bogus"),
        harmless("OMP_NUM_THREADS=many"),
        harmless("CUDA_VISIBLE_DEVICES=7"),
        harmless("PYTHONWARNINGS=error"),
        harmless("PYTHONOPTIMIZE=2"),
        harmless("PYTHONDONTWRITEBYTECODE=1"),
        harmless("TZ=Mars/Olympus"),
        harmless("TERM=bogus"),
    ),
    "encodings": (
        shown("PYTHONIOENCODING=ascii"),
        shown("LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0"),
        shown("LC_ALL=bogus"),
        shown("PYTHONOPTIMIZE=2"),
        shown("COLUMNS=1"),
        shown("COLUMNS=many"),
        Fault("train --env λ", 2, "unknown env 'lambda'", variables="PYTHONIOENCODING=ascii"),
        harmless("PYTHONIOENCODING=ascii"),
        harmless("LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0"),
    ),
    "streams": (
        Fault(VERIFY, 141, shell='set -o pipefail; "$@" | true'),
        Fault("train --help", 141, shell='set -o pipefail; "$@" | true'),
        Fault(VERIFY, 0, shell='"$@" | head -1'),
        Fault(VERIFY, 1, "cannot write to standard output", shell='"$@" > /dev/full'),
        Fault("train --help", 1, "cannot write to standard output", shell='"$@" > /dev/full'),
        Fault("--help", 1, "cannot write to standard output", shell='"$@" > /dev/full'),
        Fault(TRAIN, 1, "cannot write to standard output", '"$@" > /dev/full', same=True),
        Fault("evaluate {run}", 1, "cannot write to standard output", '"$@" > /dev/full'),
        Fault(VERIFY, 0, shell='"$@" >&-'),
        Fault(VERIFY, 0, shell='"$@" 2>&-'),
        Fault(VERIFY, 0, shell='"$@" <&-'),
        Fault("verify {missing}", 2, shell='"$@" 2>&-'),
        Fault("verify {missing}", 2, shell='"$@" 2> /dev/full'),
        Fault(TRAIN, 0, shell='"$@" <&- >&- 2>&-', same=True),
        Fault(TRAIN, 0, shell='"$@" 2> /dev/full', same=True),
    ),
    "limits": (
        Fault(TRAIN, 2, "ulimit -v", shell='ulimit -v 1000000; "$@"'),
        Fault(TRAIN, 1, "File too large", shell='ulimit -f 1; "$@"'),
        Fault(TRAIN, 2, "may open 24 files", shell='ulimit -n 24; "$@"'),
        Fault(TRAIN, 0, shell='ulimit -s 1024; "$@"', same=True),
        Fault(TRAIN, 0, shell='ulimit -c 0; "$@"', same=True),
        Fault(f"{TOO_LARGE} --out {{new}}", 2, "of memory, but this machine has"),
        Fault(f"{TOO_LARGE} --out {{new}}", 2, "(ulimit -v)", 'ulimit -v 8000000; "$@"'),
        Fault("train --hidden-size 100000 --out {new}", 2, "hidden-size is 100000, so the run"),
        Fault("train --num-seeds 100000 --out {new}", 2, "num-seeds is 100000, so the run"),
        Fault("train --num-starts 2000000000 --out {new}", 2, "num-starts is 2000000000, so"),
        Fault("evaluate {run} --episodes 100000000", 2, "choose fewer"),
        Fault("report {run} --episodes 100000000", 2, "choose fewer"),
        Fault("evaluate {run}", 2, "is not writable", READ_ONLY + COMMAND, apart=True),
        Fault("report {run}", 2, "is not writable", READ_ONLY + COMMAND, apart=True),
        Fault(VERIFY, 0, "", READ_ONLY + COMMAND, apart=True),
        Fault("train --resume --out {run}", 2, "not writable", READ_ONLY + COMMAND, apart=True),
        Fault("train --overwrite --out {run}", 2, "not writable", READ_ONLY + COMMAND, apart=True),
    ),
    "paths": (
        to("'{empty}/a b'", 0),
        to("{empty}/ümläut-λ", 0),
        to("'{empty}/100%#?&*'", 0),
        to("$'{empty}/line\\nbreak'", 0),
        to("$'{empty}/\\xff'", 2, "must be UTF-8"),
        to("{empty}/x/../y", 0),
        to("{empty}/slash/", 0),
        Fault("train --preset smoke --env pendulum --out=-dash", 0, shell='cd {empty}; "$@"'),
        Fault("verify -- -dash", 2, "not the directory of a run"),
        Fault("train --preset smoke --env pendulum --out '~'", 0, shell='cd {empty}; "$@"'),
        Fault("train --preset smoke --env pendulum", 2, "cannot write", LEAVING + COMMAND),
        Fault(VERIFY, 0, shell=LEAVING + COMMAND),
        to("{link}", 0),
        to("{begun}", 0),
        to("{dangling}", 2, "a broken link"),
        to("{file}", 2, "already exists"),
        to("{file}/run", 2, "cannot write"),
        to("{fifo}", 2, "already exists"),
        to("/dev/null", 2, "already exists"),
        to("/proc/none", 2, "cannot write"),
        to("{empty}/" + "a" * 300, 2, "File name too long"),
        to("''", 2, "out is empty"),
        to("{foreign}", 2, "already exists"),
        to("'{foreign}' --overwrite", 2, "left alone"),
        to("{logs}", 2, "already exists"),
        Fault("verify ''", 2, "not the directory of a run"),
        Fault("verify {file}", 2, "not the directory of a run"),
        Fault("verify " + "a" * 5000, 2, "not the directory of a run"),
    ),
}


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields a row for each group; it lists the faults with a wrong result."""
    places = _places(folder)
    if short:  # no run is trained
        files.write_config(places["run"], preset("smoke", env="pendulum"), {}, {})
    else:
        for name in ("run", "undisturbed"):
            smoke.train_pendulum(places[name])
        shutil.copy(places["run"] / files.CONFIG, places["begun"])
    for name, faults in GROUPS.items():
        chosen = [f for f in faults if _is_cheap(f)][:1] if short else faults
        wrong = []
        for i, fault in enumerate(chosen):
            what, seconds = _cause(fault, places, folder / f"{name}{i}".replace(" ", "_"))
            label = " ".join(filter(None, (fault.variables, fault.shell, fault.arguments)))
            common.progress({"fault": label, "seconds": seconds, "wrong": what})
            wrong += [f"{label}: {what}"] * bool(what)
        yield {
            "fault": name,
            "times": len(chosen),
            "met as they should be": len(chosen) - len(wrong),
            "wrong": wrong,
            "passed": not wrong,
        }


def _is_cheap(fault: Fault) -> bool:
    """Whether it neither trains nor needs a trained run."""
    return fault.code != 0 and "{run}" not in fault.arguments and not fault.same


def _places(folder: Path) -> dict[str, Path]:
    """Paths by what is wrong with them."""
    names = ("missing", "empty", "run", "file", "fifo", "link", "dangling", "begun", "foreign")
    places = {name: folder / name for name in (*names, "logs", "gone", "undisturbed")}
    for name in ("empty", "run"):
        places[name].mkdir()
    places["file"].write_text("", encoding="utf-8")
    os.mkfifo(places["fifo"])
    (folder / "target").mkdir()
    places["link"].symlink_to("target")
    places["dangling"].symlink_to("nowhere")
    (places["begun"] / "checkpoints" / "unfinished-0+1").mkdir(parents=True)  # of a killed run
    for name in (files.METRICS, locks.LOCK):
        (places["begun"] / name).write_text("", encoding="utf-8")
    places["foreign"].mkdir()
    (places["foreign"] / files.CONFIG).write_text('{"model": "mine"}', encoding="utf-8")
    (places["logs"] / "tensorboard").mkdir(parents=True)
    return places


def _cause(fault: Fault, places: dict[str, Path], new: Path) -> tuple[str, float]:
    """Causes a fault; returns what is wrong with the result, or "", and the seconds."""
    places = places | {"new": new}
    places["gone"].mkdir(exist_ok=True)
    filled = {name: str(path) for name, path in places.items()}
    given = fault.variables.format(**filled).split()
    taken = [f"-u {word[1:]}" for word in given if word.startswith("-")]
    variables = " ".join([*taken, *(word for word in given if not word.startswith("-"))])
    words = fault.arguments.format(**filled)
    shell = fault.shell.format(**filled)
    script = f"set -- env {variables} {sys.executable} -m maxent_jax {words}; {shell}"
    apart = ["unshare", "--user", "--map-root-user", "--mount"] if fault.apart else []
    started = time.perf_counter()
    done = subprocess.run(
        [*apart, "bash", "-c", script],
        env=os.environ | {"PYTHONPATH": os.getcwd()},
        capture_output=True,
        timeout=UNLIMITED_SECONDS,
        check=False,
    )
    seconds = round(time.perf_counter() - started, 2)
    said = PROGRESS.sub("", done.stderr.decode(errors="replace"))
    closed = "2>&-" in fault.shell or "2> /dev/full" in fault.shell
    met = done.returncode == fault.code
    sentence = "note: " if fault.code == 0 else "error: "
    for right, otherwise in (
        (met, f"exit code {done.returncode}: {said[-300:]}"),
        ("Traceback" not in said, f"a traceback: {said[-300:]}"),
        (closed or fault.says in said, f"said: {said[-300:]}"),
        (closed or not fault.says or said.startswith(sentence), f"said: {said[:300]}"),
        (said.count("\n") == bool(fault.says) - (closed and bool(fault.says)), f"said: {said}"),
        (fault.code != 2 or seconds <= REFUSAL_SECONDS, f"took {seconds} s"),
        (fault.code != 2 or not new.exists(), "it left a directory"),
        (not fault.same or not met or smoke.same(places["undisturbed"], new), "other bits"),
    ):
        if not right:
            return otherwise, seconds
    return "", seconds
