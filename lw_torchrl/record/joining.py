"""Recordings of several runs as one: curves over one another, and episodes side by side."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath, replacing
from lw_torchrl.record.conventions import entity_path, rr, step_color
from lw_torchrl.record.overview import OVERVIEW
from lw_torchrl.record.recording_file import FLUSH_SECONDS, copy_recording, find_recording, opened
from lw_torchrl.record.tabs import Layout

MOST = 4
"""How many runs: columns side by side get no narrower than a quarter of a window."""


@checked
def join_recordings(paths: Sequence[AnyPath], target: AnyPath, *, names: Sequence[str] | None = None) -> Path:
    """Write recordings of two to four runs as one: their training curves in the same views, and episodes of the same
    name, which have the same task and number if nobody chose others, side by side under one cursor.

    Args:
        paths: recordings, or folders that hold one each.
        target: the file, ending in ".rrd"; it is replaced whole.
        names: of the runs, in the legends of curves and in front of episodes' names; None takes those of the folders or
            the files, as far as these differ.

    Returns:
        The target.

    Raises:
        ValueError: there are not two to four recordings, or one of them twice, or one of an earlier version; names are
            not one for each, or not all different.

    Example:
        >>> import tempfile
        >>> import lw_torchrl as lw
        >>> folder = tempfile.mkdtemp()
        >>> for run, rate in (("fast", 0.5), ("slow", 0.9)):
        ...     with lw.RerunLogger(f"{folder}/{run}.rrd") as logger:
        ...         for step in range(5):
        ...             logger.log_scalar("loss/bc", rate**step, step)
        >>> runs = [f"{folder}/fast.rrd", f"{folder}/slow.rrd"]
        >>> lw.record.join_recordings(runs, f"{folder}/both.rrd").name
        'both.rrd'
    """
    from rerun.chunk import RrdReader

    if not 2 <= len(paths) <= MOST:
        raise ValueError(f"paths must be of 2 to {MOST} recordings, got {len(paths)}")
    target = Path(target)
    if target.suffix != ".rrd":
        raise ValueError(f"target must end in '.rrd', got {str(target)!r}")
    files = [find_recording(path) for path in paths]
    called = run_names([Path(path) for path in paths]) if names is None else [str(name) for name in names]
    if len(called) != len(files) or len(set(called)) != len(files) or not all(name.strip() for name in called):
        raise ValueError(f"names must be {len(files)} different ones, one for each recording, got {called}")
    with ExitStack() as stack:
        readers = [RrdReader(stack.enter_context(opened(file))) for file in files]
        known = [reader.recordings()[0] for reader in readers]
        layouts: dict[str, Layout] = {}
        for name, file, reader in zip(called, files, readers, strict=True):
            if (layout := Layout.read(reader)) is None:
                raise ValueError(f"recording {str(file)!r} is of an earlier version, or of another program")
            layouts[name] = layout
        if len({one.recording_id for one in known}) < len(known):
            raise ValueError(f"paths must be of different recordings, got {', '.join(map(str, files))}")
        layout = Layout.joined(layouts)
        title = " and ".join(called)
        stream = rr.RecordingStream(title)
        stream.set_log_time_enabled(False)
        with replacing(target) as copy:
            try:
                stream.save(copy)
                stream.send_recording_name(title)
                for number, (name, reader, one) in enumerate(zip(called, readers, known, strict=True)):
                    _add(stream, name, number, len(called), list(reader.stream(store=one)))
                layout.save(stream)
                layout.send(stream)
                stream.flush(timeout_sec=FLUSH_SECONDS)
            finally:
                stream.disconnect()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                compact = copy.with_name(f"{copy.name}.compact")
                copy_recording(copy, compact)
            compact.replace(copy)
    return target


def _add(stream: Any, run: str, number: int, of: int, chunks: Sequence[Any]) -> None:
    """The chunks of a run, the ``number``-th ``of`` several, below its name; and this in the legends of its curves."""
    root, kept = entity_path(run), []
    legends: dict[str, list[str]] = {}
    for chunk in chunks:
        entity = str(chunk.entity_path)
        kind = entity.split("/")[1]
        rows = chunk.to_record_batch() if kind == "metrics" and chunk.is_static else None
        if rows is not None and "SeriesLines:names" in rows.schema.names:
            legends[entity] = rows.column("SeriesLines:names")[-1].as_py()
        if kind != "__properties" and entity != entity_path(OVERVIEW, "table"):
            kept.append(chunk.with_entity_path(root + entity))
    stream.send_chunks(kept)
    drawn: Counter[str] = Counter()  # the curves of each view
    for entity, lines in sorted(legends.items()):
        view = entity.split("/")[2]
        first, drawn[view] = drawn[view], drawn[view] + len(lines)
        colors = [step_color((first + line) * of + number) for line in range(len(lines))]
        look = rr.SeriesLines(names=[f"{line} · {run}" for line in lines], colors=colors)
        stream.log(root + entity, look, static=True)


def run_names(paths: Sequence[Path]) -> list[str]:
    """What runs are called: by their folders or files, or by the nearest folders above that differ, or by number."""
    own = [path.name if path.is_dir() else path.stem for path in paths]
    above = zip(*([folder.name for folder in path.absolute().parents] for path in paths), strict=False)
    numbers = [f"{name}-{number}" for number, name in enumerate(own, 1)]
    return next(list(names) for names in (own, *above, numbers) if len({*names, ""}) == len(paths) + 1)
