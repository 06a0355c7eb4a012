"""Which of TorchRL's workers makes an environment, found on the call stack."""

import sys
from collections.abc import Callable, Mapping
from multiprocessing import current_process, parent_process
from types import FrameType
from typing import Any, NoReturn

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
