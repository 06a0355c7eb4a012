"""Ctrl-C in training is taken between steps, so that a checkpoint can be written of where training stands."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """Whether Ctrl-C was pressed."""

    asked = False


@contextmanager
def interrupts_between_steps() -> Iterator[Interrupt]:
    """Within the block the first Ctrl-C only sets ``asked``; the loop looks at it, and ends the block when it can.

    The end of the block then raises :class:`KeyboardInterrupt`; a second Ctrl-C does so at once. In another thread than
    the main one, and where SIGINT is ignored, nothing is changed. In the midst of a step the exception may surface as
    another: TorchRL's losses catch what a tensordict raises.
    """
    interrupt = Interrupt()
    before = signal.getsignal(signal.SIGINT) if threading.current_thread() is threading.main_thread() else None
    if not callable(before):
        yield interrupt
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if interrupt.asked:
            before(number, frame)
        interrupt.asked = True

    signal.signal(signal.SIGINT, ask)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupt.asked:
        raise KeyboardInterrupt
