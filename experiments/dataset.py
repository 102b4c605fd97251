"""Entry point of `python -m experiments.dataset`: see maxent_jax/commands/dataset.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("dataset")
