"""The learner on problems whose answer is known in closed form, and single updates done by hand.

The five probes are those of Andy Jones ("Debugging RL") and rejax: each pins down one thing that a
learner must get right before anything harder is worth a try. They are fed as transitions, without
an environment: states and actions in [-1, 1], one of each.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.integrate
import scipy.stats

from maxent_jax.config import preset
from maxent_jax.sac import agent, losses
from maxent_jax.sac.networks import LOG_STD_RANGE

DISCOUNT = 0.5  # far from 1, so that one step of delay and a bootstrap too many both show
NUM_UPDATES, BATCH_SIZE, LEARNING_RATE = 3000, 32, 3e-3
NO_ENTROPY_BONUS = 1e-12  # a temperature whose gradient drowns in Adam's ε, 1e-8: it stays

BOLTZMANN_MEAN, BOLTZMANN_STD = 0.3, 0.2  # of a Gaussian before its tanh


def tanh_gaussian_log_density(raw, mean):
    """Of tanh(raw), by the change of variables, in float64."""
    return scipy.stats.norm.logpdf(raw, mean, BOLTZMANN_STD) - np.log1p(-(np.tanh(raw) ** 2))


BOLTZMANN_ENTROPY = scipy.integrate.quad(
    lambda raw: (
        -tanh_gaussian_log_density(raw, BOLTZMANN_MEAN)
        * scipy.stats.norm.pdf(raw, BOLTZMANN_MEAN, BOLTZMANN_STD)
    ),
    *(-2, 2),  # beyond 8 standard deviations
)[0]


def make(**changes):
    """A small learner, one state and one action wide."""
    return agent.make(preset("smoke", **changes), 1, 1, lambda state: state)


SAC = make(
    discount=DISCOUNT,
    learning_rate=LEARNING_RATE,
    soft_update_rate=0.05,
    target_entropy_scale=-BOLTZMANN_ENTROPY,
)


def draw(low, high, seed=0):
    return np.random.default_rng(seed).uniform(low, high, (NUM_UPDATES, BATCH_SIZE))


def learn(key, state, action, reward, next_state, discount, temperature=NO_ENTROPY_BONUS, sac=SAC):
    """What a learner knows after NUM_UPDATES updates, each on fresh transitions; and its metrics.

    Columns are scalars or [NUM_UPDATES, BATCH_SIZE]; the temperature is the one at the start.
    """
    shape = (NUM_UPDATES, BATCH_SIZE)
    state, action, reward, next_state, discount = (
        jnp.asarray(np.broadcast_to(column, shape), jnp.float32)
        for column in (state, action, reward, next_state, discount)
    )
    batches = losses.Batch(
        state[..., None], action[..., None], reward, next_state[..., None], discount
    )
    parameters, metrics = _learn(sac, batches, jnp.log(jnp.float32(temperature)), key)
    return parameters, {name: np.asarray(values) for name, values in metrics.items()}


@functools.partial(jax.jit, static_argnums=0)
def _learn(sac, batches, log_temperature, key):
    key_init, key_updates = jax.random.split(key)
    fresh = agent.init(sac, key_init)
    learner, metrics = jax.lax.scan(
        lambda learner, inputs: agent.update(sac, learner, *inputs),
        fresh._replace(parameters=fresh.parameters._replace(log_temperature=log_temperature)),
        (batches, jax.random.split(key_updates, NUM_UPDATES)),
    )
    return learner.parameters, metrics


def values(parameters, state, action):
    """[..., 2]: both critics, of scalars or arrays."""
    state, action = (
        jnp.asarray(x, jnp.float32)[..., None] for x in np.broadcast_arrays(state, action)
    )
    return np.asarray(SAC.critic.apply(parameters.critic, state, action))


def policy(parameters, state):
    """Mean and standard deviation of the Gaussian before the tanh, of an array of states."""
    mean, log_std = SAC.actor.apply(parameters.actor, jnp.asarray(state, jnp.float32)[..., None])
    return np.asarray(mean)[..., 0], np.exp(np.asarray(log_std))[..., 0]


GRID = np.linspace(-1, 1, 21)
STATES, ACTIONS = np.meshgrid(GRID, GRID)


# Tolerances of the probes: about three times the largest error measured over seeds 0 .. 4.


def test_a_constant_reward_is_the_value_of_every_action(key):
    parameters, _ = learn(key, 0, draw(-1, 1), reward=1, next_state=0, discount=0)
    np.testing.assert_allclose(values(parameters, 0, GRID), 1.0, atol=0.01)


def test_a_reward_that_depends_on_the_state_is_its_value(key):
    state = draw(-1, 1)
    parameters, _ = learn(
        key, state, draw(-1, 1, seed=1), reward=state, next_state=state, discount=0
    )
    expected = np.stack([STATES, STATES], axis=-1)
    np.testing.assert_allclose(values(parameters, STATES, ACTIONS), expected, atol=0.06)


def test_a_reward_one_step_later_is_worth_its_discount(key):
    first = draw(-1, 1, seed=1) < 0  # the episode goes from -1 to 1, is paid there, and ends
    state, paid, goes_on = np.where(first, -1, 1), np.where(first, 0, 1), np.where(first, 1, 0)
    parameters, _ = learn(key, state, draw(-1, 1), reward=paid, next_state=1, discount=goes_on)
    np.testing.assert_allclose(values(parameters, -1, GRID), DISCOUNT, atol=0.05)
    np.testing.assert_allclose(values(parameters, 1, GRID), 1.0, atol=0.05)


@pytest.mark.parametrize(
    "discount, value",
    [pytest.param(0, 1.0, id="terminal"), pytest.param(1, 1 / (1 - DISCOUNT), id="time limit")],
)
def test_bootstrapping_stops_at_a_terminal_state_and_not_at_a_time_limit(discount, value, key):
    parameters, _ = learn(key, 1, draw(-1, 1), reward=1, next_state=1, discount=discount)
    np.testing.assert_allclose(values(parameters, 1, GRID), value, atol=0.03)


def test_the_policy_takes_the_action_that_pays_most(key):
    action = draw(-1, 1)
    parameters, _ = learn(key, 0, action, reward=action, next_state=0, discount=0)
    expected = np.stack([GRID, GRID], axis=-1)
    np.testing.assert_allclose(values(parameters, 0, GRID), expected, atol=0.05)
    mean, std = policy(parameters, 0.0)
    assert np.tanh(mean - 2 * std) > 0.95  # measured: mean 2.9, standard deviation 0.15


def test_the_policy_takes_the_action_that_the_state_asks_for(key):
    state, action = draw(-1, 1), draw(-1, 1, seed=1)
    parameters, _ = learn(
        key, state, action, reward=-((action - state) ** 2), next_state=0, discount=0
    )
    error = values(parameters, STATES, ACTIONS) + ((ACTIONS - STATES) ** 2)[..., None]
    # Worst in the corners, where -4 is to be met (0.13 measured), and small elsewhere (0.010).
    assert np.abs(error).max() < 0.4
    assert np.abs(error).mean() < 0.03
    mean, std = policy(parameters, GRID[2:-2])
    np.testing.assert_allclose(np.tanh(mean), GRID[2:-2], atol=0.2)  # measured: 0.08
    assert std.max() < 0.04  # nothing pays for spread; measured: 0.014, the floor is 0.007


@pytest.mark.parametrize("start", [0.2, 5.0], ids=["from below", "from above"])
def test_policy_values_and_temperature_settle_where_soft_optimality_puts_them(start, key):
    # Paid c log p(a | s) for a density p, the soft-optimal policy at temperature c is p itself; its
    # soft value is c times the log of the integral of p, 0, so that Q = r whatever the discount.
    # A tanh-Gaussian p is within the policy's reach. SAC's target entropy is that of p, so the
    # temperature must settle at c.
    c = 0.5
    state = np.where(draw(-1, 1) < 0, -1, 1)
    raw = BOLTZMANN_MEAN * state + BOLTZMANN_STD * draw(-5, 5, seed=1)
    reward = c * tanh_gaussian_log_density(raw, BOLTZMANN_MEAN * state)
    parameters, metrics = learn(
        key, state, np.tanh(raw), reward, next_state=state, discount=1, temperature=start * c
    )
    # Tolerances: two to four times the largest error over seeds 0 .. 4 and both starts.
    mean, std = policy(parameters, np.array([-1.0, 1.0]))
    settled = {name: trace[-500:].mean() for name, trace in metrics.items()}
    raw = BOLTZMANN_MEAN + BOLTZMANN_STD * np.linspace(-2, 2, 9)
    found = values(parameters, 1, np.tanh(raw))
    error = found - c * tanh_gaussian_log_density(raw, BOLTZMANN_MEAN)[:, None]
    np.testing.assert_allclose(mean, [-BOLTZMANN_MEAN, BOLTZMANN_MEAN], atol=0.15)
    np.testing.assert_allclose(std, BOLTZMANN_STD, atol=0.05)
    assert settled["policy_entropy"] == pytest.approx(BOLTZMANN_ENTROPY, abs=0.015)
    assert settled["temperature"] == pytest.approx(c, rel=0.05)
    # Left out of the bootstrap, the entropy would shift the values by γ / (1 - γ) c × it = 0.16.
    assert np.abs(error).mean() < 0.08


@pytest.mark.parametrize("lagrangian", [False, True])
def test_a_policy_at_its_target_entropy_lives_where_living_pays(lagrangian, key):
    # Two states, alive and dead: an action above 0 lives on, another dies. Each side has one best
    # action, and another loses 10 times the square of its distance. At the temperature held here,
    # 0.16, a Gaussian at the target entropy of -1 is soft-optimal: its deviation is 0.09, its loss
    # 0.08, which is paid back. Living then brings 0.12 a step, 1.2 in all, and dying 0. SAC's own
    # soft return counts 0.12 - 0.16 for a step alive, so it does better to lie between the two and
    # die at every second step. Counted from its target, entropy costs nothing, and it lives.
    sac = make(
        discount=0.9,
        learning_rate=LEARNING_RATE,
        soft_update_rate=0.05,
        lagrangian_entropy=lagrangian,
    )
    held = {"learned": sac.optimizer, "held": optax.set_to_zero()}
    sac = sac._replace(optimizer=optax.multi_transform(held, ("learned", "learned", "held")))
    action = draw(-1, 1)
    lives = action > 0
    reward = np.where(lives, 0.12, 0) + 0.08 - 10 * (action - np.where(lives, 0.25, -0.25)) ** 2
    parameters, _ = learn(
        key, 0, action, reward, next_state=0, discount=lives, temperature=0.16, sac=sac
    )
    lived = scipy.stats.norm.sf(0, *policy(parameters, 0.0))
    value = float(agent.value(sac, parameters, jnp.zeros((1000, 1)), key).mean())
    # Measured over seeds 0 .. 4: 0.45 to 0.48 and -0.18 to -0.16; 0.995 to 0.998 and 0.6 to 1.15.
    assert lived > 0.95 and value > 0.4 if lagrangian else lived < 0.6 and value < 0


# One update, of networks that ignore their input.

HAND = make(discount=0.5, learning_rate=0.01, soft_update_rate=0.25)
update_by_hand = jax.jit(functools.partial(agent.update, HAND))


def constant(q=(0.0, 0.0), target_q=(0.0, 0.0), mean=0.0, log_std=0.0, temperature=1.0):
    """A learner whose weights are all 0, but for the biases of the outputs."""
    known = jax.eval_shape(functools.partial(agent.init, HAND), jax.random.key(0)).parameters

    def biased(tree, *outputs):
        outputs = [jnp.asarray(output, jnp.float32) for output in outputs]
        sizes = {output.shape for output in outputs}  # no hidden layer is so small
        return jax.tree.map(
            lambda x: outputs.pop(0) if x.shape in sizes else jnp.zeros(x.shape, x.dtype), tree
        )

    return agent.restart(
        HAND,
        agent.Parameters(
            actor=biased(known.actor, [mean, log_std]),
            critic=biased(known.critic, [q[0]], [q[1]]),
            target_critic=biased(known.target_critic, [target_q[0]], [target_q[1]]),
            log_temperature=jnp.log(jnp.float32(temperature)),
        ),
    )


def output_of(critic):
    return np.asarray(HAND.critic.apply(critic, jnp.ones(1), jnp.ones(1)), np.float64)


HALF_TERMINAL = losses.Batch(
    observation=jnp.ones((4, 1)),
    action=jnp.zeros((4, 1)),
    reward=jnp.ones(4),
    next_observation=jnp.ones((4, 1)),
    discount=jnp.array([0.0, 1.0, 0.0, 1.0]),
)


def test_one_update_is_what_a_hand_computes_for_networks_that_are_constants(key):
    learner = constant(q=(1.0, 3.0), target_q=(-2.0, 5.0), temperature=NO_ENTROPY_BONUS)
    after, metrics = update_by_hand(learner, HALF_TERMINAL, key)
    # Targets: 1 where terminal, else 1 + 0.5 min(-2, 5) = 0.
    assert float(metrics["value"]) == pytest.approx(0.5, abs=1e-5)
    # Errors: (0, 2) where terminal, else (1, 3).
    assert float(metrics["critic_loss"]) == pytest.approx(((0 + 4) + (1 + 9)) / 2, abs=1e-4)
    assert float(metrics["actor_loss"]) == pytest.approx(-min(1, 3), abs=1e-5)
    # Adam's first step is the rate against the gradient's sign. The first critic's slope is 1;
    # had the actor's loss leaked into it, it would be 1 - 1 = 0.
    stepped = np.array([1 - 0.01, 3 - 0.01])
    np.testing.assert_allclose(output_of(after.parameters.critic), stepped, atol=1e-6)
    moved = 0.75 * np.array([-2.0, 5.0]) + 0.25 * stepped
    np.testing.assert_allclose(output_of(after.parameters.target_critic), moved, atol=1e-6)


def test_every_weight_of_the_target_critics_moves_by_the_soft_update_rate(key):
    before = agent.init(HAND, key).parameters
    before = before._replace(target_critic=jax.tree.map(lambda x: x + 1, before.critic))
    after = update_by_hand(agent.restart(HAND, before), HALF_TERMINAL, key)[0].parameters
    jax.tree.map(
        lambda found, old, new: np.testing.assert_allclose(
            found, 0.75 * np.asarray(old) + 0.25 * np.asarray(new), atol=1e-6
        ),
        after.target_critic,
        before.target_critic,
        after.critic,
    )


# The entropy of tanh(x), x ~ N(0, s), is about log(s) + 1.4 for a small s; the target is -1.
@pytest.mark.parametrize(
    "log_std, step",
    [pytest.param(-1.0, -0.01, id="above target"), pytest.param(-4.0, 0.01, id="below target")],
)
def test_temperature_falls_above_the_target_entropy_and_rises_below_it(log_std, step, key):
    after, metrics = update_by_hand(constant(log_std=log_std), HALF_TERMINAL, key)
    # From log 1 = 0, by Adam's first step, which is its rate.
    assert float(after.parameters.log_temperature) == pytest.approx(step, rel=1e-3)
    assert float(metrics["temperature"]) == pytest.approx(np.exp(step), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("layer_norm", [False, True])
def test_updates_keep_every_type_and_so_compile_once(layer_norm, key):
    sac = make(critic_layer_norm=layer_norm)
    update = jax.jit(functools.partial(agent.update, sac))
    learner = agent.init(sac, key)
    kinds = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree)
    shapes, _ = jax.eval_shape(update, learner, HALF_TERMINAL, key)
    assert kinds(shapes) == kinds(learner)
    for _ in range(3):
        learner, _ = update(learner, HALF_TERMINAL, key)
    assert update._cache_size() == 1


def test_a_fresh_learner_can_be_donated(key):
    learner = agent.init(HAND, key)
    jax.jit(functools.partial(agent.update, HAND), donate_argnums=0)(learner, HALF_TERMINAL, key)
    assert all(x.is_deleted() for x in jax.tree.leaves(learner.parameters))


def test_the_twin_critics_start_apart_and_their_targets_start_equal_to_them(key):
    parameters = agent.init(HAND, key).parameters
    first, second = output_of(parameters.critic)
    assert abs(first - second) > 1e-3
    jax.tree.map(np.testing.assert_array_equal, parameters.critic, parameters.target_critic)


def test_restarting_keeps_what_is_known_and_forgets_the_optimisers(key):
    learner, _ = update_by_hand(agent.init(HAND, key), HALF_TERMINAL, key)
    again = agent.restart(HAND, learner.parameters)
    jax.tree.map(np.testing.assert_array_equal, again.parameters, learner.parameters)
    assert any(np.any(x) for x in jax.tree.leaves(learner.optimizer))
    assert not any(np.any(x) for x in jax.tree.leaves(again.optimizer))


def test_the_average_follows_the_actor_and_is_what_is_archived(key):
    sac = HAND._replace(average_rate=0.25)
    before = agent.init(sac, key)
    after, _ = agent.update(sac, before, HALF_TERMINAL, key)
    kept = agent.archived(after)
    both = (jax.tree.leaves(each.parameters.actor) for each in (before, after))
    for found, old, new in zip(jax.tree.leaves(kept.actor), *both, strict=True):
        expected = 0.75 * np.asarray(old) + 0.25 * np.asarray(new)
        np.testing.assert_allclose(found, expected, atol=1e-6)
    assert kept.critic is after.parameters.critic
    again = agent.restart(sac, kept)
    jax.tree.map(np.testing.assert_array_equal, again.average, kept.actor)
    plain = agent.init(HAND, key)
    assert agent.archived(plain) is plain.parameters


def test_acting_draws_from_the_tanh_of_the_gaussian_for_any_leading_axes(key):
    policy = constant(mean=0.4, log_std=-0.5).parameters.policy
    action = agent.act(HAND, policy, jnp.zeros((50, 80, 1)), key)
    assert action.shape == (50, 80, 1)
    raw = np.arctanh(np.asarray(action, np.float64).ravel())
    cdf = scipy.stats.norm(0.4, np.exp(-0.5)).cdf
    assert scipy.stats.kstest(raw, cdf).pvalue > 0.01  # the seed is fixed


@pytest.mark.parametrize("asked, given", [(-9.0, LOG_STD_RANGE[0]), (9.0, LOG_STD_RANGE[1])])
def test_the_policy_spreads_no_less_and_no_more_than_its_range(asked, given):
    _, std = policy(constant(log_std=asked).parameters, 0.0)
    assert float(std) == pytest.approx(np.exp(given), rel=1e-6)


@pytest.mark.slow
def test_networks_see_the_state_only_through_its_inputs(key):
    sac = agent.make(preset("smoke"), 3, 1, lambda state: jnp.square(state[..., :2]))
    learner = agent.init(sac, key)
    state = jax.random.normal(key, (4, 3))
    hidden, seen = state * jnp.array([[-1.0, -1.0, 5.0]]), state * jnp.array([[1.0, 5.0, 1.0]])

    @jax.jit
    def outcome(state):
        batch = HALF_TERMINAL._replace(observation=state, next_observation=state)
        return agent.update(sac, learner, batch, key)[0].parameters

    same, other = jax.tree.leaves(outcome(state)), jax.tree.leaves(outcome(seen))
    for a, b in zip(same, jax.tree.leaves(outcome(hidden)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert any(np.any(a != b) for a, b in zip(same, other, strict=True))
