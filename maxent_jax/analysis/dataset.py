"""Transitions of a mixture's episodes, for offline reinforcement learning."""

import functools
import itertools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax import mixture
from maxent_jax.checks import check_whole
from maxent_jax.components import Components
from maxent_jax.config import Config
from maxent_jax.envs.base import State
from maxent_jax.envs.physics import PhysicsState
from maxent_jax.mixture import Archive, occupancy
from maxent_jax.runs import memory

EPISODES_AT_ONCE = 32


def check(config: Config, num: int) -> None:
    """Checks that `num` transitions can be collected.

    Raises:
      ValueError: num < 1, or the transitions do not fit into memory.
    """
    if check_whole("n", num) < 1:
        raise ValueError(f"a dataset needs at least 1 transition, not {num}")
    memory.check_rows(config, num, "transitions")


def collect(
    components: Components, archive: Archive, weights: jax.Array, num: int, key: jax.Array
) -> dict[str, np.ndarray]:
    """Collects n transitions, episode by episode; one policy, drawn by weight, plays each episode.

    | key               | shape, type   | what                                                     |
    |-------------------|---------------|----------------------------------------------------------|
    | observations      | [n, D] float32| the state left                                           |
    | actions           | [n, A] float32| in [-1, 1]; ±1 is `torque_limit` times the control range |
    | next_observations | [n, D] float32| the state reached, also at an episode's end              |
    | terminals         | [n] bool      | the episode ended in the state reached: no return beyond |
    | timeouts          | [n] bool      | the episode was cut after this step, see below           |
    | policy            | [n] int32     | the policy that played                                   |
    | features          | [n, F] float32| phi of the state reached                                 |

    An episode is cut at its time limit, before a step whose state is not finite, and at the last
    row. Every episode's last row is a terminal or a timeout, and no other row is either.

    With a task there is also its reward, `rewards` [n] float32. An intrinsic reward can be computed
    from the states reached, by `rewards.knn_reward(features, ...)`.

    Args:
      components: of the run; its task is the one that is rewarded.
      weights: [P] of the policies.
      num: n. EPISODES_AT_ONCE episodes are in memory in addition to the rows.
    Returns:
      The arrays of the table.
    Raises:
      ValueError: num < 1, the rows do not fit into memory, or no episode has a finite first step.
    """
    check(components.config, num)
    rows: dict[str, np.ndarray] = {}
    filled = 0
    for found in stream(components, archive, weights, key):
        if not rows:
            rows = {name: np.empty((num, *x.shape[1:]), x.dtype) for name, x in found.items()}
        taken = min(num - filled, len(found["policy"]))
        for name, x in found.items():
            rows[name][filled : filled + taken] = x[:taken]
        filled += taken
        if filled == num:
            break
    rows["timeouts"][-1] = not rows["terminals"][-1]
    return rows


def stream(
    components: Components,
    archive: Archive,
    weights: jax.Array,
    key: jax.Array,
    first: int = 0,
    physics: bool = False,
) -> Iterator[dict[str, np.ndarray]]:
    """Yields the transitions of EPISODES_AT_ONCE episodes again and again, without an end.

    Args:
      weights: [P] of the policies.
      first: how many times to skip.
      physics: also yield the simulator's state before and after each transition, `physics` and
        `next_physics` [n, Q] float32: qpos and qvel of a MuJoCo model.
    Yields:
      The arrays of `collect`.
    Raises:
      ValueError: no episode has a finite first step.
    """
    for i in itertools.count():
        key, key_episodes = jax.random.split(key)
        if i < first:
            continue
        found = _in_order(*_episodes(components, archive, weights, physics, key_episodes))
        if not len(found["policy"]):
            raise ValueError(f"none of the {EPISODES_AT_ONCE} episodes has a finite first step")
        yield found


@functools.partial(jax.jit, static_argnums=(0, 3))
def _episodes(
    components: Components, archive: Archive, weights: jax.Array, physics: bool, key: jax.Array
) -> tuple[dict[str, jax.Array], jax.Array]:
    """[T, E, ...] of each key, and [T, E] bool: the entries that are transitions."""
    key_starts, key_assign, key_order, key_play = jax.random.split(key, 4)
    starts = jax.vmap(components.env.reset)(jax.random.split(key_starts, EPISODES_AT_ONCE))
    offset = jax.random.uniform(key_assign)
    policy = mixture.assign_episodes(weights, EPISODES_AT_ONCE, offset)
    # The last episodes may be cut off, and must not always be those of the newest policies.
    policy = jax.random.permutation(key_order, policy)
    reached = occupancy.play(components, archive, policy, starts, key_play)
    goes_on = jnp.concatenate([reached.alive[1:], jnp.zeros_like(reached.alive[:1])])
    rows = {
        "observations": jnp.concatenate([starts.obs[None], reached.states[:-1]]),
        "actions": reached.actions,
        "next_observations": reached.states,
        "terminals": reached.terminated,
        "timeouts": ~goes_on & ~reached.terminated,
        "policy": jnp.broadcast_to(policy, reached.alive.shape),
        "features": components.phi(reached.states),
    }
    if components.task is not None:
        before, own = rows["observations"], reached.env.reward
        rows["rewards"] = components.task.pay(before, reached.actions, reached.states, own)
    if physics:
        rows["next_physics"] = _simulator_state(reached.env)
        first = _simulator_state(starts)[None]
        rows["physics"] = jnp.concatenate([first, rows["next_physics"][:-1]])
    return rows, reached.alive


def _simulator_state(env: State) -> jax.Array:
    """[..., Q] of states with as many leading axes as `done`."""
    state = env.pipeline_state
    parts = (state.qpos, state.qvel) if isinstance(state, PhysicsState) else jax.tree.leaves(state)
    lead = env.done.shape
    return jnp.concatenate([x.reshape(*lead, -1).astype(jnp.float32) for x in parts], axis=-1)


def _in_order(rows: dict[str, jax.Array], there: jax.Array) -> dict[str, np.ndarray]:
    """[R, ...] of each key, one episode after the other."""
    mask = np.asarray(there).T
    return {name: np.asarray(x).swapaxes(0, 1)[mask] for name, x in rows.items()}
