"""Methods as published and baselines within training: what SAC is paid, and what it is not."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from maxent_jax import algorithm, components
from maxent_jax.algorithm import experience, payment, training
from maxent_jax.config import preset
from maxent_jax.config.registry import BASELINES, STARTS
from maxent_jax.density import histogram
from maxent_jax.intrinsic import Bonus

STEPS = 12
STILL = ("re3", "rise", "renyi", "vcse")  # have nothing to learn


def config_of(method, **changes):
    return preset("smoke", env="pendulum", method=method, batch_size=16, num_segments=1, **changes)


@functools.lru_cache
def trained(method):
    """The first learner, that after some steps of all envs, and what was measured."""
    config = config_of(method)
    p = components.make(config)
    state = algorithm.start(config)

    @jax.jit
    def run(state):
        learner = state.learner._replace(
            bonus=payment.refresh_bonus(p, state.learner.bonus, visited(p, state))
        )
        step = functools.partial(training.step, p, state.method)
        return jax.lax.scan(step, learner, jax.random.split(jax.random.key(5), STEPS))

    learner, metrics = run(state)
    return config, state.learner, learner, jax.tree.map(np.asarray, metrics)


def visited(p, state):
    """As if a mixture had been in the bottom cell alone."""
    from maxent_jax.mixture.occupancy import Occupancy

    states = state.learner.episodes.starts.obs[:1]
    one = jnp.ones(1)
    nobody = jnp.zeros(1, jnp.int32)
    return Occupancy(states, p.phi(states), nobody, one, one > 0, nobody, nobody[0])


QUICK = ("rnd", "apt")  # one that learns a model, one that measures distances


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(method, marks=() if method in QUICK else pytest.mark.slow)
        for method in (*BASELINES, "h-official")
    ],
)
def test_a_bonus_pays_and_learns_within_training(method):
    config, before, after, metrics = trained(method)
    assert config.intrinsic.bonus == ("histogram" if method == "h-official" else method)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    paid = metrics["replay_paid"]
    assert np.isfinite(paid).all() and paid.std() > 0
    assert not np.allclose(paid, metrics["replay_reward"])  # the distance's, kept to compare
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), before.bonus, after.bonus)
    assert any(jax.tree.leaves(changed)) == (method not in STILL)


def test_the_reward_of_h_as_published_falls_where_the_mixture_is():
    _, _, after, _ = trained("h-official")
    payment = after.bonus.payment
    # The mixture is in one cell of 64, which pays 1/(1 + 1/8); all others pay 8.
    np.testing.assert_allclose(np.sort(payment), [1 / 1.125] + [8.0] * 64, rtol=1e-5)


@pytest.mark.slow
def test_ngu_remembers_each_episode_in_its_own_embedding():
    _, before, after, metrics = trained("ngu")
    assert before.memory.shape == (4, 100, 32)
    filled = np.abs(np.asarray(after.memory)).sum(-1) > 0
    np.testing.assert_array_equal(filled.sum(1), np.full(4, STEPS))
    assert (metrics["replay_bonus"] > 0).all()


def test_a_baseline_goes_on_from_where_it_was_and_is_its_last_policy():
    config = config_of("rnd")
    method = algorithm.start(config).method
    assert STARTS[int(method.start)] == "last"
    np.testing.assert_array_equal(method.weights, np.eye(config.archive_size))


@pytest.mark.slow
def test_an_episode_forgets_the_one_before_it():
    config = config_of("ngu", episode_length=5, reference_size=32)
    p, state = components.make(config), algorithm.start(config)

    @jax.jit
    def run(learner, keys):
        step = functools.partial(training.step, p, state.method)
        return jax.lax.scan(step, learner, keys)[0]

    learner = run(state.learner, jax.random.split(jax.random.key(5), 7))
    assert (learner.episodes.age == 2).all()
    # Of the second episode two states have been left, the rest is the first one's, not looked at.
    before = run(state.learner, jax.random.split(jax.random.key(5), 7)[:5])
    changed = np.abs(np.asarray(learner.memory - before.memory)).sum(-1) > 0
    np.testing.assert_array_equal(changed, [[True, True, False, False, False]] * 4)


def payer(column):
    """A bonus that pays one column of what it is shown, and counts what it has learned from."""
    return Bonus(
        init=lambda key: jnp.zeros(()),
        reward=lambda state, steps: (state, column(steps) * (1 + state)),
        learn=lambda state, steps, key: (state + steps.value.shape[0], {}),
    )


COLUMNS = {
    "where it came from": lambda steps: steps.features[:, 0],
    "where it went": lambda steps: steps.next_features[:, 0],
    "what it did": lambda steps: steps.action[:, 0],
    "the cell": lambda steps: steps.cell.astype(jnp.float32),
    "the row": lambda steps: steps.row.astype(jnp.float32),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", COLUMNS)
def test_a_bonus_is_shown_what_was_drawn_and_pays_before_it_learns(what):
    config = config_of("rnd", updates_per_step=0.5)
    p = components.make(config)._replace(bonus=payer(COLUMNS[what]))
    state = algorithm.start(config)
    learner = state.learner._replace(bonus=jnp.zeros(()))
    step = jax.jit(functools.partial(training.step, p, state.method))
    for key in jax.random.split(jax.random.key(5), 4):
        learner, _ = step(learner, key)
    drawn = experience.sample(p, learner.replay, learner.episodes.starts.obs, (2, 16), key)
    bonus, paid, metrics = payment.pay_bonus(p, learner, drawn, key)

    rows = np.asarray(drawn.row)
    items = learner.replay.items
    at = drawn.next_observation
    cells = histogram.cells(at.reshape(-1, at.shape[-1]), p.grid).reshape(2, 16)
    shown = {
        "where it came from": np.asarray(p.phi(drawn.observation))[..., 0],
        "where it went": np.asarray(p.phi(at))[..., 0],
        "what it did": np.asarray(items.action)[rows][..., 0],
        "the cell": np.asarray(cells),
        "the row": rows,
    }[what]
    learned = 4 * 2 * 16
    np.testing.assert_allclose(metrics["bonus_size"], (1 + learned) * shown.std(), rtol=1e-4)
    np.testing.assert_allclose(paid[..., 0], shown / shown.std(), rtol=1e-4, atol=1e-5)
    assert int(bonus) == learned + 2 * 16


@pytest.mark.slow
def test_stale_rewards_stay_as_they_were_paid():
    fresh, stale = (config_of("v", stale_rewards=value) for value in (False, True))
    found = []
    for config in (fresh, stale):
        state = algorithm.start(config)
        programs = algorithm.programs(config)
        for program in (programs.begin, programs.train_segment, programs.end):
            state, _ = program(state)
        before = np.array(state.learner.replay.items.distances.reached)
        state, _ = programs.begin(state)
        after = np.array(state.learner.replay.items.distances.reached)
        size = int(state.learner.replay.size)
        found.append(np.abs(after - before)[:size].max())
    assert found[0] > 1e-3 and found[1] == 0


@pytest.mark.parametrize("ends", [True, False])
def test_health_ends_an_episode_only_where_it_should(ends):
    from maxent_jax import envs

    env = envs.make("ant", backend="mujoco", end_unhealthy=ends)
    state = jax.jit(env.reset)(jax.random.key(0))
    physics = state.pipeline_state
    flying = physics._replace(qpos=physics.qpos.at[2].set(5.0))
    after = jax.jit(env.step)(state.replace(pipeline_state=flying), jnp.zeros(8))
    assert bool(after.done) == ends


def test_what_a_bonus_cannot_have_is_said():
    from maxent_jax.errors import ConfigError

    with pytest.raises(ConfigError, match="return-steps must be 1"):
        preset("quick", bonus="rnd")
    with pytest.raises(ConfigError, match="must be 0 with bonus rnd"):
        preset("quick", method="rnd", plateau_segments=3)
    with pytest.raises(ConfigError, match="the method sets it"):
        preset("smoke", method="rnd", bonus="icm")
    with pytest.raises(ConfigError, match="no state belongs to one policy"):
        preset("smoke", mixing="step")
    with pytest.raises(ConfigError, match="no health"):
        preset("smoke", env="pendulum", end_unhealthy=False)


def test_methods_as_published_are_methods_of_every_preset():
    for name in ("smoke", "quick", "paper", "gpu"):
        for method in (*BASELINES, "h-official"):
            config = preset(name, method=method)
            assert config.intrinsic.shaping == 0 and config.learner.return_steps == 1
            assert "bonus" in config.deviations()
            assert config.replace(seed=3).program() == config.program()
