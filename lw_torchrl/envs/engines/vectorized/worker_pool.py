"""Groups of rows, and the threads that work through them."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from math import ceil
from time import perf_counter


class RowGroup:
    """Rows that share a model, and so take turns.

    Attributes:
        rows: their numbers.
        seconds: how long the last piece of work on them took, each row of it; a guess for the next.
    """

    def __init__(self, rows: Sequence[int]) -> None:
        self.rows = tuple(rows)
        self.seconds = 1.0


def split_into_groups(keys: Sequence[str], num_threads: int) -> list[RowGroup]:
    """Put the rows with one key (the model's file) together, in several groups only where one alone would
    keep a thread busy for more than half of its share.
    """
    by_key: dict[str, list[int]] = defaultdict(list)
    for row, key in enumerate(keys):
        by_key[key].append(row)
    largest = len(keys) if num_threads == 1 else ceil(len(keys) / (2 * num_threads))
    groups = []
    for rows in by_key.values():
        parts = ceil(len(rows) / largest)
        bounds = [len(rows) * part // parts for part in range(parts + 1)]
        groups += [RowGroup(rows[low:high]) for low, high in pairwise(bounds)]
    return groups


class WorkerPool:
    """Threads that take one group after another until none is left.

    A group is in the hands of one thread at a time, so its rows may share a model; which thread that is
    changes no result. Groups that took long last time are begun first, which evens out the ends.
    """

    def __init__(self, num_threads: int) -> None:
        self._helpers = num_threads - 1
        self._threads = ThreadPoolExecutor(self._helpers, "lw_torchrl") if self._helpers else None

    def work(self, groups: Iterable[tuple[RowGroup, Sequence[int]]], do: Callable[[int], None]) -> None:
        """Call ``do(item)`` for every item of every ``(group, items)``, the items of a group in turn."""
        if self._threads is None:
            for _, items in groups:
                for item in items:
                    do(item)
            return
        waiting = deque(sorted(groups, key=lambda job: job[0].seconds * len(job[1]), reverse=True))

        def work_through() -> None:
            while True:
                try:
                    group, items = waiting.popleft()
                except IndexError:
                    return
                start = perf_counter()
                for item in items:
                    do(item)
                group.seconds = (perf_counter() - start) / len(items)

        helpers = min(self._helpers, len(waiting) - 1)
        futures = [self._threads.submit(work_through) for _ in range(helpers)]
        try:
            work_through()
        finally:
            waiting.clear()
            errors = [error for future in futures if (error := future.exception()) is not None]
        for error in errors:
            raise error

    def close(self) -> None:
        """End the threads."""
        if self._threads is not None:
            self._threads.shutdown()
