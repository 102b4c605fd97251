"""Lets a run save itself when a signal arrives; a second Ctrl-C ends it at once.

SIGHUP is sent when a terminal closes. A cluster sends SIGUSR1 or SIGUSR2 before a job's time ends.
Python runs a signal handler between two of its own instructions, and a compiled program can take
minutes. So a thread reads the signal from a pipe, whatever the main thread does.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
from pathlib import Path


def heeded() -> tuple[signal.Signals, ...]:
    """Returns the signals that save a run: SIGINT, SIGTERM, and others that depend on the process.

    SIGHUP is included unless it is ignored, as under nohup. SIGUSR1 and SIGUSR2 are included if the
    process has a handler for them, as a job of submitit has.
    """
    found = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP"):  # POSIX
        found += [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN else []
        found += [n for n in (signal.SIGUSR1, signal.SIGUSR2) if callable(signal.getsignal(n))]
    return tuple(found)


class Interrupted(Exception):
    """A signal asked the run to stop, and the run has saved itself."""

    def __init__(self, received: int, directory: Path):
        """Takes the number of the signal, and the directory in which the run is saved."""
        self.received = received
        self.exit_code = 128 + received
        name = signal.Signals(received).name
        super().__init__(
            f"stopped by {name} and saved in {directory}: continue with --resume; "
            f"a study's command continues by itself."
        )


class Interruption:
    """While entered, remembers the first signal in `received`; in the main thread alone.

    Python delivers no signal to other threads, and lets no other thread set a handler.
    """

    received: int | None = None

    def __enter__(self) -> "Interruption":
        self._listens = threading.current_thread() is threading.main_thread()
        if self._listens:
            self._listen()
        return self

    def __exit__(self, *_: object) -> None:
        if self._listens:
            self._end()

    def _listen(self) -> None:
        self._reading, self._writing = socket.socketpair()
        self._writing.setblocking(False)
        self._wakeup = signal.set_wakeup_fd(self._writing.fileno())
        # A handler in Python, although it does nothing, makes the signal reach the pipe.
        self._handlers = {n: signal.signal(n, lambda *_: None) for n in heeded()}
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _end(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        signal.set_wakeup_fd(self._wakeup)
        self._writing.close()  # which ends the thread
        self._thread.join()
        self._reading.close()

    def _watch(self) -> None:
        while received := self._reading.recv(1):
            number = received[0]
            if number not in self._handlers:
                continue
            if self.received is None:
                self.received = number
                with contextlib.suppress(OSError, ValueError):  # the terminal may be gone
                    print(
                        "stopping at the next checkpoint; press Ctrl-C again to stop at once",
                        file=sys.stderr,
                        flush=True,
                    )
            elif number == signal.SIGINT:
                os._exit(128 + number)
