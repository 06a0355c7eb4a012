"""Several questions at once: threads that stop asking when one answer says that the others would be no better."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from queue import SimpleQueue
from typing import TypeVar

from lw_torchrl.planners.errors import PlannerError

Item = TypeVar("Item")
Result = TypeVar("Result")


def ask_at_once(
    work: Callable[[Item], Result], items: Iterable[Item], concurrency: int
) -> Iterator[tuple[Item, Result | Exception]]:
    """Each item with what ``work`` gives of it, or raises, in the order in which they end.

    After an error that is no :class:`PlannerError`, or a fatal one, no further item is begun; those that are under way
    are waited for. Where the caller stops listening they end by themselves.
    """
    waiting, ended = deque(items), SimpleQueue[tuple[Item, Result | Exception] | None]()
    stop = threading.Event()

    def worker() -> None:
        while not stop.is_set():
            try:
                item = waiting.popleft()
            except IndexError:
                break
            try:
                ended.put((item, work(item)))
            except Exception as error:
                if not isinstance(error, PlannerError) or error.fatal:
                    stop.set()
                ended.put((item, error))
        ended.put(None)

    threads = [threading.Thread(target=worker, daemon=True) for _ in range(min(concurrency, len(waiting)))]
    try:
        for thread in threads:
            thread.start()
        left = len(threads)
        while left:
            found = ended.get()
            if found is None:
                left -= 1
            else:
                yield found
    finally:
        stop.set()
