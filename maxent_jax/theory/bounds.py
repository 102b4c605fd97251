"""The paper's bounds as numbers: Prop. 2 and 3, Lemma 1, Theorem 1. Loads no array library.

All logarithms are natural and all entropies are in nats. R is the smoothed entropy
H_σ(d) = -Σ d(s) log(d(s) + σ) of a *normalised* occupancy d over |S| states. Every proof below uses
that two occupancies differ by at most 2 in the 1-norm and √2 in the 2-norm, which is true only of
normalised ones. Unnormalised ones are 1/(1 - γ) times as large and would multiply the terms in β by
1/(1 - γ)². Note that Eq. 2 of the paper prints argmin, but the entropy is to be maximised.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from maxent_jax.checks import check_number, check_whole

Errors = float | Sequence[float]

FORMS = ("tight", "printed")
_SUMMED = 1000  # harmonic numbers are summed up to here; beyond, the series is exact to float64


class Lemma1(NamedTuple):
    """The parameters that MaxEnt-H needs for an accuracy ε (Hazan et al. 2019, Theorem 4.1)."""

    smoothing: float  # σ, added to a density
    density_error: float  # ε₀, of the density in any state
    planning_error: float  # ε₁, of the planner's value, nats
    eta: float  # η, step size
    num_iterations: float  # T


def smoothness(smoothing: float) -> float:
    """Returns β of H_σ: how fast its gradient changes, in nats per unit of occupancy.

    H_σ is a sum over states of f(x) = -x log(x + σ). Its second derivative,
    f''(x) = -(x + 2σ)/(x + σ)², is largest in magnitude at x = 0. Hence β = 2/σ, in the 2-norm and
    from the sup-norm to itself.

    Raises:
      ValueError: σ <= 0.
    """
    _check_positive("smoothing", smoothing)
    return 2 / smoothing


def objective_range(num_states: int, smoothing: float) -> float:
    """Returns B: the largest minus the smallest H_σ on the simplex, nats.

    H_σ is concave and symmetric. It is largest at the uniform distribution, log|S| - log(1 + |S|σ),
    and smallest at a single state, -log(1 + σ). Hence B = log(|S|(1 + σ)/(1 + |S|σ)) < log|S|.
    Theorem 1 uses B only for R(π*) - R(π_0), so B must bound this range. The paper takes B from
    Hazan et al., where it bounds the gradient's largest entry. That bounds the range only by 2B
    (R = c(d(1) - d(2)) has gradient c and range 2c), and `gradient_bound` is larger anyway.

    Raises:
      ValueError: |S| < 2 or σ <= 0.
    """
    _check_states(num_states)
    _check_positive("smoothing", smoothing)
    return math.log(num_states) + math.log1p(smoothing) - math.log1p(num_states * smoothing)


def gradient_bound(smoothing: float) -> float:
    """Returns the largest entry of H_σ's gradient in magnitude, nats; this is B in Hazan et al.

    f'(x) = -log(x + σ) - x/(x + σ) falls from -log σ at x = 0 to its value at x = 1.

    Raises:
      ValueError: σ <= 0.
    """
    _check_positive("smoothing", smoothing)
    return max(abs(math.log(smoothing)), math.log1p(smoothing) + 1 / (1 + smoothing))


def lemma_1(num_states: int, tolerance: float) -> Lemma1:
    """Returns parameters with which MaxEnt-H comes within ε of the largest entropy.

    σ = 0.1ε/(2|S|) costs at most |S|σ = 0.05ε on either side, since 0 <= H - H_σ <= |S|σ. With
    β = 2/σ = 40|S|/ε, each other term of `hazan_epsilon` becomes 0.1ε: ηβ for η = 0.1ε²/(40|S|),
    2βε₀ for ε₀ = 0.1ε²/(80|S|), ε₁ = 0.1ε, and B exp(-Tη) with B = log|S| for
    T = 40|S|/(0.1ε²) · log(log|S|/(0.1ε)).

    Args:
      num_states: |S|.
      tolerance: ε, nats.
    Raises:
      ValueError: |S| < 2, or ε outside (0, log|S|]; any policy satisfies a larger ε.
    Source: Hazan et al. 2019; Lemma 1 of the paper.
    """
    _check_states(num_states)
    _check_positive("tolerance", tolerance)
    largest = math.log(num_states)
    if tolerance > largest:
        raise ValueError(f"tolerance is {tolerance}, but no entropy exceeds log|S| = {largest:g}")
    eta = 0.1 * tolerance**2 / (40 * num_states)
    return Lemma1(
        smoothing=0.1 * tolerance / (2 * num_states),
        density_error=eta / 2,
        planning_error=0.1 * tolerance,
        eta=eta,
        num_iterations=math.log(largest / (0.1 * tolerance)) / eta,
    )


def eta_upper_bound(num_states: int) -> float:
    """Prop. 2: returns the η below which MaxEnt-H must stay for any informative accuracy.

    Lemma 1's η = 0.1ε²/(40|S|) grows with ε, and ε must stay below log|S|. Hence η < L²/(400|S|)
    with L = log|S|. The derivative by |S| is L(2 - L)/(400|S|²), so the largest value is
    1/(100e²) = 0.00135 at |S| = e². The second derivative there, (L² - 3L + 1)/(200|S|³), is
    negative. The paper prints another one; its conclusion, at most 0.00136, is correct.

    Raises:
      ValueError: |S| < 2.
    """
    _check_states(num_states)
    return math.log(num_states) ** 2 / (400 * num_states)


def min_iterations(num_states: int, tolerance: float | None = None) -> int:
    """Prop. 3: returns the number of iterations that Lemma 1 requires of MaxEnt-H.

    At ε = log|S| Lemma 1's T is 400|S| log(10)/L² = 921|S|/L² with L = log|S|. A smaller ε needs
    more. The paper prints 1329 instead of 921: this is 400 log₂ 10, but its other logarithms are
    natural. The number is sufficient by Lemma 1; it is not a lower bound for the algorithm.

    Args:
      num_states: |S|.
      tolerance: ε, nats; if None, log|S|, the largest informative value.
    Returns:
      The smallest whole number above T.
    Raises:
      ValueError: as in `lemma_1`.
    """
    _check_states(num_states)
    accuracy = math.log(num_states) if tolerance is None else tolerance
    return math.floor(lemma_1(num_states, accuracy).num_iterations) + 1


def veritas_epsilon(
    T: int, B: float, beta: float, eps0: Errors = 0.0, eps1: Errors = 0.0, form: str = "tight"
) -> float:
    """Theorem 1: returns the largest gap between R of MaxEnt-V's mixture and the optimum, nats.

    With step 1/(t + 2), smoothness gives gap(t + 1) <= (t + 1)/(t + 2) gap(t) + (2βε₀ + ε₁)/(t + 2)
    + β/(t + 2)². Multiplied by t + 2, this telescopes over t = 0 ... T. The mixture of T + 2
    policies has

        gap <= B/(T + 2) + 2β ε̄₀ + ε̄₁ + β (H_{T+2} - 1)/(T + 2),

    where H_n = 1 + 1/2 + ... + 1/n, and ε̄ is the sum of the T + 1 errors divided by T + 2 (not
    their mean). This is the tight form. The printed form lacks the - 1 after H_{T+2}, which adds a
    superfluous β/(T + 2); with it, the bound holds one policy earlier too if β >= B. The paper
    expands H_n with a remainder of 1/(8n²), but the series is ln n + ρ + 1/(2n) - 1/(12n²) ...
    Here H_n is exact.

    The bound holds for uniform weights wherever the policies come from, if the errors are those of
    the method. For LA they include the distance of its history from its mixture.

    Args:
      T: the last iteration, counted from 0.
      B: bounds R(π*) - R(π_0), see `objective_range`.
      beta: smoothness of R.
      eps0: largest error of the density in any state; one value, or T + 1 values by iteration.
      eps1: the planner's loss of value, nats; likewise.
      form: "tight" or "printed".
    Raises:
      ValueError: T < 0, a quantity is negative, there are not T + 1 errors, or the form is unknown.
    Source: Theorem 1.
    """
    _check_last(T)
    _check_constants(B, beta)
    if form not in FORMS:
        raise ValueError(f"unknown form '{form}': choose from {', '.join(FORMS)}")
    harmonic_terms = harmonic(T + 2) - (1 if form == "tight" else 0)
    errors = 2 * beta * _total("eps0", eps0, T + 1) + _total("eps1", eps1, T + 1)
    return (B + errors + beta * harmonic_terms) / (T + 2)


def hazan_epsilon(
    T: int, B: float, beta: float, eta: float, eps0: float = 0.0, eps1: float = 0.0
) -> float:
    """Returns the counterpart of Theorem 1 for MaxEnt-H with a constant step η, nats.

    Smoothness gives gap(t + 1) <= (1 - η) gap(t) + η(2βε₀ + ε₁) + η²β, hence
    B exp(-Tη) + 2βε₀ + ε₁ + ηβ. This holds if each new policy gets weight η and the weights of the
    others shrink by the factor 1 - η. The official code's weights, projected on the simplex, are
    different: the newest policy has about √(2η), the oldest none.

    Args:
      T: completed iterations.
      B: as in `veritas_epsilon`.
      beta: as in `veritas_epsilon`.
      eta: η, in (0, 1].
      eps0: as in `veritas_epsilon`, the largest of all iterations.
      eps1: as in `veritas_epsilon`, the largest of all iterations.
    Raises:
      ValueError: T < 0, a quantity is negative, or η is outside (0, 1].
    Source: the proof of Theorem 4.1 of Hazan et al. 2019.
    """
    _check_last(T)
    if not 0 < check_number("eta", eta) <= 1:
        raise ValueError(f"eta is {eta}, but must be in (0, 1]")
    _check_constants(B, beta)
    errors = 2 * beta * _total("eps0", eps0, 1) + _total("eps1", eps1, 1)
    return B * math.exp(-T * eta) + errors + eta * beta


def veritas_iterations(tolerance: float, B: float, beta: float, form: str = "tight") -> int:
    """Returns the T from which Theorem 1's ε is at most `tolerance`: Prop. 3 for MaxEnt-V.

    Oracles are exact. T starts at 1; from there ε only falls.

    Raises:
      ValueError: tolerance <= 0, or as in `veritas_epsilon`.
    """
    _check_positive("tolerance", tolerance)
    return _first(lambda T: veritas_epsilon(T, B, beta, form=form) <= tolerance)


def entropy_epsilon(T: int, num_states: int) -> tuple[float, float]:
    """Returns Theorem 1's bound for the entropy itself, in nats, and the best σ.

    Oracles are exact. H - H_σ lies between 0 and |S|σ, so the entropy's gap is at most that of H_σ
    plus |S|σ. With β = 2/σ the sum is smallest near σ = √(2(H_{T+2} - 1)/(|S|(T + 2))).

    Raises:
      ValueError: T < 0 or |S| < 2.
    """
    _check_last(T)
    _check_states(num_states)
    smoothing = math.sqrt(2 * (harmonic(T + 2) - 1) / (num_states * (T + 2)))
    of_smoothed = veritas_epsilon(T, objective_range(num_states, smoothing), smoothness(smoothing))
    return of_smoothed + num_states * smoothing, smoothing


def informative_iterations(num_states: int) -> int:
    """Returns the T from which Theorem 1 bounds the entropy's gap by less than half of log|S|.

    Raises:
      ValueError: |S| < 2.
    """
    _check_states(num_states)
    half = 0.5 * math.log(num_states)
    return _first(lambda T: entropy_epsilon(T, num_states)[0] < half)


def harmonic(n: int) -> float:
    """Returns H_n = 1 + 1/2 + ... + 1/n, exact to float64.

    Raises:
      ValueError: n < 1.
    """
    check_whole("n", n, least=1)
    if n <= _SUMMED:
        return math.fsum(1 / i for i in range(1, n + 1))
    euler = 0.57721566490153286
    return math.log(n) + euler + 1 / (2 * n) - 1 / (12 * n**2) + 1 / (120 * n**4)


def _first(holds: Callable[[int], bool]) -> int:
    """The smallest T >= 1 from which a monotone condition holds."""
    high = 1
    while not holds(high):
        high *= 2
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def _total(name: str, errors: Any, count: int) -> float:
    if not hasattr(errors, "__len__"):  # the same in each iteration
        return count * _total(name, [check_number(name, errors)], 1)
    if len(errors) != count:
        raise ValueError(f"{name} has {len(errors)} entries, but there are {count} iterations")
    if not all(0 <= check_number(name, error) < math.inf for error in errors):
        raise ValueError(f"{name} must be 0 or more in every iteration")
    return math.fsum(errors)


def _check_constants(B: float, beta: float) -> None:
    if not all(0 <= check_number(*x) < math.inf for x in (("B", B), ("beta", beta))):
        raise ValueError(f"B is {B} and beta is {beta}, but both must be 0 or more")


def _check_positive(name: str, value: float) -> None:
    if not 0 < check_number(name, value) < math.inf:
        raise ValueError(f"{name} is {value}, but must be a positive number")


def _check_states(num_states: int) -> None:
    if not 2 <= check_number("num_states", num_states) < math.inf:
        raise ValueError(f"num_states is {num_states}, but must be at least 2")


def _check_last(T: int) -> None:
    if check_whole("T", T) < 0:
        raise ValueError(f"T is {T}, but must be 0 or more")
