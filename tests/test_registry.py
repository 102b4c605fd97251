"""What a user adds from outside the package is trained and analysed like what comes with it."""

import json
import random
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest

import maxent_jax
from maxent_jax import components, envs
from maxent_jax.commands import evaluate, train
from maxent_jax.config import imports, preset, registry
from maxent_jax.envs.pendulum import Pendulum
from maxent_jax.errors import ConfigError, ConfigTypeError, UsageError

MODULE = Path(__file__).parent / "user_module.py"
SMOKE = ["--preset", "smoke", "--num-iterations", "1"]


@pytest.fixture
def restored_tables():
    """What a test registers is gone after it."""
    tables = (registry.ENVIRONMENTS, registry.BONUSES, registry.METHODS, imports.imported)
    kept = [table.copy() for table in tables]
    yield
    for table, before in zip(tables, kept, strict=True):
        table.clear()
        table.update(before) if isinstance(table, dict) else table.extend(before)


@pytest.mark.parametrize("method", ["user:far", "user:newest"])
def test_a_users_environment_and_method_are_trained_from_the_command_line(tmp_path, method):
    run = tmp_path / "run"
    words = ["train", *SMOKE, "--env", "user:point", "--method", method, "--out", str(run)]
    command = [sys.executable, "-m", "maxent_jax"]
    with_module = [*command, *words, "--import", str(MODULE)]
    done = subprocess.run(with_module, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    saved = json.loads((run / "config.json").read_text())
    assert saved["imported"] == [str(MODULE)]
    assert saved["config"]["intrinsic"]["bonus"] == ("user:far" if "far" in method else "none")
    assert saved["method"]["weights"] == "last"
    rows = (run / "metrics.jsonl").read_text().splitlines()
    assert 10 < json.loads(rows[-1])["cumulative_coverage"] <= 400  # cells of the user's grid

    evaluated = [*command, "evaluate", str(run), "--episodes", "1"]
    without = subprocess.run(evaluated, capture_output=True, text=True, check=False)
    assert without.returncode == 2 and "'user:point' is not registered" in without.stderr
    evaluated += ["--import", str(MODULE)]
    assert subprocess.run(evaluated, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--env", "user:none"], "environment 'user:none' is not registered: call maxent_jax.envs"),
        (["--method", "user:none"], "method 'user:none' is not registered: call maxent_jax.config"),
        (["--bonus", "user:none"], "bonus 'user:none' is not registered: call maxent_jax.intrin"),
        (["--import", "no_such"], "cannot be imported: ModuleNotFoundError: No module named"),
        (["--import", "no_such.py"], "cannot be imported: FileNotFoundError: no such file"),
    ],
)
def test_what_is_not_registered_is_refused_before_anything_is_trained(words, says, tmp_path):
    with pytest.raises((ConfigError, UsageError), match=says):
        train.main(["--preset", "smoke", *words, "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


def test_a_module_that_fails_is_named_with_its_reason(tmp_path):
    broken = tmp_path / "broken.py"
    broken.write_text("1 / 0")
    with pytest.raises(UsageError, match=r"broken.py', but .*ZeroDivisionError: division"):
        evaluate.main([str(tmp_path), "--import", str(broken)])


def test_a_file_does_not_take_the_place_of_another_module(restored_tables, tmp_path):
    files = [tmp_path / name for name in ("random.py", "a/own.py", "b/own.py")]
    for number, file in enumerate(files):
        file.parent.mkdir(exist_ok=True)
        file.write_text(
            "from __future__ import annotations\nimport dataclasses, sys\n"
            "@dataclasses.dataclass\nclass Own:\n    number: int\n"  # looks its module up
            f"made = Own({number})\nassert sys.modules[__name__].made is made\n"
        )
    before = dict(sys.modules)
    imports.import_modules([str(file) for file in files])
    assert sys.modules["random"] is random and sys.modules.get("own") is before.get("own")
    found = [module.made.number for name, module in sys.modules.items() if name not in before]
    assert found == [0, 1, 2] and imports.imported[-3:] == [str(file) for file in files]


def test_a_file_that_fails_is_not_left_half_imported(tmp_path):
    broken, before = tmp_path / "broken.py", set(sys.modules)
    broken.write_text("1 / 0")
    with pytest.raises(UsageError):
        imports.import_modules([str(broken)])
    assert set(sys.modules) == before and str(broken) not in imports.imported


def test_a_methods_settings_are_its_own(restored_tables):
    registry.register_method("mine", "geometric", 5, "history", "scratch", eta=0.5)
    config = preset("smoke", method="user:mine", env="pendulum")
    assert config.mixture.eta == 0.5 and config.mixture.weights == "method"
    assert registry.method("user:mine").refresh_period == 5


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (("", "last", 0, "mixture", "last"), "method's name is ''"),
        (("m", "lst", 0, "mixture", "last"), "unknown weights 'lst': did you mean 'last'"),
        (("m", "last", -1, "mixture", "last"), "refresh_period is -1, but must be 0 or more"),
        (("m", "last", True, "mixture", "last"), "refresh_period is True, but must be a whole"),
        (("m", "last", 0, "mix", "last"), "unknown reference 'mix'"),
        (("m", "last", 0, "mixture", "first"), "unknown start 'first'"),
    ],
)
def test_a_method_that_no_run_can_have_is_refused(restored_tables, wrong, says):
    with pytest.raises(ConfigError, match=says):
        registry.register_method(*wrong)


def test_an_unknown_setting_of_a_method_is_refused_where_it_is_used(restored_tables):
    registry.register_method("mine", "last", 0, "mixture", "last", etta=0.5)
    with pytest.raises(ConfigTypeError, match="unknown setting 'etta': did you mean 'eta'"):
        preset("smoke", method="user:mine")


def test_what_programs_were_made_of_cannot_be_replaced(restored_tables):
    make = lambda backend, physics: Pendulum()
    for _ in range(2):  # before it is used it may be replaced
        envs.register("replaced", make)
    components.make(preset("smoke", env="user:replaced"))
    with pytest.raises(ConfigError, match="'user:replaced' is already in use in this process"):
        envs.register("replaced", make)
    registry.register_method("replaced", "last", 0, "mixture", "last")  # of another kind


class Position:
    """A feature map of a user's."""

    names = ("x", "y", "z")

    def __call__(self, observation):
        return observation[..., :3]


class Observing(Pendulum):
    """A pendulum with an observation of another shape."""

    def __init__(self, observation):
        self._observation = observation

    def reset(self, rng):
        return super().reset(rng).replace(obs=self._observation)


@pytest.mark.parametrize(
    ("made", "arguments", "says"),
    [
        (None, {}, "user:wrong is None, but its `make` must return a brax Env."),
        (
            Observing(jnp.zeros(1)),
            {},
            r"is an array \[1\], but must be .*, D at least 2",
        ),
        (Observing(jnp.zeros(())), {}, r"of user:wrong is an array \[\], but must be an array"),
        (Observing(jnp.zeros((2, 3))), {}, r"is an array \[2, 3\], but must be an array \[D\]"),
        (Observing({"a": jnp.zeros(2)}), {}, "of user:wrong is no array, but must be an array"),
        (
            Pendulum(),
            dict(grid=envs.DEFAULT_GRID._replace(coordinates=(0, 3))),
            r"the grid of user:wrong has coordinates \(0, 3\), but there are 3",
        ),
        (Observing(jnp.zeros(2)), dict(phi=Position()), r"returns features \[2\], but has 3 names"),
    ],
)
def test_an_environment_that_cannot_be_trained_is_refused(restored_tables, made, arguments, says):
    for _ in range(2):  # and can be registered again
        envs.register("wrong", lambda backend, physics: made, **arguments)
        with pytest.raises(ConfigError, match=says):
            components.make(preset("smoke", env="user:wrong"))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (dict(low=(-1.0, 2.0), high=(1.0, 2.0)), r"from \(-1.0, 2.0\) to \(1.0, 2.0\), but low"),
        (dict(bins=(10, 0)), r"bins \(10, 0\), but both must be at least 1"),
        (dict(coordinates=(-1, 0)), r"coordinates \(-1, 0\), but none may be negative"),
    ],
)
def test_a_grid_without_cells_is_refused(restored_tables, wrong, says):
    with pytest.raises(ConfigError, match=says):
        envs.register("wrong", lambda *_: None, envs.DEFAULT_GRID._replace(**wrong))


@pytest.mark.parametrize("make", [Pendulum, lambda backend: None, lambda *, backend, physics: None])
def test_a_function_that_does_not_take_a_backend_and_a_physics_is_refused(restored_tables, make):
    with pytest.raises(ConfigTypeError, match="must take two arguments, the backend and the phys"):
        envs.register("wrong", make)


@pytest.mark.parametrize(
    ("name", "in_metres"),
    [
        *(("ant", True), ("walker2d", True), ("pendulum", False), ("brax:halfcheetah", True)),
        *(("brax:reacher", False), ("brax:humanoidstandup", False), ("user:unknown", False)),
        *(("playground:CartpoleBalance", False), ("user:plain", False), ("user:plane", True)),
    ],
)
def test_only_positions_are_counted_in_metres(restored_tables, name, in_metres):
    make = lambda backend, physics: Pendulum()
    envs.register("plain", make)
    envs.register("plane", make, in_metres=True)
    assert registry.environment(name).in_metres == in_metres


def test_a_bonus_has_units_of_the_grid_only_where_its_features_are_the_grids(restored_tables):
    def units(name, grid=envs.DEFAULT_GRID, **arguments):
        envs.register(name, lambda backend, physics: Pendulum(), grid, **arguments)
        config = preset("smoke", env=f"user:{name}")
        return components._units(config, envs.entry(config.env), 3).tolist()

    elsewhere = envs.DEFAULT_GRID._replace(coordinates=(1, 2))
    turned = envs.DEFAULT_GRID._replace(transform=lambda states: states)
    assert units("metres", in_metres=True) == [2.5, 2.5, 1]  # an eighth of 20
    assert units("angles") == [1, 1, 1]
    assert units("own_map", phi=Position(), in_metres=True) == [1, 1, 1]
    assert units("elsewhere", elsewhere, in_metres=True) == [1, 1, 1]
    assert units("turned", turned, in_metres=True) == [1, 1, 1]


def test_a_run_is_trained_and_loaded_by_one_function(tmp_path):
    config = preset("smoke", env="pendulum", num_iterations=1)
    run = maxent_jax.train(config, tmp_path / "run")
    assert run.num_policies == 2 and (tmp_path / "run" / "figures" / "curves.png").exists()
    with pytest.raises(UsageError, match="already exists"):
        maxent_jax.train(config, tmp_path / "run")
    again = maxent_jax.train(config, tmp_path / "run", resume=True)
    assert again.metrics["env_steps"] == run.metrics["env_steps"] == [400]
