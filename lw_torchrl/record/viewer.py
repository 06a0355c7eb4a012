"""Opens a recording in rerun's viewer, or takes a picture of it without a screen."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

from lw_torchrl._checks import check_int
from lw_torchrl._files import replacing
from lw_torchrl.record.timelines import EPISODE_TIMELINE

RRD_MAGIC, PNG_MAGIC = b"RRF", b"\x89PNG\r\n\x1a\n"
START_SECONDS, PAINT_SECONDS = 60.0, 1.5
LOCAL = "127.0.0.1"

# What the viewer prints when it dies, and what to do about it.
REASONS = (
    (
        r"render context|[Nn]o (graphics|wgpu) adapter|libvulkan",
        "no graphics driver was found. Without a GPU, install Vulkan's loader and Mesa's software driver "
        "(Debian: apt-get install libvulkan1 mesa-vulkan-drivers)",
    ),
    (
        r"DISPLAY is set|EventLoopError|failed to open display",
        "there is no screen here. Copy the file to a machine with one, or take a picture: --screenshot",
    ),
    (
        r"No glyph for",
        "a text in the recording has a character outside the one font that pictures are drawn with. "
        "Without --screenshot the viewer uses the system's fonts too",
    ),
)


def open_viewer(
    path: str | os.PathLike[str],
    screenshot: str | os.PathLike[str] | None = None,
    window_size: str = "1400x900",
    *,
    step: int | None = None,
) -> None:
    """Open a recording in rerun's viewer and wait until it is closed; or save a picture of it.

    Args:
        path: the .rrd file.
        screenshot: a PNG file to write instead of opening a window; it is replaced whole or not at all.
        window_size: of the picture or the window, "1400x900" points.
        step: for a picture, the step of the episode that the time cursor stands at; None takes the last.

    Raises:
        FileNotFoundError: there is no such file, or rerun's viewer is not installed.
        ValueError: the file is no recording, or a cut one; the picture's name does not end in ".png", the size is no
            "WxH", or the recording has no such step.
        RuntimeError: the viewer ended with an error; the message says what to do about it.

    Example:
        >>> open_viewer("runs/demo/rollout.rrd", screenshot="rollout.png", step=75)  # doctest: +SKIP
    """
    recording = check_recording(path)
    if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", window_size):
        raise ValueError(f"window_size must be like '1400x900', got {window_size!r}")
    if step is not None:
        check_int("step", step, minimum=0)
        if screenshot is None:
            raise ValueError("step is the moment of a picture; give screenshot as well")
    if screenshot is not None and Path(screenshot).suffix != ".png":
        raise ValueError(f"screenshot must end in '.png', got {str(screenshot)!r}")
    _verify(recording)
    if screenshot is None:
        with _viewer(recording, "--window-size", window_size) as (process, output):
            if process.wait():
                raise _failure(output)
        return
    with replacing(screenshot) as picture:
        _take_picture(recording, picture.absolute(), window_size, step)
        if not picture.is_file() or picture.read_bytes()[: len(PNG_MAGIC)] != PNG_MAGIC:
            raise RuntimeError(f"rerun's viewer wrote no picture of {str(recording)!r}")


def check_recording(path: str | os.PathLike[str]) -> Path:
    """``path`` as a Path, if its first bytes are those of a rerun recording; else an error."""
    recording = Path(path)
    if not recording.is_file():
        what = "is a folder" if recording.is_dir() else "does not exist"
        raise FileNotFoundError(f"recording {str(recording)!r} {what}; expected a file that RerunLogger wrote")
    with recording.open("rb") as file:
        head = file.read(4)
    if head[:3] != RRD_MAGIC:
        raise ValueError(f"{str(recording)!r} is no rerun recording: it begins with {head!r}")
    return recording


def _verify(recording: Path) -> None:
    """Raise :class:`ValueError` for a recording that is cut or damaged: the viewer would wait for the rest of it."""
    done = subprocess.run([_binary(), "rrd", "verify", str(recording)], capture_output=True, text=True, check=False)
    if done.returncode:
        said = [line for line in _plain(done.stdout + done.stderr).splitlines() if str(recording) in line]
        reason = said[0].rpartition(": ")[2] if said else "rerun cannot read it"
        raise ValueError(f"recording {str(recording)!r} is cut or damaged: {reason}")


def _plain(text: str) -> str:
    return re.sub(r"\x1b\[[0-9;]*m", "", text)


def _binary() -> str:
    """The viewer that the installed rerun-sdk carries."""
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


@contextmanager
def _viewer(*arguments: str | Path) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """A running viewer and the file that holds what it prints; it ends with the block."""
    with tempfile.TemporaryFile() as output:
        command = [_binary(), *map(str, arguments), "--bind", LOCAL]
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


def _failure(output: IO[bytes]) -> RuntimeError:
    output.seek(0)
    text = _plain(output.read().decode("utf-8", "replace"))
    for pattern, reason in REASONS:
        if re.search(pattern, text):
            return RuntimeError(f"rerun's viewer stopped: {reason}.")
    # Neither the stack nor the lines of routine.
    telling = [line for line in text.splitlines() if line.strip() and not re.match(r"\s+(\d+:|at )|.* INFO ", line)]
    return RuntimeError("rerun's viewer ended with an error:\n" + "\n".join(telling[-12:]))


def _take_picture(recording: Path, picture: Path, window_size: str, step: int | None) -> None:
    with socket.socket() as free:
        free.bind((LOCAL, 0))
        port = free.getsockname()[1]
    arguments = (recording, "--headless", "--port", str(port), "--window-size", window_size)
    with _viewer(*arguments) as (process, output):
        try:
            client, state = _connect(process, f"rerun+http://{LOCAL}:{port}/proxy")
            timelines = {timeline.name: timeline for timeline in state.recordings[0].timelines}
            episode = timelines.get(EPISODE_TIMELINE)
            if episode is not None:
                last = max(episode.end - 1, 0) if step is None else step
                if last > episode.end:
                    raise ValueError(f"step must be at most {episode.end}, the recording's last, got {step}")
                client.set_time(EPISODE_TIMELINE, sequence=last, play_state="paused")
            elif step is not None:
                raise ValueError(f"step {step} was given, but the recording holds no episode")
            # Its messages lie over the views.
            client.run_command("ui.toggle_top_panel")
            time.sleep(PAINT_SECONDS)
            client.save_screenshot(str(picture))
            for view in client.get_state().views:
                for report in view.reports:
                    warnings.warn(f"view {view.name!r} reports: {report.summary}", stacklevel=4)
        except (ConnectionError, TimeoutError) as error:
            # The viewer takes a moment to print why it dies.
            time.sleep(0.5)
            if process.poll() is None:
                raise RuntimeError(f"rerun's viewer did not answer: {error}") from error
            raise _failure(output) from error


def _connect(process: subprocess.Popen[bytes], url: str) -> tuple[Any, Any]:
    """A client of the viewer and its state, once it has loaded the recording."""
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + START_SECONDS
    client: Any = None
    while time.monotonic() < deadline and process.poll() is None:
        try:
            client = client or ViewerClient.connect(url)
            state = client.get_state()
            if state.recordings and state.active_recording and not state.loading:
                return client, state
        except ConnectionError:
            client = None
        time.sleep(0.1)
    raise TimeoutError(f"no answer within {START_SECONDS:.0f} seconds")
