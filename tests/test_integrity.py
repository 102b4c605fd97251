"""Manifests, against coreutils' own reading of them, and what is refused."""

import os
import subprocess

import pytest

from maxent_jax import errors
from maxent_jax.commands import verify
from maxent_jax.runs import files, integrity
from maxent_jax.runs.integrity import FOLDER, MANIFEST


@pytest.fixture
def run(tmp_path):
    """Two sealed checkpoints, without arrays."""
    (tmp_path / files.CONFIG).write_text("{}")
    for name in ("9", "10+2"):
        folder = tmp_path / FOLDER / name
        (folder / "arrays" / "rest").mkdir(parents=True)
        (folder / files.CONFIG).write_text("{}")
        (folder / "arrays" / "data").write_bytes(os.urandom(1000))
        (folder / "arrays" / "rest" / "replay").write_bytes(os.urandom(1000))
        integrity.seal(folder)
    return tmp_path


def test_a_manifest_is_one_that_sha256sum_checks(run):
    folder = run / FOLDER / "9"
    subprocess.run(["sha256sum", "--strict", "-c", MANIFEST], cwd=folder, check=True)
    (folder / "arrays" / "data").write_text("other")
    done = subprocess.run(["sha256sum", "-c", MANIFEST], cwd=folder, check=False)
    assert done.returncode == 1


def test_checkpoints_are_ordered_by_how_far_they_are(run):
    for name in ("10", "10+0", "2+11", "unfinished-11", "notes"):
        (run / FOLDER / name).mkdir()
    assert integrity.checkpoints(run) == ["2+11", "9", "10", "10+0", "10+2"]
    integrity.clear_unfinished(run)
    assert not (run / FOLDER / "unfinished-11").exists()


def test_a_removal_that_is_interrupted_leaves_no_damaged_checkpoint(run, monkeypatch):
    def interrupted(path, *_, **__):
        if path.exists():
            (path / files.CONFIG).unlink()
            raise KeyboardInterrupt

    monkeypatch.setattr(integrity.shutil, "rmtree", interrupted)
    with pytest.raises(KeyboardInterrupt):
        integrity.remove(run, "9")
    monkeypatch.undo()
    assert integrity.checkpoints(run) == ["10+2"] and not list(integrity.damages(run, "10+2"))
    integrity.clear_unfinished(run)
    assert [path.name for path in (run / FOLDER).iterdir()] == ["10+2"]


def test_a_checkpoint_that_its_run_removes_meanwhile_is_not_damaged(run, monkeypatch, capsys):
    checksum = integrity.checksum

    def slow(path, to_disk=False):
        if (run / FOLDER / "9").exists():
            integrity.remove(run, "9")
        return checksum(path, to_disk)

    monkeypatch.setattr(integrity, "checksum", slow)
    assert verify.verify(run, ["9", "10+2"])
    printed = capsys.readouterr().out
    assert "checkpoint 9: removed meanwhile" in printed and "checkpoint 10+2: intact" in printed


def test_analysis_passes_by_what_it_does_not_read(run):
    (run / FOLDER / "10+2" / "arrays" / "rest" / "replay").write_text("lost")
    assert integrity.find(run, whole=False) == ("10+2", {})
    with pytest.raises(errors.CheckpointCorruptError, match="arrays/rest/replay"):
        integrity.find(run)
    name, passed_over = integrity.find(run, fallback=True)
    assert name == "9" and list(passed_over) == ["10+2"]


def test_a_config_that_was_changed_by_hand_is_noticed(run):
    (run / files.CONFIG).write_text('{"seed": 1}')
    with pytest.raises(errors.CheckpointCorruptError, match=r"config\.json of the run"):
        integrity.find(run)


def test_the_caller_says_what_can_be_done(run):
    (run / FOLDER / "10+2" / "arrays" / "data").unlink()
    said = f"checkpoint 10+2 of {run} is damaged: arrays/data is missing"
    for remedy, end in (("", "."), ("ask Ada", "; ask Ada.")):
        with pytest.raises(errors.CheckpointCorruptError) as raised:
            integrity.find(run, remedy=remedy)
        assert str(raised.value) == said + end


def test_where_all_are_damaged_there_is_nothing_to_fall_back_to(run):
    for name in integrity.checkpoints(run):
        (run / FOLDER / name / MANIFEST).unlink()
    with pytest.raises(errors.CheckpointCorruptError, match="no earlier one is intact"):
        integrity.find(run, fallback=True)


def test_a_manifest_without_a_line_is_not_its_own(run):
    manifest = run / FOLDER / "10+2" / MANIFEST
    lines = manifest.read_text().splitlines(keepends=True)
    for i in range(len(lines)):
        manifest.write_text("".join(lines[:i] + lines[i + 1 :]))
        assert list(integrity.damages(run, "10+2")) == [f"{MANIFEST} is not what was written"]
