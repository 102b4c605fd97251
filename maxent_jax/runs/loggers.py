"""Sends metrics to TensorBoard and Weights & Biases too; both need the extra `log`."""

import contextlib
import dataclasses
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from maxent_jax.config import Config
from maxent_jax.errors import UsageError
from maxent_jax.runs import files

FOLDERS = ("tensorboard", "wandb")  # in the run's directory
Row = dict[str, Any]
Scalars = dict[str, float]
Sink = Callable[[Row], None]


class Sinks(NamedTuple):
    """Where to send metrics, in addition to metrics.jsonl."""

    tensorboard: bool = False
    wandb: str = ""  # its project; "" for none

    def check(self) -> None:
        """Raises UsageError if the package for one of them is missing."""
        for flag, asked, package in (
            ("tensorboard", self.tensorboard, "tensorboardX"),
            ("wandb", bool(self.wandb), "wandb"),
        ):
            if asked and importlib.util.find_spec(package) is None:
                raise UsageError(
                    f"--{flag} needs {package}, which is not installed: pip install {package}."
                )

    @contextlib.contextmanager
    def open(self, directory: Path, config: Config, iteration: int) -> Iterator[Sink]:
        """Context manager: gives a function that sends the row of each iteration after that one."""
        with contextlib.ExitStack() as opened:
            sinks: list[Callable[[int, Scalars], Any]] = []
            if self.tensorboard:
                sinks.append(opened.enter_context(_tensorboard(directory, iteration)))
            if self.wandb:
                sinks.append(opened.enter_context(_wandb(directory, self.wandb, config)))

            def pass_on(row: Row) -> None:
                iteration = int(np.ravel(row["iteration"])[0])  # that of all seeds
                for sink in sinks:
                    sink(iteration, scalars(row))

            yield pass_on


def scalars(row: Row) -> Scalars:
    """Returns the finite numbers of a row by name; name/0, name/1 ... if a column has several."""
    values: Scalars = {}
    for name, value in row.items():
        flat = np.asarray(value, float).ravel()  # None becomes nan
        names = [name] if flat.size == 1 else [f"{name}/{i}" for i in range(flat.size)]
        values |= {n: float(x) for n, x in zip(names, flat, strict=True) if np.isfinite(x)}
    return values


@contextlib.contextmanager
def _tensorboard(directory: Path, iteration: int) -> Iterator[Callable[[int, Scalars], None]]:
    from tensorboardX import SummaryWriter

    def write(iteration: int, values: Scalars) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, iteration)
        writer.flush()

    # A resumed run repeats some rows; only the later ones are shown.
    with SummaryWriter(str(directory / "tensorboard"), purge_step=iteration + 1) as writer:
        yield write


@contextlib.contextmanager
def _wandb(
    directory: Path, project: str, config: Config
) -> Iterator[Callable[[int, Scalars], None]]:
    import wandb

    try:
        run = wandb.init(
            project=project,
            config=dataclasses.asdict(config),
            dir=directory,
            id=files.read_id(directory),
            resume="allow",
        )
    except wandb.Error as error:
        said = str(error).splitlines()[0].rstrip(".")
        raise UsageError(
            f"wandb is {project}, but Weights & Biases cannot start ({said}): log in with `wandb "
            f"login`, set WANDB_MODE=offline, or leave out --wandb."
        ) from None
    with run:
        yield lambda iteration, values: run.log(values, step=iteration)
