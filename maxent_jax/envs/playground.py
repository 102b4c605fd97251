"""MuJoCo Playground's versions of the DeepMind Control Suite, in MJX, by name.

Source: Zakka et al. 2025, "MuJoCo Playground", arXiv 2502.08844.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from brax.envs.base import Env, State

from maxent_jax.config import registry

_PLACES = ("rootx", "rooty", "rootz")  # the suite's names of the slides that carry a body


class Kept(NamedTuple):
    """What MJX needs of its data to go on from a state."""

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    warmstart: jax.Array
    mocap_pos: jax.Array
    mocap_quat: jax.Array


class PlaygroundEnv(Env):
    """A brax environment for one of Playground's.

    If the body can move in a plane, its position there comes first in an observation. The suite
    leaves the position out, and coverage could not be measured without it. The rest is Playground's
    observation. `reward` is that of Playground's task.
    """

    def __init__(self, name: str, backend: str):
        """Loads the environment.

        Args:
          name: as Playground calls it, such as WalkerRun.
          backend: "warp", or else MJX in jax.
        Raises:
          ConfigError: Playground is not installed.
        """
        registry.check_installed(f"{registry.PLAYGROUND}{name}")
        import mujoco_playground

        self._backend, impl = ("warp", "warp") if backend == "warp" else ("mjx", "jax")
        self._state = mujoco_playground.State
        self._env = mujoco_playground.dm_control_suite.load(name, config_overrides={"impl": impl})
        self._places = _places(self._env.mj_model)
        with jax.numpy_rank_promotion("allow"):
            blank = jax.jit(self._env.reset)(jax.random.key(0))
        self._blank, self._metrics = blank.data, jax.tree.map(jnp.zeros_like, blank.metrics)
        self._num_observed = blank.obs.shape[-1]

    def reset(self, rng: jax.Array) -> State:
        """Returns a start of the suite's."""
        with jax.numpy_rank_promotion("allow"):  # MJX promotes ranks
            return self._as_brax(self._env.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        """Takes a control step of several physics steps, with an action [A] in [-1, 1]."""
        kept: Kept = state.pipeline_state
        data = self._blank.replace(
            qpos=kept.qpos,
            qvel=kept.qvel,
            act=kept.act,
            qacc_warmstart=kept.warmstart,
            mocap_pos=kept.mocap_pos,
            mocap_quat=kept.mocap_quat,
        )
        theirs = self._state(data, state.obs, state.reward, state.done, dict(self._metrics), {})
        with jax.numpy_rank_promotion("allow"):
            return self._as_brax(self._env.step(theirs, action))

    def _as_brax(self, theirs: Any) -> State:
        data = theirs.data
        kept = Kept(
            *(data.qpos, data.qvel, data.act, data.qacc_warmstart),
            *(data.mocap_pos, data.mocap_quat),
        )
        place = data.qpos[jnp.asarray(self._places, jnp.int32)]
        return State(kept, jnp.concatenate([place, theirs.obs]), theirs.reward, theirs.done)

    @property
    def observation_size(self) -> int:
        """D."""
        return len(self._places) + self._num_observed

    @property
    def action_size(self) -> int:
        """A."""
        return self._env.action_size

    @property
    def backend(self) -> str:
        """Returns mjx or warp."""
        return self._backend


def _places(model: mujoco.MjModel) -> list[int]:
    """The entries of qpos that say where the body is in its plane; none if it is fixed."""
    free = mujoco.mjtJoint.mjJNT_FREE
    for joint in range(model.njnt):
        if model.jnt_type[joint] == free:
            return [int(model.jnt_qposadr[joint]) + i for i in range(2)]
    slides = {
        model.joint(joint).name: int(model.jnt_qposadr[joint])
        for joint in range(model.njnt)
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    }
    return [slides[name] for name in _PLACES if name in slides]
