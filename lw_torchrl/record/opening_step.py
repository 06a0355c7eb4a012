"""The step at which a recording is worth opening; a layout cannot set the viewer's cursor."""

from __future__ import annotations

import os
from collections import defaultdict

from lw_torchrl._checks import check_int
from lw_torchrl.record.tabs import Tabs

COMPONENT = "opens_at"


def opening_step(path: str | os.PathLike[str], tab: str | None = None, step: int | None = None) -> int | None:
    """The step that a viewer's cursor is to stand at in a tab, the first tab if none is named.

    Args:
        path: the recording.
        tab: the tab's title, or its episode's name.
        step: the step that was asked for; None takes an episode's decisive one (where its failure is seen, its first
            success, or its end; of episodes side by side the earliest).

    Returns:
        The step; None for a tab of no episode, or a recording without steps.

    Raises:
        TypeError, ValueError: ``step`` is no whole number, or the recording does not go so far.
    """
    from rerun.chunk import RrdReader

    reader = RrdReader(os.fspath(path))
    opens_at: dict[str, int] = {}
    last: dict[str, int] = defaultdict(lambda: -1)
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        if COMPONENT in batch.schema.names:
            opens_at[str(chunk.entity_path).strip("/").replace("\\", "")] = int(batch.column(COMPONENT)[-1].as_py()[0])
        for timeline in chunk.timeline_names:
            times = batch.column(timeline)
            if step is not None and len(times):
                last[timeline] = max(last[timeline], times[-1].cast("int64").as_py())
    layouts = reader.blueprints()
    tabs = Tabs(reader.stream(store=layouts[-1]).to_chunks()) if layouts else None
    if step is None:
        shown = set() if tabs is None else tabs.episodes(tab)
        return min((found for episode, found in opens_at.items() if episode in shown), default=None)
    end = -1 if tabs is None else last[tabs.timeline(tab)]
    if end < 0:
        raise ValueError(f"step {step} was given, but the recording holds no steps")
    if check_int("step", step, minimum=0) > end:
        raise ValueError(f"step must be at most {end}, the recording's last, got {step}")
    return step
