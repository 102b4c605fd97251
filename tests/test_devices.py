"""A run on eight simulated devices against the same on one, and on two processes, one of them lost.

Each in processes of their own: jax reads the number of devices once.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import commands
import pytest

from maxent_jax.algorithm.devices import make_mesh
from maxent_jax.config import preset
from maxent_jax.errors import ConfigError
from maxent_jax.runs import files, integrity

ROOT = Path(__file__).parent.parent
SMOKE = ("--preset", "smoke", "--env", "pendulum", "--num-iterations", "4")

# 5 steps of 16 envs with an update each, in episodes of 10 steps: several programs round apart, and
# contacts amplify it.
ON_EIGHT_DEVICES = """
import re
import sys
from pathlib import Path

import jax
import numpy as np

from maxent_jax import algorithm
from maxent_jax.algorithm import devices
from maxent_jax.config import preset
from maxent_jax.runs import checkpoint, files, runtime

runtime.prepare(simulates_in_jax=False)
env, num_seeds, lag, directory = sys.argv[1], *map(int, sys.argv[2:4]), Path(sys.argv[4])
config = preset(
    "smoke", env=env, num_seeds=num_seeds, num_envs=16, steps_per_iteration=80,
    updates_per_step=1 / 16, num_segments=1, episode_length=10, num_iterations=1,
    reference_size=64, shaping=1.0, policy_lag=lag,
)
mesh = devices.make_mesh(config, jax.devices())
placed = devices.placement(config, mesh)
one, many = algorithm.start(config), devices.start(config, placed)

def numbers(leaf):
    typed = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if typed else leaf)

def compare(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    for x, y in ((numbers(x), numbers(y)) for x, y in pairs):
        if np.issubdtype(x.dtype, np.floating):
            np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4)
        else:
            np.testing.assert_array_equal(x, y)

programs = algorithm.programs(config), devices.programs(config, placed)
for on_one, on_many in zip(*programs, strict=True):
    one, metrics_one = on_one(one)
    many, metrics_many = on_many(many)
    compare(one, many)
    compare(metrics_one, metrics_many)

state = many.learner.replay.items.state
part = state.addressable_shards[0].data.shape
print("part of the replay", state.size // np.prod(part), "of", dict(mesh.shape))
# No exchange has the replay's rows, all of them or a device's part.
rows = {config.learner.replay_size, config.learner.replay_size // mesh.shape["envs"]}
program = programs[1].train_segment.lower(many).compile().as_text()
kinds = "all-gather|all-to-all|all-reduce|collective-permute"
exchanges = [x for x in program.splitlines() if re.search(f" ({kinds})(-start)?[(]", x)]
for line in exchanges:
    result = re.split(f" ({kinds})(-start)?[(]", line)[0]
    shapes = re.findall(r"[[]([0-9,]+)[]]", result)
    dims = {int(n) for shape in shapes for n in shape.split(",")}
    assert not dims & rows, line
assert exchanges
# What C++ computes is that of a device's own seeds.
calls = [x for x in program.splitlines() if 'custom_call_target="maxent_' in x]
for line in calls if num_seeds > 1 else ():
    assert not re.search(rf"[[]{num_seeds},", line.split("custom-call")[0]), line

files.write_config(directory, config, {}, {})
checkpoint.save(directory, many, checkpoint.Progress([], None, [], {}), {})
compare(one, checkpoint.restore(directory, "0", config))
compare(one, checkpoint.restore(directory, "0", config, placed))
print("equal")
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "num_seeds", "lag", "across"),
    [
        ("ant", 1, 0, {"seeds": 1, "envs": 8}),
        ("ant", 1, 1, {"seeds": 1, "envs": 8}),
        ("pendulum", 4, 0, {"seeds": 4, "envs": 2}),
    ],
)
def test_eight_devices_do_what_one_does(tmp_path, env, num_seeds, lag, across):
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
    done = subprocess.run(
        [sys.executable, "-c", ON_EIGHT_DEVICES, env, str(num_seeds), str(lag), str(tmp_path)],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == f"part of the replay 8 of {across}\nequal\n", done.stderr


def start_two(directory, logs, *flags):
    """Two processes of one run; each writes its errors to a file in the folder `logs`."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    where = ("--coordinator", f"localhost:{port}", "--num-processes", "2")
    command = [sys.executable, "-m", "experiments.train", *SMOKE, "--out", str(directory), *where]
    logs.mkdir()
    processes = []
    for index in range(2):
        with open(logs / str(index), "w") as errors:
            processes.append(
                subprocess.Popen(
                    [*command, "--process-id", str(index), *flags],
                    cwd=ROOT,
                    stdout=subprocess.DEVNULL,
                    stderr=errors,
                )
            )
    return processes


@pytest.mark.slow
def test_two_processes_train_one_run_and_end_together(tmp_path):
    directory, logs = tmp_path / "run", tmp_path / "logs"
    processes = start_two(directory, logs)
    metrics = directory / files.METRICS
    deadline = time.time() + 120
    while time.time() < deadline and not (metrics.exists() and metrics.read_text()):
        time.sleep(0.1)
    time.sleep(0.5)  # into the next iteration
    processes[1].send_signal(signal.SIGKILL)
    assert processes[0].wait(timeout=60) != 0  # raises where it lives on
    processes[1].wait()

    again = tmp_path / "again"
    for index, process in enumerate(start_two(directory, again, "--resume")):
        assert process.wait(timeout=240) == 0, (again / str(index)).read_text()
    assert [row["env_steps"] for row in files.read_metrics(directory)] == [400, 800, 1200, 1600]
    assert (directory / "figures" / "curves.png").exists()


@pytest.mark.slow
def test_two_processes_stop_together_when_one_is_asked_to(tmp_path):
    directory, logs = tmp_path / "run", tmp_path / "logs"
    many = ("--num-iterations", "40", "--mixture-episodes", "41")
    processes = start_two(directory, logs, *many)
    deadline = time.time() + 120
    while time.time() < deadline and not files.read_metrics(directory):
        time.sleep(0.1)
    processes[1].send_signal(signal.SIGTERM)
    assert [process.wait(timeout=60) for process in processes] == [143, 143]
    assert integrity.find(directory)[0] == integrity.checkpoints(directory)[-1] != "40"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--devices", "-1"), "devices is -1"),
        (("--devices", "1000"), "devices is 1000, but only"),
        (("--num-processes", "2"), "need --coordinator"),
        (("--coordinator", "somewhere"), "HOST:PORT or auto"),
        (("--coordinator", "a:1", "--num-processes", "2", "--process-id", "2"), "process-id is 2"),
        (("--coordinator", "a:1", "--devices", "2"), "leave out --devices"),
    ],
)
def test_a_share_that_cannot_be_is_one_sentence(tmp_path, flags, message):
    done = commands.call("train", *SMOKE, "--out", tmp_path / "run", *flags, expect=2)
    assert re.fullmatch(rf"error: .*{message}.*\n", done.stderr), done.stderr


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 6, "steps_per_iteration": 600, "updates_per_step": 0.5}, "num-envs is 6"),
        ({"replay_size": 2001}, "replay-size is 2001"),
    ],
)
def test_devices_share_a_seed_evenly(changes, message):
    config = preset("smoke", env="pendulum", **changes)
    with pytest.raises(ConfigError, match=f"{message}, but must be a multiple of 4"):
        make_mesh(config, [None] * 4)
