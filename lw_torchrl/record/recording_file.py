"""The file of a recording: it grows hidden beside the path that it takes in the end."""

from __future__ import annotations

import os
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rerun import RecordingStream


def hidden_beside(path: Path) -> Path:
    """A name that no other recording has, in the folder of ``path``."""
    return path.with_name(f".{path.stem}.{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp.rrd")


def open_stream(path: Path, application_id: str, name: str) -> RecordingStream:
    """A stream of its own, called ``name``, into a file; missing folders are made."""
    import rerun as rr

    path.parent.mkdir(parents=True, exist_ok=True)
    stream = rr.RecordingStream(application_id)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.save(path)
    stream.send_recording_name(name)
    return stream


def check_path(path: str | os.PathLike[str]) -> Path:
    """Return the path that a recording is to have, else raise :class:`ValueError`."""
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path must be a path, got {path!r} ({type(path).__name__})")
    target = Path(path)
    if target.suffix != ".rrd" or not target.stem:
        raise ValueError(f"path must end in '.rrd', got {str(target)!r}")
    if target.is_dir():
        raise ValueError(f"path must be a file, got the folder {str(target)!r}")
    # The nearest parent that exists decides whether the missing ones can be made.
    nearest = next((parent for parent in target.absolute().parents if parent.exists()), None)
    if nearest is not None and not nearest.is_dir():
        raise ValueError(f"path {str(target)!r} must lie in a folder, but {str(nearest)!r} is a file")
    return target
