"""The program ``rerun``, which recording is meant, and what of it a viewer opens: a whole file, at a tab and a step."""

import os
import re
import socket
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

from lw_torchrl._checks import check_int
from lw_torchrl._files import AnyPath
from lw_torchrl.record.conventions import EPISODE_TIMELINE, METRIC_TIMELINE, rr
from lw_torchrl.record.overview import OVERVIEW
from lw_torchrl.record.tabs import Layout

LOCAL = "127.0.0.1"

# What the viewer prints when it dies, and what to do about it.
REASONS = {
    r"render context|[Nn]o (graphics|wgpu) adapter|libvulkan": "no graphics driver was found. Without a GPU, install "
    "Vulkan's loader and Mesa's software driver (Debian: apt-get install libvulkan1 mesa-vulkan-drivers)",
    r"DISPLAY is set|EventLoopError|failed to open display": "there is no screen here. Take a picture, --screenshot; "
    "or look at it from another machine: --web serves a page, --html writes one",
    "No glyph for": "a text in the recording has a character outside the one font that pictures are drawn with. "
    "Without --screenshot the viewer uses the system's fonts too",
}


def binary() -> str:
    """The path of the program."""
    if override := os.environ.get("RERUN_CLI_PATH"):
        return override
    # The package needs no import: it is a folder with the viewer in it.
    package = find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise FileNotFoundError("rerun's viewer is not installed; pip install 'rerun-sdk>=0.41,<0.42'")
    folder = Path(package.origin).parent
    names = ("rerun.exe",) if sys.platform == "win32" else ("Rerun.app/Contents/MacOS/Rerun", "rerun")
    found = next((folder / name for name in names if (folder / name).is_file()), None)
    if found is None:
        raise FileNotFoundError(f"rerun's viewer is missing in {str(folder)!r}; reinstall rerun-sdk")
    return str(found)


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as free:
        free.bind((LOCAL, 0))
        return int(free.getsockname()[1])


@contextmanager
def running(*arguments: str | Path) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """The program, running, and the file that holds what it prints; it ends with the block."""
    with tempfile.TemporaryFile() as output:
        command = [binary(), *map(str, arguments), "--bind", LOCAL]
        # Its notes about software drawing would cover the picture.
        quiet = {"RUST_LOG": "error"} if "--headless" in command else {}
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=quiet | dict(os.environ))
        try:
            yield process, output
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def failure(output: IO[bytes]) -> RuntimeError:
    """The error that says why the program ended, by what it printed."""
    output.seek(0)
    text = plain(output.read().decode("utf-8", "replace"))
    for pattern, reason in REASONS.items():
        if re.search(pattern, text):
            return RuntimeError(f"rerun's viewer stopped: {reason}.")
    # Neither the stack nor the lines of routine.
    telling = [line for line in text.splitlines() if line.strip() and not re.match(r"\s+(\d+:|at )|.* INFO ", line)]
    return RuntimeError("rerun's viewer ended with an error:\n" + "\n".join(telling[-12:]))


def plain(text: str) -> str:
    """Without the colours of a terminal."""
    return re.sub(r"\x1b\[[0-9;]*m", "", text)


FLUSH_SECONDS = 60.0


def find_recording(path: AnyPath) -> Path:
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
    if head[:3] != b"RRF":
        raise ValueError(f"{str(recording)!r} is no rerun recording: it begins with {head!r}")
    return recording


@contextmanager
def opened(recording: Path, tab: str | None = None, *, alone: bool = False) -> Iterator[Path]:
    """The recording as a viewer can open it: itself, or a copy that ends properly, with ``tab`` in front or ``alone``.

    Rerun's viewer waits for the rest of one that was cut or still grows. One that cannot be read is a ValueError.
    """
    from rerun.chunk import RrdReader

    whole, source = is_whole(recording), recording
    if whole:
        _run_rerun(recording, "verify", recording)
        if tab is None and not alone:
            yield recording
            return
    else:
        why = "its writer still writes, or was stopped; what is in it so far is shown"
        warnings.warn(f"recording {str(recording)!r} was not closed: {why}", stacklevel=4)
    with tempfile.TemporaryDirectory() as folder:
        if not whole:
            source = Path(folder) / "mended.rrd"
            _run_rerun(recording, "merge", recording, "-o", source)
            reader = RrdReader(source)
            if not reader.recordings():
                raise _damaged(recording, "it holds nothing yet")
            if Layout.read(reader) is None and tab is None and not alone:  # it has a layout of another's
                yield source
                return
        copy = Path(folder) / recording.name
        copy_recording(source, copy, tab, alone=alone)
        yield copy


def is_whole(path: Path) -> bool:
    """Whether the recording was closed by its writer, and so ends with an index."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 32))
        return b"RRF2FOOT" in file.read()


def copy_recording(source: Path, target: Path, tab: str | None = None, *, alone: bool = False) -> None:
    """Write a recording again: compact, with an index, and with ``tab`` in front. ValueError: it cannot be read."""
    from rerun.chunk import OptimizationProfile, RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there is no index, which is why it is copied
            reader = RrdReader(source)
        known, layout = reader.recordings()[0], Layout.read(reader)
        # What came in many small pieces becomes a few: a training's curves take a twentieth.
        data = reader.stream(store=known).collect(optimize=OptimizationProfile.LIVE)
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    if layout is None and tab is not None:
        raise ValueError(f"episode {tab!r} was given, but the recording, of an earlier version, does not say its tabs")
    stream = rr.RecordingStream(known.application_id, recording_id=known.recording_id, send_properties=False)
    try:
        stream.save(target)
        # The layout comes first, else a slow browser shows views of its own choice meanwhile.
        if layout is not None or not alone:
            (layout or Layout()).send(stream, tab, alone=alone)
        stream.send_chunks(data)
        stream.flush(timeout_sec=FLUSH_SECONDS)
    except RuntimeError as error:
        raise OSError(f"{str(target)!r} could not be written: {error}") from error
    finally:
        stream.disconnect()
    if not is_whole(target):  # rerun does not say so
        raise OSError(f"{str(target)!r} could not be written to its end")


def layouts(path: AnyPath) -> tuple[list[dict[str, Any]], str | None, bytes]:
    """A recording's tabs, the first one's name, and layouts of each alone, pieces of a rerun stream in a row.

    A tab has its name, title, the step to open it at, its ``row`` of the overview, and where its layout is.
    """
    from rerun.chunk import RrdReader

    reader = RrdReader(os.fspath(path))
    layout, known, pieces = Layout.read(reader), reader.recordings()[0], b""
    found: list[dict[str, Any]] = []
    if layout is None:
        return [], None, b""
    for tab in layout.tabs():
        if tab.name == OVERVIEW:
            continue
        stream = rr.RecordingStream(known.application_id, recording_id=known.recording_id, send_properties=False)
        memory = rr.binary_stream(stream)
        layout.send(stream, tab.name, alone=True)
        piece = memory.read() or b""
        stream.disconnect()
        page = layout.pages.get(tab.name)
        place = [len(pieces), len(pieces) + len(piece)]
        row = page.row if page is not None and page.row else None
        step = layout.opening_step(tab.name)
        found.append({"name": tab.name, "title": tab.title, "step": step, "row": row, "layout": place})
        pieces += piece
    by_failure = sorted(found, key=lambda one: (one["row"] or {}).get("ended") != "failed")
    return by_failure, layout.front(), pieces


def opening_step(path: AnyPath, tab: str | None = None, step: int | None = None) -> int | None:
    """The step for a viewer's cursor in a tab (None: the first); None for a tab of no episode.

    It is ``step``, or a ValueError if the recording does not go so far; without one :meth:`Layout.opening_step`.
    """
    from rerun.chunk import RrdReader

    reader = RrdReader(os.fspath(path))
    layout = Layout.read(reader)
    if step is None:
        return (layout or Layout()).opening_step(tab)
    end = -1
    # A recording of an earlier version does not say its tabs; if it has episodes, it opens at one.
    for timeline in [layout.tab(tab).timeline] if layout else [EPISODE_TIMELINE, METRIC_TIMELINE]:
        for chunk in reader.stream().filter(has_timeline=timeline):
            times = chunk.to_record_batch().column(timeline)
            end = max(end, times[-1].cast("int64").as_py()) if len(times) else end
        if end >= 0:
            break
    if end < 0:
        raise ValueError(f"step {step} was given, but the recording holds no steps")
    if check_int("step", step, minimum=0) > end:
        raise ValueError(f"step must be at most {end}, the recording's last, got {step}")
    return step


def _run_rerun(recording: Path, *arguments: str | Path) -> None:
    done = subprocess.run([binary(), "rrd", *map(str, arguments)], capture_output=True, text=True, check=False)
    if done.returncode:
        said = [line for line in plain(done.stdout + done.stderr).splitlines() if str(recording) in line]
        raise _damaged(recording, said[0].rpartition(": ")[2] if said else "rerun cannot read it")


def _damaged(recording: Path, reason: object) -> ValueError:
    return ValueError(f"recording {str(recording)!r} is damaged: {reason}")
