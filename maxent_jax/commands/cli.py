"""From a command line to settings: flags made from fields, one sentence for each mistake."""

import functools
import importlib
import io
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any, TypeVar

import tyro

from maxent_jax.choices import ConfigError, UsageError
from maxent_jax.runs import NonFiniteError, RunError, SaveError
from maxent_jax.runs.interruption import Interrupted

Arguments = TypeVar("Arguments")


def run(name: str) -> None:
    """The entry point of the command of that name, with the arguments of this process."""
    entry_point(command(name))(sys.argv[1:])


def command(name: str) -> Callable[[Sequence[str]], None]:
    """The main of the command of that name."""
    return importlib.import_module(f"maxent_jax.commands.{name}").main


def spelled(name: str) -> str:
    """How a user types the command of that name: as the one that is running was typed."""
    started = Path(sys.argv[0])
    if started.stem == "maxent-jax":
        return f"maxent-jax {name}"
    if started.parent.name == "experiments":
        return f"python -m experiments.{name}"
    return f"python -m maxent_jax {name}"


def parse(
    kind: Callable[..., Arguments], argv: Sequence[str], name: str, default: Any = None
) -> Arguments:
    """The arguments of the command of that name; --help prints the fields of `kind` and exits.

    Raises:
      UsageError: an unknown flag (with the nearest one), or a value of the wrong type.
    """
    printed = io.StringIO()
    options = {} if default is None else {"default": default}
    try:
        with redirect_stderr(printed):
            return tyro.cli(
                kind,
                prog=spelled(name),
                args=argv,
                config=(tyro.conf.OmitArgPrefixes,),
                **options,
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UsageError(_sentence(printed.getvalue())) from None


def flag_value(argv: Sequence[str], flag: str) -> str | None:
    """The last value that follows `--flag`, before the whole line is parsed."""
    value = None
    for word, following in zip(argv, [*argv[1:], None], strict=True):
        if word == flag:
            value = following
        elif word.startswith(flag + "="):
            value = word.split("=", 1)[1]
    return value


def entry_point(main: Callable[[Sequence[str]], None]) -> Callable[[Sequence[str]], None]:
    """A main that ends with one sentence where it can't go on.

    Exit code 2 for a user's mistake, 1 for what the machine or the numbers did.
    """

    @functools.wraps(main)
    def run(argv: Sequence[str]) -> None:
        try:
            main(argv)
        except (UsageError, ConfigError, RunError) as mistake:
            print(f"error: {mistake}", file=sys.stderr)
            sys.exit(2)
        except (SaveError, NonFiniteError) as failure:
            print(f"error: {failure}", file=sys.stderr)
            sys.exit(1)
        except Interrupted as stop:
            print(stop, file=sys.stderr)
            sys.exit(stop.exit_code)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            sys.exit(130)

    return run


def _sentence(panel: str) -> str:
    """What tyro says in its panel, as one line: the problem, and the nearest flag if any."""
    lines = [line.strip("│╭╮╰╯ \n") for line in panel.splitlines()[1:]]
    blank = next((i for i, line in enumerate(lines) if set(line) <= {"─"}), len(lines))
    problem = " ".join(lines[:blank]).removeprefix("Error parsing config: ").rstrip(".")
    if problem.endswith("?"):
        return problem
    nearest = next((line.split()[0] for line in lines[blank:] if line.startswith("--")), None)
    suggested = any("erhaps you meant" in line for line in lines)
    return f"{problem}: did you mean {nearest}?" if suggested and nearest else f"{problem}."
