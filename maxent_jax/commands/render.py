"""Films a run's archived policies, one by one and together, without a screen.

Writes into videos/ of the run's directory: policy_<i>.mp4 and policy_<i>.png (a strip of stills)
for each policy, and mixture.mp4 and mixture.png with all policies together. One policy plays each
episode, also in runs with --mixing step.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from maxent_jax import errors
from maxent_jax.checks import check_seed
from maxent_jax.commands import cli
from maxent_jax.runs import atomic, files, integrity, progress, runtime
from maxent_jax.visual import headless, video

if TYPE_CHECKING:
    from maxent_jax.analysis import Run
    from maxent_jax.visual.frames import Episode, Film

FRAMES_PER_SECOND = 20  # about; fewer if an environment step lasts longer
VIDEO_SECONDS = 25
SIZES = (128, 1080)  # of a picture, pixels
MOST_STILLS = 20
ASPECT = 16 / 9  # of all policies together, about


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Film a run: a video and a strip of stills of each policy, and of all together."""

    directory: Annotated[Path, tyro.conf.Positional]
    """The run's directory."""
    policy: int | None = None
    """Film only this policy."""
    episodes: int = 5
    """Episodes rolled out per policy; the one of median length is shown."""
    speed: float | None = None
    """Playback speed; if left out, 1, or more if a full episode would exceed 25 s."""
    size: int = 480
    """Side of a policy's video in pixels, a multiple of 4; half of it in the joint video."""
    stills: int = 6
    """Stills in a strip, equally spaced in time."""
    seed: int = 1
    """Seed of the rollouts; training evaluates with seed 0."""
    seed_index: int = 0
    """Which seed to film, from 0, if the run trained several."""
    fallback: bool = False
    """If the last checkpoint is damaged, use the one before."""
    modules: cli.Modules = ()
    """Module, by name or path, that registers your environments, bonuses or methods."""


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then loads jax and MuJoCo."""
    cli.import_modules(argv, draws=True)
    arguments = cli.parse(Arguments, argv, "render")
    config = files.read_config(arguments.directory)
    config.check_registered()
    _check(arguments, config.archive_size)
    headless.check_drawable(config.env)
    video.check()
    headless.choose_backend()
    integrity.check_any(arguments.directory)
    files.check_writable(arguments.directory)
    runtime.start(config.simulates_in_jax)
    _film(arguments)


def folder(directory: Path, num_seeds: int, seed_index: int) -> Path:
    """Returns the folder of a seed's videos."""
    videos = directory / "videos"
    return videos if num_seeds == 1 else videos / f"seed_{seed_index}"


def _check(arguments: Arguments, num_policies: int) -> None:
    policy, (smallest, largest) = arguments.policy, SIZES
    for wrong, sentence in (
        (
            policy is not None and not 0 <= policy < num_policies,
            f"--policy is {policy}, but the run has policies 0 to {num_policies - 1}.",
        ),
        (
            arguments.speed is not None and not 0.01 <= arguments.speed <= 1000,
            f"--speed is {arguments.speed}, but must be from 0.01 to 1,000.",
        ),
        (
            not smallest <= arguments.size <= largest or arguments.size % 4,
            f"--size is {arguments.size}, but must be a multiple of 4 from {smallest} to "
            f"{largest:,}.",
        ),
        (
            not 1 <= arguments.stills <= MOST_STILLS,
            f"--stills is {arguments.stills}, but must be from 1 to {MOST_STILLS}.",
        ),
    ):
        if wrong:
            raise errors.UsageError(sentence)
    cli.check_least("--episodes", arguments.episodes)
    check_seed("--seed", arguments.seed)


def _film(arguments: Arguments) -> None:
    from maxent_jax import analysis
    from maxent_jax.visual import frames, rendering

    run = analysis.load_run(arguments.directory, arguments.seed_index, arguments.fallback)
    _check(arguments, run.num_policies)  # fewer than planned if the run is not finished
    with (
        rendering.scene(run.components, arguments.size) as large,
        rendering.scene(run.components, arguments.size // 2) as small,
    ):
        episodes = frames.median_episodes(run, run.rollout(arguments.episodes, arguments.seed))
        speed = arguments.speed or max(1.0, _seconds_in_an_episode(run) / VIDEO_SECONDS)
        shot = frames.make(run, large, episodes, speed)
        where = folder(run.path, run.config.num_seeds, arguments.seed_index)
        studio = _Studio(where, speed, shot._replace(scene=small, speed=None), arguments.stills)
        for i, episode in enumerate(episodes):
            if arguments.policy in (None, i):
                studio.film(f"policy_{i}", shot, [episode])
        if arguments.policy is None:
            studio.film("mixture", shot._replace(scene=small), episodes)
    print(
        f"{where}: {studio.num_videos} videos and their stills; the longest lasts "
        f"{studio.longest:.1f} s, at {speed:g} times the simulation's speed."
    )


def _seconds_in_an_episode(run: "Run") -> float:
    return run.config.environment.episode_length * float(run.components.env.dt)


class _Studio:
    """Makes a video and a strip of stills of some episodes."""

    def __init__(self, where: Path, speed: float, still: "Film", num_stills: int):
        self._folder, self._still, self._num_stills = where, still, num_stills
        self._every = max(1, round(speed / (FRAMES_PER_SECOND * still.seconds)))
        self._frame_rate = speed / (self._every * still.seconds)
        self.num_videos, self.longest = 0, 0.0  # seconds

    def film(self, name: str, shot: "Film", episodes: Sequence["Episode"]) -> None:
        """Films the episodes together, to the end of the longest."""
        from PIL import Image

        from maxent_jax.visual import frames

        length = max(len(episode.states) for episode in episodes)
        columns = min(len(episodes), math.ceil(math.sqrt(ASPECT * len(episodes))))
        steps = range(0, length, self._every)
        pictures = (
            frames.mosaic([frames.picture(shot, episode, step) for episode in episodes], columns)
            for step in progress.track(steps, name)
        )
        with atomic.whole_file(self._folder / f"{name}.mp4") as temporary:
            video.write(temporary, pictures, self._frame_rate)
        self.num_videos += 1
        self.longest = max(self.longest, len(steps) / self._frame_rate)
        shown = frames.stills(length, self._num_stills)
        tiles = [
            frames.picture(self._still, episode, step) for episode in episodes for step in shown
        ]
        with atomic.whole_file(self._folder / f"{name}.png") as temporary:
            Image.fromarray(frames.mosaic(tiles, columns=len(shown))).save(temporary)
