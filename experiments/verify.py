"""Entry point of `python -m experiments.verify`: see maxent_jax/commands/verify.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("verify")
