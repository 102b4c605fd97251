"""The commands: `maxent-jax NAME`, and in a checkout `python -m experiments.NAME`."""

import sys
from collections.abc import Sequence

COMMANDS = {
    "train": "train a mixture of policies that covers the state space",
    "evaluate": "roll a run's mixture out anew: entropy, coverage, returns",
    "render": "film a run's policies",
    "report": "one HTML page about one or several runs",
    "verify": "is every file of a run's checkpoints what was written?",
    "reproduce": "the paper's figures, and the studies beside them",
    "theory": "the methods against their bounds, exactly, in tabular MDPs",
}


def main() -> None:
    """The entry point `maxent-jax`: the first argument names a command, which gets the others."""
    from maxent_jax.commands import cli

    cli.entry_point(_dispatch)(sys.argv[1:])


def _dispatch(argv: Sequence[str]) -> None:
    from maxent_jax import __version__
    from maxent_jax.choices import UsageError, check_choice
    from maxent_jax.commands import cli

    if not argv:
        raise UsageError(f"name a command: {', '.join(COMMANDS)} (--help says what each does).")
    name, *arguments = argv
    if name in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        print("usage: maxent-jax COMMAND [--help] ...\n")
        print("\n".join(f"  {command:{width}}  {what}" for command, what in COMMANDS.items()))
    elif name == "--version":
        print(f"maxent_jax {__version__}")
    else:
        check_choice("command", name, COMMANDS)
        cli.command(name)(arguments)
