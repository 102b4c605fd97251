"""Entry point: maxent_jax/commands/render.py has what it does."""

from maxent_jax.commands import cli

if __name__ == "__main__":
    cli.run("render")
