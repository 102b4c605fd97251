"""Entry point of `python -m experiments.finetune`: see maxent_jax/commands/finetune.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("finetune")
