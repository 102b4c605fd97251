"""Episodes of a mixture to their ends, their weights, and the scores of its policies."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from maxent_jax import components, mixture, rollout
from maxent_jax.components import Components
from maxent_jax.config import preset
from maxent_jax.density import histogram
from maxent_jax.envs import base
from maxent_jax.mixture import occupancy
from maxent_jax.mixture.occupancy import Occupancy
from maxent_jax.mixture.scores import Scores, best, score
from maxent_jax.sac import agent

T = 6
NEVER = 1e6


class Fuse(Env):
    """Burns down by the action's amount: health fails at 0, numbers below 0. Then it grows back.

    That it revives when stepped on is the trap: an ended episode must not.
    """

    def reset(self, rng):
        raise NotImplementedError

    def step(self, state, action):
        left = state.obs[0] - action[0]
        left = jnp.where(left < 0, jnp.nan, left)
        return fuse(jnp.where(state.done > 0, 3.0, left))

    observation_size = 1
    action_size = 1
    backend = "none"


FUSE = Fuse()


def fuse(left):
    left = jnp.asarray(left, jnp.float32)
    return State(left, left[..., None], jnp.zeros_like(left), (left == 0).astype(jnp.float32))


def burn(observation, key):
    return jnp.ones_like(observation)


@pytest.fixture(scope="module")
def burnt():
    lengths = jnp.array([1.0, 3.0, T, T + 1, NEVER, 2.5])
    run = jax.jit(lambda starts, key: rollout.episodes(FUSE, starts, burn, T, key))
    return lengths, run(fuse(lengths), jax.random.key(0))


def test_an_episode_counts_to_its_last_state_and_no_further(burnt):
    _, trajectories = burnt
    # The last fuse steps over 0: its third step leaves the numbers, and is no state.
    lived = np.array([1, 3, T, T, T, 2])
    np.testing.assert_array_equal(trajectories.alive, np.arange(T)[:, None] < lived)
    assert trajectories.num_invalid == 1


def test_states_are_those_reached(burnt):
    lengths, trajectories = burnt
    expected = np.asarray(lengths) - np.arange(1, T + 1)[:, None]
    alive = np.asarray(trajectories.alive)
    np.testing.assert_array_equal(trajectories.states[..., 0][alive], expected[alive])
    assert np.isfinite(trajectories.states).all()


def test_only_health_terminates_and_actions_are_those_taken(burnt):
    lengths, trajectories = burnt
    left = np.asarray(lengths) - np.arange(1, T + 1)[:, None]
    # The fuse that steps over 0 and those that burn on are cut, not terminated.
    np.testing.assert_array_equal(trajectories.terminated, left == 0)
    assert trajectories.actions.shape == (T, len(lengths), 1)
    assert (np.asarray(trajectories.actions)[np.asarray(trajectories.alive)] == 1).all()


def test_the_policy_sees_the_state_and_a_new_key_each_step():
    def act(observation, key):
        return jnp.where(observation > 50, observation / 2, jax.random.uniform(key, (2, 1)))

    run = rollout.episodes(FUSE, fuse(jnp.array([64.0, 10.0])), act, T, jax.random.key(1))
    assert run.states[0, 0, 0] == 32
    steps = -np.diff(run.states[:, 1, 0])
    assert len(np.unique(steps.round(4))) == T - 1


def make_parts(**changes):
    return components.make(preset("smoke", **changes))


def make_archive(p, size):
    archive = None
    for key in jax.random.split(jax.random.key(2), size):
        parameters = agent.init(p.sac, key).parameters
        archive = mixture.init(parameters, 3) if archive is None else archive
        archive = mixture.append(archive, parameters)
    return archive


def make_starts(p):
    """Starts of 8 episodes, of which the first three leave the ground for good at once."""
    episodes = base.init(p.env, p.config.mixture.mixture_episodes, 64, jax.random.key(3))
    start = episodes.env.pipeline_state
    leaping = start._replace(qvel=start.qvel.at[:3, 2].set(8.0))
    return episodes.env.replace(pipeline_state=leaping)


WEIGHTS = jnp.array([0.5, 0.2, 0.3])


@pytest.fixture(scope="module", params=[False, True], ids=["stratified", "pooled"])
def visited(request):
    p = make_parts(pooled=request.param)
    run = jax.jit(lambda a, s, k: occupancy.of_mixture(p, a, WEIGHTS, s, k))
    return p.config, run(make_archive(p, 3), make_starts(p), jax.random.key(4))


def test_a_mixtures_states_weigh_one_in_all(visited):
    config, found = visited
    rows = config.mixture.mixture_episodes * config.environment.episode_length
    assert found.states.shape == (rows, 29) and found.features.shape == (rows, 7)
    assert found.num_invalid == 0
    # Sums of 800 float32 of that size.
    assert np.sum(found.weight) == pytest.approx(1, abs=1e-5)
    assert (np.asarray(found.weight)[~np.asarray(found.alive)] == 0).all()


def test_policies_weigh_as_told_or_by_the_states_they_reach(visited):
    config, found = visited
    policy, weight, alive = (np.asarray(x) for x in (found.policy, found.weight, found.alive))
    lived = np.bincount(policy[alive], minlength=3)
    share = np.bincount(policy, weight, minlength=3)
    assert lived[0] < lived[1] / 2  # so the two ways to weigh are far apart
    expected = lived / lived.sum() if config.mixture.pooled else WEIGHTS
    np.testing.assert_allclose(share, expected, atol=1e-5)
    for one in range(3):
        own = weight[(policy == one) & alive]
        np.testing.assert_allclose(own, own[0], rtol=1e-6)


def test_episodes_are_shared_among_the_policies(visited):
    config, found = visited
    played = np.bincount(found.episode_policy, minlength=3)
    shares = np.asarray(WEIGHTS) if config.mixture.pooled else np.full(3, 1 / 3)
    assert (np.abs(played - shares * config.mixture.mixture_episodes) < 1).all()
    grid = np.asarray(found.policy).reshape(config.environment.episode_length, -1)
    np.testing.assert_array_equal(grid, np.broadcast_to(found.episode_policy, grid.shape))


def test_empty_slots_do_not_play(key):
    p = make_parts()
    weights = jnp.array([0.25, 0.75, 0.0])
    found = jax.jit(lambda a, s: occupancy.of_mixture(p, a, weights, s, key))(
        make_archive(p, 2), make_starts(p)
    )
    np.testing.assert_array_equal(np.bincount(found.episode_policy), [4, 4])
    share = np.bincount(found.policy, found.weight)
    np.testing.assert_allclose(share, weights[:2], atol=1e-5)


def push_apart(archive):
    """Its two policies push with full torque up or down, and hardly any noise; the third not."""
    # The output layer's bias alone.
    output = archive.parameters.actor["params"]["Dense_0"]
    output["kernel"] = jnp.zeros_like(output["kernel"])
    push = jnp.array([[10.0], [-10.0], [0.0]])
    output["bias"] = jnp.concatenate([jnp.tile(push, 8), jnp.full((3, 8), -9.0)], axis=1)
    return archive


def test_an_episode_is_played_by_its_own_policy(key):
    p = make_parts()
    archive = push_apart(make_archive(p, 2))
    starts = make_starts(p)
    found = jax.jit(lambda a, s: occupancy.of_mixture(p, a, WEIGHTS, s, key))(archive, starts)
    torque = jnp.where(found.episode_policy == 0, 1.0, -1.0)
    after = jax.jit(jax.vmap(p.env.step))(starts, jnp.tile(torque[:, None], 8))
    # tanh(10 ± 0.03) is 1 to the last place of a float32.
    np.testing.assert_allclose(found.states[: len(torque)], after.obs, atol=1e-5)


@pytest.mark.slow
def test_a_policy_can_be_drawn_for_each_step(key):
    p = make_parts(mixing="step", leave_own_out=False, start="last")
    starts = make_starts(p)
    archive = push_apart(make_archive(p, 2))
    run = jax.jit(lambda a, w, s, k: occupancy.of_mixture(p, a, w, s, k))
    up, down = (
        jax.jit(jax.vmap(p.env.step))(starts, jnp.full((8, 8), sign)).obs for sign in (1.0, -1.0)
    )
    chosen = []
    for one in jax.random.split(key, 40):
        found = run(archive, jnp.array([0.25, 0.75, 0.0]), starts, one)
        first = found.states[:8]
        is_up = jnp.abs(first - up).max(1) < 1e-4
        assert (is_up | (jnp.abs(first - down).max(1) < 1e-4)).all()
        chosen.append(is_up)
    # Derived: 320 draws of probability 1/4; four standard errors.
    assert np.mean(chosen) == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 320))
    assert (np.std(np.stack(chosen), axis=0) > 0).all()  # each episode meets both
    alive = np.asarray(found.alive)
    np.testing.assert_allclose(np.asarray(found.weight)[alive], 1 / alive.sum(), rtol=1e-5)


def test_evaluation_plays_the_policies_that_count_by_their_means_if_asked(key):
    p = make_parts()
    archive, starts = make_archive(p, 3), make_starts(p)
    weights = jnp.array([0.0, 0.0, 1.0])
    run = jax.jit(
        lambda a, s, k: occupancy.of_mixture(
            p, a, weights, s, k, only_weighted=True, deterministic=True
        )
    )
    found = run(archive, starts, key)
    np.testing.assert_array_equal(found.episode_policy, np.full(8, 2))
    again = run(archive, starts, jax.random.key(99))
    np.testing.assert_array_equal(found.states, again.states)  # no draw is left


@pytest.mark.slow
@pytest.mark.parametrize("corrective", [False, True])
def test_fully_corrective_weights_raise_the_entropy_of_the_same_states(key, corrective):
    p = make_parts(weights="fully_corrective" if corrective else "uniform")
    archive, starts = make_archive(p, 3), make_starts(p)
    before = jax.jit(lambda a, s: occupancy.of_mixture(p, a, WEIGHTS, s, key))(archive, starts)
    after, weights = jax.jit(lambda o: occupancy.corrected(p, o, WEIGHTS))(before)

    def entropy(found):
        cells = histogram.count(found.states, p.grid, found.weight)
        return float(histogram.shannon_entropy(cells))

    share = np.bincount(np.asarray(after.policy), np.asarray(after.weight), minlength=3)
    np.testing.assert_allclose(share, weights, atol=1e-4)
    if corrective:
        assert entropy(after) > entropy(before) + 1e-3
    else:
        np.testing.assert_array_equal(after.weight, before.weight)
        np.testing.assert_array_equal(weights, WEIGHTS)


# Score and best, on occupancies made by hand.

NUM_STATES, NUM_FEATURES, NUM_POINTS = 60, 7, 24


def hand_made(key, num_policies=3):
    """States of two episodes a policy, the second of policy 0 cut short."""
    episode_policy = jnp.repeat(jnp.arange(num_policies, dtype=jnp.int32), 2)
    length = NUM_STATES // len(episode_policy)
    lived = jnp.full(2 * num_policies, length).at[1].set(2)
    alive = (jnp.arange(length)[:, None] < lived[None]).reshape(-1)
    features = jax.random.normal(key, (NUM_STATES, NUM_FEATURES))
    return Occupancy(
        states=features,
        features=features,
        policy=jnp.tile(episode_policy, length),
        weight=alive / jnp.sum(alive),
        alive=alive,
        episode_policy=episode_policy,
        num_invalid=jnp.zeros((), jnp.int32),
    )


def archive_of(size, capacity=4):
    return mixture.Archive({"w": jnp.zeros((capacity, 1))}, jnp.asarray(size, jnp.int32))


def expected_scores(found, points, rows, config, size, capacity=4):
    """By hand, in float64: for each state, a sorted list of the distances it may see."""
    policy, alive, rows = (np.asarray(x) for x in (found.policy, found.alive, rows))
    iteration = -(-policy // config.mixture.snapshots)
    total, lived = np.zeros(capacity), np.zeros(capacity)
    for i in np.flatnonzero(alive):
        hidden = rows == i
        if config.mixture.leave_own_out and size > 1:
            hidden = (rows >= 0) & (iteration[rows] == iteration[i])
        difference = np.float64(points) - np.float64(found.features[i])
        distances = np.sort(np.sqrt((difference[~hidden] ** 2).sum(1)))
        total[policy[i]] += np.log1p(
            distances[config.intrinsic.num_neighbors - 1] / config.intrinsic.reward_distance
        )
        lived[policy[i]] += 1
    played = np.bincount(found.episode_policy, minlength=capacity)
    return total / np.maximum(played, 1), total / np.maximum(lived, 1)


@pytest.mark.slow
def bare(config):
    """Components that can score, and no more."""
    return Components(config, *[None] * 5, phi=SimpleNamespace(names=("x", "y")))


@pytest.mark.parametrize("leave_own_out", [False, True])
@pytest.mark.parametrize("source", ["mixture", "history"])
@pytest.mark.parametrize(("num_policies", "snapshots"), [(1, 1), (3, 1), (3, 2)])
def test_scores_are_those_by_hand(key, leave_own_out, source, num_policies, snapshots):
    config = preset("smoke", leave_own_out=leave_own_out, reward_distance=0.5, snapshots=snapshots)
    found = hand_made(key, num_policies)
    rows = jax.random.permutation(key, jnp.flatnonzero(found.alive))[:NUM_POINTS]
    points = found.features[rows]
    if source == "history":  # points that no state of these rollouts is
        points, rows = points + 0.1, jnp.full_like(rows, -1)
    scores = score(bare(config), found, points, rows, archive_of(num_policies))
    expected = expected_scores(found, points, rows, config, num_policies)
    # Sums of up to 60 float32 rewards of order 1.
    np.testing.assert_allclose(scores.episode_return, expected[0], rtol=1e-5)
    np.testing.assert_allclose(scores.step_reward, expected[1], rtol=1e-5)


def test_a_parked_policy_scores_low_only_among_its_own_states():
    # Policy 1 stands still far out: all its states are one point, seen by nobody else.
    found = hand_made(jax.random.key(5), num_policies=2)
    parked = (found.policy == 1)[:, None]
    found = found._replace(features=jnp.where(parked, 100.0, found.features))
    rows = jnp.arange(NUM_STATES, dtype=jnp.int32)
    winner = {}
    for leave_own_out in (False, True):
        p = bare(preset("smoke", leave_own_out=leave_own_out))
        scores = score(p, found, found.features, rows, archive_of(2))
        winner[leave_own_out] = int(best(scores, found))
        if not leave_own_out:
            assert scores.step_reward[1] == 0  # its own states lie at distance 0
    assert winner == {False: 0, True: 1}


@pytest.mark.slow
def test_a_policy_that_made_the_whole_reference_sees_its_own_states(key):
    # As the newest does, where it has all the weight; the others see it as ever.
    found = hand_made(key)
    rows = jnp.flatnonzero((found.policy == 2) & found.alive).astype(jnp.int32)
    for num_foreign in (0, 2, 3):
        seen = jnp.concatenate([rows, jnp.arange(num_foreign, dtype=jnp.int32)])
        assert (found.policy[seen] != 2).sum() == num_foreign
        scores = {
            leave_own_out: score(
                bare(preset("smoke", leave_own_out=leave_own_out)),
                found,
                found.features[seen],
                seen,
                archive_of(3),
            ).step_reward
            for leave_own_out in (False, True)
        }
        assert (scores[True][:3] < 10).all()  # with no point left a step would pay 88
        enough = num_foreign >= 3  # k
        assert (scores[True][2] > scores[False][2]) == enough
        np.testing.assert_array_equal(scores[True][2] == scores[False][2], not enough)


def test_a_policy_without_weight_is_scored_all_the_same(key):
    # As MaxEnt-H weighs its older policies: they play, and the mixture does without them.
    found = hand_made(key)
    weightless = found._replace(weight=jnp.where(found.policy == 0, 0.0, found.weight))
    p = bare(preset("smoke"))
    rows = jnp.arange(NUM_STATES, dtype=jnp.int32)
    scores = [score(p, each, found.features, rows, archive_of(3)) for each in (found, weightless)]
    np.testing.assert_array_equal(scores[1].episode_return, scores[0].episode_return)
    assert scores[1].step_reward[0] > 0


@pytest.mark.parametrize(
    ("returns", "players", "winner"),
    [
        ([1.0, 3.0, 2.0, 0.0], [0, 1, 2], 1),
        ([1.0, 3.0, 2.0, 9.0], [0, 2, 2], 2),
        ([-5.0, -7.0, 0.0, 0.0], [0, 1, 1], 0),
    ],
    ids=["highest", "who did not play", "an empty slot beats none"],
)
def test_the_best_is_the_highest_that_played(key, returns, players, winner):
    found = hand_made(key)._replace(episode_policy=jnp.array(players, jnp.int32))
    scores = Scores(jnp.array(returns), jnp.zeros(4))
    assert int(best(scores, found)) == winner
