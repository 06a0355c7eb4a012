"""The standard streams, whatever they are: closed, a pipe that nobody reads, of an encoding without our characters."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TextIO

BROKEN_PIPE = 141  # what a shell reports of a program that a closed pipe ended


def check_arguments(args: Sequence[str]) -> None:
    """Refuse an argument that is no text in the locale's encoding: its name could be written to no file of ours."""
    for arg in args:
        if any("\ud800" <= character <= "\udfff" for character in arg):
            raise ValueError(f"the argument {arg!a} is no text in the encoding {sys.getfilesystemencoding()}")


def complain(message: str) -> None:
    """Print to the standard error, if it can be written to."""
    with suppress(OSError):
        print(message, file=sys.stderr, flush=True)


def nobody_reads() -> bool:
    """Whether the standard output or error is a pipe whose other end is closed."""
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # under a test's capture they have no number
            poll.register(stream.fileno(), 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _replace_absent() -> None:
    # In this order, since an opened file gets the lowest free number: nothing of ours is opened as 1 or 2.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "errors", None) in ("strict", "surrogateescape"):  # the latter in the C locale
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]


def _let_go(stream: TextIO) -> None:
    """What cannot be printed goes nowhere, so that the interpreter does not stumble over it at its end."""
    try:
        stream.flush()
    except OSError:
        with open(os.devnull, "w", encoding="utf-8") as nowhere:
            os.dup2(nowhere.fileno(), stream.fileno())


@contextmanager
def sound_streams() -> Iterator[None]:
    """Within the block there are streams to print to; a :class:`BrokenPipeError` of theirs ends the program quietly.

    Raises:
        SystemExit: 141, since nobody reads.
    """
    _replace_absent()
    try:
        yield
    except BrokenPipeError:
        if not nobody_reads():
            raise
        sys.exit(BROKEN_PIPE)
    finally:
        for stream in (sys.stdout, sys.stderr):
            _let_go(stream)
