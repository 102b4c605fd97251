"""Tabular MDPs against closed forms, simulation, linear programming and another solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from maxent_jax.theory import mdps, optimum, tabular
from maxent_jax.theory.mdps import Dynamics

SMALL = mdps.garnet(6, 3, 2, seed=1)


def two_states(to_second, to_first, start=0.0):
    """Under any of its two equal actions."""
    chain = np.array([[1 - to_second, to_second], [to_first, 1 - to_first]])
    return Dynamics(np.repeat(chain[:, None], 2, axis=1), np.array([1 - start, start]))


compiled_occupancy = jax.jit(tabular.occupancy)


@jax.jit
def compiled_plan(mdp, reward, steps):
    zeros = jnp.zeros((len(mdp.discount), len(mdp.start)))
    values = tabular.plan(mdp, reward, zeros, steps)
    policy = tabular.greedy(tabular.action_values(mdp, reward, values))
    return (
        tabular.occupancy(mdp, policy),
        tabular.planning_loss(mdp, reward, values),
        tabular.best_value(mdp, reward, steps),
    )


def occupancy(mdp, policy):
    with tabular.float64():
        return np.asarray(compiled_occupancy(tabular.on_device(mdp), jnp.asarray(policy)))


def random_policy(mdp, seed):
    with tabular.float64():
        return np.asarray(tabular.random_policy(tabular.on_device(mdp), jax.random.key(seed)))


def plan(mdp, reward, steps):
    """The occupancy of the greedy policy, what it may lose, and what no policy exceeds."""
    with tabular.float64():
        planned = compiled_plan(tabular.on_device(mdp), jnp.asarray(reward), steps)
        return np.asarray(planned[0]), float(planned[1]), float(planned[2])


def best_by_linear_programming(dynamics, discount, reward):
    """max <d, r> over state-action occupancies."""
    states, actions, _ = dynamics.transitions.shape
    flow = np.repeat(np.eye(states), actions, axis=1)
    flow -= discount * dynamics.transitions.reshape(-1, states).T
    cost, begun = -np.repeat(reward, actions), (1 - discount) * dynamics.start
    solved = optimize.linprog(cost, A_eq=flow, b_eq=begun)
    assert solved.success
    return -solved.fun


@pytest.mark.parametrize("discount", [0.0, 0.5, 0.99])
@pytest.mark.parametrize(("p", "q", "start"), [(0.3, 0.2, 0.0), (1.0, 1.0, 0.0), (0.9, 0.05, 0.7)])
def test_discounted_occupancy_of_two_states_in_closed_form(p, q, start, discount):
    mdp = mdps.discounted(two_states(p, q, start), discount)
    # From d(2) = (1 - γ) m + γ (p d(1) + (1 - q) d(2)) and d(1) + d(2) = 1.
    second = ((1 - discount) * start + discount * p) / (1 - discount * (1 - p - q))
    found = occupancy(mdp, random_policy(mdp, 0))
    # Derived: a few roundings, grown by up to 1/(1 - γ).
    np.testing.assert_allclose(found, [1 - second, second], rtol=0, atol=1e-15 / (1 - discount))


WIDE = mdps.garnet(12, 2, tabular.UNROLLED + 1, seed=3)  # more successors than are written out
LARGE = mdps.four_rooms(13)  # more states than are solved for


@pytest.mark.parametrize("dynamics", [SMALL, WIDE, LARGE], ids=["small", "wide", "large"])
def test_what_the_greedy_policy_visits_follows_from_the_chain_that_it_makes(dynamics):
    discount, states = 0.9, len(dynamics.start)
    mdp = mdps.discounted(dynamics, discount)
    reward, values = np.random.default_rng(0).normal(size=(2, states))
    action_values = reward[:, None] + discount * dynamics.transitions @ values
    chain = dynamics.transitions[np.arange(states), action_values.argmax(1)]
    moves = np.eye(states) - discount * chain
    expected = (1 - discount) * np.linalg.solve(moves.T, dynamics.start)
    with tabular.float64():
        device, given = tabular.on_device(mdp), (jnp.asarray(reward), jnp.asarray(values)[None])
        policy = tabular.greedy(tabular.action_values(device, *given))
        found = np.asarray(jax.jit(tabular.greedy_occupancy)(device, *given))
    # Derived: what is left of the flow, 1e-14, grown by 1/(1 - γ).
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(occupancy(mdp, policy), expected, rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [1, 2, 17])
def test_finite_occupancy_of_two_states_in_closed_form(horizon):
    p, q = 0.3, 0.2
    mdp = mdps.finite_horizon(two_states(p, q), horizon)
    steps = np.arange(horizon)
    second = (p / (p + q) * (1 - (1 - p - q) ** steps)).mean()
    found = occupancy(mdp, random_policy(mdp, 0))
    np.testing.assert_allclose(found, [1 - second, second], rtol=0, atol=1e-14)


def simulated(dynamics, policy, goes_on, episodes, random):
    """[episodes, S] visits of each state, one step of all episodes at a time."""
    visits = np.zeros((episodes, len(dynamics.start)))
    state = random.choice(len(dynamics.start), episodes, p=dynamics.start)
    alive, t = np.ones(episodes, bool), 0
    cumulative = dynamics.transitions.cumsum(-1)
    while alive.any():
        visits[np.flatnonzero(alive), state[alive]] += 1
        chances = policy[min(t, len(policy) - 1)][state].cumsum(-1)
        action = (random.random((episodes, 1)) < chances).argmax(1)
        state = (random.random((episodes, 1)) < cumulative[state, action]).argmax(1)
        alive &= random.random(episodes) < goes_on(t)
        t += 1
    return visits


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["discounted", "finite"])
def test_occupancies_agree_with_a_million_simulated_steps(kind):
    dynamics, random = mdps.garnet(20, 4, 3, seed=0), np.random.default_rng(0)
    if kind == "discounted":
        mdp, length, goes_on = mdps.discounted(dynamics, 0.95), 20, lambda t: 0.95
    else:
        mdp, length, goes_on = mdps.finite_horizon(dynamics, 20), 20, lambda t: t < 19
    policy = random_policy(mdp, 3)
    visits = simulated(dynamics, policy, goes_on, 50_000, random) / length
    assert abs(visits.sum() * length / 1e6 - 1) < 0.02
    error = visits.std(0, ddof=1) / np.sqrt(len(visits))
    assert (np.abs(visits.mean(0) - occupancy(mdp, policy)) <= 4 * error).all()
    assert error.max() < 1e-3  # so that it can fail


@pytest.mark.slow
def test_sampled_episodes_visit_states_as_often_as_their_occupancy_says():
    mdp = mdps.discounted(SMALL, 0.8)
    policy = random_policy(mdp, 0)
    with tabular.float64():
        device = tabular.on_device(mdp)
        sample = jax.vmap(lambda key: tabular.sample_visits(device, jnp.asarray(policy), 100, key))
        visits = np.asarray(jax.jit(sample)(jax.random.split(jax.random.key(0), 5_000)))
    error = visits.std(0, ddof=1) / np.sqrt(len(visits))
    assert (np.abs(visits.mean(0) - 5 * occupancy(mdp, policy)) <= 4 * error + 1e-15).all()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("discount", [0.5, 0.95])
def test_planning_finds_the_value_that_linear_programming_finds(seed, discount):
    dynamics = mdps.garnet(12, 3, 3, seed)
    mdp, reward = mdps.discounted(dynamics, discount), np.random.default_rng(seed).normal(size=12)
    found, loss, above = plan(mdp, reward, tabular.converged_steps(mdp))
    expected = best_by_linear_programming(dynamics, discount, reward)
    assert found @ reward == pytest.approx(expected, abs=1e-9)
    assert 0 <= loss < 1e-9
    assert expected - 1e-9 <= above <= expected + 1e-8


def test_the_planning_loss_bounds_what_few_steps_lose():
    mdp, reward = mdps.discounted(mdps.river_swim(), 0.95), np.arange(6.0)
    best = best_by_linear_programming(mdps.river_swim(), 0.95, reward)
    planned = [plan(mdp, reward, steps) for steps in range(9)]
    lost = np.array([best - found @ reward for found, _, _ in planned])
    assert (lost <= np.array([loss for _, loss, _ in planned]) + 1e-12).all()
    assert all(best <= above + 1e-12 for _, _, above in planned)
    assert lost[0] > 0.1  # far from the optimum at first


def test_backward_induction_is_exact_after_the_horizon():
    dynamics, horizon = mdps.double_chain(9), 6
    mdp, reward = mdps.finite_horizon(dynamics, horizon), np.arange(9.0) ** 2
    value = np.zeros(9)
    for _ in range(horizon):  # by hand
        value = reward + (dynamics.transitions @ value).max(1)
    found, loss, _ = plan(mdp, reward, tabular.converged_steps(mdp))
    assert found @ reward == pytest.approx(dynamics.start @ value / horizon)
    assert loss == 0


@pytest.mark.parametrize("smoothing", [1e-3, 0.3])
def test_the_objective_and_its_gradient(smoothing):
    occupied = np.random.default_rng(0).dirichlet(np.ones(7))
    with tabular.float64():
        d = jnp.asarray(occupied)
        expected = -(occupied * np.log(occupied + smoothing)).sum()
        assert float(tabular.objective(d, smoothing)) == pytest.approx(expected, rel=1e-14)
        derived = jax.grad(tabular.objective)(d, smoothing)
        np.testing.assert_allclose(tabular.gradient(d, smoothing), derived, rtol=1e-12)
        entropy = float(tabular.objective(d.at[2].set(0.0), 0.0))
    occupied[2] = 0
    assert entropy == pytest.approx(
        -np.sum(occupied[occupied > 0] * np.log(occupied[occupied > 0]))
    )


def test_float64_stays_inside():
    found = occupancy(mdps.discounted(SMALL, 0.9), random_policy(mdps.discounted(SMALL, 0.9), 0))
    assert found.dtype == np.float64
    assert jnp.ones(2).dtype == jnp.float32


ALL = {
    "garnet": mdps.garnet(20, 4, 3, 0),
    "double chain": mdps.double_chain(),
    "river swim": mdps.river_swim(),
    "four rooms": mdps.four_rooms(),
    "open grid": mdps.open_grid(),
}


@pytest.mark.parametrize("name", ALL)
def test_known_mdps_keep_their_dynamics_in_sparse_form(name):
    transitions, start = ALL[name]
    np.testing.assert_allclose(transitions.sum(-1), 1, rtol=1e-12)
    assert start.sum() == 1
    mdp = mdps.discounted(ALL[name], 0.9)
    dense = np.zeros_like(transitions)
    rows = np.indices(mdp.successors.shape)[:2]
    np.add.at(dense, (*rows, mdp.successors), mdp.probabilities)
    np.testing.assert_allclose(dense, transitions, rtol=0, atol=1e-15)
    reached, before = start > 0, None
    while before is None or (reached != before).any():
        before, reached = reached, reached | (transitions[reached].sum((0, 1)) > 0)
    assert reached.all()


def test_the_known_mdps_by_hand():
    rooms, grid, chain = ALL["four rooms"], ALL["open grid"], ALL["double chain"]
    # 21² less a cross of 2·21 - 1 cells, with 4 doors in it.
    assert len(rooms.start) == 441 - 41 + 4
    assert len(grid.start) == 441
    assert grid.start.argmax() == 220  # the centre
    corner = grid.transitions[0]  # left, right, up, down; neighbours 1 and 21
    np.testing.assert_allclose(corner[0, 0], 1)
    np.testing.assert_allclose(corner[1, [1, 21]], [0.95, 0.05])
    inside = grid.transitions[220, 2]
    np.testing.assert_allclose(inside[[199, 241, 219, 221]], [0.95, *[0.05 / 3] * 3])
    np.testing.assert_allclose(chain.transitions[0, :, :2], [[0.9, 0.1], [0.1, 0.9]])
    np.testing.assert_allclose(chain.transitions[5, 1, [4, 6]], [0.1, 0.9])
    assert chain.start.argmax() == 15
    assert ((ALL["garnet"].transitions > 0).sum(-1) == 3).all()


def test_the_optimum_where_every_state_can_be_visited_equally():
    # Alternating with probability 1/2 from a uniform start: occupancy (1/2, 1/2).
    mdp = mdps.discounted(two_states(0.5, 0.5, 0.5), 0.9)
    found = optimum.solve(mdp, 0.1)
    assert found.objective == pytest.approx(-np.log(0.6), abs=1e-12)


def best_by_slsqp(dynamics, discount, smoothing):
    states, actions, _ = dynamics.transitions.shape
    total = np.repeat(np.eye(states), actions, axis=1)
    flow = total - discount * dynamics.transitions.reshape(-1, states).T
    uniform = dynamics.transitions.mean(1)
    begun = (1 - discount) * dynamics.start
    first = np.repeat(np.linalg.solve(np.eye(states) - discount * uniform.T, begun), actions)

    def loss(x):
        d = total @ x
        return d @ np.log(d + smoothing), total.T @ (np.log(d + smoothing) + d / (d + smoothing))

    solved = optimize.minimize(
        *(loss, first / actions),
        jac=True,
        bounds=[(0, 1)] * (states * actions),
        constraints={"type": "eq", "fun": lambda x: flow @ x - begun, "jac": lambda x: flow},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 2000},
    )
    assert solved.success
    return -solved.fun


@pytest.mark.parametrize("seed", range(3))
def test_the_optimum_is_that_of_another_solver_and_certain_to_1e_8(seed):
    dynamics = mdps.garnet(6, 3, 2, seed)
    found = optimum.solve(mdps.discounted(dynamics, 0.9), 0.05)
    assert found.duality_gap <= 1e-8
    # SLSQP stops at 1e-14 of change; where the optimum is flat that is about its root in distance.
    assert found.objective == pytest.approx(best_by_slsqp(dynamics, 0.9, 0.05), abs=1e-7)
    np.testing.assert_allclose(
        occupancy(mdps.discounted(dynamics, 0.9), found.policy), found.occupancy
    )


@pytest.mark.parametrize(
    "mdp",
    [
        mdps.discounted(mdps.river_swim(20), 0.9),  # nearly a single policy
        mdps.finite_horizon(mdps.double_chain(), 20),  # some states of some steps are out of reach
        mdps.discounted(mdps.four_rooms(11), 0.95),
    ],
    ids=["river swim", "double chain", "four rooms"],
)
def test_the_duality_gap_is_closed_and_bounds_what_other_policies_lack(mdp):
    smoothing = 1 / len(mdp.start)
    found = optimum.solve(mdp, smoothing)
    assert found.duality_gap <= 1e-8
    other = occupancy(mdp, random_policy(mdp, 0))
    lacking = found.objective - -(other * np.log(other + smoothing)).sum()
    assert 0.1 < lacking <= optimum.duality_gap(mdp, other, smoothing)


def test_stacked_mdps_have_an_axis_more_and_one_shape():
    some = [mdps.discounted(mdps.garnet(5, 2, 2, seed), 0.9) for seed in range(3)]
    stacked = mdps.stack(some)
    np.testing.assert_array_equal(stacked.probabilities[2], some[2].probabilities)
    with pytest.raises(ValueError, match="2 MDPs of 2 shapes"):
        mdps.stack([some[0], mdps.discounted(SMALL, 0.9)])


def own(**changes):
    transitions, start = SMALL.transitions.copy(), SMALL.start.copy()
    if "row" in changes:
        transitions[2, 1] = changes["row"]
    return Dynamics(changes.get("transitions", transitions), changes.get("start", start))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: mdps.discounted(own(row=np.full(6, 0.2)), 0.9), "a row of transitions must be"),
        (lambda: mdps.discounted(own(row=[1.5, -0.5, 0, 0, 0, 0]), 0.9), "a row of transitions"),
        (lambda: mdps.discounted(own(row=np.full(6, np.nan)), 0.9), "a row of transitions"),
        (lambda: mdps.discounted(own(start=np.full(6, 0.5)), 0.9), "start must be"),
        (lambda: mdps.discounted(own(start=np.ones(3)), 0.9), "start has shape"),
        (lambda: mdps.discounted(own(transitions=np.ones((2, 3))), 0.9), "transitions have shape"),
        (lambda: mdps.discounted(SMALL, 1.0), "discount is 1.0"),
        (lambda: mdps.discounted(SMALL, -0.1), "discount is -0.1"),
        (lambda: mdps.discounted(SMALL, float("nan")), "discount is nan"),
        (lambda: mdps.finite_horizon(SMALL, 0), "horizon is 0"),
        (lambda: mdps.garnet(5, 2, 6, 0), "branching is 6"),
        (lambda: mdps.garnet(5, 0, 2, 0), "num_actions is 0"),
        (lambda: mdps.double_chain(1), "a side of 1"),
        (lambda: mdps.double_chain(5, 1.5), "failure is 1.5"),
        (lambda: mdps.river_swim(1), "a side of 1"),
        (lambda: mdps.four_rooms(20), "size is 20"),
        (lambda: mdps.open_grid(5, -1.0), "success is -1.0"),
        (lambda: optimum.solve(mdps.discounted(SMALL, 0.9), 0.0), "smoothing is 0.0"),
        (lambda: optimum.solve(mdps.discounted(SMALL, 0.9), 0.1, 0.0), "tolerance is 0.0"),
        (lambda: optimum.solve(mdps.discounted(SMALL, 0.9), 0.1, -1.0), "tolerance is -1.0"),
    ],
)
def test_bad_input_is_one_sentence(call, sentence):
    with pytest.raises(ValueError, match=sentence) as raised:
        call()
    assert "\n" not in str(raised.value)


def test_a_tolerance_beyond_float64_is_refused_with_what_was_reached():
    with pytest.raises(optimum.OptimumError, match=r"above the tolerance of 1\.0e-300"):
        optimum.solve(mdps.discounted(mdps.garnet(12, 3, 3, 0), 0.9), 0.05, 1e-300)


def test_probabilities_need_to_sum_to_one_to_rounding_alone():
    off = SMALL.transitions * (1 + 1e-12)
    assert mdps.discounted(Dynamics(off, SMALL.start), 0.9).probabilities.sum() == pytest.approx(18)
    with pytest.raises(ValueError, match="1 ± 1e-06"):
        mdps.discounted(Dynamics(SMALL.transitions * (1 + 1e-6), SMALL.start), 0.9)


def test_entropy_without_smoothing_is_shannons():
    occupied = np.random.default_rng(1).dirichlet(np.ones(9))
    with tabular.float64():
        found = float(tabular.objective(jnp.asarray(occupied), 0.0))
    assert found == pytest.approx(stats.entropy(occupied), rel=1e-14)
