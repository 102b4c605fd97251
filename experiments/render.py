"""Entry point of `python -m experiments.render`: see maxent_jax/commands/render.py."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("render")
