"""`python -m maxent_jax COMMAND ...`, the same as `maxent-jax COMMAND ...`."""

from maxent_jax.commands import main

if __name__ == "__main__":
    main()
