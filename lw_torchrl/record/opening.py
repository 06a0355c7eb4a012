"""Which recording is meant, and what of it a viewer opens: a file that ends where it should, at the tab asked for."""

from __future__ import annotations

import os
import subprocess
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lw_torchrl.record.copying import copy_recording
from lw_torchrl.record.rerun_binary import binary, plain
from lw_torchrl.record.rrd_stream import MAGIC, is_whole, mend


def find_recording(path: str | os.PathLike[str]) -> Path:
    """The recording ``path``, or the only one in the folder ``path``, that begins as one; else an error."""
    recording = Path(path)
    if recording.is_dir():
        found = sorted(file for file in recording.glob("*.rrd") if not file.name.startswith("."))
        found = [file for file in found if ".previous" not in file.name] or found
        if len(found) != 1:
            names = ", ".join(file.name for file in found) or "none"
            raise FileNotFoundError(f"folder {str(recording)!r} must hold one recording (*.rrd), got {names}")
        recording = found[0]
    if not recording.is_file():
        raise FileNotFoundError(f"recording {str(recording)!r} does not exist; expected a file that RerunLogger wrote")
    with recording.open("rb") as file:
        head = file.read(4)
    if head[:3] != MAGIC:
        raise ValueError(f"{str(recording)!r} is no rerun recording: it begins with {head!r}")
    return recording


@contextmanager
def opened(recording: Path, tab: str | None = None) -> Iterator[Path]:
    """The recording as a viewer can open it: itself, or a copy that ends properly and opens at ``tab``.

    Rerun's viewer waits for the rest of a recording that was cut, by a kill or a full disk, or that still grows.

    Raises:
        ValueError: nothing in it can be read, or it has no such tab.
    """
    whole = is_whole(recording)
    if whole:
        _verify(recording)
        if tab is None:
            yield recording
            return
    else:
        warnings.warn(
            f"recording {str(recording)!r} was not closed: its writer still writes, or was stopped; "
            "what is in it so far is shown",
            stacklevel=4,
        )
    with tempfile.TemporaryDirectory() as folder:
        copy, source = Path(folder) / recording.name, recording
        if not whole:
            source = Path(folder) / "mended.rrd"
            mend(recording, source)
        try:
            copy_recording(source, copy, tab)
        except ValueError as error:
            if whole:
                raise
            raise _damaged(recording, error) from error
        yield copy


def _verify(recording: Path) -> None:
    done = subprocess.run([binary(), "rrd", "verify", str(recording)], capture_output=True, text=True, check=False)
    if done.returncode:
        said = [line for line in plain(done.stdout + done.stderr).splitlines() if str(recording) in line]
        raise _damaged(recording, said[0].rpartition(": ")[2] if said else "rerun cannot read it")


def _damaged(recording: Path, reason: object) -> ValueError:
    return ValueError(f"recording {str(recording)!r} is damaged: {reason}")
