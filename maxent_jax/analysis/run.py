"""A run for analysis: its metrics, its policies, and what they visit in fresh episodes."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.export import Exported

from maxent_jax import components, mixture
from maxent_jax.algorithm import methods
from maxent_jax.analysis import dataset, export, weighing
from maxent_jax.analysis.episodes import Paths, paths
from maxent_jax.checks import check_seed, check_whole
from maxent_jax.components import Components
from maxent_jax.config import Config, tasks
from maxent_jax.config.registry import CORRECTIVE
from maxent_jax.density import histogram
from maxent_jax.mixture import Archive, occupancy
from maxent_jax.mixture.occupancy import Occupancy
from maxent_jax.mixture.scores import Scores, score
from maxent_jax.precision import in_32_bits
from maxent_jax.runs import memory
from maxent_jax.sac import agent
from maxent_jax.sac.agent import Policy

if TYPE_CHECKING:
    from pandas import DataFrame


class Summary(NamedTuple):
    """A policy's results in fresh episodes, under the reward that the mixture defines."""

    policy: int
    weight: float
    episode_return: float
    step_reward: float
    episode_length: float  # mean, steps
    mean_end: list[float]  # on the grid's axes


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """One seed of a run; `metrics` are columns with one entry per iteration, [T] or [T, ...].

    A run equals only itself, because its arrays have no single truth value.
    """

    path: Path
    config: Config
    metrics: dict[str, np.ndarray]
    seed: int
    mixture: Archive
    histogram: np.ndarray  # [bins, bins] states visited in training
    random_histogram: np.ndarray  # [bins, bins] states visited by the random baseline
    checkpoint: str = ""  # name of the one that was loaded; empty for a run made in memory

    @property
    def num_policies(self) -> int:
        """Number of policies in the mixture, the untrained one included."""
        return int(self.mixture.size)

    @property
    def weights(self) -> np.ndarray:
        """Weights [P] of the mixture's policies, 0 for empty slots."""
        if self.config.mixture.weights == CORRECTIVE and len(
            self.metrics.get("mixture_weights", ())
        ):
            return self.metrics["mixture_weights"][-1].astype(np.float32)
        return np.asarray(methods.make(self.config).weights[self.num_policies - 1])

    @property
    def components(self) -> Components:
        """The environment, the networks and the feature map of the run."""
        return components.make(self.config)

    def frame(self) -> "DataFrame":
        """Returns the metrics as a pandas frame, with one row per iteration.

        A metric with several numbers has a column for each: `weights_0`, `weights_1`, ...

        Raises:
          ImportError: pandas is not installed.
        """
        try:
            from pandas import DataFrame
        except ImportError:
            raise ImportError("Run.frame needs pandas: pip install pandas.") from None
        return DataFrame(_scalar_columns(self.metrics))

    @in_32_bits
    def features(self, states: jax.Array | np.ndarray) -> jax.Array:
        """Returns phi(s), [..., D] -> [..., F]; `components.phi.names` names the features."""
        return self.components.phi(jnp.asarray(states))

    def policy(
        self, index: int, deterministic: bool = False
    ) -> Callable[[jax.Array, jax.Array], jax.Array]:
        """Returns a policy as a function: state [..., D], key -> action [..., A] in [-1, 1].

        The function raises ValueError if a state is not [..., D].

        Args:
          index: of the policy; 0 is the untrained one.
          deterministic: act by the tanh of the Gaussian's mean; the key then changes nothing.
        Raises:
          IndexError: there is no policy `index`.
        """
        return functools.partial(_act, self.components, self._policy(index), deterministic)

    @in_32_bits
    def act(self, s: jax.Array, key: jax.Array, policy: int | None = None) -> jax.Array:
        """Draws actions [..., A] for states [..., D] by `policy`, or by one drawn by weight.

        The mixture draws a policy once per episode. To play it, draw one and use `Run.policy`.
        Without `policy`, it is drawn on the host at each call, so the call cannot be jitted.
        """
        key_draw, key_act = jax.random.split(key)
        if policy is None:
            policy = int(jax.random.choice(key_draw, self.weights.shape[0], p=self.weights))
        return self.policy(policy)(s, key_act)

    @in_32_bits
    def export_policy(self, index: int, deterministic: bool = False) -> Exported:
        """Exports a policy for use without this package; see `export.policy` for how to call it.

        Raises:
          IndexError: there is no policy `index`.
        """
        return export.policy(self.components.sac, self._policy(index), deterministic)

    @in_32_bits
    def occupancy(
        self,
        episodes_per_policy: int = 5,
        seed: int = 0,
        deterministic: bool | None = None,
        by_policy: bool = False,
    ) -> Occupancy:
        """Plays fresh episodes of the mixture, and weighs their states, as training evaluates it.

        Each policy plays equally often, and its states share its weight. With `pooled`, policies
        are drawn by weight instead. With `mixing` step, they are drawn at each step: no episode
        belongs to one policy, and `policy` and `episode_policy` are -1.

        Args:
          episodes_per_policy: times `num_policies` is the number of episodes in all.
          seed: of starts and actions.
          deterministic: the policies act by their means; None: as the config evaluates.
          by_policy: each policy plays equally often in any case. This changes nothing unless the
            config has `pooled` or `mixing` step. With `pooled`, every episode then counts by the
            weight of its policy; with `mixing` step, the states of a policy share its weight, and
            the occupancy is not that of the mixture.
        Raises:
          ValueError: episodes_per_policy < 1, the seed is out of range, or the episodes do not fit
            into memory.
        """
        check_whole("episodes_per_policy", episodes_per_policy, least=1)
        memory.check_episodes(self.config, episodes_per_policy * self.num_policies)
        key_starts, key_play = jax.random.split(_key(seed))
        num_episodes = episodes_per_policy * self.num_policies
        mean = self.config.evaluation.deterministic if deterministic is None else deterministic
        playing = self._components_by_policy if by_policy else self.components
        starts = jax.vmap(playing.env.reset)(jax.random.split(key_starts, num_episodes))
        weights = jnp.asarray(self.weights)
        found = _of_mixture(playing, self.mixture, weights, starts, key_play, False, bool(mean))
        if by_policy:
            return self._weighed(found)
        if self.config.mixture.mixing == "step":
            nobody, nobodys = -jnp.ones_like(found.episode_policy), -jnp.ones_like(found.policy)
            return found._replace(episode_policy=nobody, policy=nobodys)
        return found

    def occupancies(
        self, episodes_per_policy: int = 5, seed: int = 0
    ) -> tuple[Occupancy, Occupancy]:
        """Returns the occupancy to measure, and the one by policy, for scores and paths.

        They are the same object unless the config has `pooled` or `mixing` step.
        """
        visited = self.occupancy(episodes_per_policy, seed)
        if not self.config.mixture.pooled and self.config.mixture.mixing == "episode":
            return visited, visited
        return visited, self.occupancy(episodes_per_policy, seed, by_policy=True)

    @in_32_bits
    def occupancy_of(self, episodes: Paths) -> Occupancy:
        """Makes the occupancy of given episodes, at least one of each policy.

        It is weighted as `occupancy(by_policy=True)` is.

        Raises:
          ValueError: a policy has no episode, or an episode's policy is not in the mixture.
        """
        self._check_all_played(episodes.policy)
        states = jnp.asarray(episodes.states).swapaxes(0, 1)
        alive = jnp.asarray(episodes.alive).T
        policy, none = jnp.asarray(episodes.policy, jnp.int32), jnp.zeros((), jnp.int32)
        weights = jnp.asarray(self.weights)
        by_policy = self._components_by_policy
        return self._weighed(_of_episodes(by_policy, weights, policy, states, alive, none))

    def rollout(
        self, episodes_per_policy: int = 5, seed: int = 0, deterministic: bool | None = None
    ) -> Paths:
        """Plays fresh episodes of each policy and returns their paths.

        Args:
          episodes_per_policy: how many; one policy plays each, also with `mixing` step.
          seed: of starts and actions.
          deterministic: the policies act by their means; None: as the config evaluates.
        Raises:
          ValueError: episodes_per_policy < 1, the seed is out of range, or the episodes do not fit
            into memory.
        """
        return paths(self.occupancy(episodes_per_policy, seed, deterministic, by_policy=True))

    @in_32_bits
    def dataset(self, n: int, seed: int = 0, task: str = tasks.NONE) -> dict[str, np.ndarray]:
        """Collects `n` transitions of the mixture's fresh episodes, for offline RL.

        `np.savez_compressed(path, **run.dataset(n))` saves them; `dataset.collect` lists the keys.
        One policy, which draws its actions, plays each episode, also with `mixing` step and
        `deterministic`.

        Args:
          n: how many.
          seed: of the episodes.
          task: adds the rewards of this task, by name as in `config.tasks`; none adds none.
        Raises:
          ValueError: n < 1, or the transitions do not fit into memory.
          ConfigError (a ValueError): the environment has no such task, or the seed is out of range.
        """
        dataset.check(self.config, n)
        key = _key(seed)
        on_task = components.with_task(self.components, task)
        return dataset.collect(on_task, self.mixture, jnp.asarray(self.weights), n, key)

    @in_32_bits
    def scores(self, visited: Occupancy, seed: int = 0) -> Scores:
        """Scores each policy by its return under the reward that these states define.

        Raises:
          ValueError: a policy has no episode; `occupancy(by_policy=True)` has some of each.
        """
        self._check_all_played(visited.episode_policy)
        size = self.config.mixture.reference_size
        rows = mixture.draw_rows(visited.weight, size, _key(seed), visited.num_episodes)
        return _score(self.components, visited, visited.features[rows], rows, self.mixture)

    def summaries(self, visited: Occupancy, seed: int = 0) -> list[Summary]:
        """Summarises the episodes in `visited`, policy by policy; raises as `scores` does."""
        episodes, scores, weights = paths(visited), self.scores(visited, seed), self.weights
        ends = mean_ends(self, episodes)
        return [
            Summary(
                policy=i,
                weight=float(weights[i]),
                episode_return=float(scores.episode_return[i]),
                step_reward=float(scores.step_reward[i]),
                episode_length=float(episodes.alive[episodes.policy == i].sum(1).mean()),
                mean_end=ends[i].tolist(),
            )
            for i in range(self.num_policies)
        ]

    @in_32_bits
    def measures(self, visited: Occupancy, seed: int = 0) -> dict[str, float]:
        """Measures the mixture's coverage and entropies (nats), named as in the metrics.

        Episodes of policies of weight 0 do not count, as in training, which does not play them.
        """
        visited = weighing.without_weightless(visited, self.weights)
        measured = occupancy.measures(self.components, visited, _key(seed))
        return {name: value.item() for name, value in measured.items()}

    @in_32_bits
    def mixture_cells(self, visited: Occupancy) -> np.ndarray:
        """Returns the share of the mixture's states in each cell of the grid, [bins, bins]."""
        grid = self.components.grid
        return np.asarray(histogram.count(visited.states, grid, visited.weight))

    @property
    def _components_by_policy(self) -> Components:
        """The components with which policies play equally often, whatever the config says."""
        return components.make(self.config.replace(pooled=False, mixing="episode"))

    def _weighed(self, visited: Occupancy) -> Occupancy:
        """Episodes of which each belongs to one policy, weighted as the config says."""
        pools = self.config.mixture.pooled
        return weighing.pooled(visited, self.weights) if pools else visited

    def _check_all_played(self, episode_policy: jax.Array | np.ndarray) -> None:
        """Raises ValueError unless the episodes are of all policies of the mixture."""
        played = set(np.unique(episode_policy).tolist())
        if played != set(range(self.num_policies)):
            raise ValueError(
                f"episodes are of policies {sorted(played)}, but must be of all policies from 0 to "
                f"{self.num_policies - 1}: play them by rollout, or by occupancy(by_policy=True)"
            )

    def _policy(self, index: int) -> Policy:
        check_whole("policy", index)
        if not -self.num_policies <= index < self.num_policies:
            raise IndexError(
                f"policy is {index}, but the mixture has {self.num_policies}: choose from 0 to "
                f"{self.num_policies - 1}"
            )
        return mixture.policy(self.mixture, jnp.asarray(index % self.num_policies)).policy


def _key(seed: int) -> jax.Array:
    return jax.random.key(check_seed("seed", seed))


@in_32_bits
def _act(
    components: Components,
    policy: Policy,
    deterministic: bool,
    states: jax.Array,
    key: jax.Array,
) -> jax.Array:
    size = components.sac.observation_size
    if jnp.shape(states)[-1:] != (size,):
        raise ValueError(f"states have shape {jnp.shape(states)}, but must be [..., {size}]")
    return agent.act(components.sac, policy, jnp.asarray(states, jnp.float32), key, deterministic)


_of_mixture = jax.jit(occupancy.of_mixture, static_argnums=(0, 5, 6))
_of_episodes = jax.jit(occupancy.of_episodes, static_argnums=0)
_score = jax.jit(score, static_argnums=0)


def mean_ends(run: Run, episodes: Paths) -> np.ndarray:
    """Returns the mean end of each policy's episodes, [P, 2] on the grid's axes."""
    ends = _located_ends(run, episodes)
    return np.stack([ends[episodes.policy == i].mean(axis=0) for i in range(run.num_policies)])


def mean_end_distances(run: Run, episodes: Paths) -> np.ndarray:
    """Returns the mean distance from first to last state by policy, [P] on the grid's axes."""
    distance = np.linalg.norm(
        _located_ends(run, episodes) - _locate(run, episodes.states[:, 0]), axis=1
    )
    return np.stack([distance[episodes.policy == i].mean() for i in range(run.num_policies)])


def _located_ends(run: Run, episodes: Paths) -> np.ndarray:
    last = episodes.alive.sum(axis=1) - 1
    ends = episodes.states[np.arange(len(last)), np.maximum(last, 0)]
    return _locate(run, ends)


def _locate(run: Run, states: np.ndarray) -> np.ndarray:
    return np.asarray(histogram.locate(jnp.asarray(states), run.components.grid))


def _scalar_columns(metrics: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Metrics [T] unchanged, and each entry of metrics [T, ...] under its name and indices."""
    columns = {}
    for name, values in metrics.items():
        for index in np.ndindex(values.shape[1:]):
            columns["_".join([name, *map(str, index)])] = values[:, *index]
    return columns
