"""The commands: `maxent-jax NAME`, and in a checkout `python -m experiments.NAME`."""

import sys
from collections.abc import Sequence


def main() -> None:
    """Runs `maxent-jax`: the first argument names a command, the others are its arguments."""
    from maxent_jax.commands import cli

    cli.entry_point(_dispatch)(sys.argv[1:])


def _dispatch(argv: Sequence[str]) -> None:
    from maxent_jax import __version__
    from maxent_jax.checks import check_choice
    from maxent_jax.commands import cli
    from maxent_jax.errors import UsageError

    known = cli.COMMANDS
    if not argv:
        raise UsageError(f"no command is given: name one of {', '.join(known)} (see --help).")
    name, *arguments = argv
    if name in ("-h", "--help"):
        width = max(map(len, known))
        print("usage: maxent-jax COMMAND [--help] ...\n")
        print("\n".join(f"  {command:{width}}  {what}" for command, what in known.items()))
    elif name == "--version":
        print(f"maxent_jax {__version__}")
    else:
        check_choice("command", name, known)
        cli.command(name)(arguments)
