"""Writes mp4 files with the ffmpeg in imageio-ffmpeg (extra `render`)."""

import contextlib
import itertools
import subprocess
from collections.abc import Iterator
from pathlib import Path
from subprocess import PIPE

import numpy as np

from maxent_jax.errors import UsageError

QUALITY = 21  # x264's constant rate factor: 18 looks lossless, 23 is its default


def check() -> None:
    """Checks that ffmpeg is installed.

    Raises:
      UsageError: ffmpeg is missing.
    """
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise UsageError(
            "videos need imageio-ffmpeg, which is not installed: pip install imageio-ffmpeg."
        ) from None


def write(path: Path, frames: Iterator[np.ndarray], frame_rate: float) -> None:
    """Writes a video of at least one frame, [H, W, 3] uint8 with even H and W; frame_rate in Hz.

    Raises:
      OSError: ffmpeg cannot write it.
    """
    import imageio_ffmpeg

    first = next(frames)
    height, width = first.shape[:2]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *("-y", "-loglevel", "error")]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", str(frame_rate), "-i", "-", "-c:v", "libx264", "-crf", str(QUALITY)]
    # Every browser plays this, even before all has arrived. A bare path could look like a flag.
    command += ["-pix_fmt", "yuv420p", "-movflags", "+faststart", f"file:{path}"]
    with subprocess.Popen(command, stdin=PIPE, stderr=PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # ffmpeg has ended, and says why
            for frame in itertools.chain([first], frames):
                ffmpeg.stdin.write(frame.tobytes())
        _, said = ffmpeg.communicate()
    if ffmpeg.returncode != 0:
        raise OSError(" ".join(said.decode(errors="replace").split()) or "ffmpeg failed")
