"""Files that are replaced whole or not at all, and JSON that is read whole or refused."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import secrets
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NoReturn

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

JSON_LIMIT = 32 * 2**20
"""Bytes of a file of JSON or text; read, JSON takes some twenty times as much memory."""


@contextmanager
def replacing(path: str | os.PathLike[str], *, sync: bool = True) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to; it takes the name when the block ends without an error.

    Whenever the process is killed or the machine stops, ``path`` is the old file or the new one, whole; of several
    writers at once, the last one's. What a killed process left beside it goes at the next write, see :func:`sweep`.
    Waiting for the disk takes some 10 ms; without ``sync`` it is whole after a kill, but not if the machine stops.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    sweep(target)
    with _temporary(target) as temporary:
        try:
            yield temporary
            if sync:
                flush(temporary)
            os.replace(temporary, target)
            if sync:
                flush(target.parent)
        except OSError as error:
            if error.errno is not None and error.filename is None:
                error.filename = str(target)  # a full disk does not say which file it was
            raise


@contextmanager
def _temporary(target: Path) -> Iterator[Path]:
    """A file beside ``target`` that is the caller's alone, locked while the block lasts: by that a sweep spares it."""
    while True:
        # The suffix stays, since writers choose the format by it.
        path = target.with_name(f".{target.stem}.{secrets.token_hex(8)}.tmp{target.suffix}")
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if fcntl is not None:
            with suppress(OSError):  # a file system without locks, where no sweep gets one either
                fcntl.flock(handle, fcntl.LOCK_EX)
        if path.exists():
            break
        os.close(handle)  # it was swept before it was locked
    if fcntl is None:
        os.close(handle)  # an open file cannot be renamed there
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)
        if fcntl is not None:
            os.close(handle)


def flush(path: Path) -> None:
    """Return once a file's content, or a folder's list of names, is on the disk."""
    if os.name != "posix" and path.is_dir():
        return  # a folder cannot be opened there
    handle = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a file system that cannot
            raise
    finally:
        os.close(handle)


def sweep(target: str | os.PathLike[str]) -> list[Path]:
    """Remove the temporary files that killed writers of ``target`` left beside it; returns them.

    One that is still being written is locked, by whatever thread, process or machine, and stays.
    """
    path = Path(target)
    pattern = re.compile(re.escape(f".{path.stem}.") + r"[0-9a-f]{16}\.tmp" + re.escape(path.suffix))
    there = os.listdir(path.parent) if path.parent.is_dir() else ()
    return [left for left in map(path.with_name, filter(pattern.fullmatch, there)) if _remove_unlocked(left)]


def _remove_unlocked(path: Path) -> bool:
    if fcntl is None:
        return False
    try:
        handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
    except OSError:
        return False
    finally:
        os.close(handle)
    return True


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write a JSON file whole or not at all; NaN is refused, since it is no JSON."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_bytes(path: Path | Traversable, limit: int) -> bytes:
    """What a file holds, be it a file and of at most ``limit`` bytes: a pipe would wait, a device give for ever.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no file, or larger.
    """
    if isinstance(path, Path) and path.exists() and not path.is_file():
        raise ValueError("it is no file")
    with path.open("rb") as stream:
        if stream.seek(0, os.SEEK_END) > limit:
            raise ValueError(f"it is larger than {limit} bytes")
        stream.seek(0)
        return stream.read()


def read_text(path: Path | Traversable, error: type[ValueError]) -> str:
    """A text file in UTF-8, with or without a byte order mark; ``error`` names the file that is none."""
    try:
        return io.TextIOWrapper(io.BytesIO(read_bytes(path, JSON_LIMIT)), encoding="utf-8-sig").read()
    except ValueError as fault:
        raise error(f"{path}: must be a text file in UTF-8: {fault}") from fault


def read_toml(path: Path | Traversable, error: type[ValueError]) -> dict[str, Any]:
    """What a TOML file holds; ``error`` names the file that is none."""
    text = read_text(path, error)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as fault:  # too long a number is a ValueError, too deep a nesting the other
        raise error(f"{path}: {fault}") from fault


def read_json(path: str | os.PathLike[str], what: str, *, limit: int = JSON_LIMIT) -> dict[str, Any]:
    """The object in a JSON file.

    Args:
        path: the file.
        what: what it should be, for the error: "root: the metadata".
        limit: bytes that it may have.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is larger, no UTF-8, no JSON (NaN and Infinity are none), nested too deeply, names something
            twice, holds a number too long to read, or is no object.
    """
    file = Path(path)
    try:
        return parse_json(read_bytes(file, limit))
    except ValueError as error:
        raise ValueError(f"{what} {str(file)!r} cannot be read: {error}") from error


def parse_json(content: bytes) -> dict[str, Any]:
    """The object that JSON in UTF-8 says; :class:`ValueError` for anything else, as :func:`read_json` raises it."""
    try:
        found = json.loads(
            content.decode("utf-8"), object_pairs_hook=_object, parse_constant=_no_number, parse_float=_number
        )
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(found, dict):
        raise ValueError(f"it must be an object, got {type(found).__name__}")
    return found


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"it names {name[:100]!r} more than once")
        found[name] = value
    return found


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"it holds {text}, which is no JSON")


def _number(text: str) -> float:
    if abs(found := float(text)) == float("inf"):
        raise ValueError(f"it holds {text[:40]}, which is too large a number")
    return found
