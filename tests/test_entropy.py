"""The kNN density and entropy against closed forms, and the formula over scipy's neighbours."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.special import digamma, gamma, gammaln, polygamma

from maxent_jax import mixture
from maxent_jax.density.entropy import knn_density, knn_entropy

N, K = 20_000, 3
knn_entropy_jit = jax.jit(knn_entropy, static_argnums=1)
knn_density_jit = jax.jit(knn_density, static_argnums=2)


def standard_error(variance_of_log_density):
    # Derived: log of the mass of a ball up to the k-th of N others is log(Gamma(k) / N), of
    # variance ψ'(k), and independent of the density at its centre. Balls overlap, which adds 3 to
    # 20 % to the error (measured with scipy's neighbours, 150 samples): left out, for a stricter
    # test.
    return np.sqrt((variance_of_log_density + polygamma(1, K)) / N)


def edge_bias(dims):
    # Derived, to first order in the balls' size: a ball of radius R centred at sR from a face has
    # the share g(s) inside, and its R is read as a mass larger by 1/g. Corners are of second order.
    s = np.linspace(0, 1, 100_001)
    inside, volume = {
        1: ((1 + s) / 2, 2),
        2: (1 - (np.arccos(s) - s * np.sqrt(1 - s**2)) / np.pi, np.pi),
    }[dims]
    radius = gamma(K + 1 / dims) / gamma(K) / (N * volume) ** (1 / dims)
    depth = radius * s * inside ** (-1 / dims)
    return 2 * dims * np.trapezoid(-np.log(inside), depth)


@pytest.mark.parametrize("dims", [1, 2])
@pytest.mark.parametrize(("mean", "scale"), [(0, 1), (50, 3)])
def test_the_entropy_of_a_gaussian_is_its_closed_form(dims, mean, scale):
    samples = np.random.default_rng(dims).normal(mean, scale, (N, dims)).astype(np.float32)
    expected = dims * 0.5 * np.log(2 * np.pi * np.e * scale**2)
    assert abs(knn_entropy_jit(samples, K) - expected) < 3 * standard_error(dims / 2)


@pytest.mark.parametrize("dims", [1, 2])
@pytest.mark.parametrize("side", [1, 20])
def test_the_entropy_of_a_uniform_is_the_log_of_its_volume(dims, side):
    samples = np.random.default_rng(dims).uniform(0, side, (N, dims)).astype(np.float32)
    expected = dims * np.log(side) + edge_bias(dims)
    assert abs(knn_entropy_jit(samples, K) - expected) < 3 * standard_error(0)


def test_the_entropy_of_a_gaussian_in_feature_space_is_its_closed_form_but_for_a_known_bias():
    # Measured with scipy's neighbours over 20 samples: -0.0636 with a standard error of 0.0030. In
    # 7 dimensions a ball of 3 among 20,000 is so wide that the density curves within it.
    bias, bias_error = -0.0636, 0.0030
    samples = np.random.default_rng(7).standard_normal((N, 7)).astype(np.float32)
    error = knn_entropy_jit(samples, K) - 3.5 * np.log(2 * np.pi * np.e)
    assert abs(error - bias) < 3 * np.hypot(standard_error(3.5), bias_error)


def formula(distance, num_others, k, dims):
    log_volume = dims / 2 * np.log(np.pi) - gammaln(dims / 2 + 1) + dims * np.log(distance)
    return np.mean(np.log(num_others) + log_volume) - digamma(k)  # log k cancels


@pytest.mark.parametrize("dims", [1, 2, 7])
@pytest.mark.parametrize("k", [1, 3, 10])
def test_the_entropy_is_equation_6_over_neighbours_found_by_scipy(dims, k):
    samples = np.random.default_rng(3).standard_normal((1500, dims)).astype(np.float32)
    distance = cKDTree(samples.astype(np.float64)).query(samples, k + 1)[0][:, -1]
    # Derived: sums of a few float32 terms of size up to 20, each off by 20 × 2^-24.
    expected = formula(distance, 1499, k, dims)
    np.testing.assert_allclose(knn_entropy_jit(samples, k), expected, rtol=0, atol=1e-5)


def test_only_the_samples_that_count_enter():
    samples = np.random.default_rng(4).standard_normal((500, 2)).astype(np.float32)
    found = jax.jit(lambda count: knn_entropy(samples, 3, count))(jnp.int32(300))
    # Derived: sums of float32 terms in another order, as in the test before.
    np.testing.assert_allclose(found, knn_entropy(samples[:300], 3), rtol=0, atol=1e-5)
    assert np.isnan(knn_entropy(samples, 3, 3))


@pytest.mark.parametrize("copies", [1, 3, 8])
def test_states_of_large_weight_do_not_bias_the_entropy_of_a_mixture(copies):
    # A draw of N in proportion to weights would take each of these states `copies` times.
    num = N // copies
    states = np.random.default_rng(6).standard_normal((N, 7)).astype(np.float32)
    weights = jnp.where(jnp.arange(N) < num, 1.0, 0.0)
    rows, count = mixture.draw_distinct(weights, N, jax.random.key(0))
    assert abs(int(count) - num) <= 1  # 1 / (1 / num) is rounded
    assert len(set(np.asarray(rows[:count]))) == count
    found = knn_entropy(jnp.asarray(states)[rows], K, count)
    np.testing.assert_allclose(found, knn_entropy(states[:num], K), rtol=0, atol=0.01)


def test_coinciding_samples_have_entropy_minus_infinity():
    samples = np.repeat(np.random.default_rng(5).standard_normal((750, 1)), 2, axis=0)
    assert knn_entropy_jit(samples.astype(np.float32), 1) == -np.inf
    assert np.isfinite(knn_entropy_jit(samples.astype(np.float32), 3))


@pytest.mark.parametrize("num_samples", [1, 3])
def test_samples_too_few_for_k_neighbours_are_refused(num_samples):
    with pytest.raises(ValueError, match="too few"):
        knn_entropy(np.zeros((num_samples, 2), np.float32), 3)


@pytest.mark.parametrize(
    ("points", "k", "exclude", "expected"),
    [
        ([[1.0], [3.0], [4.0], [-9.0]], 1, None, 1 / (4 * 2 * 1)),  # k / (N · 2R)
        ([[1.0], [3.0], [4.0], [-9.0]], 2, None, 2 / (4 * 2 * 3)),
        ([[0.0], [3.0], [4.0], [-9.0]], 1, 0, 1 / (3 * 2 * 3)),
        ([[0.0], [3.0], [4.0], [-9.0]], 2, -1, 2 / (4 * 2 * 3)),
        ([[3.0, 4.0], [60.0, 80.0]], 1, None, 1 / (2 * np.pi * 25)),  # k / (N · πR²)
        ([[0.0, 2.0, 0.0]], 1, None, 1 / (4 / 3 * np.pi * 8)),  # k / (N · 4/3 πR³)
        ([[2.0] + [0.0] * 6], 1, None, 1 / (16 * np.pi**3 / 105 * 2**7)),
        ([[0.0, 0.0]], 1, None, np.inf),
    ],
)
def test_the_density_at_the_origin_is_what_one_computes_by_hand(points, k, exclude, expected):
    points = np.array(points, np.float32)
    exclude = None if exclude is None else np.array([exclude], np.int32)
    found = knn_density(np.zeros((1, points.shape[1]), np.float32), points, k, exclude)
    # Derived: exp of a logarithm up to 10 that is off by a few 10 × 2^-24.
    np.testing.assert_allclose(found, [expected], rtol=1e-5)


def square(rng):
    queries = np.stack(np.meshgrid(np.linspace(0.1, 0.9, 7), np.linspace(0.1, 0.9, 7)), -1)
    return rng.random((N, 2)), queries.reshape(-1, 2), 0.0


def ring(radius, num_queries, rng):
    angle = np.linspace(0, 2 * np.pi, num_queries, endpoint=False)
    queries = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    return rng.standard_normal((N, 2)), queries, -(radius**2) / 2 - np.log(2 * np.pi)


@pytest.mark.parametrize(
    "case",
    [square, functools.partial(ring, 0.5, 40), functools.partial(ring, 2.0, 60)],
    ids=["uniform", "Gaussian inside", "Gaussian outside"],
)
def test_the_density_is_its_closed_form(case):
    points, queries, expected = case(np.random.default_rng(6))
    k = 10  # balls of radius 0.013, 0.034 and 0.086: no two of them meet, nor an edge
    found = np.log(knn_density_jit(np.float32(queries), np.float32(points), k))
    # Derived: N times a ball's mass is Gamma(k), so that log(k / Gamma) has mean log k - ψ(k) and
    # variance ψ'(k), independently at each query. The density curves by less than 0.2 % in a ball.
    error = np.mean(found) - expected - (np.log(k) - digamma(k))
    assert abs(error) < 3 * np.sqrt(polygamma(1, k) / len(queries))
