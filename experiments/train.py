"""Entry point of `python -m experiments.train`: see maxent_jax/commands/train.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("train")
