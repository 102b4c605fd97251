"""Workers of a study on a cluster: what is submitted, and no cell lost or trained twice."""

import importlib.util
import os
import random
import signal
import time
from pathlib import Path

import commands
import pytest
import submitit

from maxent_jax import training
from maxent_jax.commands import launcher, reproduce
from maxent_jax.runs import files, locks
from maxent_jax.runs.signals import Interrupted
from maxent_jax.studies import disk, protocol

TOY = ["--scale", "toy", "--seeds", "1"]
JOB = "77"
# SLURM's commands as submitit calls them, on this machine. A job runs again once it is requeued.
FAKES = {
    "sbatch": r"""
if [ -n "$REFUSES" ]; then echo "sbatch: error: invalid partition: gpus" >&2; exit 1; fi
cp "$1" "$SLURM/script"
export SLURM_ARRAY_JOB_ID=77 SLURM_PROCID=0
last=$(sed -n 's/^#SBATCH --array=0-\([0-9]*\).*/\1/p' "$1")
for i in $([ -n "$RUNS" ] && seq 0 "$last"); do
  export SLURM_JOB_ID=$((77 + i)) SLURM_ARRAY_TASK_ID=$i again=$SLURM/requeue_77_$i
  (while bash "$1"; [ -e "$again" ]; do rm "$again"; done) > /dev/null 2>&1 &
done
echo "Submitted batch job 77"
""",
    "srun": r"""
while [[ $1 == --* ]]; do
  if [ "$1" = --output ]; then log=$2; shift; fi
  shift
done
log=${log//%A/77}; log=${log//%a/$SLURM_ARRAY_TASK_ID}
echo $$ > "$SLURM/pid_$SLURM_ARRAY_TASK_ID"
exec "$@" >> "${log//%t/0}" 2>&1
""",
    "scontrol": 'touch "$SLURM/$1_$2"\n',
}


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """The folder of a cluster of one machine, whose jobs do not start unless RUNS is set."""
    folder = tmp_path / "slurm"
    folder.mkdir()
    for name, script in FAKES.items():
        (folder / name).write_text(f"#!/bin/bash\n{script}")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
    monkeypatch.setenv("SLURM", str(folder))
    return folder


def submitted(out, *words, expect=0):
    return commands.call(
        "reproduce", "fig4", *TOY, "--out", out, "--launcher", "submitit", *words, expect=expect
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--launcher", "submitits"], "did you mean 'submitit'"),
        (["--num-workers", "2"], "are for --launcher submitit"),
        (["--slurm", "time=60"], "are for --launcher submitit"),
        (["--num-workers", "0"], "num-workers is 0, but must be at least 1"),
        (["--jobs", "2"], "jobs is for the cores of this machine"),
        (["--slurm", "time"], "slurm has 'time', but must be KEY=VALUE"),
        (["--slurm", "tme=60"], "did you mean 'time'"),
        (["--slurm", "setup=x", "time=60"], "setting of SLURM"),
        (["--slurm", "partition=gpu"], "time = missing, but needs --slurm time=MINUTES"),
        (["--slurm", "time=01:00:00"], "time = 01:00:00, but needs"),
        (["--slurm", "time=5"], "above signal_delay_s = 300 seconds"),
    ],
)
def test_bad_input_is_one_sentence_before_anything_is_written(tmp_path, slurm, words, sentence):
    local = "are for --launcher" in sentence
    launched = [] if local or "--launcher" in words else ["--launcher", "submitit"]
    argv = ["fig4", *TOY, "--out", tmp_path / "studies", *launched, *words]
    done = commands.call("reproduce", *argv, expect=2)
    assert sentence in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "studies").exists()


def test_what_has_no_cells_is_not_submitted(tmp_path, slurm):
    done = commands.call("reproduce", "fig3", "--launcher", "submitit", expect=2)
    assert "fig3 has no cells to share" in done.stderr


def test_a_missing_package_or_cluster_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    done = submitted(tmp_path / "studies", "--slurm", "time=60", expect=2)
    assert "needs sbatch, which is not on the PATH" in done.stderr
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    done = submitted(tmp_path / "studies", "--slurm", "time=60", expect=2)
    assert "needs submitit, which is not installed" in done.stderr
    assert not (tmp_path / "studies").exists()


def test_workers_are_one_job_array(tmp_path, slurm):
    out = tmp_path / "my studies"
    done = submitted(
        *(out, "--num-workers", "2", "--slurm", "time=60", "partition=gpu"),
        *("cpus_per_task=4", "gpus_per_node=1", "mem=16GB"),
    )
    asked = set((slurm / "script").read_text().splitlines())
    assert asked >= {
        *("#SBATCH --array=0-1%2", "#SBATCH --time=60", "#SBATCH --partition=gpu"),
        *("#SBATCH --cpus-per-task=4", "#SBATCH --gpus-per-node=1", "#SBATCH --mem=16GB"),
        *("#SBATCH --signal=USR2@300", "#SBATCH --requeue", "#SBATCH --open-mode=append"),
        f"#SBATCH --output='{out}/jobs/%A_%a_0_log.out'",
    }
    assert done.stdout.splitlines() == [
        f"submitted job {JOB}: 2 workers for 3 of 3 cells",
        f"logs: {out}/jobs/{JOB}_*.out",
        "next:",
        f"  squeue --jobs {JOB}",
        f"  wc -l '{out}/fig4'/*/metrics.jsonl  # iterations of each cell",
        f"  python -m maxent_jax reproduce fig4 --scale toy --out '{out}' --seeds 1"
        "  # the figures, once all cells are finished",
    ]
    worker = launcher.Worker(("fig4", "--no-figures", *("--scale", "toy", "--out", str(out))))
    worker = launcher.Worker((*worker.argv, "--seeds", "1", "--shard", "0/1"))
    for i in range(2):
        job = submitit.SlurmJob(out / "jobs", f"{JOB}_{i}").submission()
        assert job.function == worker == job._checkpoint_function().function


def test_a_job_that_the_cluster_refuses_is_one_sentence(tmp_path, slurm, monkeypatch, capfd):
    monkeypatch.setenv("REFUSES", "1")
    done = submitted(tmp_path, "--slurm", "time=60", expect=2)
    assert "the cluster refuses the job: sbatch: error: invalid partition: gpus." in done.stderr


def test_of_a_finished_study_nothing_is_submitted(tmp_path, slurm, monkeypatch):
    monkeypatch.setattr(disk, "finished", lambda *_: True)
    done = submitted(tmp_path, "--slurm", "time=60")
    assert done.stdout.startswith("all 3 cells are finished, so no job is submitted.")
    assert not (slurm / "script").exists()


def those_of_v():
    """Of a study of tasks, V's cell and the two that start from it; and which share that is."""
    every = protocol.make("downstream", "toy", 1)
    count = sum(cell.source is None for cell in every)
    return protocol.share(every, 0, count), f"0/{count}"


@pytest.mark.parametrize("dies", [False, True], ids=["finishes", "dies"])
def test_a_worker_waits_for_what_another_trains_and_others_start_from(tmp_path, monkeypatch, dies):
    """The other process holds V, from which two cells start; it finishes V, or is killed."""
    cells, _ = those_of_v()
    names = [cell.name for cell in cells]
    assert names == ["pendulum-V-0", "pendulum-V-1-gymnasium-0", "pendulum-V-2-gymnasium-0"]
    done, waited = [], []
    other = locks.holding(tmp_path / names[0])

    def other_ends(seconds):
        waited.append(seconds)
        other.__exit__(None, None, None)
        done.extend([] if dies else names[:1])

    monkeypatch.setattr(reproduce.time, "sleep", other_ends)
    monkeypatch.setattr(disk, "finished", lambda _, cell: cell.name in done)
    monkeypatch.setattr(training, "run_to_end", lambda config, at, *_: done.append(at.name))
    other.__enter__()
    assert reproduce._train(tmp_path, cells) == 0
    assert done == names and waited == [reproduce.POLL_SECONDS]


def test_a_worker_ends_while_another_trains_the_last_cell(tmp_path, monkeypatch):
    cells, trained = protocol.make("fig4", "toy", 1), []
    monkeypatch.setattr(training, "run_to_end", lambda config, at, *_: trained.append(at.name))
    monkeypatch.setattr(disk, "finished", lambda _, cell: cell.name in trained)
    monkeypatch.setattr(reproduce.time, "sleep", None)
    with locks.holding(tmp_path / cells[0].name):
        assert reproduce._train(tmp_path, cells) == 0
    assert trained == [cell.name for cell in cells[1:]]


def test_a_signal_in_a_cells_last_iteration_stops_the_study(tmp_path, monkeypatch):
    trained = []

    def stopped_too_late(config, directory, *_):
        trained.append(directory.name)
        return signal.SIGTERM

    monkeypatch.setattr(training, "run_to_end", stopped_too_late)
    with pytest.raises(Interrupted, match="SIGTERM"):
        reproduce._train(tmp_path, protocol.make("fig4", "toy", 1))
    assert len(trained) == 1


def child_of(pid):
    """The only child of a process, None without one."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return int(children[0]) if children else None


def rows_of(directory):
    """The lines of metrics.jsonl of each cell that has the file, without times."""
    paths = sorted(directory.glob(f"*/{files.METRICS}"))
    return {
        path.parent.name: [
            {name: value for name, value in row.items() if not name.startswith("wall")}
            for row in files.read_metrics(path.parent)
        ]
        for path in paths
    }


def num_rows(directory):
    return sum(path.read_bytes().count(b"\n") for path in directory.glob(f"*/{files.METRICS}"))


def killed(job):
    """Kills the worker of a job of the local executor, as a lost machine does; whether it ran."""
    worker = None if job.done() else child_of(job.job_id)
    if worker is not None:
        os.kill(worker, signal.SIGKILL)
    job.wait()
    return worker is not None


@pytest.mark.slow
def test_a_study_whose_workers_are_killed_ends_as_one_that_was_not(tmp_path):
    """Two workers are started again and again, and killed after a few more iterations."""
    study = ["weights", "--scale", "toy", "--seeds", "2", "--no-figures"]
    out, cells = tmp_path / "killed" / "weights", protocol.make("weights", "toy", 2)
    executor = submitit.LocalExecutor(tmp_path / "jobs")
    executor.update_parameters(timeout_min=30, stderr_to_stdout=True)
    rng, kills = random.Random(0), 0
    while not all(disk.finished(out, cell) for cell in cells):
        jobs = launcher.submit(executor, [*study, "--out", str(out.parent)], 2)
        rng.shuffle(jobs)
        target = num_rows(out) + rng.randint(1, 6)
        while num_rows(out) < target and not all(job.done() for job in jobs):
            time.sleep(0.05)
        for job in jobs:
            time.sleep(rng.uniform(0, 0.5))
            kills += killed(job)
    assert kills >= 4
    commands.in_subprocess("reproduce", *study, "--out", tmp_path / "whole")
    whole = rows_of(tmp_path / "whole" / "weights")
    assert list(whole) == sorted(cell.name for cell in cells)
    assert rows_of(out) == whole
    assert all([row["iteration"] for row in rows] == [1, 2] for rows in whole.values())


@pytest.mark.slow
def test_a_job_whose_time_is_over_saves_and_is_requeued(tmp_path, slurm, monkeypatch):
    """Two workers share a cell and two that start from it; the first to train is told to stop."""
    monkeypatch.setenv("RUNS", "1")
    cells, share = those_of_v()
    study = ["downstream", *TOY, "--shard", share, "--out", tmp_path]
    options = ["--launcher", "submitit", "--num-workers", "2", "--slurm", "time=60"]
    commands.in_subprocess("reproduce", *study, *options)
    logs = [tmp_path / "jobs" / f"{JOB}_{i}_0_log.out" for i in range(2)]
    first = until(lambda: next((i for i in range(2) if "compiled" in said(logs[i])), None))
    os.kill(int((slurm / f"pid_{first}").read_text()), signal.SIGUSR2)
    until(lambda: all("Job completed successfully" in said(log) for log in logs) or None)
    log = said(logs[first])
    assert log.count("stopping at the next checkpoint") == 1
    assert f"Requeued job {JOB}_{first} " in log
    assert log.count("Starting with JobEnvironment") == 2
    assert all(disk.finished(tmp_path / "downstream", cell) for cell in cells)
    rows = rows_of(tmp_path / "downstream")
    assert list(rows) == sorted(cell.name for cell in cells)
    assert all([row["iteration"] for row in of_cell] == [1, 2] for of_cell in rows.values())


def said(log):
    """What a job has written so far."""
    return log.read_text() if log.exists() else ""


def until(found, seconds=600):
    """Waits until a function returns something else than None, and returns that."""
    end = time.monotonic() + seconds
    while (value := found()) is None:
        assert time.monotonic() < end
        time.sleep(0.05)
    return value
