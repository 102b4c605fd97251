"""What a run says of a number that is not finite."""

import jax.numpy as jnp
import pytest

from maxent_jax.errors import NonFiniteError
from maxent_jax.runs import stages
from maxent_jax.runs.checkpoint import Progress
from maxent_jax.runs.integrity import FOLDER

LOST = {"agent": {"critic": jnp.array([0.0, jnp.nan]), "step": jnp.array(3)}}


@pytest.mark.parametrize(
    ("progress", "when"),
    [
        (Progress([], {}, [], {}), "iteration 1 produced a number that is not finite at its begin"),
        (Progress([{}], {}, [{}] * 3, {}), "iteration 2 produced .* not finite in segment 3"),
        (Progress([{}], None, [], {}), "iteration 1 produced .* not finite at its end"),
    ],
)
def test_a_number_that_is_not_finite_is_placed(tmp_path, progress, when):
    with pytest.raises(NonFiniteError, match=rf"{when}.*agent\.critic.*no checkpoint yet\."):
        stages.check_finite(tmp_path, LOST, progress)
    (tmp_path / FOLDER / "0+1").mkdir(parents=True)
    with pytest.raises(NonFiniteError, match=r"the run up to checkpoint 0\+1\."):
        stages.check_finite(tmp_path, LOST, progress)


def test_a_finite_state_passes(tmp_path):
    stages.check_finite(tmp_path, {"x": jnp.ones(3)}, Progress([], None, [], {}))
