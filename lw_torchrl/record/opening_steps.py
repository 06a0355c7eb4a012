"""The step at which each episode of a recording is worth opening; a layout cannot set the viewer's cursor."""

from __future__ import annotations

import os

from lw_torchrl.record.tabs import Tabs

COMPONENT = "opens_at"


def opening_steps(path: str | os.PathLike[str]) -> dict[str, int]:
    """Entity path of an episode, "/push-0", to its decisive step: where its failure is seen, its first success, or
    its end. Empty for a recording without episodes."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(os.fspath(path)).stream():
        batch = chunk.to_record_batch()
        if COMPONENT in batch.schema.names:
            found[str(chunk.entity_path)] = int(batch.column(COMPONENT).to_pylist()[-1][0])
    return found


def opening_step(path: str | os.PathLike[str], tab: str | None = None) -> int | None:
    """The step at which a tab is worth opening, the first tab if none is named; of episodes side by side the earliest.
    None for a tab of no episode."""
    from rerun.chunk import RrdReader

    reader = RrdReader(os.fspath(path))
    layouts = reader.blueprints()
    if not layouts:
        return None
    steps, tabs = opening_steps(path), Tabs(reader.stream(store=layouts[-1]).to_chunks())
    shown = tabs.episodes(tab)
    return min((step for entity, step in steps.items() if entity.strip("/").replace("\\", "") in shown), default=None)
