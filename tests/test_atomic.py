"""Files that are written completely or not at all, also by several processes at once."""

import json

import pytest

from maxent_jax.errors import SaveError, UsageError
from maxent_jax.runs import atomic


def test_a_writer_publishes_only_what_it_wrote(tmp_path):
    path = tmp_path / "evaluation.json"
    with atomic.whole_file(path) as late:
        late.write_text("late, and comp")
        with atomic.whole_file(path) as early:  # as another process does meanwhile
            early.write_text("early")
        assert path.read_text() == "early"
        late.write_text("late, and complete")
    assert path.read_text() == "late, and complete"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_fails_leaves_the_old_one(tmp_path):
    path = tmp_path / "theory.json"
    atomic.write_json(path, {"old": 1})
    with pytest.raises(SaveError, match="No space left"), atomic.whole_file(path) as temporary:
        temporary.write_text("half")
        raise OSError(28, "No space left on device")
    assert json.loads(path.read_text()) == {"old": 1} and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("name", ["config.json", "notes", "a.b.c.npz"])
def test_temporary_files_are_known_by_their_names(tmp_path, name):
    with atomic.whole_file(tmp_path / name) as temporary:
        temporary.write_text("")
        assert temporary.suffix == (tmp_path / name).suffix or "." not in name
        assert atomic.final_of(temporary.name) == name
    assert atomic.final_of(name) is None


def test_those_of_killed_processes_are_cleared(tmp_path):
    names = ["part-00000.npz", "part-00001.tmp.npz", "part-00001.0123abcd.tmp.npz"]
    for name in names:
        (tmp_path / name).write_text("")
    assert atomic.final_of(names[1]) == "part-00001.npz"  # an older release wrote it
    atomic.clear(tmp_path, ".npz")
    atomic.clear(tmp_path / "nowhere", ".npz")
    assert [path.name for path in tmp_path.iterdir()] == names[:1]


def test_paths_and_numbers_that_are_not_finite_have_a_place_in_json(tmp_path):
    content = {"mdp": tmp_path, "gap": [float("inf"), 1.0]}
    assert atomic.jsonable(content) == {"mdp": str(tmp_path), "gap": [None, 1.0]}


@pytest.mark.parametrize(
    ("out", "says"),
    [
        (".", "is a folder: name a file"),
        ("file/results.json", "cannot make the folder"),
        ("closed/results.json", "cannot write into"),
    ],
)
def test_a_place_that_cannot_be_written_is_known_before_the_results(
    tmp_path, monkeypatch, out, says
):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("os.access", lambda place, mode: place.name != "closed")
    with pytest.raises(UsageError, match=says):
        atomic.check_file(tmp_path / out)
    atomic.check_file(tmp_path / "new" / "results.json")
    assert (tmp_path / "new").is_dir()
