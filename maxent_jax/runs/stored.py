"""A state in the form in which checkpoints store it, and states that older releases stored.

Archive and visits are a separate item, so analysis neither loads nor reads the replay.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.algorithm import State
from maxent_jax.algorithm.experience import Step
from maxent_jax.algorithm.learner import Learner, Visits
from maxent_jax.envs.base import Episodes, Restarts
from maxent_jax.mixture import Archive
from maxent_jax.runs.progress import say


class Results(NamedTuple):
    """What analysis needs of a state. With several seeds, leaves have a leading axis [S, ...]."""

    archive: Archive
    visits: Visits
    random_visits: Visits


def items(state: State) -> dict[str, Any]:
    """Returns the two items of a checkpoint: the results, and the rest of the state."""
    learner = state.learner
    return {
        "results": Results(state.archive, learner.visits, learner.random_visits),
        "rest": state._replace(
            archive=None,  # type: ignore[arg-type]
            learner=learner._replace(visits=None, random_visits=None),  # type: ignore[arg-type]
        ),
    }


def encode(state: State) -> State:
    """Returns what Orbax stores: it accepts neither arrays without elements nor typed keys."""

    def of_leaf(x: Any) -> Any:
        if math.prod(x.shape) == 0:
            return None
        return jax.random.key_data(x) if _is_key(x) else x

    return jax.tree.map(of_leaf, state)


def decode(encoded: State, shapes: State, placed: State | None) -> State:
    """Returns the state that `encode` was given.

    Args:
      encoded: what `encode` returned, restored.
      shapes: of the state.
      placed: the sharding of each leaf; one device if None.
    """
    leaves, tree = jax.tree.flatten(shapes)
    shardings = [None] * len(leaves) if placed is None else jax.tree.leaves(placed)
    kept = iter(jax.tree.leaves(encoded))

    def of_leaf(shape: Any, sharding: Any) -> Any:
        if math.prod(shape.shape) == 0:
            return jnp.empty(shape.shape, shape.dtype, device=sharding)
        found = next(kept)
        return jax.random.wrap_key_data(found, impl=_key_impl(shape)) if _is_key(shape) else found

    return jax.tree.unflatten(tree, map(of_leaf, leaves, shardings))


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _key_impl(shape: Any) -> Any:
    return jax.random.key_impl(jnp.empty((), shape.dtype))


def abstract(shapes: State, placed: State | None = None) -> State:
    """Returns what Orbax must load, and on which devices."""
    if placed is None:
        device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
        placed = jax.tree.map(lambda _: device, shapes)
    # `encode` for shapes: its own functions compute, and a shape has no values.
    data = jax.eval_shape(
        lambda state: jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, state),
        shapes,
    )
    return jax.tree.map(
        lambda x, sharding: (
            None
            if math.prod(x.shape) == 0
            else jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)
        ),
        data,
        placed,
    )


def held_part(rest: State, held: Mapping[str, Any]) -> State:
    """Returns the part of the abstract state that a checkpoint holds.

    Orbax insists that a checkpoint has every array that it is asked for, in the same shape.

    Args:
      rest: abstract, as in `items`.
      held: the learner's fields in the checkpoint; older ones lack those added since.
    """

    def kept(fields: Any, those: Mapping[str, Any]) -> Any:
        return {name: x for name, x in fields._asdict().items() if name in those}

    learner = rest.learner
    episodes = learner.episodes
    if isinstance(episodes.restarts, Restarts):
        share: Any = episodes.restarts.share
        shape = held["episodes"]["restarts"]["share"].shape
        share = jax.ShapeDtypeStruct(shape, share.dtype, sharding=share.sharding)
        episodes = episodes._replace(restarts=episodes.restarts._replace(share=share))
    plane: Any = learner.plane
    if plane is None and held.get("plane") is not None:  # read, and dropped by `completed`
        where = learner.env_steps.sharding
        plane = jax.ShapeDtypeStruct(held["plane"].shape, jnp.bool_, sharding=where)
    learner = learner._replace(
        plane=plane,
        episodes=kept(episodes, held["episodes"]),
        replay=learner.replay._replace(
            items=kept(learner.replay.items, held["replay"]["items"]),
        ),
    )
    return rest._replace(learner=kept(learner, held))


def completed(rest: State, shapes: State, placed: State | None) -> State:
    """Returns the whole state, from the part that `held_part` describes.

    A checkpoint without a plane begins an empty one. Where positions are not metres there is none,
    whatever the checkpoint holds: older releases took them for metres in any environment.
    """
    learner: Any = rest.learner
    replay = learner["replay"]
    found = {
        "episodes": _with_share_of_each(Episodes(**learner["episodes"]), shapes, placed),
        "replay": replay._replace(items=Step(**replay.items)),
    }
    plane = shapes.learner.plane
    if plane is None:
        found["plane"] = None
    elif learner.get("plane") is None:
        say("note: an older release began this run: cells_1m counts from here on.")
        device = None if placed is None else placed.learner.plane
        found["plane"] = jnp.zeros(plane.shape, plane.dtype, device=device)
    return rest._replace(learner=Learner(**{**learner, **found}))


def _with_share_of_each(episodes: Episodes, shapes: State, placed: State | None) -> Episodes:
    """Episodes with a share of restarts for each; older checkpoints hold one for all of them."""
    restarts: Any = episodes.restarts
    wanted: Any = shapes.learner.episodes.restarts
    if not isinstance(restarts, Restarts) or restarts.share.shape == wanted.share.shape:
        return episodes
    num_envs, shape = shapes.learner.place.shape[-1], wanted.share.shape

    def of_each(of_all: jax.Array) -> jax.Array:
        of_agent = jnp.broadcast_to(jnp.arange(shape[-1]) < num_envs, shape)
        return jnp.where(of_agent, jnp.broadcast_to(of_all[..., None], shape), 0.0)

    where: Any = None if placed is None else placed.learner.episodes.restarts
    made = jax.jit(of_each, out_shardings=where and where.share)(restarts.share)
    return episodes._replace(restarts=restarts._replace(share=made))
