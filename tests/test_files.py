"""The files of a run's directory, when something is wrong with them; and its siblings."""

import json
from pathlib import Path

import pytest

from maxent_jax.config import preset
from maxent_jax.errors import RunError
from maxent_jax.runs import files


@pytest.mark.parametrize("config", [[], "ant", 3, None, {"budget": {"num_iterations": "many"}}])
def test_a_config_without_settings_is_one_sentence(tmp_path, config):
    (tmp_path / files.CONFIG).write_text(json.dumps({"schema": files.SCHEMA, "config": config}))
    with pytest.raises(RunError, match="does not match this release"):
        files.read_config(tmp_path)


@pytest.mark.parametrize("line", [b"\xff\xfe", b"{", b"3", b""])
def test_a_damaged_line_is_named(tmp_path, line):
    (tmp_path / files.METRICS).write_bytes(b'{"iteration": 1}\n' + line + b"\n")
    with pytest.raises(RunError, match=r"line 2 of .*metrics\.jsonl is not a JSON object: "):
        files.read_metrics(tmp_path)


def test_an_unfinished_line_does_not_count(tmp_path):
    (tmp_path / files.METRICS).write_bytes(b'{"iteration": 1}\n{"itera')
    assert files.read_metrics(tmp_path) == [{"iteration": 1}]


def test_a_sibling_is_named_after_the_run_also_from_within(tmp_path, monkeypatch):
    run = tmp_path / "runs" / "ant"
    (run / "figures").mkdir(parents=True)
    assert files.beside(Path("runs/ant"), "npz") == Path("runs/ant-npz")
    monkeypatch.chdir(run)
    assert files.beside(Path(), "npz") == tmp_path / "runs" / "ant-npz"
    monkeypatch.chdir(run / "figures")
    assert files.beside(Path(".."), "npz") == tmp_path / "runs" / "ant-npz"


def test_a_run_that_another_release_wrote_is_not_guessed(tmp_path):
    files.write_config(tmp_path, preset("smoke"), {}, {})
    content = json.loads((tmp_path / files.CONFIG).read_text())
    content["config"]["budget"]["new_setting"] = 1
    (tmp_path / files.CONFIG).write_text(json.dumps(content))
    with pytest.raises(RunError, match="unknown setting 'new_setting'"):
        files.read_config(tmp_path)
