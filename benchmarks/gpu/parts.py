"""A part: its sections, measured in a process that ends when its time is up, and its summary."""

import contextlib
import functools
import json
import multiprocessing
import os
import signal
import tarfile
import tempfile
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks import common
from benchmarks.gpu.sections import (
    ENVS,
    device,
    env_steps,
    fidelity,
    host_physics,
    kernels,
    neighbors,
    peers,
    training,
    updates,
)
from benchmarks.gpu.session import Measure, Row, Session
from maxent_jax.runs import runtime

PACKING = 5.0  # of these seconds, for packing the results
NOT_PACKED = {"checkpoints", "trace"}

# All sections begin to compile together; they are measured in this order.
PARTS: dict[str, dict[str, Callable[[Session], Measure]]] = {
    "first": {
        "device": device,
        "neighbors": neighbors,
        "env steps": functools.partial(env_steps, ("ant",), ENVS),
        "training": training,
    },
    "second": {
        "env steps": functools.partial(env_steps, ("walker2d", "humanoid"), ENVS[:1]),
        "updates": updates,
        "host physics": host_physics,
        "fidelity": fidelity,
        "kernels": kernels,
        "peers": peers,
    },
}


def measure(part: str, seconds: float, toy: bool, rows: Path, work: Path) -> None:
    """Measures a part, in its own process, which may be ended at any time."""
    os.setpgrp()  # it ends together with the compilers and the runs that it starts
    # Two processes share the device: this one, and the run of `training`.
    os.environ["XLA_PYTHON_CLIENT_MEM_FRACTION"] = "0.45"
    runtime.prepare(simulates_in_jax=True)
    began = time.monotonic()
    with ThreadPoolExecutor(max_workers=16) as compilers, rows.open("a", encoding="utf-8") as file:
        session = Session(toy, began + seconds, work, compilers, [])

        def write(row: Row) -> None:
            row = common.rounded({"after_seconds": time.monotonic() - began} | row)
            print(json.dumps(row), file=file, flush=True)
            common.progress(row)

        def failed(what: str, error: Exception) -> None:  # only its own rows are lost
            traceback.print_exception(error)
            write({"section": "failed", "what": what, "why": common.sentence(error)})

        begun = {name: compilers.submit(s, session) for name, s in PARTS[part].items()}
        for name, section in begun.items():
            try:
                measure_section = section.result()
                for row in measure_section():
                    write(row)
            except Exception as error:
                failed(name, error)


def run_part(part: str, seconds: float, toy: bool, out: Path) -> list[Row]:
    """Runs a part until its time is up, packs it into OUT/PART.* and returns its rows."""
    until = time.monotonic() + seconds
    rows = out / f"{part}.jsonl"
    rows.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        arguments = part, seconds - PACKING, toy, rows, work
        process = multiprocessing.get_context("spawn").Process(target=measure, args=arguments)
        process.start()
        assert process.pid is not None
        try:
            process.join(until - PACKING - time.monotonic())
            ended = process.exitcode  # None if its time is up
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        process.join()
        with tarfile.open(out / f"{part}.tar.gz", "w:gz") as archive:
            for path in sorted(work.rglob("*")):
                name = path.relative_to(work)
                if path.is_file() and not NOT_PACKED & set(name.parts):
                    archive.add(path, name)
    # A row that was not written completely does not count.
    written = rows.read_text(encoding="utf-8") if rows.exists() else ""
    whole = written[: written.rfind("\n") + 1]
    rows.write_text(whole, encoding="utf-8")
    found = [json.loads(line) for line in whole.splitlines()]
    if ended:
        found.append({"section": "failed", "what": part, "why": f"it ended with code {ended}"})
    return found


def summary(rows: list[Row]) -> list[str]:
    """Returns at most ten lines with the most important figures; failures come first."""
    compiled = [row for row in rows if row["section"] == "compiled"]
    programs = sum(row["programs"] for row in compiled)
    seconds = sum(row.get("trace_seconds", 0) + row["compile_seconds"] for row in compiled)
    lines = [f"{programs} programs compiled in parallel, {seconds:.0f} s in sum"]
    for section, line in SUMMARY.items():
        lines += filter(None, (line(row) for row in rows if row["section"] == section))
    return lines[:10]


SUMMARY: dict[str, Callable[[Row], str]] = {
    "failed": lambda r: f"failed: {r['what']} ({r['why']})",
    "env steps": lambda r: (
        f"{r['env']}, {r['envs']:,} envs: {r['env_steps_per_second']:,.0f} env steps/s"
    ),
    "played": lambda r: (
        f"MaxEnt-V: {r['iterations']} iterations, {r['cells']:,} cells in training, "
        f"{r['mixture_cells']:,} by the mixture on C MuJoCo, {r['mixture_nats']:.2f} nats"
    ),
    "kNN": lambda r: (
        f"kNN, {r['who']}, {r['queries']:,} x {r['points']:,}: {r['tpair_per_second']:.3g} Tpair/s"
    ),
    "updates": lambda r: (
        f"SAC, batch {r['batch_size']:,}, seeds {r['seeds']}: {r['updates_per_second']:,.0f} "
        f"updates/s, {r['over_one_seed']:.2f} times one seed's"
    ),
    "kernels": lambda r: (
        ""
        if "kernel" in r
        else f"training: {r['kernels'] / r['vector_steps']:,.0f} kernels per vector step, "
        f"{r['in_kernels_seconds'] / r['wall_seconds']:.0%} of the time in kernels"
    ),
    "fidelity": lambda r: (
        f"MJX and C MuJoCo differ after one step by at most {r['largest_error_after_1_step']:.1e}"
    ),
}
