"""Files that are replaced whole or not at all, and JSON that is read whole or refused."""

import errno
import fcntl
import io
import json
import os
import re
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
PATIENCE = 1.0  # seconds to wait for others that are at work in a place: they may be about to end
JSON_LIMIT = 32 * 2**20  # bytes of a file of JSON or text; read, JSON takes some twenty times as much memory
TOML_LIMIT = 2**18  # bytes of a TOML file, which takes a second to read; the largest of ours has 22 kB
MOST_KEYS = 16  # names joined by dots in a TOML key: Python's reader takes their square in time

_KEY = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DOTTED = re.compile(rf"{_KEY}(?:[ \t]*+\.[ \t]*+{_KEY})*+")


_SHIPPED = Path(__file__).with_name("training") / "data"


def absent_policy(path: AnyPath, writer: str = "train") -> str:
    """What to say of a policy's file that is not there."""
    close = [file.stem for file in _SHIPPED.glob("*.zip") if file.stem.startswith(Path(path).name[:8])]
    hint = f"; did you mean {close[0]!r}, which is shipped?" if close and Path(path).name == str(path) else ""
    return f"no file {str(path)!r}; `lw-torchrl {writer}` writes one{hint}"


def shipped_policy(name: AnyPath) -> Path | None:
    """The file of a policy that is shipped under a name, "few-shot-mt50", unless there is a file of that name."""
    found = _SHIPPED / f"{name}.zip"
    return found if Path(name).name == str(name) and not Path(name).exists() and found.is_file() else None


@contextmanager
def replacing(path: AnyPath, *, sync: bool = True) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to; it takes the name when the block ends without an error.

    Whenever the process is killed or the machine stops, ``path`` is the old file or the new one, whole. The next write
    removes what a killed process left, see :func:`sweep`. Waiting for the disk takes some 10 ms; without ``sync`` the
    file is whole after a kill, but not if the machine stops.
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
    """A new file beside ``target``, locked while the block lasts, so that no sweep removes it."""
    while True:
        # The suffix stays, since writers choose the format by it.
        path = target.with_name(f".{target.stem}.{secrets.token_hex(8)}.tmp{target.suffix}")
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        with suppress(OSError):  # a file system without locks, where no sweep gets one either
            fcntl.flock(handle, fcntl.LOCK_EX)
        if path.exists():
            break
        os.close(handle)  # it was swept before it was locked
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)


@contextmanager
def replacing_folder(path: AnyPath) -> Iterator[Path]:
    """A temporary folder beside ``path``, which is new or empty, whose name it takes when the block ends without error.

    As with :func:`replacing`, a killed process leaves nothing under the name, and the next write removes the rest.
    """
    target = Path(path).absolute()
    target.parent.mkdir(parents=True, exist_ok=True)
    pattern = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{16}}\.tmp")
    for left in filter(Path.is_dir, map(target.with_name, filter(pattern.fullmatch, os.listdir(target.parent)))):
        with suppress(BlockingIOError), _held_folder(left):
            shutil.rmtree(left)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.tmp")
    temporary.mkdir()
    try:
        with _held_folder(temporary):
            yield temporary
            for one in [*sorted(temporary.rglob("*"), reverse=True), temporary]:
                flush(one)
            os.replace(temporary, target)
            flush(target.parent)
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(target)
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _held_folder(path: Path) -> Iterator[None]:
    """Lock a folder while the block lasts; :class:`BlockingIOError` where another process holds it."""
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


def flush(path: Path) -> None:
    """Return once a file's content, or a folder's list of names, is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a file system that cannot
            raise
    finally:
        os.close(handle)


def sweep(target: AnyPath) -> list[Path]:
    """Remove the temporary files that killed writers of ``target`` left, and return them; locked ones stay."""
    path = Path(target)
    pattern = re.compile(rf"\.+{re.escape(path.stem)}(\.[0-9a-f]{{16}}\.tmp)+{re.escape(path.suffix)}")
    there = os.listdir(path.parent) if path.parent.is_dir() else ()
    return [left for left in map(path.with_name, filter(pattern.fullmatch, there)) if _remove_unlocked(left)]


def _remove_unlocked(path: Path) -> bool:
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


@contextmanager
def held(
    place: AnyPath,
    argument: str,
    who: str = "process",
    *,
    folder: bool = False,
    wait: bool = False,
    error: type[ValueError] = ValueError,
) -> Iterator[None]:
    """Keep other threads and processes out of a place while the block writes to it, by a lock beside the file, or in
    the ``folder``, which is made where there is none. The lock of a killed process is free. Without ``wait``, an
    ``error`` that names the ``argument`` and ``who`` may be at work there is raised after a second."""
    path = Path(place)
    lock = path / ".lock" if folder else path.with_name(f".{path.name}.lock")
    lock.parent.mkdir(parents=True, exist_ok=True)
    handle = _locked(lock, PATIENCE)
    if handle is None:
        if not wait:
            kind = "folder" if folder else "file"
            raise error(
                f"{argument}: another {who} is at work in {str(path)!r}; let it finish, or choose another {kind}"
            )
        print(f"waiting for another {who} that is at work in {str(path)!r}", file=sys.stderr, flush=True)
        handle = _locked(lock, float("inf"))
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        if handle is not None:
            os.close(handle)


def _locked(lock: Path, patience: float) -> int | None:
    """The handle of a lock, None where others hold it for so many seconds."""
    until = time.monotonic() + patience
    while True:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(handle).st_nlink:
                return handle
        except BlockingIOError:
            if time.monotonic() > until:
                os.close(handle)
                return None
            time.sleep(0.05)
        except OSError:
            return handle  # a file system without locks
        os.close(handle)  # it is held, or was removed before it was locked


def write_text(path: AnyPath, text: str) -> None:
    """Write a text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: AnyPath, value: Any) -> None:
    """Write a JSON file whole or not at all; NaN is refused, since it is no JSON."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_bytes(path: Path | Traversable, limit: int) -> bytes:
    """The content of a file; :class:`ValueError` if it is larger than ``limit`` bytes, or a pipe or a device."""
    if isinstance(path, Path) and path.exists() and not path.is_file():
        raise ValueError("it is no file")
    with path.open("rb") as stream:
        if stream.seek(0, os.SEEK_END) > limit:
            raise ValueError(f"it is larger than {limit} bytes")
        stream.seek(0)
        return stream.read()


def read_text(path: Path | Traversable, error: type[ValueError], *, limit: int = JSON_LIMIT) -> str:
    """A text file in UTF-8, with or without a byte order mark; ``error`` names a file that is not, or is larger."""
    try:
        return io.TextIOWrapper(io.BytesIO(read_bytes(path, limit)), encoding="utf-8-sig").read()
    except ValueError as fault:
        raise error(f"{path}: must be a text file in UTF-8: {fault}") from fault


def read_toml(path: Path | Traversable, error: type[ValueError]) -> dict[str, Any]:
    """The content of a TOML file; ``error`` names a file that is none, is too large or nested too deeply."""
    text = read_text(path, error, limit=TOML_LIMIT)
    for found in _DOTTED.finditer(text):
        if found[0].count(".") >= MOST_KEYS and (names := len(re.findall(_KEY, found[0]))) > MOST_KEYS:
            line = text.count("\n", 0, found.start()) + 1
            raise error(f"{path}: a key of line {line} has {names} nested keys, at most {MOST_KEYS} are read")
    try:
        return tomllib.loads(text)
    except RecursionError as fault:
        raise error(f"{path}: it is nested too deeply") from fault
    except ValueError as fault:  # also too long a number
        raise error(f"{path}: {fault}") from fault


def read_json(path: AnyPath, what: str, *, limit: int = JSON_LIMIT) -> dict[str, Any]:
    """The object in a JSON file of at most ``limit`` bytes, see :func:`parse_json`; a :class:`ValueError` begins with
    ``what``, "root: the metadata". A file that is not there is a :class:`FileNotFoundError`."""
    file = Path(path)
    try:
        return parse_json(read_bytes(file, limit))
    except ValueError as error:
        raise ValueError(f"{what} {str(file)!r} cannot be read: {error}") from error


@contextmanager
def reading(path: AnyPath, what: str) -> Iterator[None]:
    """Let an error in the block name the argument ``path``, a folder that was to hold ``what``."""
    try:
        yield
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"path: {str(path)!r} holds no {what} ({error.filename} is missing); dumps writes one"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
        raise ValueError(f"path: {str(path)!r} holds no {what} ({error})") from error


def parse_json(content: bytes) -> dict[str, Any]:
    """The object in JSON in UTF-8; :class:`ValueError` for anything else, NaN and Infinity, what is nested too deeply,
    a name that comes twice, and a number too long to read."""
    try:
        found = json.loads(content.decode(), object_pairs_hook=_object, parse_constant=_number, parse_float=_number)
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


def _number(text: str) -> float:
    if abs(found := float(text)) < float("inf"):
        return found
    raise ValueError(f"it holds {text[:40]}, which is {'too large a number' if text[-1].isdigit() else 'no JSON'}")
