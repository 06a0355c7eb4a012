"""Opens a recording in rerun's viewer, or takes a picture of it without a screen."""

from __future__ import annotations

import re
import subprocess
import threading
import time
import warnings
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath, replacing
from lw_torchrl.record.conventions import EPISODE_TIMELINE
from lw_torchrl.record.recording_file import LOCAL, failure, find_recording, free_port, opened, opening_step, running

START_SECONDS = 60.0
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
PAINT_SECONDS, SETTLE_SECONDS = 0.7, 15.0


@checked
def open_viewer(
    path: AnyPath,
    screenshot: AnyPath | None = None,
    window_size: str = "1400x900",
    *,
    step: int | None = None,
    episode: str | None = None,
) -> None:
    """Open a recording in rerun's viewer and wait until it is closed; or save a picture of it.

    A recording whose writer was killed, or still writes, is shown as far as it goes, with a warning.

    Args:
        path: the .rrd file, or a folder that holds one.
        screenshot: a PNG file to write instead of opening a window; it is replaced whole or not at all.
        window_size: of the picture or the window, "1400x900" points.
        step: where the time cursor stands; None for an episode's first success or failure, and a training's last step.
        episode: the tab to open at, by its title ("Metrics") or its episode's name; None takes the layout's.

    Raises:
        FileNotFoundError: there is no such file, or rerun's viewer is not installed.
        ValueError: the file is no recording, or a damaged one, or it has no such step or tab.
        RuntimeError: the viewer ended with an error; the message says what to do about it.

    Example:
        >>> open_viewer("runs/demo", screenshot="rollout.png", episode="drawer-open", step=75)  # doctest: +SKIP
    """
    recording = find_recording(path)
    if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", window_size):
        raise ValueError(f"window_size must be like '1400x900', got {window_size!r}")
    if screenshot is not None and Path(screenshot).suffix != ".png":
        raise ValueError(f"screenshot must end in '.png', got {str(screenshot)!r}")
    with opened(recording, episode) as file:
        at = opening_step(file, episode, step)
        if screenshot is not None:
            with replacing(screenshot) as picture:
                _take_picture(file, picture.absolute(), window_size, at)
            return
        port = free_port()
        with running(file, "--port", str(port), "--window-size", window_size) as (process, output):
            with suppress(ConnectionError, TimeoutError):  # it may have been closed at once
                go_to(*connect(process, port), at)
            if process.wait():
                raise failure(output)


def _take_picture(recording: Path, picture: Path, window_size: str, step: int | None) -> None:
    port = free_port()
    arguments = (recording, "--headless", "--port", str(port), "--window-size", window_size)
    with running(*arguments) as (process, output):
        try:
            client, shown = connect(process, port)
            go_to(client, shown, step)
            # Its messages lie over the views.
            client.run_command("ui.toggle_top_panel")
            _settle(client, picture)
            for view in client.get_state().views:
                for report in view.reports:
                    warnings.warn(f"view {view.name!r} reports: {report.summary}", stacklevel=4)
        except (ConnectionError, TimeoutError) as error:
            # The viewer takes a moment to print why it dies.
            time.sleep(0.5)
            if process.poll() is None:
                raise RuntimeError(f"rerun's viewer did not answer: {error}") from error
            raise failure(output) from error


def _settle(client: Any, picture: Path) -> None:
    """Take pictures until two in a row are the same: then nothing is loading or moving any more."""
    before, deadline = b"", time.monotonic() + SETTLE_SECONDS
    while True:
        time.sleep(PAINT_SECONDS)
        client.save_screenshot(str(picture))
        now = picture.read_bytes() if picture.is_file() else b""
        if (now == before and now) or time.monotonic() > deadline:
            break
        before = now
    if now[: len(PNG_MAGIC)] != PNG_MAGIC:
        raise RuntimeError("rerun's viewer wrote no picture")


def connect(process: subprocess.Popen[bytes], port: int) -> tuple[Any, Any]:
    """A client of the viewer and what it says of the recording, once it has loaded it; else a TimeoutError."""
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + START_SECONDS
    found: SimpleQueue[tuple[Any, Any] | Exception | None] = SimpleQueue()

    def ask() -> None:
        client: Any = None
        while time.monotonic() < deadline and process.poll() is None:
            try:
                client = client or ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy")
                state = client.get_state()
                if state.recordings and state.active_recording and not state.loading:
                    return found.put((client, state.recordings[0]))
            except ConnectionError:
                client = None
            except Exception as error:
                return found.put(error)
            time.sleep(0.1)
        found.put(None)

    # A call waits for ever where something listens and says nothing.
    threading.Thread(target=ask, name="a viewer that starts", daemon=True).start()
    with suppress(Empty):
        came = found.get(timeout=START_SECONDS)
        if isinstance(came, Exception):
            raise came
        if came is not None:
            return came
    raise TimeoutError(f"no answer within {START_SECONDS:g} seconds")


def go_to(client: Any, recording: Any, step: int | None) -> None:
    """Set the time cursor to ``step``, or to the last one, of the timeline that the layout chose."""
    timeline = next((one for one in recording.timelines if one.name == recording.current_timeline), None)
    if timeline is None or timeline.end is None:
        return
    if step is None:  # an episode's success and reward stand one step after its last row
        step = max(timeline.end - 1 if timeline.name == EPISODE_TIMELINE else timeline.end, timeline.start)
    client.set_time(timeline.name, sequence=step, play_state="paused")
