"""Parses command lines: flags are made from fields, and each mistake gives one sentence."""

import dataclasses
import functools
import importlib
import io
import logging
import os
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Collection, Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from maxent_jax.commands import streams
from maxent_jax.commands.streams import OutputError
from maxent_jax.config import imports
from maxent_jax.errors import ConfigError, NonFiniteError, RunError, SaveError, UsageError
from maxent_jax.runs import runtime
from maxent_jax.runs.signals import Interrupted
from maxent_jax.visual import headless

NARROWEST = 40  # columns
Arguments = TypeVar("Arguments")
Modules = Annotated[
    tuple[str, ...], tyro.conf.arg(name="import", metavar="MODULE"), tyro.conf.UseAppendAction
]
"""The type of a field for --import, which can be repeated."""
COMMANDS = {
    "train": "train a mixture of policies that covers the state space",
    "finetune": "train a run's policies on a task",
    "dataset": "write transitions of a run's mixture for offline learning",
    "evaluate": "roll out a run's mixture again: entropy, coverage, returns",
    "render": "film a run's policies",
    "report": "write an HTML page about one or several runs",
    "verify": "compare a run's checkpoints with their checksums",
    "reproduce": "reproduce the paper's figures, and run other studies",
    "theory": "compare the methods with their bounds, exactly, in tabular MDPs",
}


def run(name: str) -> None:
    """Runs the command of that name with the arguments of this process."""
    entry_point(command(name))(sys.argv[1:])


def command(name: str) -> Callable[[Sequence[str]], None]:
    """Returns the main function of the command of that name."""
    return importlib.import_module(f"maxent_jax.commands.{name}").main


def spelled(name: str) -> str:
    """Returns how to type a command, in the form in which the running one was typed."""
    started = Path(sys.argv[0])
    if started.stem == "maxent-jax":
        return f"maxent-jax {name}"
    if started.parent.name == "experiments":
        return f"python -m experiments.{name}"
    return f"python -m maxent_jax {name}"


def parse(
    kind: type[Arguments],
    argv: Sequence[str],
    name: str,
    default: Any = None,
    shown: Collection[str] = (),
) -> Arguments:
    """Parses the arguments of a command; --help prints the fields of `kind` and exits.

    Args:
      shown: the fields that --help shows, all if left out; --help-all shows every field.
    Raises:
      UsageError: a flag is unknown (the message names the nearest), or a value has the wrong type.
    """
    printed = io.StringIO()
    options = {} if default is None else {"default": default}
    if shown and not {"-h", "--help"}.isdisjoint(argv):
        options["description"] = f"{kind.__doc__} All settings: --help-all."
        kind, options["default"] = _hiding(kind, default, shown)
    argv = ["--help" if shown and word == "--help-all" else word for word in argv]
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


def flag_values(argv: Sequence[str], flag: str) -> list[str]:
    """Returns the values that follow `--flag`, before the command line is parsed."""
    values: list[str] = []
    for i, word in enumerate(argv):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == flag:  # tyro takes both spellings
            values += [value] if equals else argv[i + 1 : i + 2]
    return values


def flag_value(argv: Sequence[str], flag: str) -> str | None:
    """Returns the last value that follows `--flag`, before the command line is parsed."""
    values = flag_values(argv, flag)
    return values[-1] if values else None


def check_least(flag: str, value: int, least: int = 1) -> None:
    """Raises UsageError if the value of a flag is below the least."""
    if value < least:
        raise UsageError(f"{flag} is {value}, but must be at least {least}.")


def import_modules(argv: Sequence[str], draws: bool = False) -> None:
    """Imports the modules named by --import, which register environments, bonuses or methods.

    Args:
      draws: whether the command draws robots; this must be known before MuJoCo is loaded.
    Raises:
      UsageError: a module does not exist, or fails.
    """
    modules = flag_values(argv, "--import")
    if modules:
        if draws:
            headless.choose_backend()
        else:
            headless.draw_nothing()
        runtime.prepare(simulates_in_jax=flag_value(argv, "--backend") == "mjx")
        imports.import_modules(modules)


def _hiding(kind: Any, default: Any, shown: Collection[str]) -> tuple[Any, Any]:
    """Returns a copy of a dataclass and of its default whose help shows only these fields."""
    types: dict[str, Any] = {}
    values: dict[str, Any] = {"__post_init__": lambda _: None, "__annotations__": types}
    for field in dataclasses.fields(kind):
        value, types[field.name] = getattr(default, field.name), field.type
        if dataclasses.is_dataclass(value):
            types[field.name], value = _hiding(type(value), value, shown)
        elif field.name not in shown:
            types[field.name] = Annotated[field.type, tyro.conf.Suppress]
        values[field.name] = value
    names = {"__module__": kind.__module__, "__doc__": kind.__doc__}
    less: Any = dataclasses.dataclass(frozen=True)(type(kind.__name__, (kind,), names | values))
    return less, less()


def entry_point(main: Callable[[Sequence[str]], None]) -> Callable[[Sequence[str]], None]:
    """Wraps a main function so that an expected error ends it with one sentence.

    The exit code is 2 for a user's mistake, 1 for a failure of the machine or a number that is not
    finite, 128 + N for signal N, and 141 (SIGPIPE) if the reader of standard output has gone.
    """

    @functools.wraps(main)
    def run(argv: Sequence[str]) -> None:
        streams.settle()
        _settle_other_packages()
        try:
            code = _exit_code(main, argv)
            streams.finish()
        except OutputError as error:
            code = streams.exit_code(error)
        if code:
            sys.exit(code)

    return run


def _exit_code(main: Callable[[Sequence[str]], None], argv: Sequence[str]) -> int:
    try:
        main(argv)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except Interrupted as stop:
        print(stop, file=sys.stderr)
        return stop.exit_code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except OutputError:
        raise
    except Exception as error:
        code, sentence = _explained(error)
        print(f"error: {sentence}", file=sys.stderr)
        return code
    return 0


def _explained(error: Exception) -> tuple[int, str]:
    """Returns the exit code and the sentence; raises an unexpected error again."""
    if isinstance(error, UsageError | ConfigError | RunError):
        return 2, one_line(error)
    if isinstance(error, SaveError | NonFiniteError):
        return 1, one_line(error)
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return 1, (
            f"out of memory{_asked_for(error)}: choose a smaller replay-size, num-envs, "
            f"hidden-size, reference-size or mixture-episodes; what was saved before is intact."
        )
    if isinstance(error, OSError):
        where = "" if error.filename is None else f": {error.filename}"
        return 1, f"{error.strerror or one_line(error)}{where}."
    if type(error).__name__ == "JaxRuntimeError":  # whose module need not be loaded
        return 1, f"jax failed: {one_line(error)[:500]}"
    raise error


def one_line(error: Exception) -> str:
    """Returns the error's message on one line."""
    return re.sub(r"\s*\n\s*", " ", str(error)).strip()


def _asked_for(error: Exception) -> str:
    asked = re.search(r"allocat\w+ (?:an array with .*|[\d.]+ ?\w+)", str(error))
    return f" ({asked[0].rstrip('.')})" if asked else ""


def _settle_other_packages() -> None:
    """Overrides settings for other programs that would make every command fail."""
    # Tyro's help does not end in a terminal of a few columns.
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    # With an unknown MPLBACKEND, Matplotlib cannot be imported; it also logs its cache folder.
    os.environ["MPLBACKEND"] = "agg"
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    # Packages warn when they are imported, which -W error turns into an exception.
    if any(option.startswith("error") for option in sys.warnoptions):
        warnings.simplefilter("ignore")


def _sentence(panel: str) -> str:
    """Returns tyro's panel as one line: the problem and, if any, the nearest flag."""
    lines = [line.strip("│╭╮╰╯ \n") for line in panel.splitlines()[1:]]
    blank = next((i for i, line in enumerate(lines) if set(line) <= {"─"}), len(lines))
    problem = " ".join(lines[:blank]).removeprefix("Error parsing config: ").rstrip(".")
    if problem.endswith("?"):
        return problem
    nearest = next((line.split()[0] for line in lines[blank:] if line.startswith("--")), None)
    suggested = any("erhaps you meant" in line for line in lines)
    return f"{problem}: did you mean {nearest}?" if suggested and nearest else f"{problem}."
