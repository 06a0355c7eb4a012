"""Run programs that read files from others in child processes with limits on memory and time."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from contextlib import suppress

_MB = 10**6
# Each limit is a constant plus a part for the files' size; compressed files are smaller than their content.
_SECONDS, _BYTES_PER_SECOND = 30, _MB
_MEMORY, _MEMORY_PER_BYTE = 700 * _MB, 200


class LimitError(ValueError):
    """An error for files that a program could not read within its limits."""


def run_limited(command: Sequence[str | os.PathLike[str]], stored: int) -> subprocess.CompletedProcess[bytes]:
    """Run a command that reads files of ``stored`` bytes, and return its exit status and output.

    Libraries that trust the sizes in a file may allocate gigabytes for a file of a few kilobytes, or never return.

    Raises:
        LimitError: the command took too long, or was killed, for example because it had no more memory.
    """
    seconds, memory = _SECONDS + stored / _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * stored
    environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **os.environ}
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        try:
            with suppress(ImportError, AttributeError, OSError):  # other systems than Linux have no limits of memory
                import resource

                resource.prlimit(process.pid, resource.RLIMIT_DATA, (memory, memory))
            output, errors = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            raise LimitError(f"reading {stored:,} bytes took more than {seconds:.0f} s, so it was stopped") from None
        finally:
            process.kill()
    if process.returncode < 0:
        raise LimitError(f"reading {stored:,} bytes failed within {memory / _MB:,.0f} MB of memory")
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)
