"""Signals, sent to a process that is busy outside of Python."""

import signal
import subprocess
import sys
import time

# The main thread naps in C, where no handler of Python's runs; a signal ends the first nap alone.
BUSY = """
import ctypes, sys
from maxent_jax.runs.signals import Interruption
with Interruption() as interruption:
    print("busy", flush=True)
    for _ in range(3):
        ctypes.CDLL(None).usleep(1_000_000)
    print(interruption.received, flush=True)
"""


def busy(*before, code=BUSY):
    process = subprocess.Popen(
        [*before, sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "busy\n"
    return process


def test_the_first_signal_is_remembered_and_answered():
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        process = busy()
        process.send_signal(number)
        assert process.stderr.readline().startswith("stopping at the next checkpoint")
        out, _ = process.communicate()
        assert process.returncode == 0 and out == f"{int(number)}\n"


def test_a_second_ctrl_c_ends_at_once():
    process = busy()
    process.send_signal(signal.SIGTERM)
    process.stderr.readline()
    sent = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert process.returncode == 130 and time.monotonic() - sent < 1


def test_under_nohup_a_terminal_that_closes_is_ignored():
    process = busy("nohup")
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGTERM)  # which is the first that it remembers
    out, _ = process.communicate()
    assert process.returncode == 0 and out == f"{int(signal.SIGTERM)}\n"


def test_a_signal_is_remembered_where_nobody_reads_the_messages():
    process = busy()
    process.stderr.close()
    process.send_signal(signal.SIGHUP)
    with process:
        assert process.stdout.read() == f"{int(signal.SIGHUP)}\n"
    assert process.returncode == 0


def test_a_user_signal_is_remembered_if_the_program_has_a_handler_for_it():
    had = "import signal\nsignal.signal(signal.SIGUSR2, lambda *_: print('requeued', flush=True))"
    process = busy(code=f"{had}\n{BUSY}\nsignal.raise_signal(interruption.received)")
    process.send_signal(signal.SIGUSR2)
    out, _ = process.communicate()
    assert process.returncode == 0 and out == f"{int(signal.SIGUSR2)}\nrequeued\n"
    process = busy()
    process.send_signal(signal.SIGUSR2)
    process.communicate()
    assert process.returncode == -signal.SIGUSR2


def test_another_thread_runs_without_listening():
    code = f"import threading\nthreading.Thread(target=exec, args=({BUSY!r}, {{}})).start()"
    process = busy(code=code)
    out, errors = process.communicate()
    assert process.returncode == 0 and out == "None\n" and not errors
