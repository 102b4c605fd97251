"""Is all damage to a checkpoint noticed, and does the run resume from the previous one?"""

import random
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.faults import smoke
from maxent_jax import errors, load_run
from maxent_jax.runs import checkpoint, files, integrity
from maxent_jax.runs.integrity import ARRAYS, FOLDER, MANIFEST, REPLAY

NUM_FLIPS = 200


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields a row for each kind of damage, done to every file of the latest checkpoint."""
    run = folder / "run"
    process = smoke.start(run)
    while "1+1" not in integrity.checkpoints(run):  # within an iteration it has files of all kinds
        if process.poll() is not None:
            raise RuntimeError(f"a run ended early: {process.communicate()[1]}")
        time.sleep(0.01)
    process.kill()
    process.communicate()
    integrity.clear_unfinished(run)
    latest = run / FOLDER / integrity.checkpoints(run)[-1]
    files = sorted(path for path in latest.rglob("*") if path.is_file())
    rng = random.Random(0)
    filled = [path for path in files if path.stat().st_size]  # Orbax also leaves an empty one
    flipped = filled if short else rng.choices(filled, k=NUM_FLIPS)
    kinds: tuple[tuple[str, list[Path], Callable[[Path], Any]], ...] = (
        ("truncated", filled, lambda path: path.write_bytes(_half(path.read_bytes()))),
        ("deleted", files, lambda path: path.unlink()),
        ("a bit flipped", flipped, lambda path: path.write_bytes(_flip(path.read_bytes(), rng))),
    )
    for kind, paths, do in kinds:
        trials = [_damage(run, path, do) for path in paths]
        counts = {name: sum(trial[name] for trial in trials) for name in trials[0]}
        yield {
            "fault": f"file {kind}",
            "times": len(paths),
            **counts,
            "passed": counts["loaded silently"] == 0
            and counts["file named"] == counts["recovered by fallback"] == len(paths),
        }
    yield from _foreign(run, latest)


def _damage(run: Path, path: Path, do: Callable[[Path], Any]) -> dict[str, bool]:
    """Damages one file, checks the result, and restores the file."""
    before = path.read_bytes()
    do(path)
    name = path.relative_to(run / FOLDER).as_posix().split("/", 1)[1]
    silently, named = True, False
    try:
        integrity.find(run)
    except errors.CheckpointCorruptError as error:
        silently, named = False, name in str(error)
    if not name.startswith(REPLAY):  # analysis reads all but the replay
        try:
            load_run(run)
            silently = True
        except errors.CheckpointCorruptError:
            pass
    fallback, passed_over = integrity.find(run, fallback=True)
    checkpoint.restore(run, fallback, files.read_config(run))
    path.write_bytes(before)
    return {
        "loaded silently": silently,
        "file named": named,
        "recovered by fallback": len(passed_over) == 1 and integrity.find(run)[0] != fallback,
    }


def _half(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _flip(content: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(content))
    return content[:place] + bytes([content[place] ^ 1 << rng.randrange(8)]) + content[place + 1 :]


def _foreign(run: Path, latest: Path) -> Iterator[dict[str, Any]]:
    """Manipulations by someone who can also write a manifest."""
    secret = run.parent / "secret"
    secret.write_text("", encoding="utf-8")
    progress = latest / "progress.json"

    def link(path: Path) -> None:
        content = path.read_bytes()
        path.unlink()
        (run.parent / "elsewhere").write_bytes(content)
        path.symlink_to(run.parent / "elsewhere")

    def link_folder(path: Path) -> None:
        shutil.move(path, run.parent / "folder")
        path.symlink_to(run.parent / "folder")

    def seal_with(name: str) -> Callable[[], None]:
        def act() -> None:
            sums = f"{integrity.checksum(secret)}  {name}\n"
            lines = (latest / MANIFEST).read_text(encoding="utf-8").split("# ")[0] + sums
            (latest / MANIFEST).write_text(
                f"{lines}# {integrity.checksum_of(lines)}\n", encoding="utf-8"
            )

        return act

    kinds: tuple[tuple[str, Callable[[], Any]], ...] = (
        ("a file that is a link out", lambda: link(progress)),
        ("a folder that is a link out", lambda: link_folder(latest / ARRAYS)),
        ("the checkpoint a link out", lambda: link_folder(latest)),
        ("a name with ..", seal_with("../../../secret")),
        ("an absolute name", seal_with(str(secret.absolute()))),
        ("a file too many", lambda: shutil.copy(progress, latest / "more")),
    )
    for kind, do in kinds:
        kept = run.parent / "kept"
        shutil.copytree(run, kept)
        do()
        try:
            integrity.find(run)
            refused = ""
        except errors.CheckpointCorruptError as error:
            refused = str(error).split("damaged: ")[1].split(";")[0]
        shutil.rmtree(run)
        shutil.rmtree(run.parent / "folder", ignore_errors=True)
        shutil.move(kept, run)
        yield {"fault": kind, "times": 1, "refused": refused, "passed": bool(refused)}
