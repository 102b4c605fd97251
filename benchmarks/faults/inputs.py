"""Does every mistake on the command line give one sentence, at once, and exit code 2?"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from maxent_jax.config import preset
from maxent_jax.runs import files, integrity

SECONDS = 3.0


class Mistake(NamedTuple):
    """A wrong command line, and words of the message that it must give."""

    module: str
    arguments: str
    says: str  # expected words
    without: str = ""  # a package to be treated as missing
    environment: tuple[str, str] = ("", "")


def train(arguments: str, says: str) -> Mistake:
    """A wrong command line of `train`."""
    return Mistake("experiments.train", arguments, says)


MISTAKES = (
    train("--env antt", "did you mean 'ant'"),
    train("--env brax:antt", "did you mean 'brax:ant'"),
    train("--method w", "unknown method 'w'"),
    train("--preset quik", "did you mean 'quick'"),
    train("--backend mjxx", "did you mean 'mjx'"),
    train("--physics fats", "did you mean 'fast'"),
    train("--reward liner", "did you mean 'linear'"),
    train("--weights geometrical", "did you mean 'geometric'"),
    train("--presett quick", "did you mean --preset"),
    train("--nonsense", "--nonsense"),
    train("--num-envs -3", "num-envs is -3"),
    train("--num-envs 0", "num-envs is 0"),
    train("--num-envs many", "--num-envs"),
    train("--num-envs 2.5", "--num-envs"),
    train("--num-iterations", "--num-iterations"),
    train("--num-seeds 0", "num-seeds is 0"),
    train("--seed -1", "seed is -1"),
    train("--learning-rate nan", "learning-rate is nan"),
    train("--learning-rate 0", "learning-rate is 0"),
    train("--discount 1.5", "discount is 1.5"),
    train("--eta 0", "eta is 0"),
    train("--eta 1.5", "eta is 1.5"),
    train("--reward-scale inf", "reward-scale is inf"),
    train("--preset smoke --num-neighbors 256", "below reference-size = 256"),
    train("--preset smoke --batch-size 4000", "must not exceed replay-size"),
    train("--preset smoke --steps-per-iteration 401", "must be a multiple"),
    train("--env pendulum --backend mjx", "pendulum has only: auto"),
    train("--env walker2d --policy-inputs heading", "no floating torso"),
    train("--devices -1", "devices is -1"),
    train("--num-processes 2", "need --coordinator"),
    train("--save-iterations 0", "save-iterations is 0"),
    train("--save-minutes 0", "save-minutes is 0"),
    train("--fallback", "fallback is only for --resume"),
    train("--resume --overwrite", "exclude each other"),
    train("--out {run}", "already exists"),
    train("--out {file}", "already exists"),
    train("--out {file}/run", "cannot write"),
    train("--out=", "out is empty"),
    train("--num-envs 2147483648", "must be at most"),
    train("--replay-size 4000000000", "must be at most"),
    train("--hidden-size 100000000000000000000", "must be at most"),
    train("--hidden-layers 1000", "hidden-layers is 1000"),
    train("--num-neighbors 1000", "num-neighbors is 1000"),
    train("--return-steps 1000", "return-steps is 1000"),
    train("--num-iterations 1000000", "steps are counted in 32 bits"),
    train("--updates-per-step 1e9", "gradient steps are counted in 32 bits"),
    train("--mixture-episodes 100000000", "states are counted in 32 bits"),
    train("extra", "Unrecognized options: extra"),
    train("--out {foreign} --resume", "not the directory of a run"),
    train("--out {foreign} --overwrite", "left alone"),
    train("--out {newer} --resume", "schema 99"),
    train("--preset smoke --seed 7 --out {run} --resume", "seed was 0 and is 7"),
    Mistake("experiments.train", "--wandb project", "pip install wandb", without="wandb"),
    Mistake(
        "experiments.train", "--tensorboard", "pip install tensorboardX", without="tensorboardX"
    ),
    Mistake("experiments.evaluate", "{missing}", "not the directory of a run"),
    Mistake("experiments.evaluate", "{run} --episodes 0", "at least 1"),
    Mistake("experiments.evaluate", "{newer}", "schema 99"),
    Mistake("experiments.evaluate", "{pendulum} --gymnasium", "not played in Gymnasium"),
    Mistake("experiments.render", "{missing}", "not the directory of a run"),
    Mistake("experiments.render", "{pendulum}", "cannot be drawn"),
    Mistake("experiments.render", "{run} --size 3", "--size is 3, but must be"),
    Mistake("experiments.render", "{run} --policy 9", "the run has policies 0 to 2"),
    Mistake("experiments.render", "{run}", "pip install imageio-ffmpeg", without="imageio_ffmpeg"),
    Mistake(
        "experiments.render", "{run}", "MUJOCO_GL is 'gles'", environment=("MUJOCO_GL", "gles")
    ),
    Mistake("experiments.report", "", "name the directory"),
    Mistake("experiments.report", "{run} {run}", "named twice"),
    Mistake("experiments.report", "{run} --out {missing}/page.html", "cannot write"),
    Mistake("experiments.verify", "{empty}", "not the directory of a run"),
    Mistake("experiments.verify", "{begun}", "no complete checkpoint"),
    Mistake("experiments.evaluate", "{begun}", "no complete checkpoint"),
    Mistake("maxent_jax", "", "no command is given"),
    Mistake("maxent_jax", "trian", "did you mean 'train'?"),
    Mistake("maxent_jax", "--nonsense", "unknown command '--nonsense'"),
    Mistake("maxent_jax", "verify {empty}", "not the directory of a run"),
    Mistake("maxent_jax", "theory --tolerance 0", "--tolerance is 0"),
    Mistake("maxent_jax", "theory --out {empty}", "is a folder"),
    Mistake("maxent_jax", "reproduce fig9", "unknown study 'fig9'"),
    Mistake("maxent_jax", "reproduce fig4 --scale huge", "unknown scale 'huge'"),
    Mistake("maxent_jax", "reproduce fig4 --shard 3/2", "shard is 3/2"),
    Mistake("maxent_jax", "reproduce fig4 --seeds 0", "seeds is 0"),
    Mistake("experiments.verify", "", "directory"),
)


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields one row; it lists the mistakes with a wrong result."""
    places = _places(folder)
    mistakes = MISTAKES[:: 20 if short else 1]
    found = [_make(mistake, places) for mistake in mistakes]
    met = zip(mistakes, found, strict=True)
    wrong = [f"{m.module} {m.arguments}: {what}" for m, (what, _) in met if what]
    yield {
        "fault": "a mistake at the command line",
        "times": len(mistakes),
        "met by one sentence and exit code 2": len(mistakes) - len(wrong),
        "slowest, seconds": max(seconds for _, seconds in found),
        "wrong": wrong,
        "passed": not wrong,
    }


def _places(folder: Path) -> dict[str, Path]:
    """Directories by what is wrong with them."""
    names = ("missing", "empty", "foreign", "newer", "begun", "run", "pendulum")
    places = {name: folder / name for name in names}
    for name in names[1:]:
        places[name].mkdir()
    (places["foreign"] / "thesis.tex").write_text("", encoding="utf-8")
    (places["newer"] / files.CONFIG).write_text(
        json.dumps({"schema": 99, "config": {}}), encoding="utf-8"
    )
    files.write_config(places["begun"], preset("smoke"), {}, {})
    files.write_config(places["run"], preset("smoke"), {}, {})
    files.write_config(places["pendulum"], preset("smoke", env="pendulum"), {}, {})
    for name in ("run", "pendulum"):
        (places[name] / integrity.FOLDER / "2").mkdir(
            parents=True
        )  # the name of a saved checkpoint
    places["file"] = folder / "file"
    places["file"].write_text("", encoding="utf-8")
    return places


def _make(mistake: Mistake, places: dict[str, Path]) -> tuple[str, float]:
    """Makes a mistake; returns what is wrong with the result, or "", and the seconds."""
    arguments = mistake.arguments.format(**places).split()
    code = (
        f"import runpy, sys; sys.modules[{mistake.without!r}] = None; "
        f"sys.argv = {['', *arguments]!r}; "
        f"runpy.run_module({mistake.module!r}, run_name='__main__')"
    )
    started = time.perf_counter()
    name, value = mistake.environment
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | ({name: value} if name else {}),
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = round(time.perf_counter() - started, 2)
    said = done.stderr
    for right, otherwise in (
        (done.returncode == 2, f"exit code {done.returncode}: {said[-200:]}"),
        (said.startswith("error: ") and said.count("\n") == 1, f"no single sentence: {said}"),
        (mistake.says in said, f"said: {said}"),
        (not done.stdout, f"printed: {done.stdout}"),
        (seconds <= SECONDS, f"took {seconds} s"),
    ):
        if not right:
            return otherwise, seconds
    return "", seconds
