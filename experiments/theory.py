"""Entry point of `python -m experiments.theory`: see maxent_jax/commands/theory.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("theory")
