"""Policies that see the episode, and ηψ-learning: against enumeration, a linear solve, by hand."""

import itertools
import json

import jax
import numpy as np
import pytest
from scipy import stats

from maxent_jax.commands import theory
from maxent_jax.config.registry import METHODS
from maxent_jax.errors import ConfigError, UsageError
from maxent_jax.theory import eta_psi, histories, loop, mdps, tabular, trajectories

CHAIN = mdps.double_chain(4, failure=0)  # begins in state 1; the ends hold
GARNET = mdps.garnet(4, 2, 2, seed=1)
KEYS = jax.random.split(jax.random.key(0), 3)


def listed(dynamics, horizon):
    return histories.enumerate_all(mdps.finite_horizon(dynamics, horizon))


def entropy_of(states, num_states):
    return stats.entropy(np.bincount(states, minlength=num_states))


def value(dynamics, horizon, worth, episode=()):
    """The expected entropy of whole episodes, where `worth` of each action's value is taken."""
    num_states = len(dynamics.start)
    if len(episode) == horizon:
        return entropy_of(episode, num_states)
    after = [value(dynamics, horizon, worth, (*episode, s)) for s in range(num_states)]
    if not episode:
        return dynamics.start @ after
    return worth(episode, dynamics.transitions[episode[-1]] @ after)


def measured(of, policy):
    return histories.evaluate(of, policy[None]).trajectory_entropy[0]


@pytest.mark.parametrize("dynamics", [CHAIN, mdps.garnet(4, 3, 1, seed=0)], ids=["chain", "Garnet"])
@pytest.mark.parametrize("horizon", [1, 4, 6])
def test_the_best_policy_is_the_best_of_all_action_sequences(dynamics, horizon):
    of, moves = listed(dynamics, horizon), dynamics.transitions.argmax(-1)

    def entropy(actions):
        states = [dynamics.start.argmax()]
        for action in actions:
            states.append(moves[states[-1], action])
        return entropy_of(states, 4)

    sequences = itertools.product(range(moves.shape[1]), repeat=horizon - 1)
    best = max(entropy(actions) for actions in sequences)
    assert measured(of, histories.best_policy(of)) == pytest.approx(best, abs=1e-14)
    # Without chance, the fixed point of ηψ-learning is optimal.
    fixed = eta_psi.greedy_policy(of, eta_psi.fixed_point(of))
    assert measured(of, fixed) == pytest.approx(best, abs=1e-14)


def test_no_policy_that_sees_the_whole_episode_is_better():
    of = listed(GARNET, 5)
    best = value(GARNET, 5, lambda episode, values: values.max())
    assert measured(of, histories.best_policy(of)) == pytest.approx(best, abs=1e-14)


def test_visits_of_a_markov_policy():
    mdp, of = mdps.finite_horizon(GARNET, 5), listed(GARNET, 5)
    policy = np.random.default_rng(0).dirichlet(np.ones(2), (5, 4))
    found = histories.evaluate(of, histories.of_markov(of, policy)[None])
    by_hand = value(GARNET, 5, lambda episode, v: policy[len(episode) - 1, episode[-1]] @ v)
    assert found.trajectory_entropy[0] == pytest.approx(by_hand, abs=1e-14)
    with tabular.float64():
        occupied = np.asarray(tabular.occupancy(tabular.on_device(mdp), policy))
    np.testing.assert_allclose(found.occupancy[0], occupied, atol=1e-14)
    assert by_hand < histories.entropy(occupied)  # Jensen


def test_eta_and_the_greedy_action_by_hand():
    of = listed(CHAIN, 3)
    right = np.zeros(3, int)  # 1, 2, 3
    for t in (1, 2):
        right[t] = of.following[right[t - 1], 1, 0]
    np.testing.assert_array_equal(of.counts[right], [[0, 1, 0, 0], [0, 1, 1, 0], [0, 1, 1, 1]])
    np.testing.assert_array_equal(of.state[right], [1, 2, 3])
    psi = np.zeros((len(of.state), 2, 4))
    psi[right[1]] = [[0, 1, 0, 1], [2, 0, 0, 0]]  # η + ψ: (0, 2, 1, 1) and (2, 1, 1, 0)
    utility = histories.entropy(of.counts[right[1]] + psi[right[1]])
    np.testing.assert_allclose(utility, 1.5 * np.log(2))  # of (1/2, 1/4, 1/4)
    psi[right[1], 1, 3] = 0.1
    np.testing.assert_array_equal(eta_psi.greedy_policy(of, psi)[right[1]], [0, 1])


def test_the_fixed_point_solves_the_linear_equations_of_its_policy():
    of = listed(GARNET, 5)
    psi = eta_psi.fixed_point(of)
    policy = eta_psi.greedy_policy(of, psi)
    size, actions = policy.shape
    moves = np.zeros((size, actions, size))
    last = of.times[-1].start
    for h, action, n in np.ndindex(last, actions, 2):
        moves[h, action, of.following[h, action, n]] += of.probabilities[h, action, n]
    pairs = np.einsum("hak,kb->hakb", moves, policy).reshape(size * actions, size * actions)
    reached = moves.reshape(-1, size) @ np.eye(4)[of.state]
    solved = np.linalg.solve(np.eye(size * actions) - pairs, reached)
    np.testing.assert_allclose(psi.reshape(-1, 4), solved, atol=1e-13)
    left = psi.sum(-1)[:last] + of.counts.sum(-1)[:last, None]
    np.testing.assert_allclose(left, 5, atol=1e-13)  # η + ψ are all the visits of an episode


def test_where_chance_matters_the_fixed_point_is_not_the_best():
    of = listed(mdps.river_swim(), 10)
    psi = eta_psi.fixed_point(of)
    policy = eta_psi.greedy_policy(of, psi)
    best, reached = measured(of, histories.best_policy(of)), measured(of, policy)
    assert 1e-3 < best - reached < 0.02
    # What it maximises, the entropy of the expected visits, is larger than what it reaches.
    expected = histories.entropy(of.counts[0] + psi[0]).max()
    occupied = histories.evaluate(of, policy[None]).occupancy[0]
    assert expected == pytest.approx(histories.entropy(occupied), abs=1e-12)
    assert expected > best + 0.05


def test_learning_covers_a_chain_and_predicts_its_visits():
    of = listed(CHAIN, 5)  # 1, 0, 1, 2, 3
    psi = eta_psi.learn(of, eta_psi.Settings(num_episodes=1000), KEYS)
    policies = eta_psi.greedy_policy(of, psi)
    found = histories.evaluate(of, policies)
    np.testing.assert_allclose(found.occupancy, [[0.2, 0.4, 0.2, 0.2]] * 3, atol=1e-14)
    # A step of exploration on the way changes no prediction, because a* is greedy. So an error
    # shrinks by 1 - α = 0.9 at each of hundreds of visits, while those after it shrink too.
    np.testing.assert_allclose(psi[:, 0, 0], [[1, 1, 1, 1]] * 3, atol=1e-6)
    random = np.full(policies.shape[1:], 0.5)
    assert measured(of, random) < found.trajectory_entropy.min() - 0.3


@pytest.mark.slow
def test_learning_visits_each_cell_of_a_grid_once():
    of = listed(mdps.open_grid(3, success=1), 9)
    settings = eta_psi.Settings(num_episodes=3000)
    found = histories.evaluate(of, eta_psi.greedy_policy(of, eta_psi.learn(of, settings, KEYS)))
    np.testing.assert_allclose(found.trajectory_entropy, np.log(9), atol=0.16)  # at most one twice
    assert found.trajectory_entropy.max() == pytest.approx(np.log(9))


@pytest.mark.slow
def test_learning_is_better_than_chance_in_a_river():
    of = listed(mdps.river_swim(), 8)
    settings = eta_psi.Settings(num_episodes=3000)
    learned = eta_psi.greedy_policy(of, eta_psi.learn(of, settings, KEYS))
    found = histories.evaluate(of, learned).trajectory_entropy
    assert found.min() > measured(of, np.full(learned.shape[1:], 0.5)) + 0.2
    assert found.max() < measured(of, histories.best_policy(of))


def test_the_archive_of_v_is_that_of_the_method():
    mdp = mdps.finite_horizon(GARNET, 5)
    first = np.full((5, 4, 2), 0.5)
    archive = trajectories.veritas(mdp, first, 12)
    with tabular.float64():
        device = tabular.on_device(mdp)
        occupied = np.mean([tabular.occupancy(device, policy) for policy in archive], axis=0)
    settings = loop.Settings(num_iterations=12, planning_steps=5, smoothing=1 / 4)
    trace = loop.run(mdp, METHODS["v"], settings, first[None], KEYS[:1])
    np.testing.assert_allclose(occupied, trace.mixture[0], atol=1e-14)


def test_discounted_and_large_mdps_are_refused(monkeypatch):
    with pytest.raises(ValueError, match="discounted, but must have a finite horizon"):
        histories.enumerate_all(mdps.discounted(CHAIN, 0.9))
    monkeypatch.setattr(histories, "MOST", 20)
    with pytest.raises(ValueError, match="more than 20 histories: shorten the horizon"):
        listed(CHAIN, 9)


@pytest.mark.slow
def test_the_entry_point_at_toy_size(tmp_path, capsys):
    out = tmp_path / "results" / "trajectories.json"
    theory.main(["trajectories", "--toy", "--out", str(out)])
    found = json.loads(out.read_text())["mdps"]["chain"]["policies"]
    for entropies in found.values():
        assert np.all(np.array(entropies["of_a_trajectory"]) <= np.array(entropies["of_the_mean"]))
    best = found["best that sees the episode"]["of_a_trajectory"][0]
    largest = found["largest entropy of the mean"]["of_the_mean"][0]
    for entropies in found.values():
        assert max(entropies["of_a_trajectory"]) <= best + 1e-12
        assert max(entropies["of_the_mean"]) <= largest + trajectories.TOLERANCE
    assert len(found["ηψ-learning"]["of_a_trajectory"]) == 2
    printed = capsys.readouterr()
    assert "largest entropy of the mean" in printed.out
    assert not printed.err


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--episodes", "0"], "--episodes is 0, but must be at least 1."),
        (["--iterations", "0"], "--iterations is 0, but must be at least 1."),
        (["--seeds", "0"], "--seeds is 0, but must be at least 1."),
        (["--seed", "-1"], "--seed is -1, but must be 0 or more, and below 2^31"),
        (["--out", "."], ". is a folder: name a file."),
        (["--mdp", "own.npz"], "--mdp"),
    ],
)
def test_bad_flags_are_one_sentence(flags, sentence):
    with pytest.raises((ConfigError, UsageError)) as raised:
        theory.main(["trajectories", *flags])
    assert sentence in str(raised.value)
