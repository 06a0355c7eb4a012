"""Ctrl-C during training: finish the step, save, and only then stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """Records whether Ctrl-C was pressed once (``requested``) or twice (``insisted``)."""

    requested = insisted = False


@contextmanager
def interrupts_between_steps() -> Iterator[Interrupt]:
    """Record the first Ctrl-C, and raise :class:`KeyboardInterrupt` at the end of the block.

    A second Ctrl-C raises at once. Nothing changes outside the main thread, or where SIGINT is ignored.
    """
    interrupt = Interrupt()
    previous = signal.getsignal(signal.SIGINT) if threading.current_thread() is threading.main_thread() else None
    if not callable(previous):
        yield interrupt
        return

    def record(number: int, frame: FrameType | None) -> None:
        interrupt.insisted, interrupt.requested = interrupt.requested, True
        if interrupt.insisted:
            previous(number, frame)

    signal.signal(signal.SIGINT, record)
    try:
        yield interrupt
    except Exception as error:
        if interrupt.insisted:  # losses catch what tensordicts raise, and may turn it into another error
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, previous)
    if interrupt.requested:
        raise KeyboardInterrupt
