"""Values that no run can have are refused in one sentence, before anything is loaded."""

import pytest

from maxent_jax.config import from_flat, preset
from maxent_jax.config.presets import PRESETS
from maxent_jax.config.registry import ENVS, METHODS, TASK
from maxent_jax.errors import ConfigError
from maxent_jax.runs import files


@pytest.mark.parametrize("env", [*ENVS, "brax:halfcheetah", "user:mine"])
@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_in_every_environment_and_survive_a_round_trip(name, env):
    config = preset(name, env=env)
    assert from_flat(config.flat()) == config
    assert hash(config) == hash(preset(name, env=env))
    if name == "paper":
        assert config.deviations() == {}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(env="antt"), "did you mean 'ant'"),
        (dict(method="x"), "choose one of h, la, v"),
        (dict(backend="mujocoo"), "did you mean 'mujoco'"),
        (dict(env="brax:antt"), "did you mean 'brax:ant'"),
        (dict(env="pendulum", backend="mjx"), "pendulum has only: auto"),
        (dict(env="brax:ant", physics="fast"), "brax:ant has only: reference"),
        (dict(env="pendulum", torque_limit=0.5), "the action of pendulum is not scaled"),
        (dict(env="walker2d", end_flipped=True), "no floating torso that can be upside down"),
        (dict(env="walker2d", policy_inputs="heading"), "no floating torso with a heading"),
        (dict(env="walker2d", yaw_copies=1), "cannot turn about the vertical"),
        (dict(reward="log2"), "did you mean 'log'"),
        (dict(num_envs=-1), "num-envs is -1, but must be at least 1"),
        (dict(num_iterations=0), "at least 1"),
        (dict(learning_rate=0.0), "a positive number"),
        (dict(learning_rate=float("nan")), "a positive number"),
        (dict(discount=1.5), "at most 1"),
        (dict(eta=0.0), "a positive number"),
        (dict(eta=1.5), "at most 1"),
        (dict(seed=-1), "0 or more"),
        (dict(refresh_period=-2), "-1, 0 or more"),
        (dict(num_neighbors=256), "below reference-size"),
        (dict(batch_size=2_001), "must not exceed replay-size"),
        (dict(steps_per_iteration=401), "a multiple of num-envs × num-segments = 8"),
        (dict(updates_per_step=0.3), "a whole number"),
        (dict(updates_per_step=1e-9), "a whole number"),
        (dict(seed=2**31), "seed is 2147483648, but must be at most 2147483647"),
        (dict(seed=2**31 - 1, num_seeds=2), "must not exceed 2"),
        (dict(mixture_episodes=2), "must be at least 3, one for each policy"),
        (dict(reference_size=801), "at most mixture-episodes × episode-length = 800"),
        (dict(num_envs=400, num_segments=1, replay_size=1599), "at least 4 × num-envs = 1600"),
        (dict(replay_dtype="bfloat16"), "did you mean 'float16'"),
        (dict(replay_dtype="float16", yaw_copies=1), "must be float32 with yaw-copies above 0"),
        (dict(return_steps=0), "at least 1"),
        (dict(cell_restarts=1.1), "cell-restarts is 1.1, but must be at most 1"),
        (dict(cell_restarts=-0.1), "0 or more"),
        (dict(cell_restarts=0.5, restart_share=0.5), "so set one of them to 0"),
        (dict(method="apt", batch_size=12), "apt needs more than 12 transitions in the 1 batches"),
        (dict(method="h-official", start="best"), "start best needs mixing episode"),
        (dict(mixing="step", leave_own_out=False), "start best, which method v has, needs mixing"),
        (dict(eta=0.2), "weights are uniform: only geometric weights have an eta"),
        (dict(shaping_survives_death=True), "but shaping is 0"),
        (dict(task_scale=2.0), "task-scale is 2.0, but task is none"),
        (dict(intrinsic_weight=0.5), "intrinsic-weight is 0.5, but task is none"),
        (dict(intrinsic_weight=0.0, task="forward"), "no policy is scored: start best, which"),
        (dict(source_iterations=1), "source-iterations is 1, but there is no source"),
        (dict(intrinsic_decay=2**31), "intrinsic-decay is 2147483648, but must be at most"),
        (
            dict(task="forward", source="runs/x", start_from="both", stale_rewards=True),
            "stale-rewards is on, but start-from is both",
        ),
        (dict(plateau_segments=2), "at most half of num-segments = 2"),
        (dict(plateau_tolerance=-0.1), "0 or more"),
        (dict(snapshots=3), "must divide num-segments = 2"),
        (
            dict(snapshots=2, num_segments=4, plateau_segments=2, mixture_episodes=8),
            "archives one policy",
        ),
    ],
)
def test_a_bad_value_is_refused_by_name(changes, words):
    with pytest.raises(ConfigError, match=words) as error:
        preset("smoke", **changes)
    assert "\n" not in str(error.value)


def test_an_unknown_preset_names_the_nearest():
    with pytest.raises(ConfigError, match="did you mean 'quick'"):
        preset("quik")


def test_quick_names_its_deviations_and_paper_has_none():
    assert preset("paper").deviations() == {}
    named = preset("quick").deviations()
    assert {"torque_limit", "end_flipped", "shaping", "yaw_copies", "reward"} <= set(named)
    assert "shaping_survives_death" not in named


def test_an_environment_that_has_v_start_from_scratch_leaves_the_others_their_own_start():
    starts = {
        m: preset("quick", env="walker2d", method=m).mixture.start for m in METHODS if m != TASK
    }
    assert starts.pop("v") == "scratch"
    assert set(starts.values()) == {"method"}


def test_a_run_of_an_earlier_release_is_loaded_although_a_setting_has_no_effect(tmp_path):
    config = preset("smoke").replace(eta=0.2)
    files.write_config(tmp_path, config, {}, {})
    assert files.read_config(tmp_path) == config
    with pytest.raises(ConfigError, match="only geometric weights have an eta"):
        config.check_new()


def test_configs_of_all_methods_share_one_program():
    base = preset("smoke")
    of_data = dict(weights="geometric", eta=0.01)
    for changes in (dict(method="h"), dict(seed=3), dict(refresh_period=5), of_data):
        assert preset("smoke", **changes).program() == base.program()
    assert preset("smoke", num_envs=8).program() != base.program()


def test_a_hybrid_of_methods_is_named():
    hybrid = preset("paper", start="last", reference="history", refresh_period=1, pooled=True)
    assert set(hybrid.deviations()) == {"start", "reference", "refresh_period", "pooled"}


def test_choices_are_those_of_the_modules_that_make_them():
    from maxent_jax import envs, rewards
    from maxent_jax.config import names, registry
    from maxent_jax.envs.task import MujocoEnv

    for name in ENVS:
        row, env = registry.environment(name), envs.make(name)
        assert row.is_robot == isinstance(env, MujocoEnv)
        assert row.has_torso == (envs.entry(name).torso is not None)
    for row in registry.BONUSES.values():
        assert callable(registry.resolve(row.make))
    assert set(names.REWARDS) == set(rewards.FORMS)


@pytest.mark.parametrize(
    ("changes", "title"),
    [
        (dict(method="la"), "MaxEnt-LA"),
        (dict(method="rnd"), "rnd"),
        (dict(method="h-official"), "h-official"),
        (dict(method="v", bonus="rnd"), "MaxEnt-V with bonus rnd"),
    ],
)
def test_titles_name_the_method_and_a_bonus_set_apart_from_it(changes, title):
    assert preset("smoke", env="pendulum", **changes).title == title
