"""OneThread: one thread at a time in a simulation. Two would break MuJoCo's memory, or its numbers without a word."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

Method = TypeVar("Method", bound=Callable[..., Any])


class OneThread:
    """Lets one thread in at a time, that one as often as it wants.

    Args:
        lock: an RLock. A Lock would stay taken where an interrupt comes between taking it and the block.
        patience: seconds to wait for another thread.

    Raises:
        RuntimeError: on entering, another thread is still in.

    Example:
        >>> import threading
        >>> with OneThread(threading.RLock()):
        ...     print("stepping")
        stepping
    """

    def __init__(self, lock: Any, patience: float = 0.0) -> None:
        self._lock, self._patience = lock, patience

    def __enter__(self) -> None:
        if not self._lock.acquire(timeout=self._patience):
            raise RuntimeError(
                "another thread is stepping, resetting or drawing this environment, and a simulation takes one thread "
                "at a time: make an environment in each thread, or one with num_envs= and step its rows together"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


def alone(method: Method) -> Method:
    """A method of an environment that no other thread may be in, and that wants the environment usable."""

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self._one_thread:
            self._check_usable()
            return method(self, *args, **kwargs)

    return run  # type: ignore[return-value]
