"""Read text, JSON and TOML files, write files atomically, lock them, and run programs that read untrusted files."""

from __future__ import annotations

import errno
import glob
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.resources.abc import Traversable
from itertools import accumulate
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

AnyPath = str | os.PathLike[str]
_ABANDONED = 3600.0  # age in seconds at which a temporary folder counts as a leftover of a killed process
_DEEPEST = 200  # maximum nesting of JSON
PATIENCE = 1.0  # seconds that `locked` waits for another writer to finish

_SHIPPED = Path(__file__).parents[1] / "training" / "data"


def shipped_policy(name: AnyPath) -> Path | None:
    """Return the path of a shipped policy, such as "few-shot-mt50". Return None if no shipped policy has this name, or
    if a file with this name exists in the current folder."""
    path = _SHIPPED / f"{name}.safetensors"
    return path if Path(name).name == str(name) and not Path(name).exists() and path.is_file() else None


def absent_policy(path: AnyPath, writer: str = "train") -> str:
    """Return the error message for a missing policy file; ``writer`` is the command that writes such files."""
    near = [file.stem for file in _SHIPPED.glob("*.safetensors") if file.stem.startswith(Path(path).name[:8])]
    hint = f"; did you mean the shipped policy {near[0]!r}?" if near and Path(path).name == str(path) else ""
    return f"no file {str(path)!r}; create it with `lw-torchrl {writer}`{hint}"


def expanded(path: AnyPath) -> Path:
    """Return a path with a leading "~/" replaced by the user's home folder."""
    text = os.fspath(path)
    return Path(os.path.expanduser(text) if text == "~" or text.startswith("~/") else text)


@contextmanager
def replacing(path: AnyPath, *, sync: bool = True) -> Iterator[Path]:
    """Yield a temporary path to write to, and rename the file to ``path`` when the block ends without an error.

    If the process is killed, ``path`` is either the complete old file or the complete new file. With ``sync``, which
    takes about 10 ms, the same is true if the machine crashes. The new file has the old file's mode. If ``path`` is a
    symbolic link, its target is replaced. A folder, device or FIFO is not replaced: an :class:`OSError` is raised.
    """
    target = Path(os.path.realpath(expanded(path)))
    if target.exists() and not target.is_file():
        raise OSError(errno.EISDIR if target.is_dir() else errno.EINVAL, "not a regular file", str(target))
    with _staged(target, sync) as temporary:
        yield temporary
        if sync:
            flush(temporary)


@contextmanager
def replacing_folder(path: AnyPath) -> Iterator[Path]:
    """Yield a temporary folder, and rename it to ``path`` when the block ends. ``path`` must be new or an empty
    folder."""
    with _staged(expanded(path).absolute()) as temporary:
        temporary.mkdir()
        yield temporary
        for entry in [*temporary.rglob("*"), temporary]:
            flush(entry)


@contextmanager
def _staged(target: Path, sync: bool = True) -> Iterator[Path]:
    """Yield a path with the target's name in a private temporary folder, and rename it to ``target`` at the end."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if sync:  # callers use sync=False to write many small files, and listing their folder each time would be slow
        for left in target.parent.glob(f".{glob.escape(target.name)}.*.tmp"):  # leftovers of killed processes
            with suppress(OSError):
                if time.time() - left.stat().st_mtime > _ABANDONED:
                    shutil.rmtree(left)
    folder = Path(mkdtemp(".tmp", f".{target.name}.", target.parent))
    try:
        yield (temporary := folder / target.name)
        with suppress(FileNotFoundError):
            old = target.stat()
            with suppress(OSError):  # only root may change the owner of a file
                os.chown(temporary, old.st_uid, old.st_gid)
            temporary.chmod(stat.S_IMODE(old.st_mode))
        os.replace(temporary, target)
        if sync:
            flush(target.parent)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def flush(path: Path) -> None:
    """Wait until a file or folder is written to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems cannot sync
            raise
    finally:
        os.close(handle)


@contextmanager
def locked(
    path: AnyPath,
    argument: str,
    who: str = "process",
    *,
    folder: bool = False,
    wait: bool = False,
    error: type[ValueError] = ValueError,
) -> Iterator[None]:
    """Hold the lock of a file or folder until the block ends, so that no other thread or process writes to it.

    The lock is released if the process is killed. If another ``who`` (such as "process") holds the lock for more than a
    second, raise ``error`` with a message that names ``argument``; with ``wait``, wait until the lock is released.
    """
    from filelock import FileLock, Timeout

    place = expanded(path)
    lock = FileLock(place / ".lock" if folder else place.with_name(f".{place.name}.lock"))
    Path(lock.lock_file).parent.mkdir(parents=True, exist_ok=True)
    try:
        lock.acquire(timeout=PATIENCE)
    except Timeout:
        if not wait:
            remedy = f"wait until it finishes, or use a different {'folder' if folder else 'file'}"
            raise error(f"{argument}: another {who} is writing to {str(place)!r}; {remedy}") from None
        print(f"waiting for another {who}, which is writing to {str(place)!r}", file=sys.stderr, flush=True)
        lock.acquire()
    try:
        yield
    finally:
        Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()


def write_text(path: AnyPath, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: AnyPath, value: Any) -> None:
    """Write a JSON file atomically; raise a :class:`ValueError` for NaN and infinity, which JSON does not support."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_text(path: Path | Traversable, error: type[ValueError], *, limit: int | None = None) -> str:
    """Read a UTF-8 text file, remove the byte order mark and convert line ends to ``\\n``. Raise ``error`` if the file
    is longer than ``limit`` bytes or is not UTF-8."""
    content = path.read_bytes()
    if limit is not None and len(content) > limit:
        raise error(f"{path}: must have at most {limit} bytes, got {len(content)} bytes")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except ValueError as fault:
        raise error(f"{path}: must be a UTF-8 text file: {fault}") from fault


def read_toml(path: Path | Traversable, error: type[ValueError]) -> dict[str, Any]:
    """Read a TOML file; raise ``error``, with the file's path, if the file cannot be parsed."""
    text = read_text(path, error)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as fault:
        raise error(f"{path}: {fault}") from fault


def read_json(path: AnyPath, what: str) -> dict[str, Any]:
    """Read a JSON file that holds an object. Raise a :class:`ValueError` whose message begins with ``what``, such
    as "root: the metadata", if the file is invalid."""
    try:
        return parse_json(expanded(path).read_bytes())
    except ValueError as error:
        raise ValueError(f"{what} {str(path)!r} cannot be read: {error}") from error


def parse_json(content: bytes) -> dict[str, Any]:
    """Parse JSON text that holds an object; raise a :class:`ValueError` for other values, NaN, infinity and repeated
    keys."""
    brackets = re.sub(rb'"(?:[^"\\]|\\.)*+"|[^][{}"]++', b"", content)
    steps = (1 if bracket in b"[{" else -1 for bracket in brackets)
    if max(accumulate(steps), default=0) > _DEEPEST:  # Python fails to write, copy or even parse deeper ones
        raise ValueError("the JSON is nested too deeply")
    value = json.loads(content.decode(), object_pairs_hook=_unique, parse_constant=_finite, parse_float=_finite)
    if not isinstance(value, dict):
        raise ValueError(f"the JSON must be an object, got {type(value).__name__}")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(entries := dict(pairs)) < len(pairs):
        name = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the JSON has the key {name[:100]!r} more than once")
    return entries


def _finite(text: str) -> float:
    if abs(number := float(text)) < float("inf"):  # also false for NaN
        return number
    raise ValueError(f"the JSON must contain only finite numbers, got {text[:40]}")


def check_damage(error: Exception) -> None:
    """Re-raise ``error`` if its cause is a system limit, such as too many open files, and not a damaged file."""
    expected = (None, errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.EINVAL)
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno not in expected):
        raise error


@contextmanager
def reading(path: AnyPath, what: str) -> Iterator[None]:
    """Add the folder's path and ``what``, a description of its expected content, to errors raised in the block."""
    try:
        yield
    except FileNotFoundError as error:
        missing = f"{error.filename} is missing; use dumps() to save the {what}"
        raise FileNotFoundError(f"path: {str(path)!r} holds no {what} ({missing})") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
        check_damage(error)
        raise ValueError(f"path: {str(path)!r} holds no {what} ({error})") from error


_MB = 10**6
# Each limit is a constant plus a multiple of the files' size. The multiple is large, because files may be compressed.
_SECONDS, _BYTES_PER_SECOND = 30, _MB
_PATIENCE = 4  # ratio of the wall-clock limit to the CPU-time limit, because the machine may be busy
_MEMORY, _MEMORY_PER_BYTE = 700 * _MB, 200


class LimitError(ValueError):
    """An error for files that a program could not read within its limits."""


def run_limited(command: Sequence[str | os.PathLike[str]], stored: int) -> subprocess.CompletedProcess[bytes]:
    """Run a command that reads ``stored`` bytes of files, with limits on time and memory that grow with ``stored``.
    Libraries that trust the sizes in a file may allocate gigabytes for a file of a few kilobytes, or never return.

    Raise a :class:`LimitError` if the command took too long or was killed, for example because it ran out of memory.
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
