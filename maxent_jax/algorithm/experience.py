"""What the replay stores: each state once, with its distances to the reference.

An item is a step. It holds the part of the reached state that the networks see, and an index to the
state that the step left: the previous step's item or, at an episode's start, an entry of the pool
of starts. Copies are whole episodes turned by a yaw. The replay stores their angles, features and
distances, and turns the states when it draws them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.components import Components
from maxent_jax.density.knn import knn_distances
from maxent_jax.sac import replay
from maxent_jax.sac.replay import Replay
from maxent_jax.types import Distances, Experience, Outcomes, Transition

POSITION_DIMS = 2  # the features that are metres, first in every feature map
# In a full ring the state that an item left may be overwritten. This concerns the oldest items:
# those of one vector step, and of the next one if the ring's end lies within it.
STEPS_WITHOUT_START = 2


class Reference(NamedTuple):
    """The states that define r_t: the first `num_filled` points."""

    points: jax.Array  # [M, F]
    num_filled: jax.Array  # [] int32


class Step(NamedTuple):
    """An item of the replay, in V = 1 + yaw_copies variants, of which the first is not turned."""

    state: jax.Array  # [num_seen] of the state reached, float32 or float16
    features: jax.Array  # [V, F] of the state reached, float32
    previous: jax.Array  # [] int32: the item with the state left, or -1 - its row in the starts
    following: jax.Array  # [] int32: the episode's next item, -1 if there is none
    action: jax.Array  # [A]
    terminated: jax.Array  # [] bool
    bonus: jax.Array  # [] episodic term, feature units
    angle: jax.Array | None  # [V - 1] radians, the same throughout an episode; None without copies
    distances: Distances  # [V]
    task: jax.Array | None = None  # [V] the task's reward; None without a task


def init(components: Components) -> Replay:
    """Returns an empty replay."""
    config = components.config
    scalar, variants = jnp.zeros(()), jnp.zeros(1 + config.learner.yaw_copies)
    step = Step(
        state=jnp.zeros(components.num_seen, config.learner.replay_dtype),
        features=jnp.zeros((1 + config.learner.yaw_copies, len(components.phi.names))),
        previous=jnp.zeros((), jnp.int32),
        following=jnp.zeros((), jnp.int32),
        action=jnp.zeros(components.sac.action_size),
        terminated=jnp.zeros((), bool),
        bonus=scalar,
        angle=variants[1:] if config.learner.yaw_copies else None,
        distances=Distances(variants, variants, variants),
        task=None if components.task is None else variants,
    )
    return replay.init(step, config.learner.replay_size)


def add(
    components: Components,
    reference: Reference,
    ring: Replay,
    transition: Transition,
    previous: jax.Array,
    bonus: jax.Array,
    key: jax.Array,
) -> tuple[Replay, jax.Array]:
    """Adds the valid transitions to the replay.

    Args:
      transition: [N, ...] one step of each environment.
      previous: [N] int32, as in Step.
      bonus: [N] episodic term, feature units.
      key: draws the yaw of the copies of episodes that begin.
    Returns:
      The replay, and [N] int32 the rows of the new items; beyond the end for invalid ones.
    """
    config = components.config
    angle = None
    if config.learner.yaw_copies:
        shape = (transition.valid.shape[0], config.learner.yaw_copies)
        angle = jax.random.uniform(key, shape, minval=-jnp.pi, maxval=jnp.pi)
        goes_on = (previous >= 0)[:, None]
        angle = jnp.where(goes_on, ring.items.angle[jnp.maximum(previous, 0)], angle)
    after = _variants(components, transition.next_observation, angle)
    step = Step(
        state=_encoded(components, transition.next_observation),
        features=after,
        previous=previous,
        following=jnp.full_like(previous, -1),
        action=transition.action,
        terminated=transition.terminated,
        bonus=bonus,
        angle=angle,
        distances=measure(
            components, reference, _variants(components, transition.observation, angle), after
        ),
        task=_task_rewards(components, transition, angle),
    )
    rows = replay.destinations(ring, transition.valid)
    ring = replay.add(ring, step, transition.valid)
    links = jnp.where(transition.valid & (previous >= 0), previous, config.learner.replay_size)
    following = ring.items.following.at[links].set(rows, mode="drop")
    return ring._replace(items=ring.items._replace(following=following)), rows


def sample(
    components: Components, ring: Replay, starts: jax.Array, shape: tuple[int, ...], key: jax.Array
) -> Experience:
    """Draws items uniformly with replacement, each with the steps that follow it.

    Args:
      starts: [R, D] the pool of states from which the episodes began.
      shape: of the draw.
    Returns:
      [*shape, ...]; observations are the part that the networks see, [*shape, num_seen].
    """
    config = components.config
    key_rows, key_variant = jax.random.split(key)
    items: Step = ring.items
    first = replay.draw(ring, shape, key_rows, skip=STEPS_WITHOUT_START * config.budget.num_envs)
    rows, taken = _successors(items, first, config.learner.return_steps)
    last, steps = rows[-1], jnp.stack(rows, axis=-1)

    in_ring, row, start = _address(items.previous[first])
    from_start = starts[:, : components.num_seen][start]
    observation = jnp.where(in_ring[..., None], items.state[row].astype(jnp.float32), from_start)
    next_observation = items.state[last].astype(jnp.float32)
    before = _features_left(components, items, starts, first)
    variant = jnp.zeros(shape, jnp.int32)
    if items.angle is not None:
        variant = jax.random.randint(key_variant, shape, 0, 1 + config.learner.yaw_copies)
        angle = _chosen(items.angle[first], jnp.maximum(variant - 1, 0))
        turned = (variant > 0)[..., None]
        rotate = lambda state: jnp.where(turned, _rotated(components, state, angle), state)
        observation, next_observation = rotate(observation), rotate(next_observation)
    of_variant = jnp.broadcast_to(variant[..., None], steps.shape)
    reached = _chosen(items.features[steps], of_variant[..., None], axis=-2)
    left = jnp.concatenate(
        [_chosen(before, variant[..., None], axis=-2)[..., None, :], reached[..., :-1, :]], axis=-2
    )
    return Experience(
        observation=observation,
        action=items.action[first],
        next_observation=next_observation,
        outcomes=Outcomes(
            features=left,
            next_features=reached,
            bonus=items.bonus[steps],
            terminated=items.terminated[steps],
            distances=jax.tree.map(lambda x: _chosen(x[steps], of_variant), items.distances),
            taken=jnp.stack(taken, axis=-1),
            task=None if items.task is None else _chosen(items.task[steps], of_variant),
        ),
        row=first,
    )


def _successors(
    items: Step, first: jax.Array, num_steps: int
) -> tuple[list[jax.Array], list[jax.Array]]:
    """The rows of n consecutive steps of an episode, and whether each exists; n arrays [...] each.

    After the episode's last step, its row is repeated.
    """
    rows, taken = [first], [jnp.ones(first.shape, bool)]
    for _ in range(num_steps - 1):
        following = items.following[rows[-1]]
        taken.append(taken[-1] & (following >= 0))
        rows.append(jnp.where(taken[-1], following, rows[-1]))
    return rows, taken


def measure_all(
    components: Components, reference: Reference, ring: Replay, starts: jax.Array
) -> Replay:
    """Measures all distances in the replay again, from the pool of `starts` [R, D]."""
    items: Step = ring.items
    every = jnp.arange(items.previous.shape[0])
    before = _features_left(components, items, starts, every)
    distances = measure(components, reference, before, items.features)
    return ring._replace(items=items._replace(distances=distances))


def measure(
    components: Components, reference: Reference, before: jax.Array, after: jax.Array
) -> Distances:
    """Measures the distances of transitions from the features of their ends.

    Args:
      before: [..., F] features of the state left.
      after: [..., F] features of the state reached.
    Returns:
      [...] each, feature units.
    """
    config = components.config

    def distance(features):
        dims = features.shape[-1]
        nearest = knn_distances(
            features.reshape(-1, dims),
            reference.points[:, :dims],
            config.intrinsic.num_neighbors,
            count=reference.num_filled,
        )
        return nearest[:, -1].reshape(features.shape[:-1])

    if not config.explores:  # no reward depends on them
        nothing = jnp.zeros(after.shape[:-1])
        return Distances(nothing, nothing, nothing)
    reached = distance(after)
    if config.intrinsic.shaping == 0:
        return Distances(reached, jnp.zeros_like(reached), jnp.zeros_like(reached))
    if config.intrinsic.shaping_space == "features":
        return Distances(reached, distance(before), reached)
    potential, next_potential = distance(jnp.stack([before, after])[..., :POSITION_DIMS])
    return Distances(reached, potential, next_potential)


def _address(previous: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Whether a previous item exists, its row if so, and the row in the starts if not."""
    return previous >= 0, jnp.maximum(previous, 0), jnp.maximum(-1 - previous, 0)


def _features_left(
    components: Components, items: Step, starts: jax.Array, rows: jax.Array
) -> jax.Array:
    """[..., V, F] of the states that the items in `rows` [...] left."""
    in_ring, row, start = _address(items.previous[rows])
    if items.angle is None and rows.size > starts.shape[0]:
        of_start = components.phi(starts)[start][..., None, :]
    else:
        angle = None if items.angle is None else items.angle[rows]
        of_start = _variants(components, starts[start], angle)
    return jnp.where(in_ring[..., None, None], items.features[row], of_start)


def _task_rewards(
    components: Components, transition: Transition, angle: jax.Array | None
) -> jax.Array | None:
    """Rewards [N, V] of the task for transitions and their copies; None without a task."""
    if components.task is None:
        return None
    pay, (observation, action, next_observation, *_) = components.task.pay, transition
    paid = pay(observation, action, next_observation, transition.reward)[:, None]
    if angle is None:
        return paid
    turned = [_rotated(components, s[:, None], angle) for s in (observation, next_observation)]
    actions = jnp.broadcast_to(action[:, None], (*angle.shape, action.shape[-1]))
    # No environment that can be turned has a reward of its own.
    return jnp.concatenate([paid, pay(turned[0], actions, turned[1], paid)], axis=-1)


def _variants(components: Components, state: jax.Array, angle: jax.Array | None) -> jax.Array:
    """Features [..., V, F] of states [..., D] and their copies."""
    features = components.phi(state)[..., None, :]
    if angle is None:
        return features
    turned = components.phi(_rotated(components, state[..., None, :], angle))
    return jnp.concatenate([features, turned], axis=-2)


def _rotated(components: Components, state: jax.Array, angle: jax.Array) -> jax.Array:
    assert components.torso is not None  # checked by Config
    state = jnp.broadcast_to(state, (*angle.shape, state.shape[-1]))
    return components.torso.rotate(state, angle)


def _chosen(values: jax.Array, index: jax.Array, axis: int = -1) -> jax.Array:
    """The entry at `index` along `axis`, which is dropped."""
    return jnp.take_along_axis(values, jnp.expand_dims(index, axis), axis).squeeze(axis)


def _encoded(components: Components, state: jax.Array) -> jax.Array:
    dtype, seen = components.config.learner.replay_dtype, state[..., : components.num_seen]
    if dtype == "float32":
        return seen
    largest = jnp.finfo(dtype).max
    return jnp.clip(seen, -largest, largest).astype(dtype)
