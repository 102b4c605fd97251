"""A MuJoCo task, as data and a few pure functions, and the brax Env that runs any task."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from brax.envs.base import Env, State

from maxent_jax.checks import check_choice, check_number
from maxent_jax.config.registry import BACKENDS, PHYSICS
from maxent_jax.density.histogram import Grid
from maxent_jax.envs import mjx_backend, mujoco_backend, physics
from maxent_jax.envs.physics import Derived, Options, PhysicsState, Work
from maxent_jax.envs.torso import Torso
from maxent_jax.errors import ConfigError
from maxent_jax.precision import in_32_bits


class Task(NamedTuple):
    """What distinguishes one MuJoCo environment from another.

    Functions of an observation take single or batched ones, [..., D].
    """

    name: str
    xml: Path
    frame_skip: int  # physics steps of the XML in a control step
    reset: Callable[[jax.Array, PhysicsState], PhysicsState]  # key, rest -> start
    observe: Callable[[PhysicsState, Derived], jax.Array]
    healthy: Callable[[jax.Array], jax.Array]  # -> [...] bool
    grid: Grid  # where coverage and histogram entropy are measured
    derived: tuple[str, ...] = ()  # fields observed in addition to the state
    torso: Torso | None = None
    fast: Options = physics.REFERENCE  # the profile `fast`; the default: it has none


class MujocoEnv(Env):
    """A brax environment for a Task. It gives no reward and has no time limit.

    Args:
      task: the task.
      backend: "auto", "mjx", "mujoco" or "warp".
      profile: "reference" (the XML's options), "fast" (the task's), or Options.
      torque_limit: share of the control range that an action of 1 uses. Below 1 departs from
        Gymnasium.
      end_flipped: also end an episode when the torso is upside down. Departs from Gymnasium.
      end_unhealthy: end an episode when health fails, as Gymnasium does.
    Raises:
      ConfigError: the backend or profile is unknown or cannot run the task here, or the torque
        limit is outside (0, 1].
    """

    @in_32_bits
    def __init__(
        self,
        task: Task,
        backend: str = "auto",
        profile: str | Options = "reference",
        torque_limit: float = 1.0,
        end_flipped: bool = False,
        end_unhealthy: bool = True,
    ):
        self.task = task
        self._backend = resolve_backend(backend)
        if not 0 < check_number("torque_limit", torque_limit) <= 1:
            raise ConfigError(f"torque_limit is {torque_limit}, but must be in (0, 1].")
        options = _options(task, profile)
        self.model = physics.load_model(task.xml, options)
        """The MuJoCo model that is simulated."""
        _check(task, self.model, end_flipped)
        num_substeps = task.frame_skip * options.substeps
        self.dt = self.model.opt.timestep * num_substeps
        """Seconds in a control step."""
        if self._backend == "mujoco":
            self._physics = mujoco_backend.make(self.model, num_substeps, task.derived)
        else:
            impl = {"mjx": "jax", "warp": "warp"}[self._backend]
            self._physics = mjx_backend.make(self.model, num_substeps, task.derived, impl)
        low, high = self.model.actuator_ctrlrange.T
        self._control_center = jnp.asarray((high + low) / 2, jnp.float32)
        self._control_span = jnp.asarray((high - low) / 2 * torque_limit, jnp.float32)
        self._end_flipped = end_flipped
        self.end_unhealthy = end_unhealthy
        """Whether an episode ends when health fails."""

    @in_32_bits
    def reset(self, rng: jax.Array) -> State:
        """Draws the random start of a single episode; vmap it over keys for more."""
        nv = self.model.nv
        rest = PhysicsState(
            jnp.asarray(self.model.qpos0, jnp.float32), jnp.zeros(nv), jnp.zeros(nv)
        )
        start = self.task.reset(rng, rest)
        zero = jnp.zeros(())
        return State(start, self.task.observe(start, self._physics.derive(start)), zero, zero)

    @in_32_bits
    def step(self, state: State, action: jax.Array) -> State:
        """Takes one control step of a single episode; actions [A] in [-1, 1] span the controls.

        Raises:
          ValueError: the action has the wrong size.
        """
        control = self.control(action)
        return self._reached(state, *self._physics.step(state.pipeline_state, control))

    @in_32_bits
    def step_beside(
        self, state: State, action: jax.Array, work: Work, key: jax.Array
    ) -> tuple[State, Any]:
        """Takes one control step of N episodes while something else is computed.

        C MuJoCo steps on the cores that `work` leaves idle. Other simulators step afterwards.

        Args:
          state: [N, ...].
          action: [N, A] in [-1, 1].
          work: called with the key, once.
          key: typed.
        Returns:
          The states [N, ...] that `jax.vmap(self.step)` returns, and the result of `work`.
        Raises:
          ValueError: the action has the wrong size.
        """
        if self._physics.step_beside is None:
            result, _ = work(key)
            return jax.vmap(self.step)(state, action), result
        control = jax.vmap(self.control)(action)
        reached, result = self._physics.step_beside(state.pipeline_state, control, work, key)
        return jax.vmap(self._reached)(state, *reached), result

    def control(self, action: jax.Array) -> jax.Array:
        """Returns the controls of actions, [..., A] in [-1, 1] -> [..., A] in the model's units.

        Raises:
          ValueError: the action has the wrong size.
        """
        action = jnp.clip(check_action(self, action), -1, 1)
        center, span = jnp.broadcast_arrays(self._control_center, self._control_span, action)[:2]
        return center + span * action

    def _reached(self, state: State, after: PhysicsState, derived: Derived) -> State:
        observation = self.task.observe(after, derived)
        healthy = jnp.array(True)
        if self.end_unhealthy:
            healthy = self.task.healthy(observation)
        if self._end_flipped:
            assert self.task.torso is not None
            healthy &= ~self.task.torso.flipped(observation)
        return state.replace(
            pipeline_state=after, obs=observation, done=1.0 - healthy.astype(jnp.float32)
        )

    @property
    def observation_size(self) -> int:
        """The size of an observation, D."""
        return observation_size(self)

    @property
    def action_size(self) -> int:
        """The size of an action, A."""
        return self.model.nu

    @property
    def backend(self) -> str:
        """The simulator: mjx, mujoco or warp."""
        return self._backend


def resolve_backend(backend: str) -> str:
    """Returns the backend to run: "auto" is `mujoco` on a CPU and `mjx` on other devices.

    Raises:
      ConfigError: the backend is unknown.
    """
    check_choice("backend", backend, BACKENDS)
    if backend == "auto":
        return "mujoco" if jax.default_backend() == "cpu" else "mjx"
    return backend


def observation_size(env: Env) -> int:
    """Returns D from shapes alone: brax's own `observation_size` runs the simulator."""
    return jax.eval_shape(env.reset, jax.random.key(0)).obs.shape[-1]


def check_action(env: Env, action: jax.Array) -> jax.Array:
    """Returns the action [..., A] in float32; raises ValueError if its last axis is not A."""
    action = jnp.asarray(action, jnp.float32)
    if action.shape[-1:] != (env.action_size,):
        raise ValueError(f"action has shape {action.shape}, expected [{env.action_size}]")
    return action


def uniform_reset(noise: float) -> Callable[[jax.Array, PhysicsState], PhysicsState]:
    """Returns Gymnasium's usual reset: the rest pose with uniform noise in every coordinate."""

    def reset(key: jax.Array, rest: PhysicsState) -> PhysicsState:
        key_qpos, key_qvel = jax.random.split(key)
        draw = lambda key, like: jax.random.uniform(key, like.shape, minval=-noise, maxval=noise)
        return rest._replace(
            qpos=rest.qpos + draw(key_qpos, rest.qpos), qvel=draw(key_qvel, rest.qvel)
        )

    return reset


def _options(task: Task, profile: str | Options) -> Options:
    if isinstance(profile, Options):
        return profile
    check_choice("physics", profile, PHYSICS)
    if profile == "reference":
        return physics.REFERENCE
    if task.fast == physics.REFERENCE:
        raise ConfigError(
            f"physics is fast, but {task.name} has no simplified physics: choose reference, or "
            f"pass `fast` to envs.from_xml."
        )
    return task.fast


def _check(task: Task, model: mujoco.MjModel, end_flipped: bool) -> None:
    if not model.nv:
        raise ConfigError(f"{task.xml.name} has no joints, so nothing can move: add a joint.")
    if model.na:
        raise ConfigError(
            f"{task.xml.name} has actuators with an internal state (activations), which is not "
            "supported: use stateless actuators."
        )
    low, high = model.actuator_ctrlrange.T
    if not (low < high).all():
        raise ConfigError(
            f"actuator '{model.actuator(int((low >= high).argmax())).name}' of {task.xml.name} has "
            f"no control range, to which actions are scaled: give it a ctrlrange."
        )
    if end_flipped and task.torso is None:
        raise ConfigError(f"{task.name} has no floating torso: end_flipped must be False.")
