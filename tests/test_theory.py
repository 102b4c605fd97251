"""The methods in tabular MDPs: against a loop in NumPy, the bounds, and the optimum."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from maxent_jax import errors, mixture
from maxent_jax.commands import theory
from maxent_jax.config.registry import METHODS, STARTS
from maxent_jax.theory import (
    bounds,
    loop,
    mdps,
    optimum,
    peers,
    reference,
    tabular,
    tabular_figures,
    tabular_problems,
)
from maxent_jax.theory.loop import Settings

GARNET = mdps.garnet(8, 3, 2, seed=2)
DISCOUNT, SMOOTHING = 0.9, 1 / 8
MDP = mdps.discounted(GARNET, DISCOUNT)
STEPS = tabular.converged_steps(MDP)
V, LA, H = (METHODS[name] for name in ("v", "la", "h"))


def first_policies(mdp, number):
    keys = jax.random.split(jax.random.key(0), number)
    with tabular.float64():
        device = tabular.on_device(mdp)
        first = jax.jit(jax.vmap(lambda key: tabular.random_policy(device, key)))(keys)
        return np.asarray(first), keys


def run(row, iterations=12, steps=STEPS, seeds=2, mdp=MDP, **options):
    first, keys = first_policies(mdp, seeds)
    settings = Settings(iterations, steps, 1 / len(mdp.start), **options)
    return loop.run(mdp, row, settings, first, keys)


def by_hand(first, iterations, weights, reward):
    """[T + 1, S] the mixtures of Frank-Wolfe, with policy iteration and matrix inverses."""
    transitions, start = GARNET
    states = np.arange(len(start))

    def occupancy(policy):
        chain = np.einsum("sa,sat->st", policy, transitions)
        return (1 - DISCOUNT) * start @ np.linalg.inv(np.eye(len(start)) - DISCOUNT * chain)

    def best_policy(reward):
        chosen = np.zeros(len(start), int)
        for _ in range(100):
            chain = transitions[states, chosen]
            value = np.linalg.solve(np.eye(len(start)) - DISCOUNT * chain, reward)
            chosen = (transitions @ value).argmax(1)
        return np.eye(transitions.shape[1])[chosen]

    found = [occupancy(first)]
    mixtures = [found[0]]
    for t in range(iterations):
        found.append(occupancy(best_policy(reward(mixtures[-1], t))))
        mixtures.append(weights(t + 2) @ np.array(found))
    return np.array(mixtures)


def smoothed_entropy(occupancy):
    return -(occupancy * np.log(occupancy + SMOOTHING)).sum(-1)


def gradient(occupancy, t=None):
    return -np.log(occupancy + SMOOTHING) - occupancy / (occupancy + SMOOTHING)


@pytest.mark.parametrize(
    ("row", "weights"),
    [
        (V, mixture.uniform_weights),
        (H, lambda n: mixture.geometric_weights(n, 0.1)),
        (H._replace(weights="recursive"), lambda n: loop.recursive_weights(n, 0.1)),
    ],
    ids=["V", "official H", "H"],
)
def test_rows_of_the_method_table_run_the_algorithm_as_written_by_hand(row, weights):
    trace, (first, _) = run(row), first_policies(MDP, 2)
    for seed in range(2):
        mixtures = by_hand(first[seed, 0], 12, weights, gradient)
        np.testing.assert_allclose(trace.objective[seed], smoothed_entropy(mixtures), atol=1e-9)
        np.testing.assert_allclose(trace.mixture[seed], mixtures[-1], atol=1e-9)
        shannon = -(mixtures * np.log(mixtures)).sum(-1)
        np.testing.assert_allclose(trace.entropy[seed], shannon, atol=1e-9)
    assert (trace.density_error == 0).all()
    assert trace.planning_error.max() < 1e-8


def test_the_recursive_weights_are_the_recursion():
    weights = np.ones(1)
    for n in range(1, 8):
        np.testing.assert_allclose(loop.recursive_weights(n, 0.3), weights, rtol=1e-14)
        weights = np.append(0.7 * weights, 0.3)


def test_linear_weights_are_those_of_step_2_over_t_plus_2():
    weights = np.ones(1)
    for n in range(1, 8):
        np.testing.assert_allclose(loop.linear_weights(n), weights, rtol=1e-14)
        step = 2 / (n + 2)
        weights = np.append((1 - step) * weights, step)


@pytest.mark.parametrize("eta", [0.1, 0.01])
def test_official_weights_forget_all_but_a_few_policies_however_long_the_run(eta):
    weights = mixture.geometric_weights(1000, eta)
    assert (weights > 0).sum() == round(np.sqrt(2 / eta) + 0.5)
    assert weights[-1] == pytest.approx(np.sqrt(2 * eta), rel=0.2)  # where a step would be η


@pytest.mark.parametrize("start", STARTS)
def test_once_planning_has_converged_its_start_does_not_matter(start):
    found = run(V._replace(start=start))
    np.testing.assert_allclose(found.objective, run(V).objective, atol=1e-9)


@pytest.mark.slow
def test_las_history_is_its_mixture_where_each_step_is_archived():
    trace = run(LA, iterations=20, steps=1)
    np.testing.assert_allclose(trace.history_objective, trace.objective, atol=1e-12)
    assert trace.density_error.max() < 1e-12
    assert trace.objective.std() > 1e-3
    apart = run(LA, iterations=20, steps=5)
    assert apart.density_error[:, 1:].min() > 1e-3


@pytest.mark.slow
def test_a_refresh_period_is_a_number_of_planning_steps():
    at_each, once, after_all = (
        run(LA._replace(refresh_period=period), steps=6).objective for period in (1, 0, 6)
    )
    np.testing.assert_array_equal(once, after_all)
    assert np.abs(at_each - once).max() > 1e-3


@pytest.mark.slow
def test_policies_that_depend_on_time_come_near_the_optimum_too():
    mdp = mdps.finite_horizon(mdps.double_chain(7), 6)
    gap = optimum.solve(mdp, 1 / 7).objective - run(V, iterations=60, steps=6, mdp=mdp).objective
    assert (gap > -1e-8).all()
    assert (gap[:, -1] < 0.02 * gap[:, 0]).all()


@pytest.mark.slow
def test_seeds_and_mdps_side_by_side_change_nothing():
    some = [mdps.discounted(mdps.garnet(8, 3, 2, seed), DISCOUNT) for seed in (5, 2)]
    stacked, alone = run(V, mdp=MDP), []
    first, keys = first_policies(MDP, 2)
    settings = Settings(12, STEPS, SMOOTHING)
    both = loop.run(mdps.stack(some), V, settings, first, keys)
    np.testing.assert_allclose(both.objective[1], stacked.objective[1], atol=1e-12)
    assert np.abs(both.objective[0] - stacked.objective[0]).max() > 1e-3
    alone = loop.run(MDP, V, settings, first[1:], keys[1:])
    np.testing.assert_allclose(alone.objective[0], stacked.objective[1], atol=1e-12)


RIVER = mdps.discounted(mdps.river_swim(), 0.95)
LONG = 400


def gap_and_bound(row, of_bound, **options):
    """[N, T] after 1 ... T iterations."""
    trace = run(row, iterations=LONG, seeds=3, mdp=RIVER, **options)
    best = optimum.solve(RIVER, 1 / 6).objective
    constants = bounds.objective_range(6, 1 / 6), bounds.smoothness(1 / 6)
    bound = [
        [of_bound(n, *constants, *errors) for n in range(1, LONG + 1)]
        for errors in zip(trace.density_error, trace.planning_error, strict=True)
    ]
    return best - trace.objective, np.array(bound)


def veritas(n, of_range, beta, density, planning):
    return bounds.veritas_epsilon(n - 1, of_range, beta, density[:n], planning[:n])


@pytest.mark.parametrize(
    ("row", "options"),
    [
        (V, {}),
        (V, {"density_noise": 0.01, "planning_noise": 0.1}),
        (LA, {"steps": 16}),
        (LA._replace(refresh_period=4), {"steps": 16}),
    ],
    ids=["V", "noisy V", "LA", "LA, refreshed less"],
)
def test_gaps_lie_below_theorem_1_with_the_errors_made(row, options):
    gap, bound = gap_and_bound(row, veritas, **options)
    assert (gap[:, 1:] < bound).all()
    assert (gap > -1e-8).all()


def test_theorem_1_says_something_here_so_that_the_check_can_fail():
    gap, bound = gap_and_bound(V, veritas)
    assert (bound[:, -1] < 0.5 * np.log(6)).all()
    assert (gap[:, 0] > bound[:, -1]).all()  # a method that learned nothing would be caught
    assert (gap[:, -1] < 0.01 * bound[:, -1]).all()  # and V is far better than the bound


def test_gaps_lie_below_the_bound_of_h_for_the_weights_that_it_is_about():
    def hazan(n, of_range, beta, density, planning):
        return bounds.hazan_epsilon(n, of_range, beta, 0.02, density.max(), planning.max())

    gap, bound = gap_and_bound(H._replace(weights="recursive"), hazan, eta=0.02)
    assert (gap[:, 1:] < bound).all()
    assert (gap[:, 0] > bound[:, -1]).all()


def test_noise_has_the_size_that_was_asked_for():
    trace = run(V, density_noise=0.003, planning_noise=0.05)
    # A density that would be negative is cut off at 0, which brings it nearer to the truth.
    np.testing.assert_allclose(trace.density_error, 0.003, rtol=1e-9)
    np.testing.assert_allclose(trace.planning_error, 0.05, atol=1e-8)


@pytest.mark.slow
def test_where_one_policy_is_optimal_v_never_forgets_the_first():
    mdp = mdps.discounted(mdps.river_swim(20), 0.9)
    best = optimum.solve(mdp, 1 / 20)
    trace = run(V, iterations=200, seeds=2, mdp=mdp)
    first, _ = first_policies(mdp, 2)
    with tabular.float64():
        begun = [tabular.occupancy(tabular.on_device(mdp), jnp.asarray(p)) for p in first]
    reward = -np.log(best.occupancy + 0.05) - best.occupancy / (best.occupancy + 0.05)
    cost = np.array([(best.occupancy - np.asarray(d)) @ reward for d in begun])
    # R is concave, so the gap is at least linear in what the mixture has of the first policy.
    gap = best.objective - trace.objective[:, -1]
    assert (gap >= cost / 201 - 1e-8).all()
    assert (gap < 1.5 * cost / 201).all()
    forgetful = run(H, iterations=200, seeds=2, mdp=mdp).objective[:, -1]
    assert (best.objective - forgetful < 1e-3 * gap).all()


@pytest.mark.slow
def test_fully_corrective_weights_find_the_optimum_that_the_solver_finds():
    first, _ = first_policies(MDP, 1)
    best = optimum.solve(MDP, SMOOTHING)
    found = reference.run(MDP, reference.fully_corrective, first[0], 30, SMOOTHING)
    assert found[-1] == pytest.approx(best.objective, abs=1e-7)
    searched = reference.run(MDP, reference.line_search, first[0], 30, SMOOTHING)
    assert (np.diff(searched) >= -1e-12).all()
    assert (searched <= found + 1e-9).all()  # the best of all weights, and a better start each time
    np.testing.assert_allclose(searched[:2], found[:2], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_no_other_weights_beat_the_fully_corrective_ones(seed):
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 8))
    occupancies = random.dirichlet(np.full(10, 0.2), n)
    found = mixture.fully_corrective_weights(occupancies, 0.01)
    assert found.shape == (n,)
    assert found.min() >= 0
    assert found.sum() == pytest.approx(1)
    value = lambda weights: -((d := weights @ occupancies) * np.log(d + 0.01)).sum(-1)
    others = random.dirichlet(np.full(n, 0.5), 2000)
    assert max(value(w) for w in others) <= value(found) + 1e-9


def test_fully_corrective_weights_by_hand():
    # Two policies in one state, one in the other: half and half, however the first half is split.
    occupancies = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    found = mixture.fully_corrective_weights(occupancies, 0.1)
    np.testing.assert_allclose(found[:2].sum(), 0.5, atol=1e-7)
    with pytest.raises(ValueError, match="at least 1 policy"):
        mixture.fully_corrective_weights(np.empty((0, 2)), 0.1)
    with pytest.raises(ValueError, match="smoothing is 0"):
        mixture.fully_corrective_weights(occupancies, 0.0)


def test_ent_game_with_expected_visits_as_written_by_hand():
    first, keys = first_policies(MDP, 2)
    found = peers.ent_game(MDP, first, 15, 0.7, False, keys)

    def reward(mixed, t):
        return -np.log((t + 1) * mixed / (1 - DISCOUNT) + 0.7)

    for seed in range(2):
        mixtures = by_hand(first[seed, 0], 15, mixture.uniform_weights, reward)
        np.testing.assert_allclose(found.mixture[seed], mixtures[-1], atol=1e-9)
        entropy = -(mixtures * np.log(mixtures)).sum(-1)
        np.testing.assert_allclose(found.entropy[seed], entropy, atol=1e-9)


@pytest.mark.slow
def test_ent_game_with_sampled_visits_approaches_the_same_entropy():
    first, keys = first_policies(MDP, 2)
    sampled = peers.ent_game(MDP, first, 100, 1.0, True, keys).entropy
    expected = peers.ent_game(MDP, first, 100, 1.0, False, keys).entropy
    assert (expected[:, -1] - sampled[:, -1] < 0.05).all()
    assert (sampled[:, -1] - sampled[:, 0] > 0.05).all()


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: run(V, iterations=0), "num_iterations is 0"),
        (lambda: run(V, steps=0), "planning_steps is 0"),
        (lambda: run(V, density_noise=-1.0), "density_noise is -1.0"),
        (lambda: run(V, planning_noise=float("inf")), "planning_noise is inf"),
        (lambda: run(V._replace(weights="steep")), "unknown weights 'steep'"),
        (lambda: run(V._replace(reference="future")), "unknown reference 'future'"),
        (lambda: run(V._replace(start="best ever")), "unknown start 'best ever'"),
        (lambda: peers.ent_game(MDP, *first_policies(MDP, 1), 0.0, False, None), "prior|num"),
    ],
)
def test_bad_input_is_one_sentence(call, sentence):
    with pytest.raises((ValueError, TypeError), match=sentence):
        call()


@pytest.mark.slow
def test_the_entry_point_at_toy_size(tmp_path, capsys):
    theory.main(["--toy", "--out", str(tmp_path / "results" / "theory.json")])
    results = json.loads((tmp_path / "results" / "theory.json").read_text())
    assert set(results["rates"]) == {"river swim", "Garnet"}
    for name, found in results["rates"].items():
        assert found["duality_gap"] <= 1e-8
        assert 0 < found["largest_share_of_bound"] < 1
        assert found["slope"] < 0
        for method in results["methods"][name]["methods"].values():
            assert method.get("largest_share_of_bound", 0) < 1
    assert all(row["largest_share_of_bound"] < 1 for row in results["noise"]["rows"])
    for name in ("gaps", "refresh", "cases"):
        assert (tmp_path / "results" / f"theory_{name}.png").read_bytes()[:4] == b"\x89PNG"
    printed = capsys.readouterr()
    assert "Prop. 1" in printed.out
    assert not printed.err


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--discount", "1"], "--discount is 1.0, but must be above 0 and below 1."),
        (["--tolerance", "0"], "--tolerance is 0.0, but must be a positive number."),
        (["--iterations", "5"], "--iterations is 5, but must be at least 20, to fit a rate."),
        (["--seeds", "1", "--few-seeds", "1"], "--seeds is 1, but must be at least 2"),
        (["--few-seeds", "21"], "--few-seeds is 21, but must be from 1 to --seeds = 20."),
        (["--seed", "-1"], "--seed is -1, but must be 0 or more"),
        (["--mdp", "nowhere.npz"], "--mdp nowhere.npz cannot be read"),
        (["--out", "."], ". is a folder: name a file."),
        (["--out", f"{__file__}/theory.json"], f"cannot make the folder {__file__}"),
        (["--figures", __file__], f"cannot make the folder {__file__}"),
    ],
)
def test_bad_flags_are_one_sentence(flags, sentence):
    mistake = (errors.UsageError, errors.ConfigError)
    with pytest.raises(mistake, match=sentence.replace(".", r"\.")):
        theory.main(flags)


@pytest.mark.parametrize("row", [[0.5, 0.6, 0], [0.5, 0.4, 0]])
def test_an_mdp_of_ones_own_is_checked_before_anything_is_computed(tmp_path, row):
    transitions = np.tile(np.eye(3)[:, None], (1, 2, 1))
    transitions[1, 1] = row
    np.savez(tmp_path / "own.npz", transitions=transitions, start=np.eye(3)[0])
    with pytest.raises(
        errors.UsageError, match="a row of transitions must be 0 or more and sum to one"
    ):
        theory.main(["--mdp", str(tmp_path / "own.npz"), "--out", str(tmp_path / "theory.json")])
    assert not (tmp_path / "theory.json").exists()


@pytest.mark.parametrize("content", ["empty", "half", "array"])
def test_a_file_that_is_no_archive_is_one_sentence(tmp_path, content):
    path = tmp_path / "own.npz"
    np.savez(path, transitions=np.full((2, 1, 2), 0.5), start=np.eye(2)[0])
    if content == "array":
        with path.open("wb") as file:
            np.save(file, np.eye(2))
    else:
        path.write_bytes(path.read_bytes()[: 100 if content == "half" else 0])
    with pytest.raises(errors.UsageError, match=r"own\.npz is not an \.npz file: save it with"):
        tabular_problems.read(path, 0.9)


def test_the_results_of_an_mdp_of_ones_own_are_written(tmp_path, monkeypatch):
    """The studies themselves take a minute: see the test of the whole command."""
    monkeypatch.setattr(theory, "study", lambda arguments: {"settings": vars(arguments)})
    monkeypatch.setattr(tabular_figures, "draw", lambda results, folder: [])
    monkeypatch.setattr(theory, "_print", lambda results: None)
    theory.main(["--mdp", "own.npz", "--out", str(tmp_path / "new" / "theory.json")])
    held = json.loads((tmp_path / "new" / "theory.json").read_text())
    assert held["settings"]["mdp"] == "own.npz"


def test_the_exit_code_of_a_mistake_is_2_and_jax_is_not_loaded_for_it():
    code = (
        "import sys; from maxent_jax.commands import theory\n"
        "try: theory.cli.entry_point(theory.main)(['--tolerance', '-1'])\n"
        "except SystemExit as stop: sys.exit(10 * ('jax' in sys.modules) + stop.code)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True
    )
    assert ended.returncode == 2
    assert ended.stderr == "error: --tolerance is -1.0, but must be a positive number.\n"
