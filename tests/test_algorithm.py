"""The outer loop: one program for all methods and seeds, rewards that are never stale."""

import functools
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from maxent_jax import algorithm, components, mixture
from maxent_jax.algorithm import experience, training
from maxent_jax.config import preset
from maxent_jax.mixture import occupancy
from maxent_jax.sac import agent

TINY = dict(num_segments=1, mixture_episodes=4, num_iterations=3, shaping=1.0, backend="mujoco")


def tiny(**changes):
    return preset("smoke", **{**TINY, **changes})


def call(part, config, state):
    """A part of an iteration, compiled once for all tests; the state that goes in stays intact."""
    program = getattr(algorithm.programs(config), part)
    return program(jax.tree.map(jnp.copy, state))


@functools.lru_cache
def stages(method):
    """The state before and after the second iteration's `begin`, and after its segment."""
    config = tiny(method=method)
    state = algorithm.start(config)
    for part in ("begin", "train_segment", "end"):
        state, _ = call(part, config, state)
    begun, metrics = call("begin", config, state)
    trained, _ = call("train_segment", config, begun)
    return config, state, begun, metrics, trained


@functools.lru_cache
def compiled_step(program):
    return jax.jit(functools.partial(training.step, components.make(program)))


def leaves_equal(a, b):
    return all(np.array_equal(x, y) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True))


@pytest.mark.slow
def test_iterate_is_traced_once_in_a_run_of_five_iterations(monkeypatch):
    calls = []
    traced = algorithm.iterate
    monkeypatch.setattr(algorithm.loop, "iterate", lambda c, s: calls.append(1) or traced(c, s))
    config = tiny(num_iterations=5, mixture_episodes=6)
    run = jax.jit(algorithm.run, static_argnums=(0, 2))
    state, metrics = run(config.program(), algorithm.start(config), 5)
    assert len(calls) == 1
    assert state.iteration == 5 and state.archive.size == 6
    np.testing.assert_array_equal(metrics["env_steps"], 400 * np.arange(1, 6))
    np.testing.assert_array_equal(metrics["gradient_steps"], 100 * np.arange(1, 6))
    assert (np.diff(metrics["cumulative_coverage"]) >= 0).all()


@pytest.mark.slow
def test_two_seeds_by_vmap_equal_two_single_runs():
    # 5 steps of 2 envs with 1 update each. Episodes of 10 steps: contacts amplify the last bits
    # in which a batched program differs, so that longer ones could not agree to 1e-4.
    config = tiny(
        num_envs=2,
        steps_per_iteration=10,
        updates_per_step=0.5,
        episode_length=10,
        reference_size=16,
        num_iterations=1,
        num_seeds=2,
    )
    run = jax.jit(algorithm.run, static_argnums=(0, 2))
    together, metrics = jax.jit(
        jax.vmap(
            functools.partial(algorithm.run, config.program(), num_iterations=1),
            in_axes=(algorithm.SEED_AXES,),
            out_axes=(algorithm.SEED_AXES, 0),
        )
    )(algorithm.start(config))
    for index in range(2):
        single = config.replace(seed=index, num_seeds=1)
        alone, metrics_alone = run(config.program(), algorithm.start(single), 1)
        for name in ("env_steps", "gradient_steps", "iteration", "num_deaths", "best_policy"):
            np.testing.assert_array_equal(metrics[name][index], metrics_alone[name])
        learner = jax.tree.map(lambda x, i=index: x[i], together.learner)
        for a, b in (
            (learner.agent.parameters, alone.learner.agent.parameters),
            (learner.replay.items.state, alone.learner.replay.items.state),
            (learner.replay.items.distances, alone.learner.replay.items.distances),
            (learner.reference.points, alone.learner.reference.points),
        ):
            jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4), a, b)


@pytest.mark.slow
def test_seeds_differ():
    config = tiny(num_seeds=2)
    actors = algorithm.start(config).learner.agent.parameters.actor
    assert not leaves_equal(*(jax.tree.map(lambda x, i=i: x[i], actors) for i in range(2)))


def test_all_methods_and_refresh_periods_share_one_compilation():
    programs = {
        algorithm.programs(tiny(method=method, refresh_period=period))
        for method in ("h", "la", "v")
        for period in (-1, 0, 1, 10)
    }
    assert len(programs) == 1
    (shared,) = programs
    for method, period in (("h", 0), ("la", 1), ("la", 10), ("v", 0)):
        state = algorithm.start(tiny(method=method, refresh_period=period))
        for program in shared:
            state, _ = program(state)
    assert [program._cache_size() for program in shared] == [1, 1, 1]


def test_h_starts_from_scratch_la_goes_on_and_v_from_the_best():
    _, before, begun, _, _ = stages("la")
    assert leaves_equal(before.learner.agent, begun.learner.agent)

    _, before, begun, metrics, _ = stages("v")
    best = mixture.policy(before.archive, metrics["best_policy"])
    assert leaves_equal(best, begun.learner.agent.parameters)
    returns = np.asarray(metrics["policy_return"])[:2]
    assert metrics["best_policy"] == np.argmax(returns)

    _, before, begun, _, _ = stages("h")
    for i in range(2):
        archived = mixture.policy(before.archive, jnp.asarray(i))
        assert not leaves_equal(archived.actor, begun.learner.agent.parameters.actor)


def test_an_archived_policy_keeps_the_moments_that_it_was_trained_with():
    config = tiny(normalize_inputs=True, actor_average=0.1)
    p, state = components.make(config), algorithm.start(config)
    states = jax.random.normal(jax.random.key(1), (5, 29))

    def acts(state):
        known = mixture.policy(state.archive, jnp.asarray(1)).policy
        return agent.act(p.sac, known, states, jax.random.key(2))

    for _ in range(2):
        begun, _ = call("begin", config, state)
        before, _ = call("train_segment", config, begun)
        state, _ = call("end", config, before)
        learner = state.learner.agent
        archived = mixture.policy(state.archive, state.archive.size - 1)
        assert leaves_equal(archived.moments, learner.parameters.moments)
        assert leaves_equal(archived.actor, learner.average)
        known_at_the_start = begun.learner.agent.parameters.moments.weight
        assert float(archived.moments.weight - known_at_the_start) == pytest.approx(400)
        assert state.iteration == 1 or leaves_equal(acts(before), acts(state))
    first, second = (mixture.policy(state.archive, jnp.asarray(i)).moments for i in (1, 2))
    assert not leaves_equal(first, second)


def test_an_iteration_archives_its_snapshots_as_they_act_at_that_moment():
    config = tiny(num_iterations=1, num_segments=4, snapshots=2)
    state = algorithm.start(config)
    state, _ = call("begin", config, state)
    after = []
    for _ in range(4):
        state, _ = call("train_segment", config, state)
        after.append(state.learner.agent.parameters)
    state, metrics = call("end", config, state)
    assert state.archive.size == config.archive_size == 3
    assert leaves_equal(mixture.policy(state.archive, jnp.asarray(1)), after[1])
    assert leaves_equal(mixture.policy(state.archive, jnp.asarray(2)), after[3])
    np.testing.assert_allclose(metrics["mixture_weights"], 1 / 3, rtol=1e-6)


@pytest.mark.slow
def test_fully_corrective_weights_are_measured_on_episodes_that_they_were_not_fitted_to(
    monkeypatch,
):
    seen = {}
    corrected, measures = occupancy.corrected, occupancy.measures

    def fit(p, visited, weights):
        seen["fitted"] = visited
        return corrected(p, visited, weights)

    def measure(p, visited, key):
        seen["measured"] = visited
        return measures(p, visited, key)

    monkeypatch.setattr(occupancy, "corrected", fit)
    monkeypatch.setattr(occupancy, "measures", measure)
    config = preset("smoke", env="pendulum", weights="fully_corrective", mixture_episodes=8)
    p = components.make(config)
    program = jax.jit(lambda state: (algorithm.end(config, state)[1], dict(seen)))
    metrics, found = program(algorithm.start(config))  # two policies alike, each with its noise
    assert not np.array_equal(found["fitted"].states, found["measured"].states)
    fitted = corrected(p, found["fitted"], jnp.array([0.5, 0.5, 0.0]))[1]
    np.testing.assert_allclose(metrics["mixture_weights"], fitted, atol=1e-5)
    share = np.bincount(found["measured"].policy, found["measured"].weight, minlength=3)
    np.testing.assert_allclose(share, fitted, atol=1e-5)
    assert abs(fitted[0] - 0.5) > 0.01
    logs = np.log(np.maximum(fitted, 1e-30))
    np.testing.assert_allclose(metrics["effective_policies"], np.exp(-fitted @ logs), rtol=1e-4)


@pytest.mark.parametrize("method", ["h", "v"])
def test_a_frozen_reference_leaves_every_stored_distance_current(method):
    config, before, begun, _, trained = stages(method)
    assert not leaves_equal(before.learner.reference, begun.learner.reference)
    assert leaves_equal(begun.learner.reference, trained.learner.reference)
    ring = trained.learner.replay
    assert int(ring.size) == 800  # half of it from before the refresh
    anew = experience.measure_all(
        components.make(config),
        trained.learner.reference,
        ring,
        trained.learner.episodes.starts.obs,
    )
    for name, stored in ring.items.distances._asdict().items():
        assert (stored[: int(ring.size)] > 0).any()
        # the blocks of the two programs differ, hence the last bits
        np.testing.assert_allclose(getattr(anew.items.distances, name), stored, rtol=1e-5)


@pytest.mark.slow
def test_la_learns_from_the_current_reference_whatever_the_replay_has_stored():
    config, _, _, _, state = stages("la")
    step = compiled_step(config.program())
    learner, key = state.learner, jax.random.key(1)
    items = learner.replay.items
    poison = jax.tree.map(lambda x: x + 1e6, items.distances)
    poisoned = learner._replace(
        replay=learner.replay._replace(items=items._replace(distances=poison))
    )
    clean_after, _ = step(state.method, learner, key)
    poisoned_after, _ = step(state.method, poisoned, key)
    assert leaves_equal(clean_after.agent, poisoned_after.agent)
    # and the same poison reaches a method that keeps its reference: the test can fail
    frozen = state.method._replace(refresh_period=jnp.asarray(0, jnp.int32))
    assert not leaves_equal(
        step(frozen, learner, key)[0].agent, step(frozen, poisoned, key)[0].agent
    )


@pytest.mark.parametrize(("period", "refreshes"), [(1, 10), (3, 4), (10, 1), (1000, 1), (0, 0)])
def test_the_refresh_period_counts_steps_of_all_envs(period, refreshes):
    config = tiny(method="la", refresh_period=period)
    state, _ = call("begin", config, algorithm.start(config))
    step = compiled_step(config.program())
    learner, changes = state.learner, 0
    for key in jax.random.split(jax.random.key(0), 10):
        previous = learner.reference
        learner, _ = step(state.method, learner, key)
        changes += not leaves_equal(previous, learner.reference)
    # With 1000 the first step, whose count is 0, is due all the same.
    assert changes == refreshes


@functools.lru_cache
def lagged(**changes):
    """A config with a policy lag, its jitted vector steps, and a state with a filled replay."""
    config = tiny(policy_lag=1, normalize_inputs=True, **changes)
    state, _ = call("begin", config, algorithm.start(config))
    steps = functools.partial(training.steps, components.make(config.program()))
    # With XLA's older emitters (see conftest), the bits of a loop depend on its length.
    emitters = "xla_cpu_use_fusion_emitters"
    has_older = emitters in os.environ.get("XLA_FLAGS", "")
    steps = jax.jit(steps, compiler_options={emitters: True} if has_older else None)
    learner, metrics = steps(state.method, state.learner, jax.random.split(jax.random.key(7), 5))
    return config, steps, state, learner, metrics


def test_with_a_lag_the_first_vector_step_has_nothing_to_learn_from():
    config, steps, state, _, _ = lagged()
    learner, metrics = steps(state.method, state.learner, jax.random.split(jax.random.key(0), 1))
    kept, before = learner.agent.parameters, state.learner.agent.parameters
    assert leaves_equal(kept._replace(moments=None), before._replace(moments=None))
    assert not leaves_equal(kept.moments, before.moments)  # which saw the states
    assert int(learner.gradient_steps) == 0 and metrics["critic_loss"] == 0
    assert int(learner.replay.size) == int(learner.env_steps) == config.budget.num_envs


def test_with_a_lag_every_later_vector_step_learns():
    config, _, _, learner, metrics = lagged()
    assert int(learner.gradient_steps) == 4 * config.updates_per_vector_step
    assert (metrics["critic_loss"][1:] > 0).all()


def test_with_a_lag_gradient_steps_do_not_see_the_vector_step_beside_them():
    _, steps, state, learner, _ = lagged()
    keys = jax.random.split(jax.random.key(1), 1)
    elsewhere = learner._replace(
        episodes=learner.episodes._replace(
            env=jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), learner.episodes.env)
        )
    )
    one, other = (steps(state.method, x, keys)[0] for x in (learner, elsewhere))
    without_moments = lambda x: x.agent.parameters._replace(moments=None)
    assert not leaves_equal(one.replay.items.state, other.replay.items.state)
    assert leaves_equal(without_moments(one), without_moments(other))
    # and without a lag they do: the test can fail
    step = compiled_step(tiny(normalize_inputs=True).program())
    one, other = (step(state.method, x, keys[0])[0] for x in (learner, elsewhere))
    assert not leaves_equal(without_moments(one), without_moments(other))


def test_with_a_lag_vector_steps_do_not_depend_on_how_they_are_divided():
    _, steps, state, learner, _ = lagged()
    keys = jax.random.split(jax.random.key(2), 6)
    whole, _ = steps(state.method, learner, keys)
    for part in (keys[:2], keys[2:4], keys[4:]):
        learner, _ = steps(state.method, learner, part)
    assert leaves_equal(whole, learner)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["la", "ngu", "rnd"])  # those that change more than the agent
def test_with_a_lag_other_methods_learn_too(method):
    config, _, state, learner, metrics = lagged(method=method, batch_size=32, shaping=0.0)
    assert int(learner.gradient_steps) == 4 * config.updates_per_vector_step
    assert all(np.isfinite(x).all() for x in metrics.values())
    assert not leaves_equal(learner.agent.parameters.actor, state.learner.agent.parameters.actor)


def test_the_history_holds_what_was_visited():
    config, _, _, _, trained = stages("la")
    p = components.make(config)
    ring = trained.learner.replay
    visited = np.asarray(p.phi(ring.items.state[: int(ring.size)]))
    history = np.asarray(trained.learner.history.points)
    # Before there is a history the first rollouts stand in for one; some of them may remain.
    close = (np.abs(history[:, None] - visited[None]).max(-1) < 1e-5).any(1)
    assert close.mean() > 0.4


def test_the_random_baseline_takes_as_many_steps_as_the_agent():
    _, _, _, _, trained = stages("v")
    for visits in (trained.learner.visits, trained.learner.random_visits):
        assert int(visits.cells.sum() + visits.off_grid) == int(trained.learner.env_steps) == 800
