"""Run programs that read untrusted files in child processes with limits on memory and time."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from contextlib import suppress

_MB = 10**6
# Each limit is a constant plus a multiple of the files' size. The multiple allows for compressed files.
_SECONDS, _BYTES_PER_SECOND = 30, _MB
_PATIENCE = 4  # wall-clock limit divided by the CPU-time limit; a process may have to wait for a busy machine
_MEMORY, _MEMORY_PER_BYTE = 700 * _MB, 200


class LimitError(ValueError):
    """An error for files that a program could not read within its limits."""


def run_limited(command: Sequence[str | os.PathLike[str]], stored: int) -> subprocess.CompletedProcess[bytes]:
    """Run a command that reads files of ``stored`` bytes; its time and memory limits grow with ``stored``.

    Libraries that trust the sizes in a file may allocate gigabytes for a file of a few kilobytes, or never return.

    Returns:
        The command's exit status and output.

    Raises:
        LimitError: the command took too long, or was killed, for example because it ran out of memory.
    """
    seconds, memory = _SECONDS + stored // _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * stored
    environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **os.environ}
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        try:
            with suppress(ImportError, AttributeError, OSError):  # outside Linux, only the timeout applies
                import resource

                resource.prlimit(process.pid, resource.RLIMIT_DATA, (memory, memory))
                resource.prlimit(process.pid, resource.RLIMIT_CPU, (seconds, seconds))
            output, errors = process.communicate(timeout=_PATIENCE * seconds)
        except subprocess.TimeoutExpired:
            output = errors = b""
        finally:
            process.kill()
    if process.returncode < 0:
        limits = f"{seconds} s and {memory / _MB:,.0f} MB of memory"
        raise LimitError(f"reading {stored:,} bytes exceeded the limits of {limits}, so it was stopped")
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)
