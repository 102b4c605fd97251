"""The losses against scipy, against numerical integration, and against sums done by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from maxent_jax.sac import losses

MEAN, STD = 0.4, 0.6  # of the Gaussian before the tanh, where a test needs only one


def density(action, mean=MEAN, std=STD):
    """Of the tanh of a Gaussian, by the change of variables, in float64."""
    return scipy.stats.norm.pdf(np.arctanh(action), mean, std) / (1 - np.square(action))


def draw(mean, log_std, key, num=20_000):
    mean, log_std = jnp.broadcast_to(mean, (num, 1)), jnp.broadcast_to(log_std, (num, 1))
    action, log_prob = losses.sample_action(mean, log_std, key)
    assert action.shape == (num, 1) and log_prob.shape == (num,)
    return np.asarray(action[:, 0], np.float64), np.asarray(log_prob, np.float64)


def test_log_probability_is_that_of_the_change_of_variables(key):
    key_mean, key_std, key_action = jax.random.split(key, 3)
    mean = jax.random.uniform(key_mean, (5, 200, 3), minval=-1.0, maxval=1.0)
    log_std = jax.random.uniform(key_std, (5, 200, 3), minval=-1.5, maxval=0.0)
    action, log_prob = losses.sample_action(mean, log_std, key_action)
    assert log_prob.shape == (5, 200)
    action = np.asarray(action, np.float64)
    expected = np.log(density(action, np.asarray(mean), np.exp(np.asarray(log_std)))).sum(-1)
    kept = (np.abs(action) < 0.99).all(-1)
    assert kept.mean() > 0.5
    # A rounding of the action by 2^-24 moves the raw action by 2^-24 / (1 - 0.99^2) = 3e-6, and
    # its log-density by at most |noise| / std = 20 times that, in each of three dimensions.
    np.testing.assert_allclose(np.asarray(log_prob)[kept], expected[kept], atol=3 * 20 * 3e-6)


def test_actions_follow_the_tanh_of_the_gaussian(key):
    action, _ = draw(MEAN, np.log(STD), key)
    cdf = lambda a: scipy.stats.norm.cdf(np.arctanh(a), MEAN, STD)
    assert scipy.stats.kstest(action, cdf).pvalue > 0.01  # the seed is fixed; there p is 0.7


@pytest.mark.parametrize("mean, std", [(0.0, 1.0), (MEAN, STD), (-1.5, 0.3), (0.0, 2.0)])
def test_the_probability_that_comes_with_the_actions_integrates_to_one(mean, std, key):
    action, log_prob = draw(mean, np.log(std), key)
    order = np.argsort(action)
    inside = np.trapezoid(np.exp(log_prob[order]), action[order])
    # 20,000 draws leave out a tail of about 1 / 20,000 on either side; measured: at most 2e-4.
    assert inside == pytest.approx(1.0, abs=5e-4)


def test_mean_negative_log_probability_is_the_differential_entropy(key):
    _, log_prob = draw(MEAN, np.log(STD), key)
    entropy, _ = scipy.integrate.quad(
        lambda a: -density(a) * np.log(density(a)), -1 + 1e-12, 1 - 1e-12
    )
    standard_error = log_prob.std() / np.sqrt(log_prob.size)
    assert -log_prob.mean() == pytest.approx(entropy, abs=4 * standard_error)


@pytest.mark.parametrize("raw", [-60.0, -12.0, 12.0, 60.0])
def test_log_probability_and_its_gradients_stay_finite_where_the_tanh_saturates(raw, key):
    def log_prob(mean, log_std):
        return losses.sample_action(mean, log_std, key)[1]

    mean, log_std = jnp.full((1,), raw), jnp.full((1,), -5.0)
    value, gradients = jax.value_and_grad(log_prob, argnums=(0, 1))(mean, log_std)
    standard, _ = losses.sample_action(jnp.zeros(1), jnp.zeros(1), key)  # same key, same noise
    noise = np.arctanh(float(standard[0]))
    raw_action = raw + np.exp(-5.0) * noise
    # Far out 1 - tanh(x)^2 is 4 exp(-2 |x|), but for a relative exp(-4 |x|).
    expected = scipy.stats.norm.logpdf(noise) + 5.0 - (np.log(4) - 2 * abs(raw_action))
    assert float(value) == pytest.approx(expected, rel=1e-5)  # float32: 2^-24 of numbers near 120
    # d/dx of -log(1 - tanh(x)^2) is 2 tanh(x), so 2 sign(x) out there.
    np.testing.assert_allclose(gradients[0], 2 * np.sign(raw), rtol=1e-6)
    assert np.isfinite(gradients[1]).all()


def test_bellman_target_looks_beyond_a_time_limit_and_not_beyond_a_terminal_state():
    nothing = jnp.zeros((3, 1))
    reward, discount = jnp.array([1.0, 1.0, -2.0]), jnp.array([1.0, 0.0, 1.0])
    batch = losses.Batch(nothing, nothing, reward, nothing, discount)
    target = losses.bellman_target(batch, jnp.full(3, 10.0), 0.9)
    np.testing.assert_allclose(target, [10.0, 1.0, 7.0], rtol=1e-6)


def test_critic_loss_sums_over_the_critics_and_averages_over_the_batch():
    loss = losses.critic_loss(jnp.array([[2.0, 2.0], [4.0, 2.0]]), jnp.array([1.0, 4.0]))
    # Errors: (1, 1) and (0, -2).
    assert float(loss) == pytest.approx(((1 + 1) + (0 + 4)) / 2)


def test_actor_loss_trades_entropy_against_the_smaller_of_the_two_values():
    values = jnp.array([[1.0, 5.0], [7.0, 3.0]])
    loss = losses.actor_loss(jnp.array([-2.0, 4.0]), values, jnp.array(0.5))
    assert float(loss) == pytest.approx(((-1 - 1) + (2 - 3)) / 2)


def test_temperature_loss_falls_with_the_temperature_where_entropy_exceeds_its_target():
    log_prob, target_entropy = jnp.array([-3.0, 1.0]), -2.5  # entropy 1, which is above -2.5
    loss, slope = jax.value_and_grad(losses.temperature_loss)(
        jnp.log(0.2), log_prob, target_entropy
    )
    # α (entropy - target), and in log α its slope is itself.
    assert float(loss) == pytest.approx(0.2 * 3.5)
    assert float(slope) == pytest.approx(0.2 * 3.5)


def test_temperature_loss_does_not_train_the_policy():
    slope = jax.grad(losses.temperature_loss, argnums=1)(jnp.log(0.2), jnp.ones(4), -1.0)
    np.testing.assert_array_equal(slope, 0)
