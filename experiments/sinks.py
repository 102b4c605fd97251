"""Where metrics go beside metrics.jsonl: TensorBoard's files, Weights & Biases. Both are extras."""

import dataclasses
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.cli import UsageError
from maxent_jax import runs
from maxent_jax.config import Config

Row = dict[str, Any]


class Sinks(NamedTuple):
    """Which are asked for."""

    tensorboard: bool = False
    wandb: str = ""  # its project; "" for none

    def check(self) -> None:
        """Raises UsageError where the package of one is missing."""
        for flag, asked, package in (
            ("tensorboard", self.tensorboard, "tensorboardX"),
            ("wandb", bool(self.wandb), "wandb"),
        ):
            if asked and importlib.util.find_spec(package) is None:
                raise UsageError(
                    f"--{flag} needs {package}, which is not installed: "
                    f'pip install "maxent_jax[log]".'
                )

    def open(self, directory: Path, config: Config, iteration: int) -> Callable[[Row], None]:
        """A function that takes the row of each iteration after that one, and passes it on."""
        passes: list[Callable[[int, dict[str, float]], None]] = []
        if self.tensorboard:
            passes.append(_tensorboard(directory, iteration))
        if self.wandb:
            passes.append(_wandb(directory, self.wandb, config))

        def add(row: Row) -> None:
            values = scalars(row)
            for pass_on in passes:
                pass_on(row_iteration(row), values)

        return add


def scalars(row: Row) -> dict[str, float]:
    """The numbers of a row by name; name/0, name/1 ... where a column has several."""
    values: dict[str, float] = {}
    for name, value in row.items():
        flat = np.asarray(value, float).ravel()  # None becomes nan
        if flat.size == 1:
            values[name] = float(flat[0])
        else:
            values |= {f"{name}/{i}": float(x) for i, x in enumerate(flat)}
    return values


def row_iteration(row: Row) -> int:
    """The iteration that a row is of, the same for all seeds."""
    return int(np.ravel(row["iteration"])[0])


def _tensorboard(directory: Path, iteration: int) -> Callable[[int, dict[str, float]], None]:
    from tensorboardX import SummaryWriter

    # Rows after the checkpoint that a run resumes from are shown once.
    writer = SummaryWriter(str(directory / "tensorboard"), purge_step=iteration + 1)

    def pass_on(iteration: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, iteration)
        writer.flush()

    return pass_on


def _wandb(
    directory: Path, project: str, config: Config
) -> Callable[[int, dict[str, float]], None]:
    import wandb

    run = wandb.init(
        project=project,
        config=dataclasses.asdict(config),
        dir=directory,
        id=runs.read_id(directory),
        resume="allow",
    )
    return lambda iteration, values: run.log(values, step=iteration)
