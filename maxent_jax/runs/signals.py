"""SIGINT, SIGTERM and SIGHUP (a terminal that closes): the first lets a run save where it next can,
a second Ctrl-C ends it at once.

Python runs a signal's handler between two of its own instructions, and a compiled program may take
minutes. So a thread reads what the signal leaves in a pipe, whatever the main thread is at.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
from pathlib import Path

SIGNALS = (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))


def heeded() -> tuple[signal.Signals, ...]:
    """Those that this process answers: under nohup SIGHUP stays ignored."""
    return tuple(
        number
        for number in SIGNALS
        if number in SIGNALS[:2] or signal.getsignal(number) != signal.SIG_IGN
    )


class Interrupted(Exception):
    """A run that was asked to stop, and has saved itself."""

    def __init__(self, received: int, directory: Path):
        """By the signal of that number; saved in that directory."""
        self.exit_code = 128 + received
        name = signal.Signals(received).name
        super().__init__(
            f"stopped by {name} and saved in {directory}: --resume goes on; "
            f"a study's command does so by itself."
        )


class Interruption:
    """While entered, remembers the first signal in `received`."""

    received: int | None = None

    def __enter__(self) -> "Interruption":
        self._reading, self._writing = socket.socketpair()
        self._writing.setblocking(False)
        self._wakeup = signal.set_wakeup_fd(self._writing.fileno())
        # A handler in Python, though it does nothing, is what makes the signal reach the pipe.
        self._handlers = {n: signal.signal(n, lambda *_: None) for n in heeded()}
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup)
        self._writing.close()  # which ends the thread
        self._thread.join()
        self._reading.close()

    def _watch(self) -> None:
        while received := self._reading.recv(1):
            number = received[0]
            if number not in SIGNALS:
                continue
            if self.received is None:
                self.received = number
                with contextlib.suppress(OSError, ValueError):  # the terminal may be gone
                    print(
                        "stopping at the next checkpoint; Ctrl-C once more to stop at once",
                        file=sys.stderr,
                        flush=True,
                    )
            elif number == signal.SIGINT:
                os._exit(128 + number)
