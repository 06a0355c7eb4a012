"""A picture of a recording, taken by rerun's viewer without a screen once the data is there and drawn."""

from __future__ import annotations

import subprocess
import time
import warnings
from pathlib import Path
from typing import Any

from lw_torchrl._checks import check_int
from lw_torchrl.record.rerun_binary import LOCAL, failure, free_port, running
from lw_torchrl.record.timelines import EPISODE_TIMELINE

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
START_SECONDS, PAINT_SECONDS, SETTLE_SECONDS = 60.0, 0.7, 15.0


def take_picture(recording: Path, picture: Path, window_size: str, step: int | None) -> None:
    """Write a PNG of what the viewer shows of ``recording``, at ``step`` of the timeline that is in force.

    Raises:
        ValueError: there is no such step.
        RuntimeError: the viewer ended with an error, or drew nothing.
    """
    port = free_port()
    arguments = (recording, "--headless", "--port", str(port), "--window-size", window_size)
    with running(*arguments) as (process, output):
        try:
            client, state = _connect(process, f"rerun+http://{LOCAL}:{port}/proxy")
            _go_to(client, state.recordings[0], step)
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


def _go_to(client: Any, recording: Any, step: int | None) -> None:
    """Set the time cursor to ``step``, or to the last one, of the timeline that the layout chose."""
    timelines = {timeline.name: timeline for timeline in recording.timelines}
    timeline = timelines.get(recording.current_timeline)
    if timeline is None or timeline.end is None:
        if step is not None:
            raise ValueError(f"step {step} was given, but the recording holds no steps")
        return
    # An episode's success and reward stand one step after its last row.
    end = timeline.end - 1 if timeline.name == EPISODE_TIMELINE else timeline.end
    last = max(end, timeline.start) if step is None else check_int("step", step, minimum=0)
    if last > timeline.end:
        raise ValueError(f"step must be at most {timeline.end}, the recording's last, got {step}")
    client.set_time(timeline.name, sequence=last, play_state="paused")


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
