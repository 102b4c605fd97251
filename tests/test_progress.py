"""Progress as it is seen: by one who has a terminal, and by one who has a file."""

import re

import pytest

from maxent_jax.config import preset
from maxent_jax.runs.progress import Bar

ROW = {"cumulative_coverage": 7059, "cumulative_entropy": 7.754, "wall_seconds": 402.0}


def shown(monkeypatch, capsys, row, **environment):
    """The lines that two segments and an iteration's end leave on standard error."""
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with Bar(preset("quick", num_iterations=6, updates_per_step=0.25), 4, 0, row) as bar:
        bar.segment_done()
        bar.segment_done()
        bar.iteration_done(ROW)
    frames = re.sub(r"\x1b\[2K|\r", "\n", capsys.readouterr().err)
    return re.sub(r"\x1b\[[?0-9;]*[A-Za-z]", "", frames).split("\n")


@pytest.mark.parametrize("width", [60, 80, 110, 200])
def test_a_narrow_terminal_cuts_what_comes_last_and_never_the_times(monkeypatch, capsys, width):
    terminal = {"TTY_COMPATIBLE": "1", "TERM": "xterm", "NO_COLOR": "1", "COLUMNS": str(width)}
    last = [line for line in shown(monkeypatch, capsys, ROW, **terminal) if line][-1]
    assert len(last) <= width
    assert re.match(r"iteration 6/6 [━╸ ]{16} \d:\d\d:\d\d left \d:\d\d:\d\d 7,059 c", last)
    whole = "7,059 cells · 7.75 nats · 600,000 env steps · 149,984 updates"
    assert (whole in last) == (width > 110) and ("…" in last) == (width <= 110)


def test_without_a_terminal_there_is_a_line_an_iteration(monkeypatch, capsys):
    lines = shown(monkeypatch, capsys, {}, TTY_COMPATIBLE="0")
    assert lines[0].startswith("compiled")
    assert lines[1] == (
        "iteration 5/6 · 600,000 env steps · 149,984 updates · 7,059 cells · 7.75 nats · 6 min 42 s"
        ", about 0 s left"
    )
    assert lines[2:] == [""]


@pytest.mark.parametrize("lost", [None, [3.0, None]])
def test_a_return_that_is_not_finite_ends_no_run(monkeypatch, capsys, lost):
    """metrics.jsonl holds null for it: a user's task may reward a state with NaN."""
    row = {"task_return": lost, "task_success": lost, "wall_seconds": 1.0}
    monkeypatch.setenv("TTY_COMPATIBLE", "0")
    with Bar(preset("smoke"), 0, 0, row) as bar:
        bar.iteration_done(row)
    assert "return nan" in capsys.readouterr().err
