"""Runs on a task that start from the policies of another run."""

import json
import shutil
import time

import commands
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import user_module  # noqa: F401  registers user:point and user:right
from test_checkpoint import StopAt, restored, timeless

import maxent_jax
from maxent_jax import algorithm, components, mixture
from maxent_jax.algorithm import experience, finetune, payment
from maxent_jax.algorithm.learner import NUM_RESTARTS
from maxent_jax.commands import finetune as finetune_command
from maxent_jax.commands import train
from maxent_jax.config import preset
from maxent_jax.config.registry import ENVS
from maxent_jax.density import plane
from maxent_jax.errors import ConfigError
from maxent_jax.runs import checkpoint, driver, files, source
from maxent_jax.runs.checkpoint import Progress
from maxent_jax.runs.signals import Interrupted
from maxent_jax.sac import agent
from maxent_jax.types import Distances, Outcomes

STARTS = ("scratch", "last", "best", "mixture", "both")


def task_config(**changes):
    """A run on the task `user:right`: the point is paid for its first coordinate."""
    settings = {"env": "user:point", "method": "task", "task": "user:right", "source": "there"}
    return preset("smoke", **{**settings, **changes})


def biased(config, key, bias):
    """Parameters whose actions are those of `tanh(bias)` with little noise, in each dimension."""
    p = components.make(config)
    parameters = agent.init(p.sac, key).parameters
    size = p.sac.action_size
    actor = jax.tree.map(jnp.zeros_like, parameters.actor)
    output = actor["params"]["Dense_0"]
    output["bias"] = jnp.concatenate([jnp.full(size, bias), jnp.full(size, -4.0)])
    return parameters._replace(actor=actor)


def archive_of(config, biases):
    keys = jax.random.split(jax.random.key(1), len(biases))
    made = [biased(config, key, bias) for key, bias in zip(keys, biases, strict=True)]
    archive = mixture.init(made[0], len(made) + 2)  # with empty slots, as of an unfinished run
    for parameters in made:
        archive = mixture.append(archive, parameters)
    return archive


def on_forward(directory, **changes):
    """The config of a run on the task `forward` that starts from the run in a directory."""
    return source.on_task(files.read_config(directory), str(directory), "forward", **changes)


def equal(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


@pytest.mark.parametrize("start_from", STARTS)
def test_the_agent_is_the_one_that_the_start_names(start_from):
    config = task_config(start_from=start_from, first_episodes=2)
    archive = archive_of(config, [-0.1, 0.1, -0.05])
    state, first = finetune.start(config, archive)
    expected = {"scratch": -1, "last": 2, "best": 1, "mixture": -1, "both": 1}[start_from]
    assert int(first.policy) == expected
    if expected < 0:
        fresh = algorithm.start(config).learner.agent.parameters
        assert equal(state.learner.agent.parameters, fresh)
    else:
        chosen = mixture.policy(archive, jnp.asarray(expected))
        assert equal(state.learner.agent.parameters.policy, chosen.policy)
        assert equal(mixture.policy(state.archive, jnp.asarray(0)).policy, chosen.policy)
    assert int(state.archive.size) == 1
    played = start_from in ("best", "mixture", "both")
    assert (int(first.num_steps) > 0) == played == bool(np.isfinite(first.task_return).all())
    assert int(state.learner.first_steps) == int(first.num_steps)
    filled = start_from in ("mixture", "both")
    assert int(state.learner.replay.size) == (int(first.num_steps) if filled else 0)


def test_returns_are_those_of_the_task():
    config = task_config(start_from="best", first_episodes=4)
    _, first = finetune.start(config, archive_of(config, [0.0, 0.1]))
    # An action a moves the point by 0.2 a a step, until it leaves the circle of radius 2.
    along = 0.2 * np.tanh(0.1) * np.arange(1, 101)
    num_steps = np.argmax(2 * along**2 > 4.0) + 1
    np.testing.assert_allclose(first.task_return[1], along[:num_steps].sum(), rtol=0.15)
    assert abs(first.task_return[0]) < 0.2 * first.task_return[1]


def test_the_replay_holds_the_first_episodes():
    config = task_config(start_from="mixture", first_episodes=3, replay_size=4_000)
    state, first = finetune.start(config, archive_of(config, [0.02, -0.03, 0.01]))
    ring, starts = state.learner.replay, np.asarray(state.learner.episodes.starts.obs)
    items = jax.tree.map(lambda x: np.asarray(x[: int(ring.size)]), ring.items)
    begins = items.previous < 0
    assert begins.sum() == 9  # in 3 rounds, for there are 4 environments
    left = np.where(
        begins[:, None], starts[np.maximum(-1 - items.previous, 0)], items.state[items.previous]
    )
    np.testing.assert_allclose(items.state, left + 0.2 * items.action, atol=1e-6)
    np.testing.assert_array_equal(items.task[:, 0], items.state[:, 0])
    goes_on = items.following >= 0
    assert (items.previous[items.following[goes_on]] == np.flatnonzero(goes_on)).all()
    assert goes_on.sum() == len(begins) - begins.sum()
    assert int(first.num_steps) == len(begins)
    assert int(state.learner.visits.cells.sum() + state.learner.visits.off_grid) == len(begins)
    unit_cells = {tuple(cell) for cell in np.floor(items.state).astype(int)}
    assert int(plane.num_cells(state.learner.plane)) == len(unit_cells) > 1


def test_if_no_episode_succeeds_the_newest_policy_and_all_episodes_are_used():
    config = task_config(task="user:beyond", start_from="both", restart_share=0.5)
    state, first = finetune.start(config, archive_of(config, [-0.1, 0.0, -0.2]))
    assert (first.task_return == 0).all() and int(first.policy) == 2
    episodes = state.learner.episodes
    within = np.asarray(episodes.starts.obs[-episodes.restarts.age.shape[0] :])
    assert within[:, 0].min() < -1.0 and (np.abs(within[:, 0]) < 0.5).mean() > 0.2


def test_restarts_are_states_of_successful_episodes():
    config = task_config(task="user:beyond", start_from="both", restart_share=0.5)
    state, first = finetune.start(config, archive_of(config, [-0.1, 0.1]))
    assert first.task_return[0] == 0 and first.task_return[1] > 0
    learner, episodes = state.learner, state.learner.episodes
    num = NUM_RESTARTS
    assert episodes.restarts.age.shape == (min(num, config.environment.num_starts),)
    within = np.asarray(episodes.starts.obs[-episodes.restarts.age.shape[0] :])
    # The successful policy moves right by 0.02 a step, from about 0.
    np.testing.assert_allclose(within[:, 0], 0.02 * episodes.restarts.age, atol=0.5)
    assert within[:, 0].max() > 1
    age = np.asarray(episodes.restarts.age)
    assert age.min() >= 1 and age.max() < config.environment.episode_length
    again = np.asarray(episodes.start) >= config.environment.num_starts
    assert ((np.asarray(episodes.age) > 0) == again).all()
    np.testing.assert_array_equal(learner.place, -1 - episodes.start)
    state, _ = jax.jit(lambda s: algorithm.begin(config, s))(state)
    state, metrics = jax.jit(lambda s: algorithm.train_segment(config, s))(state)
    assert np.isfinite(metrics["critic_loss"])


def test_the_random_baseline_does_not_restart():
    config = task_config(start_from="both", restart_share=1.0, random_baseline=True)
    state, _ = finetune.start(config, archive_of(config, [0.1]))
    again = np.asarray(state.learner.episodes.start) >= config.environment.num_starts
    n = config.budget.num_envs
    assert again.shape == (2 * n,) and again[:n].all() and not again[n:].any()


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_a_checkpoint_with_one_share_of_restarts_for_all_episodes_loads(tmp_path, num_seeds):
    config = task_config(
        start_from="both", restart_share=0.5, random_baseline=True, num_seeds=num_seeds
    )
    files.write_config(tmp_path, config, {}, {})
    state = algorithm.start(config)
    episodes = state.learner.episodes
    of_all = jnp.full((num_seeds,) if num_seeds > 1 else (), 0.5)
    older = episodes._replace(restarts=episodes.restarts._replace(share=of_all))
    older = state._replace(learner=state.learner._replace(episodes=older))
    checkpoint.save(tmp_path, older, Progress([], None, [], {}), {})
    back = checkpoint.restore(tmp_path, "0", config).learner.episodes.restarts
    expected = np.broadcast_to([0.5] * 4 + [0.0] * 4, episodes.restarts.share.shape)
    np.testing.assert_array_equal(back.share, expected)
    np.testing.assert_array_equal(back.age, episodes.restarts.age)


def test_first_episodes_begin_at_starts_and_not_where_restarts_will_be():
    config = task_config(start_from="both", restart_share=0.5, first_episodes=20)
    state, _ = finetune.start(config, archive_of(config, [-0.1, 0.1]))
    items = jax.tree.map(np.asarray, state.learner.replay.items)
    begins = np.arange(len(items.previous)) < int(state.learner.replay.size)
    begins &= items.previous < 0
    rows = -1 - items.previous[begins]
    assert (rows < config.environment.num_starts).all()
    left = np.asarray(state.learner.episodes.starts.obs)[rows]
    moved = 0.2 * items.action[begins]
    np.testing.assert_allclose(items.state[begins], left + moved, atol=1e-6)


def test_a_run_on_a_task_does_not_restart_at_the_cells_of_its_source():
    explored = preset("smoke", env="ant", cell_restarts=0.9)
    config = source.on_task(explored, "there", "forward")
    assert config.environment.cell_restarts == 0 and config.downstream.restart_share == 0.5


def test_only_critics_learn_at_first():
    config = task_config(start_from="last", critic_steps=200)  # a segment of two
    state, _ = finetune.start(config, archive_of(config, [0.1]))
    begun, _ = jax.jit(lambda s: algorithm.begin(config, s))(state)
    before = begun.learner.agent.parameters
    segment = jax.jit(lambda s: algorithm.train_segment(config, s))
    once, _ = segment(begun)
    after = once.learner.agent.parameters
    assert equal(after.actor, before.actor) and after.log_temperature == before.log_temperature
    assert not equal(after.critic, before.critic)
    twice, _ = segment(once)
    assert not equal(twice.learner.agent.parameters.actor, after.actor)


def test_critics_are_new_unless_they_are_kept():
    for restarts in (True, False):
        config = task_config(start_from="last", restart_critics=restarts)
        archive = archive_of(config, [0.1])
        state, _ = finetune.start(config, archive)
        held = mixture.policy(archive, jnp.asarray(0))
        learner = state.learner.agent.parameters
        assert equal(learner.critic, held.critic) == (not restarts)
        assert equal(learner.critic, learner.target_critic) and equal(learner.actor, held.actor)


def test_copies_are_paid_at_the_states_to_which_they_are_turned():
    config = preset(
        "smoke", env="ant", method="task", task="run:20", yaw_copies=2, policy_inputs="heading"
    )
    state = algorithm.start(config)
    state, _ = jax.jit(lambda s: algorithm.train_segment(config, s))(
        jax.jit(lambda s: algorithm.begin(config, s))(state)[0]
    )
    p, learner = components.make(config), state.learner
    drawn = experience.sample(
        p, learner.replay, learner.episodes.starts.obs, (64,), jax.random.key(3)
    )
    # Of one step: the state drawn is the one left, turned like the state reached.
    expected = p.task.reward(drawn.observation, drawn.action, drawn.next_observation)
    np.testing.assert_allclose(drawn.outcomes.task[:, 0], expected, atol=1e-3)
    assert learner.replay.items.task.shape[1] == 3


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (dict(intrinsic_weight=0.0, start="last"), 6.0),
        (dict(), 6.0 + 5.0),
        (dict(intrinsic_weight=0.5), 6.0 + 2.5),
        (dict(intrinsic_decay=400), 6.0 + 0.75 * 5.0),
        (dict(intrinsic_decay=50), 6.0),
    ],
)
def test_beta_weighs_the_intrinsic_reward_and_falls(changes, expected):
    config = task_config(**{"method": "v", "task_scale": 2.0, **changes})
    p = components.make(config)
    learner = algorithm.start(config).learner._replace(env_steps=jnp.asarray(100, jnp.int32))
    number = jnp.full((1, 1), 1.0)
    outcomes = Outcomes(
        features=number[..., None],
        next_features=number[..., None],
        bonus=number,
        terminated=number < 0,
        distances=Distances(number, number, number),
        taken=number > 0,
        task=3.0 * number,
    )
    found = payment.with_task(p, learner, 5.0 * number, outcomes)
    np.testing.assert_allclose(found, [[expected]], rtol=1e-6)


def finetuned(run, out, *flags, expect=0):
    return commands.call("finetune", run, "--out", out, *flags, expect=expect)


@pytest.fixture(scope="module")
def on_task(smoke_run, tmp_path_factory):
    """The run of preset smoke on Ant, trained on a task."""
    out = tmp_path_factory.mktemp("on_task") / "run"
    finetuned(smoke_run, out, "--task", "goal:0,0", "--num-iterations", "2")
    return out


def test_a_run_on_a_task_is_a_run_with_a_return(smoke_run, on_task):
    run = maxent_jax.load_run(on_task)
    first = json.loads((on_task / files.FIRST).read_text())
    assert first["source"] == str(smoke_run)
    assert len(first["task_return"]) == maxent_jax.load_run(smoke_run).num_policies
    assert first["policy"] == int(np.argmax(first["task_return"]))
    np.testing.assert_array_equal(
        run.metrics["env_steps"], first["num_steps"] + 400 * np.array([1, 2])
    )
    # A start lies within the goal's radius of 2 m, and an untrained Ant hardly leaves it.
    assert (run.metrics["task_success"] == 1).all()
    assert (run.metrics["task_return"] > 1).all()
    assert (run.metrics["task_step_reward"] > 0.5).all()
    assert (on_task / "figures" / "curves.png").exists()
    assert run.config.method == "task" and run.config.intrinsic.shaping == 0


def test_reports_and_evaluations_name_the_task(on_task, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(on_task, copy)
    assert "task_success" in commands.call("evaluate", copy, "--episodes", "1").stdout
    commands.call("report", copy)
    page = (copy / "report.html").read_text()
    assert "return of the task" in page and "goal:0,0" in page


def test_a_finished_run_is_left_alone_and_another_start_is_refused(smoke_run, on_task):
    flags = ("--task", "goal:0,0", "--num-iterations", "2", "--resume")
    assert "is complete" in finetuned(smoke_run, on_task, *flags).stdout
    refused = finetuned(smoke_run, on_task, *flags, "--from", "best", expect=2)
    assert "start_from was both and is best" in refused.stderr


@pytest.mark.slow
def test_a_stopped_run_ends_as_one_that_was_not(smoke_run, tmp_path, monkeypatch):
    config = on_forward(smoke_run, intrinsic_weight=0.1)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    for directory in (whole, broken):
        directory.mkdir()
    driver.train(config, whole, time.perf_counter())
    for boundary in (1, 2):  # begun; the iteration's end
        monkeypatch.setattr(driver, "Interruption", lambda n=boundary: StopAt(n))
        with pytest.raises(Interrupted):
            driver.train(config, broken, time.perf_counter())
    monkeypatch.undo()
    driver.train(config, broken, time.perf_counter())
    assert timeless(broken) == timeless(whole)
    assert equal(restored(broken), restored(whole))


def test_seeds_side_by_side_start_from_one_archive():
    config = task_config(start_from="both", num_seeds=2)
    archive = archive_of(config, [0.1, -0.1])
    state, first = finetune.start(config, archive)
    assert not np.array_equal(*first.task_return)
    _, alone = finetune.start(config.replace(num_seeds=1), archive)
    np.testing.assert_allclose(first.task_return[0], alone.task_return, rtol=1e-4)
    shapes = jax.eval_shape(lambda: algorithm.start(config))
    assert jax.tree.map(jnp.shape, state) == jax.tree.map(jnp.shape, shapes)


def test_a_seed_of_several_can_be_chosen(two_seeds):
    for i in range(2):
        archive, _ = source.load(on_forward(two_seeds, source_seed=i))
        assert equal(archive.parameters, maxent_jax.load_run(two_seeds, i).mixture.parameters)


@pytest.mark.parametrize("env", ENVS)
def test_every_environment_has_a_budget_for_its_tasks(env):
    for method in ("v", "apt"):
        config = source.on_task(preset("quick", env=env, method=method), "there", "gymnasium")
        assert config.budget.num_iterations == 8 and config.downstream.source == "there"


def test_a_run_can_be_used_as_it_was_after_fewer_iterations(smoke_run):
    whole, _ = source.load(on_forward(smoke_run))
    part, _ = source.load(on_forward(smoke_run, source_iterations=1))
    assert (int(whole.size), int(part.size)) == (3, 2)
    _, first = finetune.start(on_forward(smoke_run, source_iterations=1, first_episodes=1), part)
    assert first.task_return.shape == (2,)


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ((), "the task is missing: add --task, one of gymnasium, forward, "),
        (("--task", "flip"), "task is flip, but ant has only: gymnasium, "),
        (("--task", "user:nobody"), "task 'user:nobody' is not registered"),
        (("--task", "stand", "--from", "top"), "unknown start-from 'top'"),
        (("--task", "stand", "--first-episodes", "0"), "first-episodes is 0, but must be at least"),
        (("--task", "stand", "--hidden-size", "64"), "hidden-size is 64, but must be 32, as in "),
        (("--task", "stand", "--source-seed", "1"), "source-seed is 1, but must be below 1"),
        (("--task", "stand", "--source-iterations", "3"), "but must be at most 2, the number of"),
        (
            ("--task", "stand", "--from", "last", "--restart-share", "0.1"),
            "restart-share is 0.1, but must be 0 with start-from last",
        ),
        (("--task", "stand", "--intrinsic-decay", "9"), "but intrinsic-weight is 0: leave one out"),
    ],
)
def test_bad_input_gives_one_sentence(smoke_run, tmp_path, flags, sentence):
    done = finetuned(smoke_run, tmp_path / "out", *flags, expect=2)
    assert sentence in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_python_checks_the_source_before_it_writes(smoke_run, tmp_path):
    other = on_forward(smoke_run).replace(hidden_size=64)
    with pytest.raises(ConfigError, match="hidden-size is 64, but must be 32"):
        maxent_jax.train(other, tmp_path / "out")
    assert not (tmp_path / "out" / files.CONFIG).exists()


def test_both_spellings_of_a_flag_choose_the_same_defaults(smoke_run, tmp_path):
    of_out = ["--task", "stand", "--out", str(tmp_path)]
    spelled = ("--from", "--start-from", "--start_from")
    read = [
        finetune_command.read_arguments([str(smoke_run), flag, "last", *of_out]).config
        for flag in spelled
    ]
    assert read[0] == read[1] == read[2] and read[0].downstream.restart_share == 0


def test_a_directory_without_a_run_gives_one_sentence(tmp_path):
    done = commands.call("finetune", tmp_path, "--task", "stand", expect=2)
    assert "is not the directory of a run" in done.stderr
    assert "name it first" in commands.call("finetune", "--task", "stand", expect=2).stderr


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (("--method", "task"), "method is task, but task is none: name a task."),
        (("--start-from", "last"), "but there is no source: name the directory of a run."),
        (("--intrinsic-weight", "0"), "intrinsic-weight is 0, but task is none: name a task."),
    ],
)
def test_train_refuses_a_task_without_a_name(flags, sentence):
    assert sentence in commands.call("train", "--preset", "smoke", *flags, expect=2).stderr


def test_a_resumed_run_does_not_need_its_source(smoke_run, on_task, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(on_task, copy)
    path = copy / files.CONFIG
    content = json.loads(path.read_text())
    content["config"]["downstream"]["source"] = "gone"
    path.write_text(json.dumps(content))
    resumed = train.read_arguments(["--resume", "--out", str(copy)])
    assert resumed.config.downstream.source == "gone"
    from_it = ["gone", "--resume", "--out", str(copy)]
    assert finetune_command.read_arguments(from_it).config == resumed.config
    gone = commands.call("finetune", "gone", "--task", "stand", expect=2).stderr
    assert "gone is not the directory of a run" in gone
