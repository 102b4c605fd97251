"""From a command line to settings: flags made from fields, one sentence for each mistake."""

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
from maxent_jax.config import registry
from maxent_jax.errors import ConfigError, NonFiniteError, RunError, SaveError, UsageError
from maxent_jax.runs import runtime
from maxent_jax.runs.signals import Interrupted
from maxent_jax.visual import headless

NARROWEST = 40  # columns
Arguments = TypeVar("Arguments")
Modules = Annotated[
    tuple[str, ...], tyro.conf.arg(name="import", metavar="MODULE"), tyro.conf.UseAppendAction
]
"""The type of a field for --import, which may be given more than once."""
COMMANDS = {
    "train": "train a mixture of policies that covers the state space",
    "evaluate": "roll a run's mixture out anew: entropy, coverage, returns",
    "render": "film a run's policies",
    "report": "one HTML page about one or several runs",
    "verify": "is every file of a run's checkpoints what was written?",
    "reproduce": "the paper's figures, and the studies beside them",
    "theory": "the methods against their bounds, exactly, in tabular MDPs",
}


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
    kind: type[Arguments],
    argv: Sequence[str],
    name: str,
    default: Any = None,
    shown: Collection[str] = (),
) -> Arguments:
    """The arguments of the command of that name; --help prints the fields of `kind` and exits.

    Args:
      shown: the fields that --help shows; --help-all shows every one. All of them if left out.
    Raises:
      UsageError: an unknown flag (with the nearest one), or a value of the wrong type.
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
    """The values that follow `--flag`, before the whole line is parsed."""
    values: list[str] = []
    for i, word in enumerate(argv):
        if word == flag:
            values += argv[i + 1 : i + 2]
        elif word.startswith(flag + "="):
            values.append(word.split("=", 1)[1])
    return values


def flag_value(argv: Sequence[str], flag: str) -> str | None:
    """The last value that follows `--flag`, before the whole line is parsed."""
    values = flag_values(argv, flag)
    return values[-1] if values else None


def import_modules(argv: Sequence[str], draws: bool = False) -> None:
    """Imports the modules that --import names, for the environments and the like they register.

    Args:
      draws: the command draws robots, which is to be settled before MuJoCo is loaded.
    Raises:
      UsageError: there is no such module, or it fails.
    """
    modules = flag_values(argv, "--import")
    if modules:
        if draws:
            headless.choose_backend()
        else:
            headless.draw_nothing()
        runtime.prepare(simulates_in_jax=flag_value(argv, "--backend") == "mjx")
        registry.import_modules(modules)


def _hiding(kind: Any, default: Any, shown: Collection[str]) -> tuple[Any, Any]:
    """A dataclass and its default like these, whose help shows no other fields."""
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
    """A main that ends with one sentence where it can't go on.

    Exit code 2 for a user's mistake, 1 for what the machine or the numbers did, 128 + N for a
    signal N; 141 (SIGPIPE) where the reader of standard output has gone.
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
    """The exit code and the sentence; what no user can cause is raised again."""
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
        return 1, f"jax cannot go on: {one_line(error)[:500]}"
    raise error


def one_line(error: Exception) -> str:
    """The message, also where what it quotes has line breaks."""
    return re.sub(r"\s*\n\s*", " ", str(error)).strip()


def _asked_for(error: Exception) -> str:
    asked = re.search(r"allocat\w+ (?:an array with .*|[\d.]+ ?\w+)", str(error))
    return f" ({asked[0].rstrip('.')})" if asked else ""


def _settle_other_packages() -> None:
    """Keeps a user's settings for other programs from ending every command.

    Packages warn when they are imported, which -W error makes an exception. Matplotlib refuses to
    be imported with an MPLBACKEND that it does not know, and talks of its own cache folder; figures
    here need neither. Tyro does not end its help in a terminal of a few columns.
    """
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    os.environ["MPLBACKEND"] = "agg"
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    if any(option.startswith("error") for option in sys.warnoptions):
        warnings.simplefilter("ignore")


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
