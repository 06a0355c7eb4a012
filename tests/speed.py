"""Cases of a test that only the slow suite runs, and limits of time."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from time import thread_time
from typing import Any

import pytest

USUAL = 0.01  # seconds of CPU time for _work on a usual machine


def first_fast(values: Iterable[Any], fast: int = 1) -> list[Any]:
    """Mark all but the first values of a parametrisation as slow."""
    return [value if n < fast else pytest.param(value, marks=pytest.mark.slow) for n, value in enumerate(values)]


def _work() -> float:
    start, words = thread_time(), dict[str, int]()
    for number in range(30_000):
        words[f"word {number % 97}"] = number
    return thread_time() - start


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Fail if a block takes more CPU time in this thread than ``seconds``, or more on a slower or busy machine."""
    before, start = _work(), thread_time()
    yield
    took = thread_time() - start
    slowness = max(before, _work(), USUAL) / USUAL
    assert took < seconds * slowness, f"took {took:.2f} s, at most {seconds} s × {slowness:.1f} are allowed"
