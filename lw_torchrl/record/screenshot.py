"""A picture of a recording, taken by rerun's viewer without a screen once the data is there and drawn."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

from lw_torchrl.record.cursor import connect, go_to
from lw_torchrl.record.rerun_binary import failure, free_port, running

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
PAINT_SECONDS, SETTLE_SECONDS = 0.7, 15.0


def take_picture(recording: Path, picture: Path, window_size: str, step: int | None) -> None:
    """Write a PNG of what the viewer shows of ``recording``, at ``step`` of the timeline that is in force.

    Raises:
        RuntimeError: the viewer ended with an error, or drew nothing.
    """
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
