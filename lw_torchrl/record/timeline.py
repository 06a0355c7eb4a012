"""What changes over an episode's steps: the timeline of skills and conditions, the plan at the cursor, the curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.record.conventions import FALSE, STEEL, TRUE, Color, Stream, entity_path, rr, step_color, time_columns
from lw_torchrl.record.recorded_episode import NOBODY, RecordedEpisode

NONE_HOLDS, EVENLY = "no condition holds", "evenly mixed"
ACTION_NAMES = ("dx", "dy", "dz", "gripper")
MARKS = {True: "✓", False: "✗", None: "·"}


def log_timeline(stream: Stream, root: str, episode: RecordedEpisode) -> int:
    """Rows for the step in force, each condition and success below ``root``/timeline; returns how many.

    A row has an entry where its state changes, and an empty one at the end. The viewer shows a row's path as its title,
    with a backslash before whatever is no letter or underscore, and sorts the rows, so the names begin with numbers.
    """
    rows = 0

    def send(name: str, first: int, states: Sequence[str], styles: Mapping[str, tuple[str, Color]]) -> None:
        nonlocal rows
        rows += 1
        path = f"{root}/timeline{entity_path(name)}"
        labels, colors = zip(*styles.values(), strict=True)
        stream.log(path, rr.StateConfiguration(values=list(styles), labels=labels, colors=colors), static=True)
        changes = [i for i in range(len(states)) if i == 0 or states[i] != states[i - 1]]
        entries = [*(states[i] for i in changes), ""]
        times = time_columns(np.array([*changes, len(states)]) + first)
        stream.send_columns(path, times, rr.StateChange.columns(state=entries))

    def truth(name: str, first: int, values: NDArray[np.bool_], words: tuple[str, str] = ("true", "false")) -> None:
        styles = {"true": (words[0], TRUE), "false": (words[1], FALSE)}
        send(name, first, np.where(values, "true", "false").tolist(), styles)

    found = [a.shape[1] for a in (episode.qaf, episode.believed, episode.skill_weights) if a is not None]
    columns = max([len(episode.steps), *found])
    width = len(str(columns))
    if episode.in_force is not None:
        names = [f"{i} {skill}" for i, (_, skill) in enumerate(episode.steps, 1)] or map(str, range(1, columns + 1))
        styles = {str(i): (name, step_color(i)) for i, name in enumerate(names)}
        styles |= {NONE_HOLDS: (NONE_HOLDS, FALSE), EVENLY: (EVENLY, FALSE)}
        send(f"{0:0{width}}_in_force", 0, _states_in_force(episode), styles)
    for column in range(columns):
        number = f"{column + 1:0{width}}"
        if episode.qaf is not None:
            condition = episode.steps[column][0] if episode.steps else "condition"
            # This apostrophe counts as a letter.
            truth(f"{number}_" + condition.replace("'", "\u02bc").replace(" ", "_"), 0, episode.qaf[:, column])
        if episode.believed is not None:
            truth(f"{number}b_as_the_evaluator_has_it", 0, episode.believed[:, column])
    if episode.success is not None:
        truth("success", 1, episode.success, ("success", "not yet"))
    return rows


def _states_in_force(episode: RecordedEpisode) -> list[str]:
    """The number of the step in force in each row, or why there is none."""
    assert episode.in_force is not None
    answered = True if episode.answers is None else episode.answers.any(axis=1)
    nobody = np.where(np.broadcast_to(answered, len(episode)), EVENLY, NONE_HOLDS)
    return np.where(episode.in_force == NOBODY, nobody, episode.in_force.astype(str)).tolist()


def log_plan(stream: Stream, root: str, episode: RecordedEpisode) -> None:
    """The plan in ``root``/plan, with a text wherever truth or the step in force change."""
    length = len(episode)
    columns = [
        np.full((length, 1), -1) if episode.in_force is None else episode.in_force[:, None],
        *(answers for answers in (episode.qaf, episode.believed) if answers is not None),
    ]
    states = np.concatenate(columns, axis=1)
    changes = np.flatnonzero(np.concatenate([[True], (states[1:] != states[:-1]).any(axis=1)]))
    texts = [_plan_text(episode, row) for row in changes.tolist()]
    documents = rr.TextDocument.columns(text=texts, media_type=[rr.MediaType.MARKDOWN] * len(texts))
    stream.send_columns(f"{root}/plan", time_columns(changes), documents)


def _plan_text(episode: RecordedEpisode, row: int) -> str:
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


def log_curves(stream: Stream, root: str, episode: RecordedEpisode) -> list[str]:
    """``root``/action, and, where there is any, /distance (cm), /reward, /skill_weights, /corrected; returns which."""
    rows = np.arange(len(episode))
    sent = ["action"]
    _send(stream, f"{root}/action", rows, episode.action, ACTION_NAMES)
    if (distance := episode.distance()) is not None:
        # One line in centimetres, in the colour of the step in force.
        assert episode.in_force is not None
        colors = [FALSE if step == NOBODY else step_color(step) for step in episode.in_force.tolist()]
        stream.log(f"{root}/distance", rr.SeriesLines(names=["distance [cm]"], widths=[2.0]), static=True)
        columns = [*rr.Scalars.columns(scalars=distance * 100), *rr.SeriesLines.columns(colors=colors)]
        stream.send_columns(f"{root}/distance", time_columns(rows), columns)
        sent.append("distance")
    # A sparse reward is the success, which has a row in the timeline.
    if episode.reward is not None and not (
        episode.success is not None and np.array_equal(episode.reward, episode.success)
    ):
        _send(stream, f"{root}/reward", rows + 1, episode.reward[:, None], ["reward"], STEEL)
        sent.append("reward")
    weights = episode.skill_weights
    if weights is not None and bool(((weights > 1e-3) & (weights < 1 - 1e-3)).any()):  # else the timeline has them
        texts = [f" {skill}" for _, skill in episode.steps] or [""] * weights.shape[1]
        _send(stream, f"{root}/skill_weights", rows, weights, [f"{i}{text}" for i, text in enumerate(texts, 1)])
        sent.append("skill_weights")
    if episode.corrected is not None:
        _send(stream, f"{root}/corrected", rows, episode.corrected[:, None], ["of the correction"])
        sent.append("corrected")
    return sent


def _send(stream: Stream, path: str, steps: Any, values: Any, names: Sequence[str], *color: Color) -> None:
    colors = list(color) or [step_color(i) for i in range(len(names))]
    stream.log(path, rr.SeriesLines(names=names, colors=colors, widths=[1.5] * len(names)), static=True)
    columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
    stream.send_columns(path, time_columns(steps), columns)
