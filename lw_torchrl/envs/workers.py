"""Which of TorchRL's workers makes an environment, found on the call stack; and a lock for one thread at a time."""

import sys
from collections.abc import Callable, Mapping
from functools import wraps
from multiprocessing import current_process, parent_process
from types import FrameType
from typing import Any, NoReturn, TypeVar

MANY = 2**16  # stands for a number of workers that TorchRL does not tell: more than there are

Locals = Mapping[str, Any]


def _by_process(level: int) -> tuple[int, int]:
    return current_process()._identity[level] - 1, MANY


def _threads(found: Locals) -> NoReturn:
    what = "steps an environment from several threads, and does not say which of its environments this is"
    raise RuntimeError(f"a ThreadingAsyncEnvPool {what}: take backend='multiprocessing'")


def _remote(found: Locals) -> tuple[int, int]:
    """A RayCollector tells its collectors their index; those of other collectors are counted by their process."""
    index = found.get("worker_idx")
    return (0, 1) if index is None or parent_process() is not None else (index, MANY)


_BATCHED = "torchrl.envs.batched_envs"
# Where TorchRL (0.14), which tells a factory nothing of its worker, calls one: module and function to its (rank, of),
# from the function's local variables. A factory must not give each worker the same episodes.
_WORKERS: dict[tuple[str, str], Callable[[Locals], tuple[int, int]]] = {
    (_BATCHED, "SerialEnv._start_workers"): lambda found: (found["idx"], found["_num_workers"]),
    # An environment of environments, which starts its own at its first reset.
    (_BATCHED, "SerialEnv._reset"): lambda found: (found["i"], found["self"].num_workers),
    ("torchrl.envs.async_envs", "ThreadingAsyncEnvPool._setup"): _threads,
    ("torchrl.collectors._single", "Collector.__init__"): _remote,
}
_WORKER_PROCESSES: dict[tuple[str, str], Callable[[Locals], tuple[int, int]]] = {
    (_BATCHED, "_run_worker_pipe_shared_mem"): lambda found: (found["worker_idx"], len(found["shm_done_flags"])),
    (_BATCHED, "_run_worker_pipe_direct"): lambda found: _by_process(-1),
    ("torchrl.envs.async_envs", "ProcessorAsyncEnvPool._env_exec"): lambda found: (found["i"], MANY),
    ("torchrl.collectors._runner", "_main_async_collector_impl"): lambda found: (found["idx"], MANY),
}


def torchrl_worker() -> tuple[int, int]:
    """(rank, of) of the worker that this is called in, (0, 1) outside; workers within workers are counted through. Of
    collectors and AsyncEnvPool ``of`` is :data:`MANY`."""
    rank, of, processes = 0, 1, 0
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        place = (frame.f_globals.get("__name__", ""), frame.f_code.co_qualname)
        if (tell := _WORKERS.get(place) or _WORKER_PROCESSES.get(place)) is not None:
            outer, count = tell(frame.f_locals)
            rank, of = rank + outer * of, of * count
            processes += place in _WORKER_PROCESSES
        frame = frame.f_back
    parent = parent_process()
    if processes == 1 and parent is not None and parent.name.startswith("_ProcessNoWarn"):
        # A collector's worker spawned this one, so its stack is not below ours; fork leaves it there.
        outer, count = _by_process(-2)
        rank, of = rank + outer * of, of * count
    return rank, of


Method = TypeVar("Method", bound=Callable[..., Any])


class OneThread:
    """Lets one thread in at a time, which may enter again; two would break MuJoCo's memory or, silently, its numbers.
    Entering raises a RuntimeError if another thread is in for longer than ``patience`` seconds."""

    def __init__(self, lock: Any, patience: float = 0.0) -> None:
        self._lock, self._patience = lock, patience

    def __enter__(self) -> None:
        if not self._lock.acquire(timeout=self._patience):
            raise RuntimeError(
                "another thread is stepping, resetting or drawing this environment, which takes one thread at a time: "
                "make an environment in each thread, or one with num_envs= and step its rows together"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


def one_thread_at_a_time(method: Method) -> Method:
    """A method of a usable environment that one thread may be in at a time."""

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self._one_thread:
            self._check_usable()
            return method(self, *args, **kwargs)

    return run  # type: ignore[return-value]
