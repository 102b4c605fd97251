"""The replay of a rollout against the same transitions kept in full, in plain Python lists."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from maxent_jax import components
from maxent_jax.algorithm import experience, payment
from maxent_jax.algorithm.experience import Reference
from maxent_jax.config import preset
from maxent_jax.types import Distances, Outcomes, Transition

NUM_ENVS, CAPACITY, SIZE = 3, 24, 29
STARTS = 5


def make(**changes):
    """A small ring, Ant's unless said; the environment itself is not stepped."""
    sizes = dict(num_envs=NUM_ENVS, replay_size=CAPACITY, batch_size=4)
    budget = dict(updates_per_step=1.0, steps_per_iteration=NUM_ENVS * 15)
    return components.make(preset("quick", **{**sizes, **budget, "return_steps": 1, **changes}))


def states(rng, num, size=SIZE):
    """Random states of a robot whose quaternions have unit length."""
    drawn = rng.standard_normal((num, size)).astype(np.float32)
    drawn[:, 3:7] /= np.linalg.norm(drawn[:, 3:7], axis=1, keepdims=True)
    return drawn


def reference(rng, features):
    return Reference(
        jnp.asarray(rng.standard_normal((64, features)).astype(np.float32)), jnp.asarray(64)
    )


def filled(p, num_steps, seed=0, invalid=0.1):
    """A ring after so many steps of all envs, and the full transitions that it was told of."""
    rng = np.random.default_rng(seed)
    size, num_actions = p.sac.observation_size, p.sac.action_size
    starts, measured_against = states(rng, STARTS, size), reference(rng, len(p.phi.names))
    add = jax.jit(functools.partial(experience.add, p))
    ring = experience.init(p)
    start = rng.integers(0, STARTS, NUM_ENVS)
    current, place = starts[start], -1 - start
    told = []
    for step in range(num_steps):
        reached = states(rng, NUM_ENVS, size)
        terminated, truncated = rng.random((2, NUM_ENVS)) < 0.15
        valid = rng.random(NUM_ENVS) >= invalid
        terminated |= ~valid
        reached = np.where(valid[:, None], reached, current)
        action = rng.uniform(-1, 1, (NUM_ENVS, num_actions)).astype(np.float32)
        bonus = rng.random(NUM_ENVS).astype(np.float32)
        own = np.zeros(NUM_ENVS, np.float32)
        transition = Transition(current, action, reached, terminated, truncated, valid, own)
        ring, rows = add(
            measured_against, ring, jax.tree.map(jnp.asarray, transition), jnp.asarray(place),
            jnp.asarray(bonus), jax.random.key(step),
        )  # fmt: skip
        told += [
            (current[i], action[i], reached[i], terminated[i], bonus[i])
            for i in np.flatnonzero(valid)
        ]
        ended = terminated | truncated
        start = rng.integers(0, STARTS, NUM_ENVS)
        current = np.where(ended[:, None], starts[start], reached)
        place = np.where(ended, -1 - start, rows)
    return ring, jnp.asarray(starts), measured_against, told


def drawn_from(p, ring, starts, num, seed=0):
    sample = jax.jit(functools.partial(experience.sample, p, shape=(num,)))
    return jax.tree.map(np.asarray, sample(ring, starts, key=jax.random.key(seed)))


def index_of(drawn, told):
    """Which transition each drawn one is, by its action; actions are all different."""
    actions = np.stack([action for _, action, _, _, _ in told])
    same = (drawn.action[:, None] == actions[None]).all(-1)
    assert (same.sum(1) == 1).all()
    return same.argmax(1)


def assert_measured(p, against, drawn):
    """The distances of what was drawn are those of the states that it shows."""
    ends = p.phi(drawn.observation), p.phi(drawn.next_observation)
    fresh = experience.measure(p, against, *ends)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b[:, 0], rtol=1e-4, atol=1e-5),
        fresh,
        drawn.outcomes.distances,
    )


@pytest.mark.parametrize(
    ("env", "num_steps"), [*(("ant", n) for n in (1, 4, 8, 9, 31)), ("humanoid", 31)]
)
def test_what_is_drawn_is_what_happened(env, num_steps):
    """Both ends of each transition, also after the ring went round, with episodes that ended.

    Of a Humanoid's, whose networks see the heading's frame, the positions and velocities.
    """
    p = make(env=env, yaw_copies=0)
    seen = {"ant": 29, "humanoid": 47}[env]
    ring, starts, _, told = filled(p, num_steps)
    drawn = drawn_from(p, ring, starts, 400)
    which = index_of(drawn, told)
    observation, _, reached, terminated, bonus = (
        np.stack(column)[which] for column in zip(*told, strict=True)
    )
    np.testing.assert_array_equal(drawn.observation, observation[:, :seen])
    np.testing.assert_array_equal(drawn.next_observation, reached[:, :seen])
    np.testing.assert_array_equal(drawn.outcomes.terminated[:, 0], terminated)
    np.testing.assert_array_equal(drawn.outcomes.bonus[:, 0], bonus)
    assert drawn.outcomes.taken.all()
    # to rounding: the programs that made them sum in another order
    exact = {"rtol": 1e-5, "atol": 1e-6}
    outcomes = jax.tree.map(lambda x: x[:, 0], drawn.outcomes)  # of the only step
    np.testing.assert_allclose(outcomes.features, p.phi(observation), **exact)
    np.testing.assert_allclose(outcomes.next_features, p.phi(reached), **exact)


@pytest.mark.parametrize("num_steps", [4, 31], ids=["part full", "gone round"])
def test_all_that_still_have_their_start_are_drawn_alike(num_steps):
    p = make(yaw_copies=0)
    ring, starts, _, told = filled(p, num_steps)
    left_out = 0 if len(told) < CAPACITY else experience.STEPS_WITHOUT_START * NUM_ENVS
    expected = np.arange(len(told))[-min(len(told), CAPACITY) :][left_out:]
    drawn = index_of(drawn_from(p, ring, starts, 20_000), told)
    values, counts = np.unique(drawn, return_counts=True)
    np.testing.assert_array_equal(values, expected)
    share = 20_000 / len(expected)
    assert (np.abs(counts - share) < 5 * np.sqrt(share)).all()


@pytest.mark.slow
def test_a_copy_is_the_transition_in_a_turned_world():
    """Both ends are turned alike, about the origin; heights and joints stay."""
    p = make(yaw_copies=3)
    ring, starts, against, told = filled(p, 6)
    drawn = drawn_from(p, ring, starts, 2000)
    which = index_of(drawn, told)
    turns = []
    for end, column in ((drawn.observation, 0), (drawn.next_observation, 2)):
        original = np.stack([row[column] for row in told])[which]
        np.testing.assert_allclose(end[:, 2], original[:, 2])
        np.testing.assert_array_equal(end[:, 7:15], original[:, 7:15])
        turns.append(
            np.angle((end[:, 0] + 1j * end[:, 1]) / (original[:, 0] + 1j * original[:, 1]))
        )
    difference = np.angle(np.exp(1j * (turns[0] - turns[1])))
    np.testing.assert_allclose(difference, 0, atol=1e-4)
    unturned = np.abs(turns[0]) < 1e-6
    assert abs(unturned.mean() - 1 / 4) < 0.05
    assert_measured(p, against, drawn)


@pytest.mark.slow
@pytest.mark.parametrize("copies", [0, 2])
@pytest.mark.parametrize("space", ["features", "position"])
def test_measuring_all_anew_is_measuring_what_would_be_drawn(copies, space):
    p = make(yaw_copies=copies, shaping_space=space)
    ring, starts, _, _ = filled(p, 31)
    other = reference(np.random.default_rng(7), len(p.phi.names))
    ring = jax.jit(functools.partial(experience.measure_all, p))(other, ring, starts)
    drawn = drawn_from(p, ring, starts, 500)
    assert_measured(p, other, drawn)


@pytest.mark.slow
def test_16_bits_round_the_states_and_nothing_else():
    wide, narrow = make(yaw_copies=0), make(yaw_copies=0, replay_dtype="float16")
    exact, rounded = (drawn_from(p, *filled(p, 31)[:2], 200) for p in (wide, narrow))
    for name in exact._fields:
        a, b = getattr(exact, name), getattr(rounded, name)
        if name.endswith("observation"):
            in_starts = (a == b).all(-1)  # a start is read from its pool
            assert not in_starts.all()
            np.testing.assert_allclose(a, b, rtol=2**-11, atol=2**-24)
        else:
            jax.tree.map(np.testing.assert_array_equal, a, b)


def test_16_bits_hold_what_is_too_large_for_them_as_their_largest():
    p = make(yaw_copies=0, replay_dtype="float16")
    huge = np.full((NUM_ENVS, SIZE), 1e6, np.float32) * np.sign(np.arange(SIZE) - 10.5)
    transition = Transition(
        huge, np.zeros((NUM_ENVS, 8), np.float32), huge, *np.zeros((2, NUM_ENVS), bool),
        np.ones(NUM_ENVS, bool), np.zeros(NUM_ENVS, np.float32),
    )  # fmt: skip
    ring, _ = experience.add(
        p, reference(np.random.default_rng(0), 7), experience.init(p),
        jax.tree.map(jnp.asarray, transition), jnp.full(NUM_ENVS, -1), jnp.zeros(NUM_ENVS),
        jax.random.key(0),
    )  # fmt: skip
    stored = np.asarray(ring.items.state[:NUM_ENVS], np.float32)
    np.testing.assert_array_equal(stored, np.sign(huge) * 65504)


def bytes_of(config):
    shapes = jax.eval_shape(lambda: experience.init(components.make(config)))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))


@pytest.mark.parametrize(
    ("inputs", "dtype", "most"),
    [("state", "float32", 1.7e9), ("state", "float16", 0.9e9), ("heading", "float32", 0.32e9)],
)
def test_a_million_transitions_of_humanoid_stay_within_their_memory(inputs, dtype, most):
    sizes = dict(replay_size=1_000_000, yaw_copies=0)
    changes = dict(replay_dtype=dtype, policy_inputs=inputs, **sizes)
    config = preset("quick", env="humanoid", **changes)
    assert 0.9 * most < bytes_of(config) <= most


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", [6, 31], ids=["part full", "gone round"])
@pytest.mark.parametrize("copies", [0, 2])
def test_several_steps_are_those_that_followed_in_the_episode(num_steps, copies):
    n = 4
    p = make(yaw_copies=copies, return_steps=n)
    ring, starts, against, told = filled(p, num_steps)
    drawn = drawn_from(p, ring, starts, 600)
    outcomes = drawn.outcomes
    which = index_of(drawn, told)
    # What follows a transition leaves the very state that it reached; fresh states are all new.
    after = {
        i: next((j for j, other in enumerate(told) if (other[0] == row[2]).all() and j > i), None)
        for i, row in enumerate(told)
    }
    lengths = set()
    for row, first in enumerate(which):
        chain = [first]
        while len(chain) < n and after[chain[-1]] is not None:
            chain.append(after[chain[-1]])
        steps = len(chain)
        lengths.add(steps)
        np.testing.assert_array_equal(outcomes.taken[row], np.arange(n) < steps)
        np.testing.assert_array_equal(outcomes.bonus[row, :steps], [told[i][4] for i in chain])
        terminated = [told[i][3] for i in chain]
        np.testing.assert_array_equal(outcomes.terminated[row, :steps], terminated)
        end = told[chain[-1]][2]  # in the same turned world as the beginning: so far from it
        apart = np.linalg.norm(told[first][0][:2] - end[:2])
        seen = np.linalg.norm(drawn.observation[row, :2] - drawn.next_observation[row, :2])
        np.testing.assert_allclose(seen, apart, rtol=1e-4, atol=1e-5)
    assert lengths == set(range(1, n + 1))
    # a step begins where the one before it ended, and its distances are of what it shows
    joined = outcomes.taken[:, 1:]
    np.testing.assert_array_equal(
        outcomes.features[:, 1:][joined], outcomes.next_features[:, :-1][joined]
    )
    exact = {"rtol": 1e-4, "atol": 1e-5}
    np.testing.assert_allclose(outcomes.features[:, 0], p.phi(drawn.observation), **exact)
    last = outcomes.next_features[np.arange(600), outcomes.taken.sum(1) - 1]
    np.testing.assert_allclose(last, p.phi(drawn.next_observation), **exact)
    fresh = experience.measure(p, against, outcomes.features, outcomes.next_features)
    for a, b in zip(fresh, outcomes.distances, strict=True):
        np.testing.assert_allclose(a[outcomes.taken], b[outcomes.taken], **exact)


def test_returns_by_hand():
    """γ = 1/2: rewards 1, 2, 4 make 1 + 1 + 1; only what was taken counts, death ends the sum."""
    paid = jnp.array([[1.0, 2.0, 4.0]] * 3)
    taken = jnp.array([[1, 1, 1], [1, 1, 0], [1, 1, 0]], bool)
    terminated = jnp.array([[0, 0, 0], [0, 0, 0], [0, 1, 0]], bool)
    outcomes = Outcomes(None, None, None, terminated, None, taken)
    total, beyond = payment.returns(outcomes, paid, 0.5)
    np.testing.assert_allclose(total, [3, 2, 2])
    np.testing.assert_allclose(beyond, [1 / 4, 1 / 2, 0])  # one γ more in the Bellman target


def test_a_step_alive_is_paid_for_and_a_death_is_not():
    distances = Distances(*(jnp.ones((2, 1)) for _ in range(3)))
    terminated = jnp.array([[False], [True]])
    outcomes = Outcomes(None, None, jnp.zeros((2, 1)), terminated, distances, ~terminated)
    without, paid = (payment.intrinsic(make(alive_bonus=b), outcomes) for b in (0.0, 0.3))
    np.testing.assert_allclose(paid - without, [[0.3], [0]], atol=1e-5)
