"""Entry point of `python -m experiments.report`: see maxent_jax/commands/report.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("report")
