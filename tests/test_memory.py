"""Estimates of memory, held against the states themselves and against XLA's own account."""

import jax
import jax.numpy as jnp
import pytest
import user_module

from maxent_jax import algorithm
from maxent_jax.config import from_flat, preset
from maxent_jax.errors import ConfigError
from maxent_jax.runs import machine, memory
from maxent_jax.runs.machine import Room


@pytest.fixture(scope="module")
def smoke():
    return preset("smoke", env="pendulum")


def test_the_state_is_estimated_exactly(smoke):
    state = algorithm.start(smoke)
    states = memory.nbytes(state._replace(key=jax.random.key_data(state.key)))
    shapes = algorithm.shapes(smoke)
    small = 100  # bytes: keys and counters
    assert 0 <= memory.nbytes(shapes) - states < small
    of_state = sum(memory.of_a_seed(smoke.program()).values())
    assert of_state > memory.nbytes(shapes) - small


@pytest.mark.slow
def test_the_estimate_is_below_what_xla_allocates(smoke):
    config = smoke.replace(hidden_size=256, replay_size=100_000, batch_size=1000)
    state = algorithm.start(config)
    needed = 0
    for function in algorithm.programs(config):
        analysis = function.lower(state).compile().memory_analysis()
        needed = max(needed, analysis.argument_size_in_bytes + analysis.temp_size_in_bytes)
    estimate = sum(memory.on_a_device(config).values())
    assert 0.5 * needed < estimate <= needed


@pytest.mark.parametrize(
    ("setting", "changes"),
    [
        ("replay-size", dict(replay_size=2**31 - 1)),
        ("replay-size", dict(replay_size=2_000_000_000, replay_dtype="float16")),
        ("hidden-size", dict(hidden_size=100_000)),
        ("hidden-size", dict(hidden_size=2**31 - 1)),
        ("num-starts", dict(num_starts=2**31 - 1)),
        ("num-seeds", dict(num_seeds=10**7)),
        ("batch-size", dict(batch_size=2**31 - 1, replay_size=2**31 - 1)),
        ("mixture-episodes", dict(mixture_episodes=20_000_000)),
        (
            "num-iterations",
            dict(num_iterations=10**6, mixture_episodes=10**6 + 1, steps_per_iteration=8),
        ),
        (
            "num-envs",
            dict(
                num_envs=2**28,
                num_segments=1,
                steps_per_iteration=2**28,
                replay_size=2**30,
            ),
        ),
    ],
)
def test_a_run_that_cannot_fit_is_refused_by_what_takes_most(monkeypatch, setting, changes):
    config = preset("smoke", **{"env": "pendulum", **changes})
    monkeypatch.setattr(machine, "memory", lambda: Room(2**33, "this machine"))
    with pytest.raises(ConfigError) as refused:
        memory.check(config, jax.devices()[:1])
    said = str(refused.value)
    assert said.startswith(f"{setting} is {config[setting.replace('-', '_')]}, so")
    assert "but this machine has 8 GiB" in said
    memory.check(preset("smoke", env="pendulum"), jax.devices()[:1])


def test_the_states_of_cells_are_counted(monkeypatch):
    without = preset("smoke", env="ant", backend="mujoco")
    config = without.replace(cell_restarts=0.5)
    more = memory.of_a_seed(config.program())[memory.CELLS]
    # qpos 15, qvel and warm start 14 each, observation 29, reward, done; and two integers.
    assert more == memory.FLOAT * (
        10_000 * (15 + 14 + 14 + 29 + 2 + 2) + 2 * config.budget.num_envs
    )
    assert memory.of_a_seed(without.program())[memory.CELLS] == 0
    monkeypatch.setattr(machine, "memory", lambda: Room(2**21, "this machine"))
    with pytest.raises(ConfigError, match=r"^cell-restarts is 0.5, so .*: set it to 0\.$"):
        memory.check(config, jax.devices()[:1])
    memory.check(without, jax.devices()[:1])


@pytest.mark.parametrize("size", [2**31, 4 * 10**9, 2**63, 10**30])
@pytest.mark.parametrize(
    "name", ["replay_size", "hidden_size", "num_envs", "num_starts", "batch_size", "num_seeds"]
)
def test_sizes_that_nothing_can_count_are_refused_before_jax_is_asked(name, size):
    with pytest.raises(ConfigError, match=f"{name.replace('_', '-')} is {size}, but must be"):
        from_flat({name: size})


def test_no_environment_is_computed_for_the_estimate(monkeypatch):
    constants, reset = [], user_module.Point.reset

    def watched(point, rng):
        constants.append(jnp.zeros(()))
        return reset(point, rng)

    monkeypatch.setattr(user_module.Point, "reset", watched)
    memory.on_a_device(preset("smoke", env="user:point", episode_length=41))
    assert constants and all(isinstance(x, jax.core.Tracer) for x in constants)


def test_devices_share_what_they_can(smoke):
    one, two = memory.on_a_device(smoke), memory.on_a_device(smoke, 2)
    assert two["replay-size"] == one["replay-size"] // 2
    assert two["hidden-size"] == one["hidden-size"]
    of_four = smoke.replace(num_seeds=4)
    assert memory.on_a_device(of_four, 2)["hidden-size"] == 2 * one["hidden-size"]


def test_episodes_that_cannot_be_held_are_refused(smoke, monkeypatch):
    monkeypatch.setattr(machine, "memory", lambda: Room(10**6, "this machine"))
    memory.check_episodes(smoke, 10)
    with pytest.raises(ConfigError, match=r"\(1000 episodes of 100 steps\) need at least"):
        memory.check_episodes(smoke, 1000)


def test_the_smallest_limit_counts(monkeypatch, tmp_path):
    (tmp_path / "memory.max").write_text("123456\n")
    monkeypatch.setattr(machine, "CGROUPS", tmp_path)
    monkeypatch.setattr(machine, "_cgroup_files", lambda: iter([tmp_path / "memory.max"]))
    monkeypatch.setattr(machine, "_process_limits", lambda: iter(()))
    assert machine.memory() == Room(123456, "this container")
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.memory().of == "this machine"
    monkeypatch.setattr(machine, "_process_limits", lambda: iter([Room(7, "this process")]))
    assert machine.memory().size == 7


def test_a_shells_limit_counts_less_what_is_used(monkeypatch):
    monkeypatch.setattr(machine, "address_space", lambda: 2**50)
    (room,) = machine._process_limits()
    assert 2**50 - 2**45 < room.size < 2**50 and "ulimit -v" in room.of


def test_bytes_are_readable():
    assert [machine.readable(n) for n in (0, 1023, 2**31, 3 * 2**49)] == [
        *("0 bytes", "1,023 bytes", "2 GiB", "1.5 PiB")
    ]
