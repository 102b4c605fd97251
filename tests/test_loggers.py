"""Metrics in TensorBoard's files, read back."""

import struct

import numpy as np
import pytest
from tensorboardX.proto import event_pb2

from maxent_jax.config import preset
from maxent_jax.errors import UsageError
from maxent_jax.runs import loggers
from maxent_jax.runs.loggers import Sinks


def test_scalars_name_each_finite_number_of_a_column():
    row = {"a": np.float32(0.5), "b": [None, 1], "c": np.zeros((1, 1)), "wall_peak_bytes": None}
    assert loggers.scalars(row) == {"a": 0.5, "b/1": 1, "c": 0}


def test_tensorboard_files_hold_every_row(tmp_path):
    with Sinks(tensorboard=True).open(tmp_path, preset("smoke"), 0) as pass_on:
        for iteration in (1, 2):
            pass_on({"iteration": np.array([iteration] * 2), "coverage": [3.0, 4.0 * iteration]})
    (path,) = (tmp_path / "tensorboard").iterdir()
    content, found = path.read_bytes(), []
    while content:  # TFRecord: length, its checksum, data, its checksum
        (length,) = struct.unpack("<Q", content[:8])
        event = event_pb2.Event.FromString(content[12 : 12 + length])
        found += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
        content = content[16 + length :]
    assert (1, "coverage/1", 4.0) in found and (2, "coverage/1", 8.0) in found
    assert (2, "coverage/0", 3.0) in found


def test_a_missing_extra_is_one_sentence(monkeypatch):
    monkeypatch.setattr(loggers.importlib.util, "find_spec", lambda name: None)
    Sinks().check()
    for asked in (Sinks(tensorboard=True), Sinks(wandb="project")):
        with pytest.raises(UsageError, match="pip install "):
            asked.check()
