"""The plan as a text that follows the cursor: the step in force stands out, its conditions carry their truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lw_torchrl.record.recorded_episode import RecordedEpisode
from lw_torchrl.record.timelines import time_columns

if TYPE_CHECKING:
    from rerun import RecordingStream

MARKS = {True: "✓", False: "✗", None: "·"}


def log_plan(stream: RecordingStream, root: str, episode: RecordedEpisode) -> None:
    """The plan in ``root``/plan, with a text wherever truth or the step in force change."""
    import rerun as rr

    length = len(episode)
    columns = [
        np.full((length, 1), -1) if episode.in_force is None else episode.in_force[:, None],
        *(answers for answers in (episode.qaf, episode.believed) if answers is not None),
    ]
    states = np.concatenate(columns, axis=1)
    changes = np.flatnonzero(np.concatenate([[True], (states[1:] != states[:-1]).any(axis=1)]))
    texts = [plan_text(episode, row) for row in changes.tolist()]
    documents = rr.TextDocument.columns(text=texts, media_type=[rr.MediaType.MARKDOWN] * len(texts))
    stream.send_columns(f"{root}/plan", time_columns(changes), documents)


def plan_text(episode: RecordedEpisode, row: int) -> str:
    """The plan as it stands in one row, in Markdown."""
    parts = []
    for step, (condition, skill) in enumerate(episode.steps):
        truth = None if episode.qaf is None else bool(episode.qaf[row, step])
        line = f"{MARKS[truth]}  {step + 1}.  if {condition}"
        if episode.believed is not None:
            believed = bool(episode.believed[row, step])
            line += f"  (evaluator: {MARKS[believed]})" if believed != truth else ""
        if episode.in_force is not None and episode.in_force[row] == step:
            parts.append(f"**{line}**\n### → {skill}\n")
        else:
            parts.append(f"{line}  \n\u2003\u2003{skill}\n")
    return "\n".join(parts)
