"""A run's policies in Gymnasium's own environments, and how far these lead from our simulator's."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from numpy.typing import ArrayLike

from maxent_jax import analysis, components
from maxent_jax.analysis import Paths, Run
from maxent_jax.config import Config
from maxent_jax.errors import ConfigError

IDS = {"ant": "Ant-v4", "walker2d": "Walker2d-v4", "humanoid": "Humanoid-v4"}
NUM_SETS = 5  # sets of our own episodes, whose differences are chance alone


class RunTask(gymnasium.Wrapper):
    """Gymnasium's environment as a run's policies know it.

    Actions lie in [-1, 1] and span the run's share of the control range, states are float32, and an
    episode also ends upside down where the run says so. Starts, physics, health and reward are
    Gymnasium's.
    """

    def __init__(self, env: gymnasium.Env, config: Config):
        super().__init__(env)
        controls = env.action_space
        assert isinstance(controls, gymnasium.spaces.Box)
        low, high = controls.low.astype(np.float64), controls.high.astype(np.float64)
        self._control_center = (low + high) / 2
        self._control_span = (high - low) / 2 * config.environment.torque_limit
        self._ended = _never
        if config.environment.end_flipped:
            torso = components.make(config).torso
            assert torso is not None  # checked by MujocoEnv
            self._ended = jax.jit(torso.flipped)
        self.action_space = gymnasium.spaces.Box(-1, 1, low.shape)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, env.observation_space.shape)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A start of Gymnasium's."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation.astype(np.float32), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step."""
        control = self._control_center + self._control_span * np.clip(np.float64(action), -1, 1)
        observation, reward, terminated, truncated, info = self.env.step(control)
        state = observation.astype(np.float32)
        return state, float(reward), bool(terminated or self._ended(state)), truncated, info


class Gap(NamedTuple):
    """A measure of the mixture in both simulators."""

    ours: float  # mean over NUM_SETS sets of episodes
    gymnasium: float  # of one set
    difference: float  # Gymnasium's less ours
    chance: float  # between two sets of our own, root mean square


def make(config: Config) -> RunTask:
    """Gymnasium's environment of a run, with its time limit.

    Raises:
      ConfigError: there is none, or Gymnasium cannot make it here.
    """
    if config.env not in IDS:
        raise ConfigError(f"{config.env} is not played in Gymnasium: only {', '.join(IDS)} are.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # v5 exists; the paper's is v4
            env = gymnasium.make(
                IDS[config.env],
                max_episode_steps=config.environment.episode_length,
                disable_env_checker=True,
                exclude_current_positions_from_observation=False,
                terminate_when_unhealthy=config.environment.end_unhealthy,
            )
    except (gymnasium.error.Error, ImportError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f'Gymnasium cannot make {IDS[config.env]} (pip install "gymnasium[mujoco]"): {reason}'
        ) from None
    return RunTask(env, config)


def play(run: Run, policies: ArrayLike, seed: int = 0) -> Paths:
    """Episodes in Gymnasium, one after another.

    Args:
      policies: [E] ascending, who plays each: `[2] * 5`, or for the mixture
        `mixture.assign_episodes(run.weights, 50, 0.5)`.
      seed: of Gymnasium's starts and of the actions.
    Raises:
      ConfigError: as make. IndexError: no such policy.
    """
    policies = np.asarray(policies)
    env = make(run.config)
    acts = {i: jax.jit(run.policy(i)) for i in np.unique(policies).tolist()}
    length = run.config.environment.episode_length
    states = np.zeros((len(policies), length, run.components.sac.observation_size), np.float32)
    alive = np.zeros((len(policies), length), bool)
    keys = jax.random.split(jax.random.key(seed), len(policies))
    env.reset(seed=seed)
    for i, policy in enumerate(policies.tolist()):
        reached = _episode(env, acts[policy], jax.random.split(keys[i], length))
        states[i, : len(reached)] = reached
        alive[i, : len(reached)] = True
    env.close()
    return Paths(states, alive, policies)


def rollout(run: Run, episodes_per_policy: int = 5, seed: int = 0) -> Paths:
    """Run.rollout in Gymnasium: fresh episodes of each policy, as paths."""
    return play(run, np.repeat(np.arange(run.num_policies), episodes_per_policy), seed)


def gap(run: Run, episodes_per_policy: int = 5, seed: int = 0) -> dict[str, Gap]:
    """How the same policies do in Gymnasium and in our simulator, by measure.

    Gymnasium plays one set of episodes, and our simulator NUM_SETS as large ones. A difference
    that is no larger than `chance` is one that two sets of our own have too.
    """
    seeds = range(seed, seed + NUM_SETS)
    theirs = measures(run, rollout(run, episodes_per_policy, seed), seed)
    ours = [measures(run, run.rollout(episodes_per_policy, s), s) for s in seeds]
    return {name: _gap([each[name] for each in ours], value) for name, value in theirs.items()}


def measures(run: Run, episodes: Paths, seed: int = 0) -> dict[str, float]:
    """Run.measures of these episodes, and how far from its start each policy ends."""
    distances = analysis.mean_end_distances(run, episodes)
    named = {f"policy_{i}_end_distance": float(x) for i, x in enumerate(distances)}
    return run.measures(run.occupancy_of(episodes), seed) | named


def _episode(
    env: RunTask, act: Callable[[np.ndarray, jax.Array], jax.Array], keys: jax.Array
) -> np.ndarray:
    """[L, D]: the states reached, to the episode's end."""
    reached = []
    state, _ = env.reset()
    for key in keys:
        state, _, terminated, truncated, _ = env.step(np.asarray(act(state, key)))
        if not np.isfinite(state).all():
            break
        reached.append(state)
        if terminated or truncated:
            break
    return np.array(reached, np.float32).reshape(-1, state.size)


def _gap(ours: list[float], theirs: float) -> Gap:
    mean = float(np.mean(ours))
    chance = float(np.sqrt(2) * np.std(ours, ddof=1))
    return Gap(mean, theirs, theirs - mean, chance)


def _never(_: np.ndarray) -> bool:
    return False
