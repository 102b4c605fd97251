"""The bounds by hand, and against the recursions and the extremes that they are to bound."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from maxent_jax.theory import bounds

# |S|, L²/(400|S|) and 400|S| log(10)/L², computed by hand with 40 digits.
BY_HAND = [
    (2, 0.0006005662673977517808, 3834.0233509469756),
    (10, 0.0013254745276195995026, 1737.1779276130073),
    (1000, 0.0001192927074857639552, 19301.976973477859),
    (10**6, 4.7717082994305582095e-7, 4825494.2433694648),
]
positive = st.floats(1e-3, 1e3)
errors = st.lists(st.floats(0, 0.1), min_size=1, max_size=40)


@pytest.mark.parametrize(("states", "eta", "iterations"), BY_HAND)
def test_propositions_2_and_3_by_hand(states, eta, iterations):
    assert bounds.eta_upper_bound(states) == pytest.approx(eta, rel=1e-14)
    assert bounds.min_iterations(states) == math.floor(iterations) + 1


def test_a_smaller_tolerance_asks_for_more_iterations_by_hand():
    # 400·10/0.5² · log(10 log(10)/0.5)
    assert bounds.min_iterations(10, 0.5) == 61277


def test_the_constant_of_proposition_3_is_921_and_not_1329():
    states = 10**6
    assert round(bounds.min_iterations(states) * math.log(states) ** 2 / states) == 921
    assert round(400 * math.log2(10)) == 1329


def test_the_largest_eta_is_at_e_squared_and_below_0_00136():
    eta = np.array([bounds.eta_upper_bound(states) for states in range(2, 5000)])
    assert 2 + eta.argmax() == round(math.e**2)
    largest = bounds.eta_upper_bound(math.e**2)
    assert eta.max() < largest < 0.00136
    assert largest == pytest.approx(0.01 / math.e**2)


@pytest.mark.parametrize("x", [2.5, math.e**2, 10.0, 300.0])
def test_the_second_derivative_of_proposition_2(x):
    step, logarithm = 1e-3 * x, math.log(x)
    below, at, above = (bounds.eta_upper_bound(x + d) for d in (-step, 0, step))
    derived = (logarithm**2 - 3 * logarithm + 1) / (200 * x**3)
    # The error of a central difference, step²/12 of the fourth derivative, which is about f''/x².
    assert (below - 2 * at + above) / step**2 == pytest.approx(derived, rel=1e-4, abs=1e-5 / x**3)


def test_the_first_bounds_of_theorem_1_by_hand():
    # T = 0, B = 1, β = 2: (1 + 2·½)/2, printed (1 + 2·3/2)/2; with errors 4·0.1/2 + 0.2/2 more.
    assert bounds.veritas_epsilon(0, 1, 2) == pytest.approx(1)
    assert bounds.veritas_epsilon(0, 1, 2, form="printed") == pytest.approx(2)
    assert bounds.veritas_epsilon(0, 1, 2, 0.1, 0.2) == pytest.approx(1.3)
    # T = 2, B = 0, β = 12: 12(1/2 + 1/3 + 1/4)/4
    assert bounds.veritas_epsilon(2, 0, 12) == pytest.approx(3.25)
    # T = 10, B = 2, β = 3, η = 0.1: 2/e + 0.3, and 6·0.01 + 0.02 more
    assert bounds.hazan_epsilon(10, 2, 3, 0.1, 0.01, 0.02) == pytest.approx(2 / math.e + 0.38)


@given(positive, positive, errors, st.data())
def test_theorem_1_solves_the_recursion_of_its_proof(of_range, beta, density, data):
    size = len(density)
    planning = data.draw(st.lists(st.floats(0, 1), min_size=size, max_size=size))
    gap = of_range
    for t, (eps0, eps1) in enumerate(zip(density, planning, strict=True)):
        step = 1 / (t + 2)
        gap = (1 - step) * gap + step * (2 * beta * eps0 + eps1) + step**2 * beta
    bound = bounds.veritas_epsilon(size - 1, of_range, beta, density, planning)
    assert bound == pytest.approx(gap, rel=1e-12)
    printed = bounds.veritas_epsilon(size - 1, of_range, beta, density, planning, "printed")
    assert printed - bound == pytest.approx(beta / (size + 1))
    # What the superfluous term is good for: it holds one policy earlier too.
    if size > 1 and beta >= of_range and not any(density) and not any(planning):
        assert printed >= bounds.veritas_epsilon(size - 2, of_range, beta) * (1 - 1e-12)


@given(positive, positive, st.floats(1e-3, 1), st.floats(0, 0.1), st.integers(0, 200))
def test_the_bound_of_h_is_above_the_recursion_of_its_proof(of_range, beta, eta, error, T):
    gap = of_range
    for _ in range(T):
        gap = (1 - eta) * gap + eta * (2 * beta * error + error) + eta**2 * beta
    bound = bounds.hazan_epsilon(T, of_range, beta, eta, error, error)
    assert gap <= bound * (1 + 1e-12)
    if T == 0:
        assert bound >= of_range


@pytest.mark.parametrize("states", [2, 10, 441])
@pytest.mark.parametrize("share", [0.01, 0.5, 1])
def test_lemma_1_makes_each_term_a_tenth_of_the_tolerance(states, share):
    tolerance = share * math.log(states)
    needed = bounds.lemma_1(states, tolerance)
    beta = bounds.smoothness(needed.smoothing)
    terms = (
        needed.eta * beta,
        2 * beta * needed.density_error,
        needed.planning_error,
        math.log(states) * math.exp(-needed.num_iterations * needed.eta),
    )
    assert terms == pytest.approx([0.1 * tolerance] * 4)
    assert states * needed.smoothing == pytest.approx(0.05 * tolerance)


def second_derivative(x, smoothing):
    step = 1e-4 * (x + smoothing)
    f = lambda x: -x * math.log(x + smoothing)
    return (f(x - step) - 2 * f(x) + f(x + step)) / step**2


@pytest.mark.parametrize("smoothing", [1e-3, 0.1, 2.0])
def test_smoothness_is_the_largest_curvature_and_is_reached_at_an_empty_state(smoothing):
    curvature = np.array([-second_derivative(x, smoothing) for x in np.linspace(0, 1, 200)])
    # Derived: the differences lose 1e-8 of curvature to their step and as much to rounding.
    assert curvature.max() == pytest.approx(bounds.smoothness(smoothing), rel=1e-6)
    assert curvature.argmax() == 0


@pytest.mark.parametrize("smoothing", [1e-4, 0.1, 2.0])
@pytest.mark.parametrize("states", [2, 5, 100])
def test_b_is_the_range_of_the_objective_and_half_of_what_a_gradient_bounds(states, smoothing):
    value = lambda d: -(d * np.log(d + smoothing)).sum(-1)
    corner, middle = np.eye(states)[0], np.full(states, 1 / states)
    of_range = bounds.objective_range(states, smoothing)
    assert value(middle) - value(corner) == pytest.approx(of_range)
    random = np.random.default_rng(0)
    for concentration in (0.01, 0.3, 3.0):
        some = value(random.dirichlet(np.full(states, concentration), 500))
        assert (value(corner) - 1e-12 <= some).all()
        assert (some <= value(middle) + 1e-12).all()
    entries = np.linspace(0, 1, 1000)
    gradient = -np.log(entries + smoothing) - entries / (entries + smoothing)
    assert bounds.gradient_bound(smoothing) == pytest.approx(np.abs(gradient).max())
    assert of_range <= 2 * bounds.gradient_bound(smoothing)


@pytest.mark.parametrize("n", [1, 2, 10, 999, 1000, 1001, 3000])
def test_harmonic_numbers_are_exact(n):
    exact = sum(Fraction(1, i) for i in range(1, n + 1))
    assert bounds.harmonic(n) == pytest.approx(float(exact), rel=4e-16)


@pytest.mark.parametrize("form", bounds.FORMS)
@pytest.mark.parametrize(("tolerance", "beta"), [(1.0, 12.0), (0.3, 882.0), (5.0, 1.0)])
def test_the_iterations_that_v_needs_are_the_fewest(form, tolerance, beta):
    needed = bounds.veritas_iterations(tolerance, 1.5, beta, form)
    after = bounds.veritas_epsilon(needed, 1.5, beta, form=form)
    before = bounds.veritas_epsilon(needed - 1, 1.5, beta, form=form)
    assert after <= tolerance
    assert needed == 1 or before > tolerance


@pytest.mark.parametrize("states", [2, 10, 1000])
def test_the_entropy_is_bounded_with_nearly_the_best_smoothing(states):
    T = 10 * states

    def bound(log_smoothing):
        smoothing = math.exp(log_smoothing)
        constants = bounds.objective_range(states, smoothing), bounds.smoothness(smoothing)
        return bounds.veritas_epsilon(T, *constants) + states * smoothing

    best = minimize_scalar(bound, bounds=(-20, 2), method="bounded").fun
    found, smoothing = bounds.entropy_epsilon(T, states)
    assert found == pytest.approx(bound(math.log(smoothing)))
    assert best - 1e-9 <= found <= 1.05 * best  # B's dependence on σ is left out of its choice


def test_the_bound_of_the_entropy_speaks_from_where_it_says():
    T = bounds.informative_iterations(10)
    half = 0.5 * math.log(10)
    assert bounds.entropy_epsilon(T, 10)[0] < half <= bounds.entropy_epsilon(T - 1, 10)[0]


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: bounds.eta_upper_bound(1), "num_states is 1"),
        (lambda: bounds.min_iterations(1), "num_states is 1"),
        (lambda: bounds.min_iterations(10, 0.0), "tolerance is 0.0"),
        (lambda: bounds.min_iterations(10, -1.0), "tolerance is -1.0"),
        (lambda: bounds.min_iterations(10, 2.4), "tolerance is 2.4, but no entropy exceeds"),
        (lambda: bounds.lemma_1(10, float("nan")), "tolerance is nan"),
        (lambda: bounds.veritas_iterations(0, 1, 1), "tolerance is 0"),
        (lambda: bounds.smoothness(0.0), "smoothing is 0.0"),
        (lambda: bounds.objective_range(5, -1.0), "smoothing is -1.0"),
        (lambda: bounds.veritas_epsilon(-1, 1, 1), "T is -1"),
        (lambda: bounds.veritas_epsilon(3, -1, 1), "B is -1"),
        (lambda: bounds.veritas_epsilon(3, 1, 1, [0, 0, 0]), "eps0 has 3 entries, but there are 4"),
        (lambda: bounds.veritas_epsilon(3, 1, 1, 0.0, -0.1), "eps1 must be 0 or more"),
        (lambda: bounds.veritas_epsilon(3, 1, 1, form="loose"), "unknown form 'loose'"),
        (lambda: bounds.hazan_epsilon(3, 1, 1, 0.0), "eta is 0.0"),
        (lambda: bounds.hazan_epsilon(-3, 1, 1, 0.1), "T is -3"),
        (lambda: bounds.harmonic(0), "n is 0"),
    ],
)
def test_bad_input_is_one_sentence(call, sentence):
    with pytest.raises(ValueError, match=sentence) as raised:
        call()
    assert "\n" not in str(raised.value)
