"""The commands, as tests call them: in this process, or in one of their own."""

import contextlib
import io
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from maxent_jax.commands import cli

ROOT = Path(__file__).parent.parent


class Done(NamedTuple):
    """How a command ended, and what it printed."""

    code: int
    stdout: str
    stderr: str


def call(name, *arguments, expect=0) -> Done:
    """The command of that name in this process, which has its libraries loaded."""
    out, errors, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            cli.entry_point(cli.command(name))([*map(str, arguments)])
        except SystemExit as end:
            code = end.code or 0
    done = Done(code, out.getvalue(), errors.getvalue())
    assert done.code == expect, done
    return done


def in_subprocess(name, *arguments, expect=0) -> Done:
    """The command of that name as a user starts it in a checkout."""
    line = [sys.executable, "-m", f"experiments.{name}", *map(str, arguments)]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == expect, done.stderr
    return Done(done.returncode, done.stdout, done.stderr)
