"""Running moments of the networks' inputs, against numpy's of all that was seen."""

import jax.numpy as jnp
import numpy as np

from maxent_jax.sac import normalizer


def seen(batches):
    """What is known after [N, 2] inputs and which of them count, [N], one pair after the other."""
    known = normalizer.init(2)
    for inputs, counts in batches:
        known = normalizer.add(known, jnp.asarray(inputs, jnp.float32), jnp.asarray(counts))
    return known


def test_moments_are_those_of_all_inputs_that_count():
    rng = np.random.default_rng(0)
    batches = [
        (rng.normal([30, -0.2], [5, 0.1], (16, 2)), rng.random(16) < share)
        for share in (0.5, 0.0, 1.0, 0.1)
    ]
    all_seen = np.concatenate([inputs[counts] for inputs, counts in batches])
    known = seen(batches)
    assert float(known.number) == len(all_seen)
    np.testing.assert_allclose(known.mean, all_seen.mean(0), rtol=1e-5)
    np.testing.assert_allclose(known.variance, all_seen.var(0), rtol=1e-4)
    scaled = normalizer.apply(known, jnp.asarray(all_seen, jnp.float32))
    np.testing.assert_allclose(np.mean(scaled, 0), 0, atol=1e-4)
    np.testing.assert_allclose(np.std(scaled, 0), 1, rtol=1e-4)


def test_inputs_pass_unchanged_before_any_was_seen():
    nothing_counts = seen([(np.full((4, 2), np.nan), np.zeros(4, bool))])
    for known in (normalizer.init(2), nothing_counts):
        np.testing.assert_array_equal(normalizer.apply(known, jnp.array([3.0, -2.0])), [3, -2])


def test_an_input_that_never_varied_is_not_blown_up_and_one_far_off_is_cut():
    known = seen([(np.tile([7.0, 0.0], (8, 1)) + [[0, 1], [0, -1]] * 4, np.ones(8, bool))])
    near, far = normalizer.apply(known, jnp.array([[7.05, 0.5], [7.0, 1e6]]))
    np.testing.assert_allclose(near, [5, 0.5], rtol=1e-3)
    np.testing.assert_allclose(far, [0, normalizer.LARGEST], atol=1e-3)
