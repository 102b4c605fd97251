"""From a command line to settings: flags made from fields, one sentence for each mistake."""

import functools
import io
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from typing import Any, TypeVar

import tyro

from experiments.interruption import Interrupted
from maxent_jax.choices import ConfigError
from maxent_jax.runs import NonFiniteError, RunError, SaveError

Arguments = TypeVar("Arguments")


class UsageError(ValueError):
    """A command line that asks for something impossible; the message is one sentence."""


def parse(
    kind: Callable[..., Arguments], argv: Sequence[str], prog: str, default: Any = None
) -> Arguments:
    """The arguments of `python -m prog` as a dataclass; --help prints its fields and exits.

    Raises:
      UsageError: an unknown flag (with the nearest one), or a value of the wrong type.
    """
    printed = io.StringIO()
    options = {} if default is None else {"default": default}
    try:
        with redirect_stderr(printed):
            return tyro.cli(
                kind,
                prog=f"python -m {prog}",
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


def entry_point(main: Callable[[Sequence[str]], None]) -> Callable[[], None]:
    """A main that ends with one sentence where it can't go on.

    Exit code 2 for a user's mistake, 1 for what the machine or the numbers did.
    """

    @functools.wraps(main)
    def run() -> None:
        try:
            main(sys.argv[1:])
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
