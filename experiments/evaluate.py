"""Entry point of `python -m experiments.evaluate`: see maxent_jax/commands/evaluate.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("evaluate")
