"""Plays a run's policies in Gymnasium's environments, and compares with our simulator."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from numpy.typing import ArrayLike

from maxent_jax import analysis, components
from maxent_jax.analysis import Paths, Run
from maxent_jax.checks import NUM_SEEDS, check_seed
from maxent_jax.config import Config
from maxent_jax.errors import ConfigError

IDS = {"ant": "Ant-v4", "walker2d": "Walker2d-v4", "humanoid": "Humanoid-v4"}
NUM_SETS = 5  # sets of episodes in our simulator, which differ by chance alone


class RunTask(gymnasium.Wrapper):
    """Gymnasium's environment with the actions and states of a run's policies.

    Actions in [-1, 1] span the run's share of the control range, and states are float32, followed
    by the episode's skill if the run has skills. An episode also ends upside down if the run's do.
    Starts, physics, health and reward are Gymnasium's.
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
        self._skill = np.zeros(config.environment.skill_size, np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, low.shape)
        assert env.observation_space.shape is not None
        size = env.observation_space.shape[0] + self._skill.size
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Resets Gymnasium's environment; returns the state [D] and its info."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self._skill.size:
            direction = self.env.unwrapped.np_random.normal(size=self._skill.size)
            self._skill = np.asarray(direction / np.linalg.norm(direction), np.float32)
        return self._state(observation), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes one control step with the action [A] in [-1, 1]; returns the state [D] first."""
        control = self._control_center + self._control_span * np.clip(np.float64(action), -1, 1)
        observation, reward, terminated, truncated, info = self.env.step(control)
        state = self._state(observation)
        return state, float(reward), bool(terminated or self._ended(state)), truncated, info

    def _state(self, observation: np.ndarray) -> np.ndarray:
        return np.concatenate([observation.astype(np.float32), self._skill])


class Gap(NamedTuple):
    """A measure of the mixture in both simulators."""

    ours: float  # mean over NUM_SETS sets of episodes
    gymnasium: float  # of one set
    difference: float  # Gymnasium's minus ours
    chance: float  # root mean square difference between two sets in our simulator


def make(config: Config) -> RunTask:
    """Makes Gymnasium's environment for a run, with the run's time limit.

    Raises:
      ConfigError: Gymnasium has no such environment, or cannot make it on this machine.
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


def play(run: Run, policies: ArrayLike, seed: int = 0, deterministic: bool | None = None) -> Paths:
    """Plays episodes in Gymnasium, one after another.

    Args:
      policies: [E] ascending, the policy that plays each episode: `[2] * 5`, or for the mixture
        `mixture.assign_episodes(run.weights, 50, 0.5)`.
      seed: of Gymnasium's starts and of the actions.
      deterministic: the policies act by their means; None: as the config evaluates.
    Returns:
      The paths of the E episodes.
    Raises:
      ConfigError: as in `make`, or the seed is out of range.
      IndexError: there is no such policy.
    """
    policies, seed = np.asarray(policies), check_seed("seed", seed)
    env = make(run.config)
    mean = run.config.evaluation.deterministic if deterministic is None else deterministic
    acts = {i: jax.jit(run.policy(i, mean)) for i in np.unique(policies).tolist()}
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


def rollout(
    run: Run, episodes_per_policy: int = 5, seed: int = 0, deterministic: bool | None = None
) -> Paths:
    """Plays fresh episodes of each policy in Gymnasium; the counterpart of `Run.rollout`."""
    policies = np.repeat(np.arange(run.num_policies), episodes_per_policy)
    return play(run, policies, seed, deterministic)


def gap(run: Run, episodes_per_policy: int = 5, seed: int = 0) -> dict[str, Gap]:
    """Compares each measure of the same policies in Gymnasium and in our simulator.

    Gymnasium plays one set of episodes, and our simulator NUM_SETS sets of the same size. Two sets
    in our simulator also differ by about `chance`, so a smaller difference means nothing. One
    policy plays each episode, also in runs with `mixing` step, whose mixture is another.
    """
    seeds = [(check_seed("seed", seed) + i) % NUM_SEEDS for i in range(NUM_SETS)]
    theirs = measures(run, rollout(run, episodes_per_policy, seed), seed)
    ours = [measures(run, run.rollout(episodes_per_policy, s), s) for s in seeds]
    return {name: _gap([each[name] for each in ours], value) for name, value in theirs.items()}


def measures(run: Run, episodes: Paths, seed: int = 0) -> dict[str, float]:
    """Returns `Run.measures` of these episodes, and the distance from start to end by policy."""
    distances = analysis.mean_end_distances(run, episodes)
    named = {f"policy_{i}_end_distance": float(x) for i, x in enumerate(distances)}
    return run.measures(run.occupancy_of(episodes), seed) | named


def _episode(
    env: RunTask, act: Callable[[np.ndarray, jax.Array], jax.Array], keys: jax.Array
) -> np.ndarray:
    """[L, D]: the states reached, up to the episode's end."""
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
