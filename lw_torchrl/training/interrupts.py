"""Ctrl-C in training is taken between steps, so that a checkpoint can be written of where training stands."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """Whether Ctrl-C was pressed, once or again."""

    asked = insisted = False


@contextmanager
def interrupts_between_steps() -> Iterator[Interrupt]:
    """Within the block the first Ctrl-C only sets ``asked``; the loop looks at it, and ends the block when it can.

    The end of the block then raises :class:`KeyboardInterrupt`; a second Ctrl-C does so at once. In another thread than
    the main one, and where SIGINT is ignored, nothing is changed.
    """
    interrupt = Interrupt()
    before = signal.getsignal(signal.SIGINT) if threading.current_thread() is threading.main_thread() else None
    if not callable(before):
        yield interrupt
        return

    def ask(number: int, frame: FrameType | None) -> None:
        interrupt.insisted, interrupt.asked = interrupt.asked, True
        if interrupt.insisted:
            before(number, frame)

    signal.signal(signal.SIGINT, ask)
    try:
        yield interrupt
    except Exception as error:
        if interrupt.insisted:  # in the midst of a step it may surface as another: losses catch what tensordicts raise
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupt.asked:
        raise KeyboardInterrupt
