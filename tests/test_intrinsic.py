"""Each bonus against NumPy in float64, what each claims, and one suite that all must pass."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.special import digamma, log_softmax

from maxent_jax import intrinsic, moments
from maxent_jax.config.registry import BONUSES
from maxent_jax.intrinsic import (
    Setting,
    Steps,
    giril,
    kmeans,
    metra,
    ngu,
    particles,
    proto,
    rise,
    vcse,
)

D, A, B = 3, 2, 24
SCALE = np.array([0.5, 2.0, 10.0], np.float32)
RATE = 3e-3
CELLS = 6
# Derived: a float32 sum of 512 products is off by at most 512 · 2^-24 = 3e-5 of its terms' size,
# by far less if roundings are random; three layers of them, and differences of such sums.
CLOSE = dict(rtol=2e-4, atol=1e-5)
KEY = jax.random.key(7)


def setting(size=D, scale=SCALE):
    return Setting(size, A, jnp.asarray(scale), RATE, CELLS, state_size=size)


def steps_of(seed=0, size=B, spread=1.0):
    rng = np.random.default_rng(seed)
    before, after = rng.normal(0, spread, (2, size, D)) * SCALE
    return steps(before, rng.uniform(-1, 1, (size, A)), after, rng.normal(size=size))


def steps(before, action, after, value=0.0, episodic=1.0):
    size = len(after)
    columns = (before, action, after, np.broadcast_to(value, size), np.full(size, episodic))
    row = np.arange(size, dtype=np.int32)
    columns = [np.asarray(column, np.float32) for column in columns]
    angle = np.random.default_rng(size).uniform(0, 2 * np.pi, size)
    skill = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    return Steps(*columns, row, row % (CELLS + 1), columns[0], columns[2], skill)


def arriving(after):
    """Steps of which only the states reached matter, [B] or [B, F]."""
    after = np.asarray(after, np.float32).reshape(len(after), -1)
    return steps(after, np.zeros((len(after), A)), after)


def layers(tree):
    """Of an Mlp: (kernel, bias) in float64, in the order in which they are applied."""
    parameters = tree["params"]
    hidden = parameters["Torso_0"]
    dense = [hidden[f"Dense_{i}"] for i in range(len(hidden))] + [parameters["Dense_0"]]
    return [(np.float64(d["kernel"]), np.float64(d["bias"])) for d in dense]


def mlp(tree, x):
    *hidden, (kernel, bias) = layers(tree)
    for hidden_kernel, hidden_bias in hidden:
        x = np.maximum(x @ hidden_kernel + hidden_bias, 0)
    return x @ kernel + bias


def trunk(tree, x):
    dense, norm = tree["params"]["Dense_0"], tree["params"]["LayerNorm_0"]
    x = x @ np.float64(dense["kernel"]) + np.float64(dense["bias"])
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    return np.tanh(x * np.float64(norm["scale"]) + np.float64(norm["bias"]))


def apart(points, others):
    return np.linalg.norm(points[:, None] - others[None], axis=-1)


def nearest(points, k):
    """[B, k] distances to the nearest others, ascending."""
    distance = apart(points, points)
    np.fill_diagonal(distance, np.inf)
    return np.sort(distance, axis=1)[:, :k]


# One suite for all.


@functools.cache
def made(name):
    bonus = intrinsic.make(name, setting_with_skills())

    def step(state, batch, key):
        state, reward = bonus.reward(state, batch)
        state, metrics = bonus.learn(state, batch, key)
        return state, reward, metrics

    return bonus, jax.jit(bonus.init), jax.jit(step)


def shapes(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype), tree)


def kinds(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree)


@pytest.mark.parametrize("name", BONUSES)
class TestEveryBonus:
    def test_rewards_are_finite_also_where_states_coincide_and_nothing_compiles_twice(self, name):
        _, init, step = made(name)
        state, before = init(KEY), step._cache_size()
        one = jax.tree.map(lambda x: x[:1], steps_of())
        same = jax.tree.map(lambda x: np.repeat(x, B, axis=0), one)
        for batch in (same, steps_of(), same, steps_of(spread=1e6), same):
            state, reward, metrics = step(state, batch, KEY)
            assert reward.shape == (B,)
            assert reward.dtype == jnp.float32
            assert all(np.isfinite(x).all() for x in jax.tree.leaves((state, reward, metrics)))
        assert step._cache_size() <= before + 1

    def test_states_keep_their_shapes_and_types(self, name):
        bonus, init, _ = made(name)
        state = jax.eval_shape(init, KEY)
        assert not any(x.weak_type for x in jax.tree.leaves(state))
        batch = steps_of()
        for function, rest in ((bonus.reward, ()), (bonus.learn, (KEY,))):
            after, others = jax.eval_shape(function, state, batch, *rest)
            assert kinds(after) == kinds(state)
            assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(others))
        if bonus.episodic is None:
            return
        embedding = jax.eval_shape(bonus.episodic.embed, state, batch.features)
        assert embedding.shape == (B, bonus.episodic.size)
        earlier = jnp.zeros((B, 9, bonus.episodic.size))
        count = jnp.zeros(B, jnp.int32)
        after, novelty = jax.eval_shape(bonus.episodic.novelty, state, embedding, earlier, count)
        assert kinds(after) == kinds(state)
        assert kinds(novelty) == ((B,), jnp.float32, False)

    @pytest.mark.slow
    def test_seeds_side_by_side_are_the_seeds_alone(self, name):
        _, init, step = made(name)
        keys = jax.random.split(KEY, 2)
        seeds = [(init(key), steps_of(seed)) for seed, key in enumerate(keys)]
        states, batches = jax.tree.map(lambda *x: np.stack(x), *seeds)
        assert shapes(jax.eval_shape(jax.vmap(init), keys)) == shapes(states)
        together = jax.tree.map(np.asarray, jax.jit(jax.vmap(step))(states, batches, keys))
        for i, seed in enumerate(seeds):
            found, alone = jax.tree.map(lambda x, i=i: x[i], together), step(*seed, keys[i])
            np.testing.assert_allclose(found[1], alone[1], **CLOSE)
            # A first step of Adam has the rate's size, whatever sign rounding gives a slope of 0.
            close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=2.1 * RATE)
            jax.tree.map(close, found[0], alone[0])


def test_a_name_a_scale_or_a_batch_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="unknown bonus 'curiosity': did you mean 'rise'"):
        intrinsic.make("curiosity", setting())
    with pytest.raises(ValueError, match=r"scale has shape \(2,\), but must be \(3,\)"):
        intrinsic.make("rnd", setting(scale=SCALE[:2]))
    for name, least in (("re3", 3), ("rise", 5), ("renyi", 5), ("apt", 12), ("vcse", 12)):
        bonus = intrinsic.make(name, setting())
        state = jax.eval_shape(bonus.init, KEY)
        jax.eval_shape(bonus.reward, state, steps_of(size=least + 1))
        with pytest.raises(ValueError, match=f"too small for {least} neighbours"):
            jax.eval_shape(bonus.reward, state, steps_of(size=least))


# Running moments.


def test_moments_are_those_of_all_that_was_met():
    rng = np.random.default_rng(0)
    batches = [rng.normal(5, 2, (size, D)).astype(np.float32) for size in (1, 300)]
    running = moments.init((D,))
    for batch in batches:
        running = jax.jit(moments.update)(running, batch)
    everything = np.concatenate(batches).astype(np.float64)
    # Measured: 3e-6. The prior weighs 1e-4 of 301.
    np.testing.assert_allclose(running.mean, everything.mean(0), rtol=1e-5)
    np.testing.assert_allclose(running.variance, everything.var(0), rtol=1e-5)


def test_what_is_normalized_has_mean_0_and_deviation_1_and_is_cut_far_off():
    met = np.stack([np.zeros(8), np.tile([8.0, 6.0], 4)], axis=1).astype(np.float32)
    unchanged = moments.normalized(moments.init((2,)), jnp.array([[3.0, -2.0]]), 10)
    np.testing.assert_array_equal(unchanged, [[3, -2]])
    known = moments.update(moments.init((2,)), jnp.asarray(met))
    near, far = moments.normalized(known, jnp.array([[0.05, 7.5], [0.0, 1e6]]), 10)
    np.testing.assert_allclose(near, [5, 0.5], rtol=1e-2)  # the first never varied
    np.testing.assert_allclose(far, [0, 10], atol=1e-2)


def test_moments_leave_out_rows_that_are_not_valid():
    rows = np.array([1, np.inf, 3, np.nan], np.float32)
    update = jax.jit(moments.update)
    running = update(moments.init(), rows, np.array([True, False, True, False]))
    np.testing.assert_allclose([running.mean, running.variance], [2.0, 1.0], rtol=2e-4)
    unchanged = update(running, rows, np.zeros(4, bool))
    jax.tree.map(np.testing.assert_array_equal, unchanged, running)


# RND.


def rnd_error(state, met, after):
    """In float64, after the states `met`, [M, D], with unit scale."""
    mean, variance = met.mean(0), met.var(0)
    inputs = np.clip((after - mean) / np.sqrt(variance + 1e-5), -5, 5)
    wanted = mlp(state.target, inputs)
    return np.mean((mlp(state.predictor.parameters, inputs) - wanted) ** 2, axis=-1)


def test_rnd_pays_the_error_over_its_running_deviation():
    _, init, step = made("rnd")
    state = init(KEY)
    batches = [steps_of(seed) for seed in (1, 2)]
    batches[1].next_features[0, 0] = 1e4  # is clipped
    met, errors = np.zeros((0, D)), []
    for batch in batches:
        after = np.float64(batch.next_features) / SCALE
        met = np.concatenate([met, after])
        errors.append(rnd_error(state, met, after))
        state, reward, metrics = step(state, batch, KEY)
        np.testing.assert_allclose(reward, errors[-1] / np.concatenate(errors).std(), **CLOSE)
        np.testing.assert_allclose(metrics["bonus_prediction_error"], errors[-1].mean(), **CLOSE)


def test_rnd_pays_less_where_it_has_learned_and_as_much_elsewhere():
    _, init, step = made("rnd")
    unit = moments.Moments(jnp.zeros(D), jnp.ones(D), jnp.float32(1e9))  # stays as it is
    start = init(KEY)._replace(observations=unit)
    rng = np.random.default_rng(0)
    known, near = rng.uniform(-1, 0, (2, B, D))
    far = rng.uniform(0.5, 1.5, (B, D))
    state = start
    for _ in range(100):
        state, _, _ = step(state, arriving(known * SCALE), KEY)

    def error(state, states):
        return rnd_error(state, [[-1.0], [1.0]] * np.ones((2, D)), states).mean()

    kept = [error(state, states) / error(start, states) for states in (known, near, far)]
    reward = lambda states: np.asarray(step(state, arriving(states * SCALE), KEY)[1]).mean()
    # Measured over five seeds: at most 0.002, 0.01, at least 0.7; and a hundredfold reward.
    assert kept[0] < 0.01
    assert kept[1] < 0.05  # what is learned carries over to what lies near
    assert kept[2] > 0.5
    assert reward(far) > 30 * reward(near) > 30 * reward(known)
    jax.tree.map(np.testing.assert_array_equal, state.target, start.target)


# ICM and APT.


def icm_errors(parameters, batch):
    before, after = (
        trunk(parameters.trunk, np.float64(x) / SCALE)
        for x in (batch.features, batch.next_features)
    )
    action = np.float64(batch.action)
    forward = mlp(parameters.forward, np.concatenate([before, action], -1)) - after
    inverse = np.tanh(mlp(parameters.inverse, np.concatenate([before, after], -1))) - action
    return np.linalg.norm(forward, axis=-1), np.linalg.norm(inverse, axis=-1)


def test_icm_pays_the_forward_error_and_learns_from_both():
    _, init, step = made("icm")
    state, batch = init(KEY), steps_of()
    for _ in range(2):
        forward, inverse = icm_errors(state.parameters, batch)
        state, reward, metrics = step(state, batch, KEY)
        np.testing.assert_allclose(reward, np.log(1 + forward), **CLOSE)
        np.testing.assert_allclose(metrics["bonus_forward_error"], forward.mean(), **CLOSE)
        np.testing.assert_allclose(metrics["bonus_inverse_error"], inverse.mean(), **CLOSE)


def moves(seed):
    """A toy world: the action moves the first two coordinates, the third is noise."""
    rng = np.random.default_rng(seed)
    before, after = rng.uniform(-1, 1, (2, B, D))
    action = rng.uniform(-1, 1, (B, A))
    after[:, :A] = before[:, :A] + 0.3 * action
    return steps(before * SCALE, action, after * SCALE)


def after_moves(name, num_updates):
    """A state that has learned from as many batches of the toy world."""
    _, init, step = made(name)
    state = init(KEY)
    for seed in range(num_updates):
        state, _, _ = step(state, moves(seed), KEY)
    return state


def test_icm_finds_the_action_and_is_surprised_by_what_it_has_not_seen():
    _, _, step = made("icm")
    state = after_moves("icm", 500)
    fresh = moves(1000)
    _, inverse = icm_errors(state.parameters, fresh)
    # Measured over three seeds: at most 0.19 of the error of guessing 0; 12 times the reward.
    assert inverse.mean() < 0.3 * np.linalg.norm(fresh.action, axis=-1).mean()
    usual = step(state, fresh, KEY)[1]
    astray = fresh._replace(next_features=-fresh.next_features)
    assert step(state, astray, KEY)[1].mean() > 5 * usual.mean()


def test_a_model_without_error_still_has_a_gradient():
    _, init, step = made("icm")
    zero = jax.tree.map(jnp.zeros_like, init(KEY))
    batch = steps_of()._replace(action=np.zeros((B, A), np.float32))
    state, reward, _ = step(zero, batch, KEY)
    assert reward.max() < 1e-5
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state))


def test_apt_pays_the_logarithm_of_the_mean_distance_in_running_means():
    _, init, step = made("apt")
    state, met = init(KEY), []
    for seed in (1, 2):
        batch = steps_of(seed)
        embedding = trunk(state.icm.parameters.trunk, np.float64(batch.next_features) / SCALE)
        distance = nearest(embedding, 12)
        met.append(distance)
        expected = np.log1p(np.maximum(distance / np.mean(met) - 1e-4, 0).mean(-1))
        state, reward, _ = step(state, batch, KEY)
        np.testing.assert_allclose(reward, expected, rtol=1e-5)  # measured: 2e-6


def test_apt_learns_what_icm_learns():
    batch = steps_of()
    states = []
    for name in ("icm", "apt"):
        _, init, step = made(name)
        states.append(step(init(KEY), batch, KEY)[0])
    # The same program within two others, whose roundings may differ.
    close = functools.partial(np.testing.assert_allclose, atol=1e-6)
    jax.tree.map(close, states[1].icm.parameters, states[0].parameters)


# NGU.


@functools.cache
def ngu_parts():
    bonus, init, step = made("ngu")
    return init(KEY), jax.jit(bonus.episodic.embed), jax.jit(bonus.episodic.novelty), step


def in_line(positions):
    """Embeddings that lie on a line."""
    direction = np.eye(ngu.EMBEDDING_SIZE, dtype=np.float32)[0]
    return np.asarray(positions, np.float32)[..., None] * direction


def novelty_by_hand(squared, mean):
    kernel = 1e-4 / (np.maximum(np.asarray(squared) / mean - 0.008, 0) + 1e-4)
    return 1 / (np.sqrt(kernel.sum()) + 1e-3)


def test_novelty_is_what_one_computes_by_hand():
    state, _, novelty, _ = ngu_parts()
    # Two envs with 2 and 12 states before them, the rest of whose memory is rubbish.
    earlier = np.full((2, 14), np.nan)
    earlier[0, :2] = 1, 3
    earlier[1, :12] = np.arange(12) - 5
    here, count = in_line([0.0, 0.2]), np.array([2, 12], np.int32)
    squared = [np.array([1.0, 9.0]), np.sort((np.arange(12) - 5.2) ** 2)[:10]]
    mean = np.concatenate(squared).mean()
    state, found = novelty(state, here, in_line(earlier), count)
    expected = [novelty_by_hand(s, mean) for s in squared]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    # The second time all are met again: the mean stays, and with it the novelty.
    _, again = novelty(state, here, in_line(earlier), count)
    np.testing.assert_allclose(again, expected, rtol=1e-4)


def test_novelty_falls_as_a_state_repeats_and_is_whole_again_in_the_next_episode():
    state, _, novelty, _ = ngu_parts()
    memory = np.full((1, 14), np.nan)
    memory[0, :2] = 5, -5
    found = []
    for count in range(2, 14):  # the state at 0 comes again and again
        state, new = novelty(state, in_line([0.0]), in_line(memory), np.array([count], np.int32))
        found.append(float(new[0]))
        memory[0, count] = 0
    assert (np.diff(found[:11]) < 0).all()
    np.testing.assert_allclose(found[1:11], 1 / (np.sqrt(np.arange(1, 11)) + 1e-3), rtol=1e-2)
    np.testing.assert_allclose(found[11], found[10], rtol=1e-6)  # no more than 10 count
    elsewhere = novelty(state, in_line([9.0]), in_line(memory), np.array([13], np.int32))[1]
    assert float(elsewhere[0]) > 10 * found[-1]
    unchanged, fresh = novelty(state, in_line([0.0]), in_line(memory), np.array([0], np.int32))
    np.testing.assert_allclose(fresh, 1000, rtol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, unchanged.distances, state.distances)


def test_ngu_multiplies_what_was_stored_by_a_modulator_between_1_and_5():
    state, _, _, step = ngu_parts()
    batch = steps_of()
    episodic = np.linspace(0, 30, B, dtype=np.float32)
    batch = batch._replace(episodic=episodic)
    after = np.float64(batch.next_features) / SCALE
    error = rnd_error(state.rnd, after, after)
    modulator = np.clip(1 + (error - error.mean()) / error.std(), 1, 5)
    assert 1.5 < modulator.max() < 5
    assert (modulator == 1).sum() > 5
    np.testing.assert_allclose(step(state, batch, KEY)[1], episodic * modulator, **CLOSE)
    # One state far off, of 24: (23 × 24)^½ / 24^½ = 4.8 deviations above the mean, nearly.
    lone = np.repeat(batch.next_features[:1], B, axis=0)
    lone[0] *= -1
    found = step(state, batch._replace(next_features=lone, episodic=np.ones_like(episodic)), KEY)[1]
    np.testing.assert_allclose(found[1:], 1, rtol=1e-6)
    assert float(found[0]) == 5


def test_the_embedding_of_ngu_is_its_network_and_keeps_to_what_actions_move():
    state, embed, _, _ = ngu_parts()
    batch = steps_of()
    network = state.controllable.parameters.embedding
    expected = mlp(network, np.float64(batch.features) / SCALE)
    np.testing.assert_allclose(embed(state, batch.features), expected, **CLOSE)

    learned = after_moves("ngu", 400)
    fresh = moves(1000)
    metrics = made("ngu")[2](learned, fresh, KEY)[2]
    # Measured over three seeds: 0.012, where guessing 0 gives 1 / 3; a contrast of 7, from 1.
    assert metrics["bonus_inverse_error"] < 0.1 / 3

    def sensitivity(state, axis):
        moved = batch.features + 0.3 * SCALE * np.eye(D, dtype=np.float32)[axis]
        change = np.asarray(embed(state, moved)) - np.asarray(embed(state, batch.features))
        return np.linalg.norm(change, axis=-1).mean()

    contrast = lambda state: sensitivity(state, 0) / sensitivity(state, 2)
    assert contrast(learned) > 3 * contrast(state)


# RE3, RISE and Rényi.


def test_re3_pays_the_third_nearest_in_a_space_that_stays():
    _, init, step = made("re3")
    state, batch = init(KEY), steps_of()
    embedding = mlp(state, np.float64(batch.next_features) / SCALE)
    after, reward, _ = step(state, batch, KEY)
    np.testing.assert_allclose(reward, np.log(1 + nearest(embedding, 3)[:, -1]), **CLOSE)
    jax.tree.map(np.testing.assert_array_equal, after, state)


LINE = np.array([0, 1, 3, 7, 12, 20, 30, 45], np.float32)
FIFTH = np.array([20, 19, 17, 13, 12, 19, 27, 42])  # to the fifth nearest of the others, by hand


@pytest.mark.parametrize("order", [0.0, 0.1, 0.5])
def test_rise_pays_a_power_of_the_distance_to_the_fifth_nearest(order):
    _, reward = rise.reward(setting(1, np.ones(1)), (), arriving(LINE), order)
    np.testing.assert_allclose(reward, FIFTH ** (1 - order), rtol=1e-6)


def test_rise_tells_states_apart_by_the_logarithm_and_ever_less_as_the_order_nears_1():
    spreads = []
    for order in (0.1, 0.5, 0.9, 0.99, 0.999):
        _, reward = rise.reward(setting(1, np.ones(1)), (), arriving(LINE), order)
        spreads.append(np.ptp(reward))
        slope = (np.float64(reward) - 1) / (1 - order)
    assert (np.diff(spreads) < 0).all()
    assert spreads[-1] < 2e-3
    # Second order of the exponential, (1 - α) log² R / 2 of 0.001 × 7, and rounding over 0.001.
    np.testing.assert_allclose(slope, np.log(FIFTH), atol=0.01)


def test_the_bonus_of_rise_has_order_a_tenth_and_that_of_renyi_is_its_logarithm_on_a_line():
    line = setting(1, 2 * np.ones(1, np.float32))
    state, found = rise.make(line).reward((), arriving(LINE))
    np.testing.assert_allclose(found, (FIFTH / 2) ** 0.9, rtol=1e-6)
    _, renyi = rise.make_renyi(line).reward(state, arriving(LINE))
    # On a line 1/density = N · 2R / k, with the N = 7 others.
    np.testing.assert_allclose(renyi, 0.9 * np.log(7 * FIFTH / 5), rtol=1e-5)


# VCSE.


def kraskov(states, values, k):
    """ε and n in float64 by brute force."""
    states, values = np.float64(states), np.float64(values)
    value_apart = np.abs(values[:, None] - values[None])
    joint = np.maximum(apart(states, states), value_apart)
    np.fill_diagonal(joint, np.inf)
    np.fill_diagonal(value_apart, np.inf)
    distance = np.sort(joint, axis=1)[:, k - 1]
    return distance, (value_apart < distance[:, None]).sum(1)


def test_a_transition_drawn_more_than_once_is_not_its_own_neighbour():
    points = np.float32([0, 0, 0, 1, 3, 7])[:, None]
    rows = np.int32([4, 4, 4, 2, 9, 0])
    found = particles.distances(points, rows, 4)
    np.testing.assert_array_equal(found[0], [1, 3, 7, 7])  # three others; the farthest stands in
    np.testing.assert_array_equal(found[3], [1, 1, 1, 2])
    np.testing.assert_array_equal(particles.distances(points[:3], rows[:3], 2), np.zeros((3, 2)))

    distance, count = vcse.joint_neighbors(points, np.zeros(6, np.float32), rows, 2)
    assert (distance[0], count[0]) == (3, 3) and (distance[3], count[3]) == (1, 5)


def test_joint_neighbors_are_those_of_brute_force_also_beyond_one_block_of_rows():
    rng = np.random.default_rng(0)
    size = vcse.ROWS + 44
    states = rng.normal(size=(size, D)).astype(np.float32)
    values = rng.normal(size=size).astype(np.float32)
    values[:40] = values[0]  # many of one value
    distance, count = jax.jit(vcse.joint_neighbors, static_argnums=3)(
        states, values, np.arange(size), 12
    )
    expected, expected_count = kraskov(states, values, 12)
    np.testing.assert_allclose(distance, expected, rtol=1e-6)
    np.testing.assert_array_equal(count, expected_count)


def test_vcse_estimates_the_entropy_of_a_gaussian_given_another():
    rng = np.random.default_rng(0)
    k, size, correlation = 12, 4000, 0.8
    value = rng.normal(size=size)
    state = correlation * value + np.sqrt(1 - correlation**2) * rng.normal(size=size)
    states, values = np.float32(state)[:, None], np.float32(value)
    distance, count = jax.jit(vcse.joint_neighbors, static_argnums=3)(
        states, values, np.arange(size), k
    )
    # In one dimension a ball of radius ε has volume 2ε.
    found = np.mean(digamma(np.asarray(count) + 1.0) + np.log(2 * np.asarray(distance)))
    expected = 0.5 * np.log(2 * np.pi * np.e * (1 - correlation**2))
    assert abs(found - digamma(k) - expected) < 0.05  # measured over five seeds: at most 0.023


def test_vcse_pays_what_the_estimator_says_of_normalised_values():
    _, init, step = made("vcse")
    batch = steps_of()
    value = np.float64(batch.value)
    values = (value - value.mean()) / np.sqrt(value.var() + 1e-5)
    states = np.float64(batch.next_features) / SCALE / D
    distance, count = kraskov(states, values, 12)
    expected = digamma(count + 1.0) / D + np.log(2 * distance + 1e-5)
    np.testing.assert_allclose(step(init(KEY), batch, KEY)[1], expected, rtol=1e-5, atol=1e-6)


def test_without_a_difference_in_value_vcse_is_the_entropy_of_states():
    _, init, step = made("vcse")
    batch = steps_of()._replace(value=np.full(B, 3, np.float32))
    radius = nearest(np.float64(batch.next_features) / SCALE / D, 12)[:, -1]
    expected = digamma(B) / D + np.log(2 * radius + 1e-5)
    np.testing.assert_allclose(step(init(KEY), batch, KEY)[1], expected, rtol=1e-5, atol=1e-6)


def test_vcse_measures_states_among_those_of_their_value_alone():
    low, high = (np.float64(steps_of(s, 40).next_features) / SCALE for s in (3, 4))
    low[0] = high.mean(0)  # crowded, but not by states of its value
    both = np.concatenate([low, high])
    value = np.repeat(np.float32([-1, 1]), 40)
    batch = arriving(both * SCALE)._replace(value=value)
    _, found = jax.jit(functools.partial(vcse.reward, setting()))((), batch)
    for rows, group in ((slice(0, 40), low), (slice(40, 80), high)):
        radius = nearest(group / D, 12)[:, -1]
        # ψ(n + 1) of the 39 others of the group, as long as no other value comes within ε < 2.
        expected = digamma(40) / D + np.log(2 * radius + 1e-5)
        assert radius.max() < 2
        np.testing.assert_allclose(found[rows], expected, rtol=1e-5, atol=1e-5)


# k-means.


def spread_of(centers):
    distance = apart(centers, centers)
    np.fill_diagonal(distance, np.inf)
    return np.sqrt(distance.min(1)).sum()


def test_the_gain_of_a_moved_centre_is_the_difference_of_the_two_sums():
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(9, 2)).astype(np.float32)
    chosen = rng.integers(9, size=60)
    moved = (centers[chosen] + rng.normal(0, 1.5, (60, 2))).astype(np.float32)
    found = jax.jit(kmeans.gains)(centers, chosen, moved)
    expected = []
    for index, place in zip(chosen, moved, strict=True):
        after = np.float64(centers)
        after[index] = place
        expected.append(spread_of(after) - spread_of(np.float64(centers)))
    assert np.min(expected) < -0.5 < 0.5 < np.max(expected)
    # Derived: 9 roots of size 1, each off by a few roundings, and squares near 0 at duplicates.
    np.testing.assert_allclose(found, expected, atol=1e-5)


def follow(centers, counts, states):
    """Algorithm 1 of Nedergaard & Cook, in float64; the distances before each move."""
    centers, counts, distances = np.float64(centers), np.float64(counts), []
    for state in np.float64(states):
        distance = np.linalg.norm(centers - state, axis=-1)
        index = np.argmin(distance + 1e-4 * (counts - counts.mean()))
        distances.append(distance[index])
        centers[index] = 0.05 * state + 0.95 * centers[index]
        counts[index] += 1
    return centers, counts, distances


def test_kmeans_pays_from_where_the_centres_are_and_then_follows_each_state_in_turn():
    _, init, step = made("kmeans")
    state = init(KEY)
    for seed in (1, 2):
        batch, key = steps_of(seed), jax.random.key(seed)
        scaled = batch.next_features / SCALE
        expected = []
        for one in scaled:
            moved = follow(state.centers, state.counts, [one])[0]
            expected.append(spread_of(moved) - spread_of(np.float64(state.centers)))
        shuffled = jax.random.permutation(key, scaled)
        centers, counts, distances = follow(state.centers, state.counts, np.asarray(shuffled))
        state, reward, metrics = step(state, batch, key)
        np.testing.assert_allclose(reward, expected, atol=1e-5)
        np.testing.assert_allclose(state.centers, centers, atol=1e-5)
        np.testing.assert_array_equal(state.counts, counts)
        np.testing.assert_allclose(metrics["bonus_center_distance"], np.mean(distances), rtol=1e-5)
    assert int(state.counts.sum()) == 2 * B
    many = made("kmeans")[0].learn(state, steps_of(size=kmeans.MAX_FOLLOWED + 9), KEY)[0]
    assert int(many.counts.sum()) == 2 * B + kmeans.MAX_FOLLOWED


def test_a_centre_that_follows_few_is_chosen_over_one_that_lies_nearer():
    centers, state = np.float32([[0, 0], [1, 0]]), np.float32([[0.4, 0]])
    nearest_center = jax.jit(kmeans.nearest_center)
    for counts, expected in (((0, 0), 0), ((1999, 0), 0), ((2001, 0), 1)):  # 1e-4 × 2000 = 0.2
        chosen = nearest_center(kmeans.State(centers, np.array(counts, np.int32)), state)
        assert int(chosen[0]) == expected


def test_kmeans_pays_for_leaving_the_crowd():
    _, init, step = made("kmeans")
    state = init(KEY)
    crowd = 0.05 * SCALE * np.random.default_rng(0).normal(size=(B, D))
    for seed in range(40):
        state, _, _ = step(state, arriving(crowd), jax.random.key(seed))
    pays = lambda states: np.asarray(step(state, arriving(states), KEY)[1])
    assert pays(crowd + 4 * SCALE).min() > 5 * np.abs(pays(crowd)).max()  # measured: 9 to 27


# METRA.


def test_metra_pays_the_step_along_the_skill_in_its_space():
    bonus, init, step = made("metra")
    batch = steps_of(3)
    state, paid, _ = step(init(KEY), batch, KEY)
    phi = init(KEY).learned.parameters.phi  # before learning
    met = np.float64(batch.next_state)
    units = lambda states: (states - met.mean(0)) / met.std(0)
    moved = mlp(phi, units(met)) - mlp(phi, units(np.float64(batch.state)))
    # The prior of the moments weighs 1e-4 of 24.
    np.testing.assert_allclose(paid, (moved * batch.skill).sum(1), rtol=1e-3, atol=1e-4)
    assert bonus.has_scale
    with pytest.raises(ValueError, match="the steps have none"):
        bonus.reward(state, batch._replace(skill=None))


def test_metra_measures_states_until_the_replay_holds_10_000():
    bonus, init, _ = made("metra")
    state, batch = init(KEY), steps_of(size=4000)
    for newest, seen in ((4000, 4000), (9999, 8000), (10_000, 8000), (50_000, 8000)):
        state, _ = bonus.reward(state, batch._replace(row=newest - batch.row))
        np.testing.assert_allclose(state.inputs.weight, seen, rtol=1e-6)


def test_metra_learns_the_axes_along_which_skills_move_and_steps_of_at_most_1():
    # Two entries of the state move along the skill, by 0.1; the third at random, by 10 times that.
    rng = np.random.default_rng(0)
    _, init, step = made("metra")

    def batch(seed):
        base = steps_of(seed, size=256)
        moved = np.concatenate([0.1 * base.skill, rng.normal(size=(256, 1))], axis=1)
        return base._replace(next_state=np.float32(base.state + moved))

    state, first, _ = step(init(KEY), batch(0), KEY)
    for seed in range(600):
        state, paid, _ = step(state, batch(seed), KEY)
    phi = state.learned.parameters.phi
    moved = metra.displacement(metra.build(setting_with_skills()), state, phi, batch(1))
    # The constraint: a mean square of 1 in each of two dimensions, so a length of √2 along z.
    assert np.abs(np.mean(first)) < 0.2
    assert 1.0 < np.mean(paid) < 1.5
    assert 0.8 < np.mean(moved**2) < 1.3


def setting_with_skills():
    return setting()._replace(state_size=D, skill_size=2)


# Proto-RL.


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def proto_embedding(network, observation):
    return unit(mlp(network, np.float64(observation) / SCALE))


def balanced(scores):
    """Sinkhorn-Knopp as a scaling of rows and columns, in float64, after three iterations."""
    kernel = np.exp(np.float64(scores))
    rows = np.ones(len(kernel))
    for _ in range(3):
        columns = 1 / (kernel.T @ rows)
        rows = 1 / (kernel @ columns)
    return rows[:, None] * kernel * columns[None]


def proto_loss(state, parameters, batch):
    """In float64: cross entropy between the assignment of s' and the prediction from s."""
    prototypes = np.float64(state.online.parameters.prototypes)
    reached = proto_embedding(state.target, batch.next_features)
    assigned = balanced(reached @ prototypes.T / 0.1)
    embedding = mlp(parameters.network, np.float64(batch.features) / SCALE)
    scores = unit(mlp(parameters.projector, embedding)) @ np.float64(parameters.prototypes).T
    return -(assigned * log_softmax(scores / 0.1, axis=-1)).sum(-1).mean()


def test_sinkhorn_shares_a_batch_equally_among_prototypes():
    scores = np.random.default_rng(0).normal(0, 1, (B, 8)).astype(np.float32)
    found = np.asarray(jax.jit(proto.sinkhorn)(scores))
    np.testing.assert_allclose(found, balanced(scores), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.sum(1), 1, rtol=1e-6)
    uneven = lambda shares: np.abs(shares.sum(0) / (B / 8) - 1).max()
    # Measured over five seeds: at most 0.017, where softmax gives 0.19 to 0.34.
    assert uneven(found) < 0.05 < 0.1 < uneven(np.asarray(jax.nn.softmax(scores)))
    far = np.asarray(jax.jit(proto.sinkhorn)(np.float32([[10, -10], [10, -10]])))
    np.testing.assert_allclose(far, 0.5, rtol=1e-6)  # equal states, at the ends of the range


def test_prototypes_draw_states_in_proportion_to_their_similarity():
    chances = np.float32([1, 2, 3, 4]) / 10
    scores = np.log(np.repeat([chances, chances[::-1]], 10_000, axis=0))
    drawn = np.asarray(jax.jit(proto.draw)(scores, KEY))
    for half, expected in ((drawn[:10_000], chances), (drawn[10_000:], chances[::-1])):
        found = np.bincount(half, minlength=4) / 10_000
        np.testing.assert_allclose(found, expected, atol=0.02)  # four standard errors, 0.5 / 100
    np.testing.assert_array_equal(jax.jit(proto.draw)(scores[:, :1], KEY), 0)


def test_proto_pays_the_third_nearest_candidate_and_its_queue_forgets_the_oldest():
    _, init, step = made("proto")
    state = init(KEY)
    for seed in range(1, 6):
        batch, before = steps_of(seed), state
        embedding = proto_embedding(state.online.parameters.network, batch.next_features)
        state, reward, metrics = step(state, batch, KEY)
        new, kept = np.split(np.asarray(state.queue), [512])
        np.testing.assert_array_equal(kept, before.queue[:-512])
        assert int(state.filled) == min(512 * seed, 2048)
        to_new = apart(new, embedding)
        drawn = to_new.argmin(1)
        assert to_new.min(1).max() < 1e-5
        assert len(set(drawn)) > B / 2 and (state.key != before.key).any()

        distance = apart(embedding, np.float64(state.queue[: int(state.filled)]))
        distance[:, :512][drawn[None] == np.arange(B)[:, None]] = np.inf
        np.testing.assert_allclose(reward, np.sort(distance)[:, 2], **CLOSE)
        expected = proto_loss(before, before.online.parameters, batch)
        np.testing.assert_allclose(metrics["bonus_prototype_loss"], expected, **CLOSE)

        prototypes = np.asarray(state.online.parameters.prototypes)
        np.testing.assert_allclose(np.linalg.norm(prototypes, axis=-1), 1, rtol=1e-6)
        slow = optax.incremental_update(state.online.parameters.network, before.target, 0.05)
        jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-7), state.target, slow)
    assert (prototypes != before.online.parameters.prototypes).any()


@pytest.mark.parametrize(("filled", "expected"), [(0, 0), (1, 0.5), (2, 1), (3, 1), (4, 0.75)])
def test_proto_pays_the_farthest_of_fewer_than_three_candidates_and_0_without_any(filled, expected):
    bonus, init, _ = made("proto")
    state = init(KEY)
    batch = jax.tree.map(lambda x: np.repeat(x[:1], B, axis=0), steps_of())  # one transition
    here = proto_embedding(state.online.parameters.network, batch.next_features)[0]
    queue = np.tile(np.float32(here), (proto.QUEUE_SIZE, 1))  # what is not filled lies at 0
    queue[:filled, 0] += (0.5, 1.0, 0.25, 0.75)[:filled]
    state = state._replace(queue=queue, filled=jnp.int32(filled))
    after, reward = bonus.reward(state, batch)
    np.testing.assert_allclose(reward, expected, atol=1e-6)
    assert int(after.filled) == 512 + filled


def test_proto_pays_for_what_it_has_not_seen_until_it_has():
    _, init, step = made("proto")
    state = init(KEY)
    rng = np.random.default_rng(0)
    crowd = SCALE * (1 + 0.05 * rng.normal(size=(B, D)))
    lone = crowd.copy()
    lone[0] *= -1
    for seed in range(4):
        state, _, _ = step(state, arriving(crowd), jax.random.key(seed))
    _, first, _ = step(state, arriving(lone), KEY)
    for seed in range(8):
        state, last, _ = step(state, arriving(lone), jax.random.key(seed))
    # Measured over four seeds: at least 120 times as much; then at most 0.07 of it.
    assert first[0] > 30 * first[1:].mean()
    assert last[0] < 0.2 * first[0]


def test_a_state_without_length_still_has_a_gradient():
    _, init, step = made("proto")
    state, reward, _ = step(init(KEY), arriving(np.zeros((B, D))), KEY)  # biases are 0 at first
    assert (np.asarray(reward) == 0).all()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state))


# GIRIL.


def giril_losses(parameters, batch, noise):
    """In float64: reconstruction, action, divergence."""
    before, after = (np.float64(x) / SCALE for x in (batch.features, batch.next_features))
    encoded = mlp(parameters.encoder, np.concatenate([before, after], -1))
    mean, log_std = encoded[:, :A], np.clip(encoded[:, A:], -5, 2)
    code = mean + np.exp(log_std) * noise
    error = mlp(parameters.decoder, np.concatenate([before, code], -1)) - after
    divergence = (mean**2 + np.exp(2 * log_std) - 1) / 2 - log_std
    return (error**2).mean(), ((code - batch.action) ** 2).mean(), divergence.sum(-1).mean()


def test_giril_pays_the_squared_error_given_the_action_and_reports_its_losses():
    _, init, step = made("giril")
    state = init(KEY)
    for seed in (1, 2):
        batch, key = steps_of(seed), jax.random.key(seed)
        before, after = (np.float64(x) / SCALE for x in (batch.features, batch.next_features))
        cause = np.concatenate([before, np.float64(batch.action)], -1)
        squared = ((mlp(state.parameters.decoder, cause) - after) ** 2).sum(-1)
        losses = giril_losses(state.parameters, batch, np.float64(jax.random.normal(key, (B, A))))
        state, reward, metrics = step(state, batch, key)
        np.testing.assert_allclose(reward, squared, **CLOSE)
        names = ("bonus_reconstruction_error", "bonus_action_error", "bonus_divergence")
        np.testing.assert_allclose([metrics[name] for name in names], losses, **CLOSE)


def test_the_divergence_of_giril_is_the_integral():
    mean, log_std = np.float32([[0.0, 1.5], [-0.7, 0.2]]), np.float32([[0.0, -1.0], [0.5, -2.0]])
    x = np.linspace(-12, 12, 100_001)
    log_normal = lambda m, s: -((x - m) ** 2) / (2 * s**2) - np.log(s) - np.log(2 * np.pi) / 2
    expected = []
    for means, stds in zip(np.float64(mean), np.exp(np.float64(log_std)), strict=True):
        log_p = [log_normal(m, s) for m, s in zip(means, stds, strict=True)]
        each = [np.sum(np.exp(p) * (p - log_normal(0, 1))) for p in log_p]
        expected.append(sum(each) * (x[1] - x[0]))
    found = giril.divergence_from_prior(mean, log_std)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_giril_finds_the_action_and_is_surprised_by_what_it_has_not_seen():
    _, _, step = made("giril")
    state = after_moves("giril", 500)
    fresh = moves(1000)
    usual, metrics = step(state, fresh, KEY)[1:]
    # Measured over three seeds: at most 0.027, where guessing 0 gives 1 / 3; 10 times the reward.
    assert metrics["bonus_action_error"] < 0.2 / 3
    astray = fresh._replace(next_features=-fresh.next_features)
    assert step(state, astray, KEY)[1].mean() > 5 * usual.mean()


def slope(loss, parameters, direction):
    """The slope of a loss in float64 along a direction, by a central difference."""
    move = lambda size: jax.tree.map(
        lambda x, d: np.float64(x) + size * np.float64(d), parameters, direction
    )
    return (loss(move(1e-6)) - loss(move(-1e-6))) / 2e-6


def descent_of(before, after):
    """What one step of gradient descent at rate 1 subtracted, and its squared length."""
    step = jax.tree.map(lambda b, a: np.float64(b) - np.float64(a), before, after)
    return step, sum((x**2).sum() for x in jax.tree.leaves(step))


def test_giril_descends_the_weighted_sum_of_its_losses():
    plain = giril.build(setting())._replace(optimizer=optax.sgd(1.0))
    batch, noise = steps_of(), np.float64(jax.random.normal(KEY, (B, A)))
    state = giril.init(plain, KEY)
    output = state.parameters.encoder["params"]["Dense_0"]
    output["bias"] = output["bias"].at[A:].set(-2)  # narrower than the prior
    after, _ = giril.learn(plain, state, batch, KEY)
    step, squared = descent_of(state.parameters, after.parameters)
    loss = lambda parameters: np.dot([1, 100, 1], giril_losses(parameters, batch, noise))
    # Measured: 1e-5, of which most is the central difference's; and 1e-8.
    np.testing.assert_allclose(slope(loss, state.parameters, step), squared, rtol=1e-4)
    # The width of the code alone, on which the divergence weighs as much as the action.
    width = jax.tree.map(np.zeros_like, step)
    of_width = step.encoder["params"]["Dense_0"]["bias"][A:]
    width.encoder["params"]["Dense_0"]["bias"][A:] = of_width
    found = slope(loss, state.parameters, width)
    np.testing.assert_allclose(found, (of_width**2).sum(), rtol=1e-4)


def test_proto_descends_the_cross_entropy_with_its_assignment_held_fixed():
    plain = proto.build(setting())._replace(optimizer=optax.sgd(1.0))
    batch, state = steps_of(), proto.init(plain, KEY)
    parameters = state.online.parameters
    after, _ = proto.learn(plain, state, batch, KEY)
    step, squared = descent_of(
        parameters, after.online.parameters._replace(prototypes=parameters.prototypes)
    )
    loss = lambda parameters: proto_loss(state, parameters, batch)
    np.testing.assert_allclose(slope(loss, parameters, step), squared, rtol=1e-4)  # measured: 3e-8


def test_the_published_reward_of_h_by_hand():
    bonus = intrinsic.make("histogram", setting())
    state = bonus.init(KEY)
    assert (bonus.reward(state, steps_of())[1] == 0).all()  # before there is a mixture
    share = jnp.array([[0.5, 0.25, 0.0], [0.0, 0.125, 0.0]])  # and an eighth off the grid
    _, paid = bonus.reward(bonus.refresh(state, share), steps_of(size=7))
    smoothing = 1 / np.sqrt(6)
    expected = 1 / (np.array([0.5, 0.25, 0, 0, 0.125, 0, 0.125]) + smoothing)
    np.testing.assert_allclose(paid, expected, rtol=1e-6)  # derived: a few roundings
