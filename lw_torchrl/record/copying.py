"""A recording written again, through rerun's own reader and writer: whole, compact, with an index, at another tab."""

from __future__ import annotations

import warnings
from pathlib import Path

from lw_torchrl._checks import unknown_name
from lw_torchrl.record.rrd_stream import is_whole
from lw_torchrl.record.tabs import Tabs

FLUSH_SECONDS = 60.0


def copy_recording(source: Path, target: Path, tab: str | None = None) -> None:
    """Write what can be read of a recording, and its layout, with ``tab`` in front.

    Raises:
        ValueError: nothing can be read, or there is no such tab.
        OSError: the copy could not be written whole.
    """
    import rerun as rr
    import rerun_bindings
    from rerun.chunk import OptimizationProfile, RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no index, which is why it is copied
        try:
            reader = RrdReader(source)
            recordings, layouts = reader.recordings(), reader.blueprints()
            if not recordings:
                raise ValueError("it holds nothing yet")
            known = recordings[0]
            layout = reader.stream(store=layouts[-1]).to_chunks() if layouts else []
            tabs = Tabs(layout)
            front = None if tab is None else tabs.find(tab)
            if tab is not None and front is None:
                raise unknown_name("episode", tab, tabs.names())
            # What came in many small pieces becomes a few: a training's curves take a twentieth.
            data = reader.stream(store=known).collect(optimize=OptimizationProfile.LIVE)
        except RuntimeError as error:
            raise ValueError(str(error)) from error
    stream = rr.RecordingStream(known.application_id, recording_id=known.recording_id, send_properties=False)
    try:
        stream.save(target)
        if layout:  # it comes first, else a slow browser shows views of its own choice meanwhile
            native = rerun_bindings.new_blueprint(known.application_id, make_default=False, make_thread_default=False)
            rows = rr.RecordingStream._from_native(native)
            rows.send_chunks(layout)
            if front is not None:
                tabs.bring_to_front(rows, front)
            rerun_bindings.send_blueprint(rows.memory_recording().storage, True, True, recording=stream.to_native())
        stream.send_chunks(data)
        stream.flush(timeout_sec=FLUSH_SECONDS)
    except RuntimeError as error:
        raise OSError(f"{str(target)!r} could not be written: {error}") from error
    finally:
        stream.disconnect()
    if not is_whole(target):  # rerun does not say so
        raise OSError(f"{str(target)!r} could not be written to its end")
