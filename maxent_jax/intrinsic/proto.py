"""Proto-RL: the distance from a state to its nearest among candidates that prototypes have drawn.

Yarats et al. 2021, "Reinforcement learning with prototypical representations", arXiv 2102.11271, as
in URLB for states (`agent/proto.py`). A state's embedding predicts, after a projection, to which
prototypes the next state belongs. A slow copy of the network embeds the next state, and
Sinkhorn-Knopp assigns the batch to all prototypes in equal shares. Each time that a batch is
rewarded, every prototype draws one of its states into a queue, in proportion to exp(similarity).
The reward is the distance to the third nearest in the queue. Differences:
- Embeddings have 50 entries (128 in URLB), projections 256 hidden units (512). URLB's predictor is
  linear in a state; ours has one hidden layer, in place of the encoder of images. States are not
  augmented.
- A batch is rewarded before it is learned from, as with every bonus. URLB first learns.
- A state ignores its copies among the candidates of its batch, see particles; in URLB they count.
- The queue starts empty. That of URLB starts with zeros, which lie at distance 1 from every state.
"""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from maxent_jax.density.knn import knn_distances
from maxent_jax.intrinsic import descent, particles, protocol
from maxent_jax.intrinsic.descent import Learned
from maxent_jax.intrinsic.protocol import EMBEDDING_SIZE, HIDDEN_SIZE, Bonus, Setting, Steps
from maxent_jax.sac.networks import Mlp
from maxent_jax.types import Metrics

# num_protos, queue_size, topk, tau and encoder_target_tau of URLB's proto.yaml.
NUM_PROTOTYPES, QUEUE_SIZE, NUM_NEIGHBORS = 512, 2048, 3
TEMPERATURE, TARGET_UPDATE_RATE = 0.1, 0.05
SINKHORN_ITERATIONS = 3
SQUARE_FLOOR = 1e-6  # of a squared length before it is divided by: bounds the slope at 0
EARLIER = -2  # the label of the candidates of earlier batches, which no row of a replay has


class Proto(NamedTuple):
    """The static part."""

    setting: Setting
    network: Mlp
    projector: Mlp
    optimizer: optax.GradientTransformation


class Parameters(NamedTuple):
    """Of the network that embeds states and of the projection, and the prototypes."""

    network: Any
    projector: Any
    prototypes: jax.Array  # [P, F] of length 1


class State(NamedTuple):
    """What is learned, the slow copy of the network, and the queue of candidates."""

    online: Learned
    target: Any
    queue: jax.Array  # [Q, F] embeddings, the newest first
    filled: jax.Array  # [] int32, how many of them were drawn
    key: jax.Array  # [2] uint32, of the next draw


def make(setting: Setting) -> Bonus:
    """Makes the bonus, the distance to the third nearest candidate, from 0 to 2."""
    proto = build(setting)
    return Bonus(
        init=functools.partial(init, proto),
        reward=functools.partial(reward, proto),
        learn=functools.partial(learn, proto),
    )


def build(setting: Setting) -> Proto:
    """Makes the static part."""
    return Proto(
        setting=setting,
        network=Mlp(1, HIDDEN_SIZE, EMBEDDING_SIZE),
        projector=Mlp(1, HIDDEN_SIZE, EMBEDDING_SIZE),
        optimizer=protocol.optimizer(setting),
    )


def init(proto: Proto, key: jax.Array) -> State:
    """Returns random networks and prototypes, and an empty queue."""
    key_network, key_projector, key_prototypes, key_draw = jax.random.split(key, 4)
    prototypes = jax.random.normal(key_prototypes, (NUM_PROTOTYPES, EMBEDDING_SIZE))
    parameters = Parameters(
        network=proto.network.init(key_network, jnp.zeros((1, proto.setting.num_features))),
        projector=proto.projector.init(key_projector, jnp.zeros((1, EMBEDDING_SIZE))),
        prototypes=_of_length_1(prototypes),
    )
    return State(
        online=descent.begin(proto.optimizer, parameters),
        target=parameters.network,
        queue=jnp.zeros((QUEUE_SIZE, EMBEDDING_SIZE)),
        filled=jnp.zeros((), jnp.int32),
        key=jax.random.key_data(key_draw),
    )


def reward(proto: Proto, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns the distance to the third nearest candidate, [B]; first adds those of the batch.

    Where fewer than three candidates are not copies of the state, the farthest of them counts; 0
    where there is none.
    """
    parameters = state.online.parameters
    key, key_draw = jax.random.split(jax.random.wrap_key_data(state.key))
    embedding = embed(proto, parameters.network, steps.next_features)
    drawn = draw(parameters.prototypes @ embedding.T, key_draw)
    queue = jnp.concatenate([embedding[drawn], state.queue[:-NUM_PROTOTYPES]])
    filled = jnp.minimum(state.filled + NUM_PROTOTYPES, QUEUE_SIZE)
    earlier = jnp.full(QUEUE_SIZE - NUM_PROTOTYPES, EARLIER, jnp.int32)
    nearest = knn_distances(
        *(embedding, queue, NUM_NEIGHBORS),
        exclude=steps.row,
        count=filled,
        labels=jnp.concatenate([steps.row[drawn], earlier]),
    )
    state = state._replace(queue=queue, filled=filled, key=jax.random.key_data(key))
    return state, particles.filled(nearest)[:, -1]


def learn(proto: Proto, state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """Takes one gradient step of networks and prototypes; the slow copy follows."""
    del key
    prototypes = state.online.parameters.prototypes
    reached = embed(proto, state.target, steps.next_features)
    assigned = sinkhorn(reached @ prototypes.T / TEMPERATURE)

    def loss(parameters):
        embedding = _embedding(proto, parameters.network, steps.features)
        projected = cast(jax.Array, proto.projector.apply(parameters.projector, embedding))
        scores = _of_length_1(projected) @ parameters.prototypes.T
        log_p = jax.nn.log_softmax(scores / TEMPERATURE)
        value = -jnp.mean(jnp.sum(assigned * log_p, axis=-1))
        return value, {"bonus_prototype_loss": value}

    online, metrics = descent.descend(proto.optimizer, state.online, loss)
    parameters = online.parameters
    parameters = parameters._replace(prototypes=_of_length_1(parameters.prototypes))
    target = optax.incremental_update(parameters.network, state.target, TARGET_UPDATE_RATE)
    online = online._replace(parameters=parameters)
    return state._replace(online=online, target=target), metrics


def embed(proto: Proto, network: Any, features: jax.Array) -> jax.Array:
    """Embeds features, [B, F] -> [B, E] of length 1."""
    return _of_length_1(_embedding(proto, network, features))


def draw(scores: jax.Array, key: jax.Array) -> jax.Array:
    """Draws a state for each prototype, in proportion to exp(score), [P, B] -> [P] int32."""
    # By the cumulative sum: noise for each pair, as in random.categorical, takes ten times as long.
    cumulative = jnp.cumsum(jnp.exp(scores), axis=-1)
    threshold = jax.random.uniform(key, (scores.shape[0], 1)) * cumulative[:, -1:]
    drawn = jnp.sum(cumulative <= threshold, axis=-1, dtype=jnp.int32)
    return jnp.minimum(drawn, scores.shape[1] - 1)  # if a threshold is rounded up to the total


def sinkhorn(scores: jax.Array) -> jax.Array:
    """Assigns states to prototypes so that all prototypes get nearly equal shares of the batch.

    Divides by the sums of columns and rows in turn, three times each (Cuturi 2013, as in SwAV).

    Args:
      scores: [B, P] similarities over the temperature.
    Returns:
      [B, P] shares of each state; rows sum to 1, columns to about B / P.
    """
    shares = jnp.exp(scores - jnp.max(scores))
    for _ in range(SINKHORN_ITERATIONS):
        shares /= jnp.sum(shares, axis=0, keepdims=True)
        shares /= jnp.sum(shares, axis=1, keepdims=True)
    return shares


def _embedding(proto: Proto, network: Any, features: jax.Array) -> jax.Array:
    inputs = protocol.scaled(proto.setting, features)
    return cast(jax.Array, proto.network.apply(network, inputs))


def _of_length_1(vectors: jax.Array) -> jax.Array:
    square = jnp.sum(vectors**2, axis=-1, keepdims=True)
    return vectors * jax.lax.rsqrt(jnp.maximum(square, SQUARE_FLOOR))
