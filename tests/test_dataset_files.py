"""Datasets on disk, read as their formats' own readers read them."""

import json
import shutil

import commands
import minari
import numpy as np
import pytest

import maxent_jax
from maxent_jax.analysis import dataset_files
from maxent_jax.commands import dataset
from maxent_jax.errors import CheckpointCorruptError, SaveError, UsageError
from maxent_jax.runs import files, source
from maxent_jax.runs.source import on_task

NUM = 5_000  # two rounds of 32 episodes of at most 100 steps
pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")


@pytest.fixture(scope="module")
def run(smoke_run):
    return maxent_jax.load_run(smoke_run)


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """The directory of a dataset in each format."""
    directories = {}
    for form in dataset_files.WRITERS:
        directories[form] = tmp_path_factory.mktemp(form) / "data"
        dataset_files.write(run, directories[form], form, NUM, task="forward", seed=3)
    return directories


@pytest.fixture(scope="module")
def expected(run):
    return run.dataset(NUM, seed=3, task="forward")


def episodes_of(rows):
    ends = np.flatnonzero(rows["terminals"] | rows["timeouts"]) + 1
    return np.split(np.arange(len(rows["policy"])), ends[:-1])


def test_the_command_checks_for_the_formats_that_can_be_written():
    assert {*dataset.FORMATS} == {*dataset_files.WRITERS}


def test_parts_are_the_arrays_of_a_dataset_in_memory(written, expected):
    parts = [np.load(path) for path in sorted(written["npz"].glob("part-*.npz"))]
    assert len(parts) >= 2
    for name, x in expected.items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), x)


def test_exorl_reads_the_transitions(written, expected):
    paths = sorted(
        (written["exorl"] / "buffer").glob("*.npz"), key=lambda p: int(p.stem.split("_")[1])
    )
    index = 0
    for number, path in enumerate(paths):
        # As ExORL's replay_buffer.py: number and length from the name, transition i from rows
        # i - 1 and i, where row 0 is a dummy.
        named, length = (int(word) for word in path.stem.split("_")[1:])
        assert named == number
        with np.load(path) as episode:
            assert all(len(x) == length + 1 for x in episode.values())
            rows = slice(index, index + length)
            assert (episode["observation"][:-1] == expected["observations"][rows]).all()
            assert (episode["observation"][1:] == expected["next_observations"][rows]).all()
            assert (episode["action"][1:] == expected["actions"][rows]).all()
            assert (episode["reward"][1:, 0] == expected["rewards"][rows]).all()
            assert (episode["discount"][1:, 0] == 1 - expected["terminals"][rows]).all()
            # Ant observes qpos and qvel as they are.
            np.testing.assert_array_equal(episode["physics"], episode["observation"])
        index += length
    assert index == NUM


@pytest.fixture
def minari_dataset(written, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(written["minari"]))
    (name,) = minari.list_local_datasets()
    return minari.load_dataset(name)


def test_minari_reads_the_episodes(run, minari_dataset, expected):
    assert minari_dataset.total_steps == NUM
    groups = episodes_of(expected)
    assert minari_dataset.total_episodes == len(groups)
    for episode, rows in zip(minari_dataset.iterate_episodes(), groups, strict=True):
        assert (episode.observations[:-1] == expected["observations"][rows]).all()
        assert (episode.observations[-1] == expected["next_observations"][rows[-1]]).all()
        limit = run.config.environment.torque_limit
        np.testing.assert_allclose(episode.actions, limit * expected["actions"][rows], rtol=1e-6)
        assert (episode.rewards == expected["rewards"][rows]).all()
        assert (episode.terminations == expected["terminals"][rows]).all()
        assert (episode.truncations == expected["timeouts"][rows]).all()
        assert minari_dataset.action_space.contains(episode.actions[0])


def test_a_stored_step_is_one_of_gymnasiums(minari_dataset):
    env = minari_dataset.recover_environment()
    assert env.spec.id == "Ant-v4"
    raw = env.unwrapped
    gaps = []
    env.reset(seed=0)
    for episode in minari_dataset.iterate_episodes(range(10)):
        for before, action, after in zip(
            episode.observations[:-1], episode.actions, episode.observations[1:], strict=True
        ):
            raw.set_state(before[:15], before[15:])
            raw.data.qacc_warmstart[:] = 0.0
            gaps.append(np.abs(env.step(action)[0] - after).max())
    # Rounding states to 32 bits and leaving out the solver's warm start cost about 1e-6.
    assert max(gaps) < 1e-4


def test_a_dataset_that_was_stopped_goes_on(run, written, tmp_path):
    class Stop(Exception):
        pass

    def stop(transitions):
        raise Stop

    for form, complete in written.items():
        directory = tmp_path / form
        with pytest.raises(Stop):
            dataset_files.write(run, directory, form, NUM, "forward", 3, stop)
        held = json.loads((directory / dataset_files.MANIFEST).read_text())
        assert not held["complete"] and held["written"]["rounds"] == 1
        dataset_files.write(run, directory, form, NUM, task="forward", seed=3)
        assert json.loads((directory / dataset_files.MANIFEST).read_text())["complete"]
        if form != "minari":  # HDF5 stores times
            ours, theirs = (
                {p.relative_to(d): p.read_bytes() for p in d.rglob("*.npz")}
                for d in (directory, complete)
            )
            assert ours == theirs


def test_a_full_disk_leaves_no_half_file(run, tmp_path, monkeypatch):
    def full(path, **arrays):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(SaveError, match="No space left on device"):
        dataset_files.write(run, tmp_path / "data", "npz", 100)
    monkeypatch.undo()
    assert not list((tmp_path / "data").glob("*.npz"))
    dataset_files.write(run, tmp_path / "data", "npz", 100)
    assert len(np.load(tmp_path / "data" / "part-00000.npz")["policy"]) == 100


def test_the_command_writes_and_says_so(smoke_run, tmp_path):
    out = tmp_path / "data"
    flags = (smoke_run, "--transitions", "200", "--task", "jump", "--out", out)
    done = commands.call("dataset", *flags)
    assert done.stdout == f"{out}: 200 transitions in format npz.\n"
    assert "200 of 200 transitions" in done.stderr
    assert commands.call("dataset", *flags).stderr == ""  # complete
    other = commands.call("dataset", *flags, "--seed", "1", expect=2)
    assert "holds another dataset, with another seed: choose another --out." in other.stderr


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (("--format", "hdf5"), "unknown format 'hdf5'"),
        (("--transitions", "0"), "--transitions is 0, but must be at least 1."),
        (("--task", "flip"), "task is flip, but ant has only"),
        (("--task", "user:nobody"), "task 'user:nobody' is not registered"),
        (("--seed-index", "1"), "seed_index is 1, but"),
    ],
)
def test_bad_input_gives_one_sentence(smoke_run, tmp_path, flags, sentence):
    done = commands.call("dataset", smoke_run, "--out", tmp_path / "out", *flags, expect=2)
    assert sentence in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_manifest_names_the_checkpoint_that_was_read(copy_of_smoke_run, tmp_path):
    directory = copy_of_smoke_run
    shutil.move(directory / "checkpoints" / "2", tmp_path / "2")
    run = maxent_jax.load_run(directory)  # while it trains
    shutil.move(tmp_path / "2", directory / "checkpoints" / "2")
    dataset_files.write(run, tmp_path / "data", "npz", 100)
    held = json.loads((tmp_path / "data" / dataset_files.MANIFEST).read_text())
    assert held["run"]["checkpoint"] == run.checkpoint == "1"
    later = maxent_jax.load_run(directory)
    assert later.checkpoint == "2"
    with pytest.raises(UsageError, match="holds another dataset, with another run"):
        dataset_files.write(later, tmp_path / "data", "npz", 100)


def test_a_damaged_checkpoint_is_passed_over_on_demand(copy_of_smoke_run, tmp_path):
    directory, out = copy_of_smoke_run, tmp_path / "data"
    (directory / "checkpoints" / "2" / "arrays" / "results" / "_METADATA").unlink()
    flags = (directory, "--transitions", "100", "--out", out)
    assert "--fallback of a command" in commands.call("dataset", *flags, expect=2).stderr
    with pytest.warns(UserWarning, match="checkpoint 2"):
        commands.call("dataset", *flags, "--fallback")
    held = json.loads((out / dataset_files.MANIFEST).read_text())
    assert held["run"]["checkpoint"] == "1" and held["complete"]
    with pytest.raises(CheckpointCorruptError) as raised:
        source.load(on_task(files.read_config(directory), str(directory), "forward"))
    assert "train --resume --fallback on that run" in str(raised.value)


def test_a_directory_with_other_files_is_left_alone(run, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    done = commands.call("dataset", run.path, "--out", tmp_path, expect=2)
    assert f"{tmp_path} is not empty: choose another --out." in done.stderr


def test_minari_holds_robots_alone(tmp_path):
    out = tmp_path / "run"
    commands.call("train", "--preset", "smoke", "--env", "pendulum", "--out", out)
    done = commands.call("dataset", out, "--format", "minari", "--out", tmp_path / "d", expect=2)
    assert "holds ant, walker2d, humanoid, but the run is on pendulum." in done.stderr
    assert files.is_config(out / files.CONFIG) and not (tmp_path / "d").exists()
