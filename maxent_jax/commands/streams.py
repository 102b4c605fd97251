"""Makes standard input, output and error safe: closed, full, cut off, or lacking a letter.

Messages on standard error are a courtesy: a run continues if they cannot be written. What a command
prints on standard output is its result: the command fails if it cannot be written.
"""

import codecs
import errno
import io
import os
import sys
from typing import Any, TextIO

CUT_OFF = 141  # 128 + SIGPIPE, as shells report a program whose reader has gone
_GREEK = dict(α="alpha", β="beta", γ="gamma", ε="eps", η="eta", λ="lambda", π="pi", σ="sigma")
_SIGNS = dict(zip("─│╭╮╰╯×·→’“”²", '-|++++x*>\'""2', strict=True))
_PLAIN = str.maketrans(_GREEK | _SIGNS)


class OutputError(OSError):
    """Standard output cannot be written."""


class _Output(io.FileIO):
    """Raises OutputError once; then drops what is still buffered."""

    lost = False

    def write(self, data: Any, /) -> int:
        if self.lost:
            return len(data)
        try:
            return super().write(data) or 0
        except OSError as error:
            self.lost = True
            raise OutputError(error.errno, error.strerror) from None


class _Messages(io.FileIO):
    """Drops what cannot be written."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data) or 0
        except OSError:
            return len(data)


def settle() -> None:
    """Prepares the streams of this process; leaves streams alone that were replaced.

    A letter that the encoding lacks is spelled out or becomes "?". Closed streams become
    /dev/null: otherwise the next file that is opened would get their descriptor, and messages
    would be written into it.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    if sys.stdin is None:
        sys.stdin = io.TextIOWrapper(io.FileIO(0, closefd=False), "utf-8")
    sys.stdout = _wrapped(sys.stdout, sys.__stdout__, 1, _Output)
    sys.stderr = _wrapped(sys.stderr, sys.__stderr__, 2, _Messages)


def finish() -> None:
    """Flushes standard output.

    Raises:
      OutputError: standard output cannot be written.
    """
    sys.stdout.flush()


def exit_code(error: OutputError) -> int:
    """Returns the exit code of a command that could not print; says why unless the reader left."""
    if error.errno == errno.EPIPE:
        return CUT_OFF
    print(f"error: cannot write to standard output: {error.strerror}.", file=sys.stderr)
    return 1


def _wrapped(now: TextIO | None, original: TextIO | None, number: int, raw: type) -> TextIO:
    if now is not original or isinstance(getattr(getattr(now, "buffer", None), "raw", None), raw):
        return now  # type: ignore[return-value]
    encoding = "utf-8" if now is None else now.encoding
    if now is not None:
        now.flush()
    buffer = io.BufferedWriter(raw(number, "w", closefd=False))
    live = number == 2 or os.isatty(number)
    return io.TextIOWrapper(buffer, encoding, errors="maxent_plain", line_buffering=live)


def _spell(error: UnicodeError) -> tuple[str | bytes, int]:
    """Handles codec errors: plain letters, and the raw bytes of file names that are not text."""
    assert isinstance(error, UnicodeEncodeError)
    letters = error.object[error.start : error.end]
    if all("\udc80" <= letter <= "\udcff" for letter in letters):
        return letters.encode("utf-8", "surrogateescape"), error.end
    spelled = letters.translate(_PLAIN)
    return "".join(letter if letter.isascii() else "?" for letter in spelled), error.end


codecs.register_error("maxent_plain", _spell)
