"""Opens a recording in rerun's viewer, or takes a picture of it without a screen."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

from lw_torchrl._checks import checked
from lw_torchrl._files import replacing
from lw_torchrl.record.cursor import connect, go_to
from lw_torchrl.record.opening import find_recording, opened
from lw_torchrl.record.opening_step import opening_step
from lw_torchrl.record.rerun_binary import failure, free_port, running
from lw_torchrl.record.screenshot import take_picture


@checked
def open_viewer(
    path: str | os.PathLike[str],
    screenshot: str | os.PathLike[str] | None = None,
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
        step: of the episode, or of the training, that the time cursor stands at; None takes the one that tells most of
            an episode, its first success, say, and of a training the last.
        episode: the tab to open at, by its title ("Metrics") or its episode's name; None takes the layout's.

    Raises:
        FileNotFoundError: there is no such file, or rerun's viewer is not installed.
        ValueError: the file is no recording, or a damaged one; the picture's name does not end in ".png", the size is
            no "WxH", or the recording has no such step or tab.
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
                take_picture(file, picture.absolute(), window_size, at)
            return
        port = free_port()
        with running(file, "--port", str(port), "--window-size", window_size) as (process, output):
            with suppress(ConnectionError, TimeoutError):  # it may have been closed at once
                go_to(*connect(process, port), at)
            if process.wait():
                raise failure(output)
