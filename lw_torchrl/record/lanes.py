"""The lanes of an episode over time: success, the active step, the truth of each condition, and the gripper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.relations import STATES
from lw_torchrl.record.entities import (
    FALSE,
    GOLD,
    STEEL,
    TRUE,
    Color,
    changes,
    entity_path,
    rr,
    step_color,
    time_columns,
)
from lw_torchrl.record.recorded_episode import NOBODY, MendedRecording, RecordedEpisode

NONE_HOLDS, EVENLY = "no condition holds", "evenly mixed"
OPEN, CLOSED, NOTHING = "open", "closed", "nothing"
_WRONG = "false, answered true", "true, answered false"
FAILED: Color = (215, 75, 75)
WRONG: Color = (200, 60, 140)
TOUCHES_CLOSED, TOUCHES_OPEN = (225, 130, 60), (150, 165, 220)


@dataclass
class Lanes:
    """Lanes below ``root``: one has an entry where its state changes, and an empty one at the end.

    The viewer shows a lane's path as its title, with a backslash before anything but letters, digits and underscores,
    and sorts the lanes; so paths are short, and names begin with numbers. ``states`` holds the text and colour of each
    state, shared by all lanes of a view; ``conditions`` are the paths of the lanes of conditions.
    """

    root: str
    step_time: float
    states: dict[str, tuple[str, Color]] = field(default_factory=dict)
    paths: list[str] = field(default_factory=list)
    conditions: list[str] = field(default_factory=list)

    def send(self, stream: Any, name: str, first: int, states: NDArray[np.str_], looks: Mapping[str, Any]) -> str:
        """Add a lane that begins at step ``first`` and return its path; ``looks`` are colours, or texts and colours."""
        for state, look in looks.items():
            self.states[state] = look if isinstance(look[0], str) else (state, look)
        rows = changes(states[:, None])
        entries = [*states[rows].tolist(), ""]
        times = time_columns(np.array([*rows, len(states)]) + first, self.step_time)
        # This apostrophe counts as a letter.
        path = self.root + entity_path(name.replace("'", "\u02bc").replace(" ", "_"))
        stream.send_columns(path, times, rr.StateChange.columns(state=entries))
        self.paths.append(path)
        return path


def log_lanes(
    stream: Any,
    root: str,
    episode: RecordedEpisode,
    ended: str,
    touched: Sequence[str] | None,
    ghost: MendedRecording | None,
) -> Lanes:
    """Log the lanes of an episode below ``root``; ``ended`` is its verdict, ``touched`` what its fingers touched."""
    lanes = Lanes(root, episode.step_time)
    widths = [a.shape[1] for a in (episode.qaf, episode.believed, episode.skill_weights) if a is not None]
    columns = max([len(episode.steps), *widths])
    width = len(str(columns))
    if episode.success is not None:
        won = episode.first_success is not None
        looks = {"success": TRUE, "not yet": FALSE} if won else {ended: FAILED}
        states = np.where(episode.success, "success", "not yet" if won else ended)
        lanes.send(stream, f"{0:0{width}} verdict", 1, states, looks)
    if episode.active is not None:
        _send_steps(stream, lanes, f"{0:0{width}}b plan step", episode)
    if ghost is not None and ghost.episode.active is not None:
        _send_steps(stream, lanes, f"{0:0{width}}c ghost with {ghost.by}", ghost.episode, "ghost")
    for column in range(0 if episode.qaf is None else columns):
        assert episode.qaf is not None
        condition = episode.short_conditions[column] if episode.steps else "condition"
        truth = np.where(episode.qaf[:, column], "true", "false")
        if episode.believed is not None:
            believed = episode.believed[:, column]
            truth = np.where(believed != episode.qaf[:, column], np.where(believed, *_WRONG), truth)
        looks = {"true": TRUE, "false": FALSE, **dict.fromkeys(_WRONG, WRONG)}
        lanes.conditions.append(lanes.send(stream, f"{column + 1:0{width}} {condition}", 0, truth, looks))
    if episode.opening is None:
        return lanes
    threshold = STATES[OPEN][0].threshold
    states = np.where(episode.opening > threshold, OPEN, CLOSED)
    looks = {OPEN: STEEL, CLOSED: GOLD}
    if touched is not None:
        objects = np.array(touched[: len(episode)])
        states = np.where(objects == NOTHING, states, np.char.add(np.char.add(states, ", touches "), objects))
        for state in np.unique(states[episode.opening > threshold]).tolist():
            looks.setdefault(state, TOUCHES_OPEN)
        for state in np.unique(states).tolist():
            looks.setdefault(state, TOUCHES_CLOSED)
    lanes.send(stream, "gripper", 0, states, looks)
    return lanes


def _send_steps(stream: Any, lanes: Lanes, name: str, episode: RecordedEpisode, kind: str = "") -> None:
    """Log the active step, numbered from 1; the steps of another ``kind`` of plan have separate names."""
    assert episode.active is not None
    count = max(len(episode.steps), int(episode.active.max()) + 1)
    named = [f"{i} {skill}" for i, (_, skill) in enumerate(episode.steps, 1)] or map(str, range(1, count + 1))
    looks: dict[str, Any] = {f"{kind}{i}": (label, step_color(i)) for i, label in enumerate(named)}
    answered = True if episode.answers is None else episode.answers.any(axis=1)
    nobody = np.where(np.broadcast_to(answered, len(episode)), EVENLY, NONE_HOLDS)
    states = np.where(episode.active == NOBODY, nobody, np.array([*looks, ""])[episode.active])
    lanes.send(stream, name, 0, states, looks | {NONE_HOLDS: FALSE, EVENLY: FALSE})
