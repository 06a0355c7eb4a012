"""Read text, JSON and TOML; write whole files; lock a file or a folder for one writer."""

from __future__ import annotations

import errno
import glob
import json
import os
import secrets
import shutil
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

AnyPath = str | os.PathLike[str]
_ABANDONED = 3600.0  # seconds after which a temporary file is the leftover of a killed process
PATIENCE = 1.0  # seconds that `locked` waits for another writer, which may be about to finish

_SHIPPED = Path(__file__).parents[1] / "training" / "data"


def shipped_policy(name: AnyPath) -> Path | None:
    """Return the file of a shipped policy ("few-shot-mt50"); None if there is a file, or no policy, of that name."""
    path = _SHIPPED / f"{name}.safetensors"
    return path if Path(name).name == str(name) and not Path(name).exists() and path.is_file() else None


def absent_policy(path: AnyPath, writer: str = "train") -> str:
    """Return the error message for a policy file that does not exist."""
    near = [file.stem for file in _SHIPPED.glob("*.safetensors") if file.stem.startswith(Path(path).name[:8])]
    hint = f"; did you mean the shipped policy {near[0]!r}?" if near and Path(path).name == str(path) else ""
    return f"no file {str(path)!r}; `lw-torchrl {writer}` writes one{hint}"


@contextmanager
def replacing(path: AnyPath, *, sync: bool = True) -> Iterator[Path]:
    """Yield a temporary path to write to, which is renamed to ``path`` when the block ends without an error.

    If the process is killed, ``path`` is the whole old or the whole new file. If the machine stops, that holds only
    with ``sync``, which takes some 10 ms.
    """
    target = Path(os.path.realpath(path))  # keeps a link and replaces the file to which it points
    target.parent.mkdir(parents=True, exist_ok=True)
    if sync:  # else listing a folder with many small files would take long
        _remove_abandoned(target)
    # Writers choose the format by the suffix.
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(8)}.tmp{target.suffix}")
    try:
        yield temporary
        if sync:
            flush(temporary)
        os.replace(temporary, target)
        if sync:
            flush(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _remove_abandoned(target: Path) -> None:
    """Remove temporary files of killed processes."""
    for left in target.parent.glob(f".{glob.escape(target.stem)}.*.tmp{target.suffix}"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > _ABANDONED:
                left.unlink()


@contextmanager
def replacing_folder(path: AnyPath) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed to ``path``, new or empty, when the block ends."""
    target = Path(path).absolute()
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.tmp")
    temporary.mkdir(parents=True)
    try:
        yield temporary
        for written in [*temporary.rglob("*"), temporary]:
            flush(written)
        os.replace(temporary, target)
        flush(target.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def flush(path: Path) -> None:
    """Wait until the content of a file or folder is on the disk."""
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
    """Lock a file or a folder against other threads and processes while the block writes to it.

    A killed process releases its lock. Without ``wait``, raise ``error``, which names the ``argument``, if another
    ``who`` keeps the lock for more than a second.
    """
    from filelock import FileLock, Timeout

    place = Path(path)
    lock = FileLock(place / ".lock" if folder else place.with_name(f".{place.name}.lock"))
    Path(lock.lock_file).parent.mkdir(parents=True, exist_ok=True)
    try:
        lock.acquire(timeout=PATIENCE)
    except Timeout:
        if not wait:
            kind = "folder" if folder else "file"
            message = f"another {who} is writing to {str(place)!r}; let it finish, or choose another {kind}"
            raise error(f"{argument}: {message}") from None
        print(f"waiting for another {who}, which is writing to {str(place)!r}", file=sys.stderr, flush=True)
        lock.acquire()
    try:
        yield
    finally:
        Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()


def write_text(path: AnyPath, text: str) -> None:
    """Write a text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: AnyPath, value: Any) -> None:
    """Write a JSON file whole or not at all; raise :class:`ValueError` for NaN, which JSON does not have."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_text(path: Path | Traversable, error: type[ValueError], *, limit: int | None = None) -> str:
    """Return a UTF-8 file's text, without a byte order mark and with ``\\n`` as line ends; else raise ``error``."""
    content = path.read_bytes()
    if limit is not None and len(content) > limit:
        raise error(f"{path}: must have at most {limit} bytes, got {len(content)}")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except ValueError as fault:
        raise error(f"{path}: must be a text file in UTF-8: {fault}") from fault


def read_toml(path: Path | Traversable, error: type[ValueError]) -> dict[str, Any]:
    """Return the content of a TOML file; raise ``error`` with its name if it cannot be parsed."""
    text = read_text(path, error)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as fault:
        raise error(f"{path}: {fault}") from fault


def read_json(path: AnyPath, what: str) -> dict[str, Any]:
    """Return the object in a JSON file; a :class:`ValueError` begins with ``what``, such as "root: the metadata"."""
    try:
        return parse_json(Path(path).read_bytes())
    except ValueError as error:
        raise ValueError(f"{what} {str(path)!r} cannot be read: {error}") from error


def parse_json(content: bytes) -> dict[str, Any]:
    """Return the object in JSON; raise :class:`ValueError` for other values, NaN, infinity and repeated names."""
    try:
        value = json.loads(content.decode(), object_pairs_hook=_unique, parse_constant=_finite, parse_float=_finite)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(value, dict):
        raise ValueError(f"it must be an object, got {type(value).__name__}")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    if repeated := [name for name in names if names.count(name) > 1] if len({*names}) < len(names) else []:
        raise ValueError(f"it names {repeated[0][:100]!r} more than once")
    return dict(pairs)


def _finite(text: str) -> float:
    if abs(number := float(text)) < float("inf"):  # false for NaN too
        return number
    raise ValueError(f"it holds {text[:40]}, which is not a finite number")


@contextmanager
def reading(path: AnyPath, what: str) -> Iterator[None]:
    """Add the ``path`` of a folder, and ``what`` it should hold, to errors raised in the block."""
    try:
        yield
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"path: {str(path)!r} holds no {what} ({error.filename} is missing); dumps writes one"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
        raise ValueError(f"path: {str(path)!r} holds no {what} ({error})") from error
