"""Entry point of `python -m experiments.reproduce`: see maxent_jax/commands/reproduce.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("reproduce")
