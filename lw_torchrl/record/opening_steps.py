"""The step at which each episode of a recording is worth opening; a layout cannot set the viewer's cursor."""

from __future__ import annotations

import os

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
