"""Where the viewer's time cursor stands: set in a running viewer, or as what a page asks its viewer for."""

from __future__ import annotations

import subprocess
import threading
import time
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any

from lw_torchrl.record.rerun_binary import LOCAL
from lw_torchrl.record.timelines import EPISODE_TIMELINE

START_SECONDS = 60.0


def connect(process: subprocess.Popen[bytes], port: int) -> tuple[Any, Any]:
    """A client of the viewer and what it says of the recording, once it has loaded it.

    Raises:
        TimeoutError: the viewer ended, or did not answer in time.
    """
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
    timelines = {timeline.name: timeline for timeline in recording.timelines}
    timeline = timelines.get(recording.current_timeline)
    if timeline is None or timeline.end is None:
        return
    if step is None:  # an episode's success and reward stand one step after its last row
        step = max(timeline.end - 1 if timeline.name == EPISODE_TIMELINE else timeline.end, timeline.start)
    client.set_time(timeline.name, sequence=step, play_state="paused")


def request(step: int) -> bytes:
    """What asks a viewer in a page for ``step`` of the timeline in force, paused: a ``ViewerControlRequest``.

    Source: what :meth:`rerun.experimental.ViewerClient.set_time` of rerun 0.41 sends.
    """
    paused = b"\x28\x01"
    cursor = b"\x1a" + _sized(b"\x08" + _varint(step)) + paused
    return b"\x32" + _sized(cursor)


def sign(step: int) -> bytes:
    """What the state of a viewer in a page, a ``GetStateResponse``, holds when its cursor stands at ``step``."""
    timeline = b"\n" + _sized(EPISODE_TIMELINE.encode())
    time = b"\x08" + _varint(step) if step else b""
    return b"\n" + _sized(timeline) + b"\x10\x01\x1a" + _sized(time)


def _sized(message: bytes) -> bytes:
    return _varint(len(message)) + message


def _varint(number: int) -> bytes:
    high, low = divmod(number, 128)
    return bytes([low | 128]) + _varint(high) if high else bytes([low])
