"""What is around a command: streams, variables of the environment, paths, and how errors end."""

import ast
import errno
import json
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import commands
import jax
import pytest

from maxent_jax import envs, errors
from maxent_jax.commands import cli, streams, train
from maxent_jax.config import preset
from maxent_jax.errors import UsageError
from maxent_jax.runs import files, integrity, machine, runtime
from maxent_jax.visual import headless

ROOT = Path(__file__).parent.parent
SMOKE = ["--preset", "smoke", "--env", "pendulum", "--out"]


def shell(script, *words, **variables):
    """maxent_jax with these words, as "$@" of a script in bash."""
    return subprocess.run(
        ["bash", "-c", script, "bash", sys.executable, "-m", "maxent_jax", *map(str, words)],
        cwd=ROOT,
        env=os.environ | variables,
        capture_output=True,
        check=False,
    )


def ended(raised, capsys):
    """The exit code and the sentence of a command that ends with that exception."""

    def main(_):
        raise raised

    with pytest.raises(SystemExit) as stop:
        cli.entry_point(main)([])
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1
    return stop.value.code, said


def test_help_is_printed_where_letters_are_missing():
    done = shell('"$@"', "train", "--help-all", PYTHONIOENCODING="ascii")
    assert done.returncode == 0 and not done.stderr
    assert b"lambda: weight of the episodic term" in done.stdout.replace(b"\n", b" ")


@pytest.mark.parametrize("name", ["evaluate", "report", "dataset", "render"])
@pytest.mark.parametrize("seed", [-1, 2**31, 10**20])
def test_a_seed_out_of_range_is_one_sentence(tmp_path, name, seed):
    files.write_config(tmp_path, preset("smoke"), {}, {})
    done = commands.call(name, tmp_path, "--seed", seed, expect=2)
    allowed = "must be 0 or more, and below 2^31 = 2147483648."
    assert done.stderr == f"error: --seed is {seed}, but {allowed}\n"


def test_letters_are_spelled_and_bytes_of_a_file_name_kept():
    assert "λ × é".encode("ascii", errors="maxent_plain") == b"lambda x ?"
    assert "a\udcffb".encode(errors="maxent_plain") == b"a\xffb"


def test_a_reader_that_has_gone_is_no_error_of_ours():
    done = shell('set -o pipefail; "$@" | true', "train", "--help")
    assert (done.returncode, done.stderr) == (streams.CUT_OFF, b"")


def test_a_full_standard_output_is_one_sentence():
    done = shell('"$@" > /dev/full', "--help")
    assert done.returncode == 1
    assert done.stderr == b"error: cannot write to standard output: No space left on device.\n"


def test_messages_go_into_no_file_that_was_opened_in_place_of_a_closed_stream(tmp_path):
    code = (
        "import os, sys\n"
        "from maxent_jax.commands import streams\n"
        "streams.settle()\n"
        "with open('file', 'w') as file:\n"
        "    print('out'); print('err', file=sys.stderr); os.system('echo child; echo child >&2')\n"
        "    file.write('content')\n"
        "    streams.finish()\n"
    )
    closed = ["bash", "-c", 'exec "$@" <&- >&- 2>&-', "bash", sys.executable, "-c", code]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    assert subprocess.run(closed, cwd=tmp_path, env=environment, check=False).returncode == 0
    assert (tmp_path / "file").read_text() == "content"


def test_a_platform_that_is_not_there_leaves_no_directory(tmp_path):
    done = shell('"$@"', "train", *SMOKE, tmp_path / "run", JAX_PLATFORMS="cuda")
    assert done.returncode == 2 and done.stderr.count(b"\n") == 1
    assert done.stderr.startswith(b"error: JAX_PLATFORMS is 'cuda', but jax finds no such device")
    assert not (tmp_path / "run").exists()


def test_variables_that_jax_cannot_read_are_a_sentence(tmp_path):
    out = str(tmp_path / "theory.json")
    done = shell('"$@"', "theory", "--toy", "--out", out, JAX_ENABLE_X64="maybe")
    assert done.returncode == 2 and b"JAX_ENABLE_X64" in done.stderr
    assert done.stderr.count(b"\n") == 1


def test_flags_that_xla_does_not_know_are_named(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"--no_such_flag {runtime.IN_ORDER}")
    with pytest.raises(UsageError, match=r"XLA_FLAGS is '--no_such_flag', .*Unknown flag"):
        runtime._check_flags()
    monkeypatch.setattr(runtime, "PROBE_SECONDS", 1e-3)  # as on a machine that is too busy
    runtime._check_flags()
    monkeypatch.setenv("XLA_FLAGS", runtime.IN_ORDER)
    runtime._check_flags()


@pytest.fixture
def settings():
    """jax's, put back afterwards."""
    names = (*runtime.SETTLED, "jax_compilation_cache_dir", "jax_enable_compilation_cache")
    before = {name: jax.config.values[name] for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.parametrize(
    ("name", "value"), [("jax_enable_x64", True), ("jax_numpy_rank_promotion", "raise")]
)
def test_variables_that_change_programs_are_overruled(settings, monkeypatch, name, value):
    jax.config.update(name, value)
    runtime.prepare(False)
    assert jax.config.values[name] == value  # set by a program, which knows what it does
    monkeypatch.setenv(name.upper(), str(value))
    runtime.prepare(False)
    assert jax.config.values[name] == runtime.SETTLED[name]


@pytest.mark.parametrize("what", ["a file", "no home"])
def test_without_a_cache_folder_programs_are_compiled_anew(
    settings, monkeypatch, tmp_path, capsys, what
):
    jax.config.update("jax_compilation_cache_dir", None)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file") if what == "a file" else "")
    if what == "no home":

        def no_home():
            raise RuntimeError("Could not determine home directory.")

        monkeypatch.setattr(Path, "home", no_home)
    runtime.prepare(False)
    assert not jax.config.values["jax_enable_compilation_cache"]
    said = capsys.readouterr().err
    assert said.startswith("note: programs are compiled again") and said.count("\n") == 1
    runtime.prepare(False)
    assert not capsys.readouterr().err  # it is said once


def test_limits_with_which_jax_cannot_start_are_named(monkeypatch):
    monkeypatch.setattr(machine, "address_space", lambda: 2**30)
    with pytest.raises(UsageError, match=r"1 GiB of address space \(ulimit -v\)"):
        machine.check_limits()
    monkeypatch.setattr(machine, "address_space", lambda: None)
    machine.check_limits()

    monkeypatch.setattr(machine, "_limit", lambda name: {"RLIMIT_NOFILE": 24}[name])
    with pytest.raises(UsageError, match=r"may open 24 files \(ulimit -n\)"):
        machine.check_limits()
    monkeypatch.undo()
    monkeypatch.setattr(machine, "address_space", lambda: None)

    def no_thread(_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(machine.threading.Thread, "start", no_thread)
    with pytest.raises(UsageError, match=r"cannot start \d+ threads"):
        machine.check_limits()


def test_memory_that_runs_out_is_one_sentence(capsys):
    error = jax.errors.JaxRuntimeError(
        "RESOURCE_EXHAUSTED: Out of memory allocating 40000000000 bytes.\nBufferAssignment: ..."
    )
    code, said = ended(error, capsys)
    assert code == 1 and "out of memory (allocating 40000000000 bytes)" in said
    code, said = ended(MemoryError("Unable to allocate 40.0 GiB for an array"), capsys)
    assert code == 1 and "(allocate 40.0 GiB)" in said


def test_what_the_system_refuses_is_one_sentence(capsys):
    error = OSError(errno.EMFILE, "Too many open files", "some.file")
    assert ended(error, capsys) == (1, "error: Too many open files: some.file.\n")


def test_a_path_with_a_line_break_keeps_the_sentence_on_one_line(capsys):
    assert ended(errors.RunError("a\nb is no run."), capsys) == (2, "error: a b is no run.\n")


def test_settings_for_other_programs_end_no_command(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "bogus")  # with which matplotlib cannot be imported
    monkeypatch.setenv("COLUMNS", "1")  # at which tyro's help never ends
    monkeypatch.setattr(sys, "warnoptions", ["error"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cli.entry_point(lambda _: warnings.warn("of another package", stacklevel=1))([])
    assert (os.environ["MPLBACKEND"], os.environ["COLUMNS"]) == ("agg", "40")


def test_a_command_that_draws_nothing_needs_no_opengl(monkeypatch):
    assert envs.TASKS  # which loads MuJoCo
    monkeypatch.setenv(headless.VARIABLE, "bogus")
    headless.draw_nothing()
    assert os.environ[headless.VARIABLE] == "bogus"  # MuJoCo is loaded, and has read it
    monkeypatch.delitem(sys.modules, "mujoco")
    headless.draw_nothing()
    assert os.environ[headless.VARIABLE] == "disable"


def test_a_mistake_of_ours_is_not_hidden():
    def main(_):
        raise KeyError("a bug")

    with pytest.raises(KeyError):
        cli.entry_point(main)([])


def test_an_empty_out_is_refused():
    with pytest.raises(UsageError, match="out is empty"):
        train.read_arguments(["--out="])


def begin(directory):
    """What a run leaves that was killed before its first checkpoint."""
    (directory / integrity.FOLDER / "unfinished-0+1").mkdir(parents=True)
    files.write_config(directory, preset("smoke", env="pendulum", seed=3), {}, {})
    for name in ("metrics.jsonl", "lock", "config.0123abcd.tmp.json"):
        (directory / name).write_text("")


@pytest.mark.parametrize("flags", [[], ["--resume"], ["--overwrite"]])
def test_a_directory_without_a_checkpoint_is_nobodys_run(tmp_path, flags):
    begin(tmp_path / "run")
    train.read_arguments([*SMOKE, str(tmp_path / "run"), *flags]).claim.check()


def user_config(run):
    (run / files.CONFIG).write_text(json.dumps({"model_type": "mine"}))


@pytest.mark.parametrize(
    "change",
    [
        user_config,
        lambda run: (run / "thesis.tex").write_text(""),
        lambda run: (run / files.METRICS).write_text("{}\n"),
        lambda run: (run / integrity.FOLDER / "mine").mkdir(),
        lambda run: (run / integrity.FOLDER / "1").mkdir(),
        lambda run: [(run / "tensorboard").mkdir(), (run / files.CONFIG).unlink()],
    ],
)
def test_a_directory_with_anything_else_in_it_is_left_alone(tmp_path, change):
    begin(tmp_path)
    change(tmp_path)
    arguments = train.read_arguments([*SMOKE, str(tmp_path)])
    with pytest.raises(UsageError, match="already exists"):
        arguments.claim.check()


def test_a_config_of_the_users_is_not_removed_as_a_run(tmp_path):
    user_config(tmp_path)
    arguments = train.read_arguments([*SMOKE, str(tmp_path), "--overwrite"])
    with pytest.raises(UsageError, match="left alone"), arguments.claim.hold():
        pass
    assert (tmp_path / files.CONFIG).exists()


def test_an_interrupted_overwrite_can_be_repeated(tmp_path, monkeypatch):
    begin(tmp_path)
    (tmp_path / "mine.tmp.txt").write_text("")
    (tmp_path / integrity.FOLDER / "1").mkdir()
    claim = train.read_arguments([*SMOKE, str(tmp_path), "--overwrite"]).claim

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("shutil.rmtree", interrupted)
    with pytest.raises(KeyboardInterrupt), claim.hold():
        pass
    monkeypatch.undo()
    assert (tmp_path / files.CONFIG).exists()
    with claim.hold():
        assert {path.name for path in tmp_path.iterdir()} == {"lock", "mine.tmp.txt"}


def test_a_busy_directory_without_a_checkpoint_stays_busy(tmp_path):
    begin(tmp_path)
    arguments = train.read_arguments([*SMOKE, str(tmp_path)])
    with (
        arguments.claim.hold(),
        pytest.raises(UsageError, match="another process"),
        arguments.claim.hold(),
    ):
        pass


@pytest.mark.parametrize("what", ["file/run", "nowhere", "read_only", "\udcff"])
def test_a_place_that_cannot_be_written_is_known_at_once(tmp_path, monkeypatch, what):
    (tmp_path / "file").write_text("")
    (tmp_path / "nowhere").symlink_to("target")
    monkeypatch.setattr(os, "access", lambda place, mode: what != "read_only")
    with pytest.raises(UsageError, match="cannot write to"):
        train.read_arguments([*SMOKE, str(tmp_path / what)]).claim.check()


def test_every_text_file_names_its_encoding():
    for folder in ("maxent_jax", "experiments", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not isinstance(node, ast.Call):
                    continue
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                modes = [a.value for a in node.args if isinstance(a, ast.Constant)]
                binary = any("b" in mode for mode in modes if isinstance(mode, str))
                if name in ("read_text", "write_text") or (
                    name == "open" and isinstance(node.func, ast.Name) and not binary
                ):
                    given = {keyword.arg for keyword in node.keywords}
                    assert "encoding" in given, f"{path}:{node.lineno}"


@pytest.mark.slow
def test_a_run_whose_terminal_closes_is_saved(tmp_path):
    ours, theirs = os.openpty()
    run = tmp_path / "run"
    take_terminal = (
        "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0);"
        "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    )
    words = [sys.executable, "-c", take_terminal, "-m", "maxent_jax", "train", *SMOKE, str(run)]
    more = ["--num-iterations", "1000", "--mixture-episodes", "1001", "--save-iterations", "1000"]
    process = subprocess.Popen(
        [*words, *more],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        cwd=ROOT,
        start_new_session=True,
    )
    os.close(theirs)
    while not files.read_metrics(run):
        os.read(ours, 1000)
        assert process.poll() is None
        time.sleep(0.01)
    os.close(ours)
    assert process.wait(timeout=60) == 129
    assert integrity.checkpoints(run)
