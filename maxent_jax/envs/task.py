"""A MuJoCo task is data and a few pure functions; one brax Env runs any of them."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from maxent_jax.density.histogram import Grid
from maxent_jax.envs import physics


class Task(NamedTuple):
    """What tells one environment from another.

    Functions take and give single or batched observations, [..., D].
    """

    name: str
    xml: str  # in gymnasium/envs/mujoco/assets
    frame_skip: int  # physics steps in a control step
    reset: Callable[[jax.Array, physics.PhysicsState], physics.PhysicsState]  # key, rest -> start
    observe: Callable[[physics.PhysicsState], jax.Array]
    healthy: Callable[[jax.Array], jax.Array]  # -> [...] bool
    flipped: Callable[[jax.Array], jax.Array]  # -> [...] bool: upside down
    heading_inputs: Callable[[jax.Array], jax.Array]  # -> [..., I], see ant.heading_inputs
    rotate: Callable[[jax.Array, jax.Array], jax.Array]  # turn the world about the vertical
    grid: Grid  # where coverage and histogram entropy are measured


class MujocoEnv(Env):
    """A brax environment around a Task. Nothing is rewarded; the time limit is the caller's.

    Args:
      task: which environment.
      backend: "auto", "mjx" or "mujoco".
      profile: "reference" or "fast", see physics.load_model.
      torque_limit: share of the control range that an action of 1 uses. Below 1 it departs from
        Gymnasium.
      end_flipped: also end an episode once the torso is upside down. Departs from Gymnasium.
    """

    def __init__(
        self,
        task: Task,
        backend: str = "auto",
        profile: str = "reference",
        torque_limit: float = 1.0,
        end_flipped: bool = False,
    ):
        self.task = task
        self.model = physics.load_model(task.xml, profile)
        self.dt = self.model.opt.timestep * task.frame_skip
        """Seconds in a control step."""
        self._backend = physics.resolve_backend(backend)
        self._step = physics.make_step(self.model, self._backend, task.frame_skip)
        low, high = self.model.actuator_ctrlrange.T
        self._control_center = jnp.asarray((high + low) / 2, jnp.float32)
        self._control_span = jnp.asarray((high - low) / 2 * torque_limit, jnp.float32)
        self._end_flipped = end_flipped

    def reset(self, rng: jax.Array) -> State:
        """A fresh random start, single; vmap it over keys for more."""
        nv = self.model.nv
        rest = physics.PhysicsState(
            jnp.asarray(self.model.qpos0, jnp.float32), jnp.zeros(nv), jnp.zeros(nv)
        )
        start = self.task.reset(rng, rest)
        zero = jnp.zeros(())
        return State(start, self.task.observe(start), zero, zero)

    def step(self, state: State, action: jax.Array) -> State:
        """One control step, single; an action in [-1, 1] spans the control range.

        Raises:
          ValueError: an action of the wrong size.
        """
        if action.shape[-1:] != (self.action_size,):
            raise ValueError(f"action has shape {action.shape}, expected [{self.action_size}]")
        control = self._control_center + self._control_span * jnp.clip(action, -1, 1)
        after = self._step(state.pipeline_state, control)
        observation = self.task.observe(after)
        healthy = self.task.healthy(observation)
        if self._end_flipped:
            healthy &= ~self.task.flipped(observation)
        return state.replace(
            pipeline_state=after, obs=observation, done=1.0 - healthy.astype(jnp.float32)
        )

    @property
    def observation_size(self) -> int:
        """D."""
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[-1]

    @property
    def action_size(self) -> int:
        """A."""
        return self.model.nu

    @property
    def backend(self) -> str:
        """What simulates: mjx or mujoco."""
        return self._backend
