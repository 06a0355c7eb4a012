"""Lanes over the steps of an episode: the step in force, the truth of each condition, success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.record.colors import FALSE, TRUE, Color, step_color
from lw_torchrl.record.recorded_episode import NOBODY, RecordedEpisode
from lw_torchrl.record.timelines import entity_path, time_columns

if TYPE_CHECKING:
    from rerun import RecordingStream

NONE_HOLDS, EVENLY = "no condition holds", "evenly mixed"


def log_lanes(stream: RecordingStream, root: str, episode: RecordedEpisode) -> int:
    """The lanes below ``root``/lanes; returns how many there are.

    A lane has an entry where its state changes, and an empty one at the end. The viewer shows a lane's path as its
    title, with a backslash before whatever is no letter, so the names are words joined by underscores; it sorts them,
    so they begin with numbers.
    """
    import rerun as rr

    lanes = 0

    def send(lane: str, first: int, states: Sequence[str], styles: Mapping[str, tuple[str, Color]]) -> None:
        nonlocal lanes
        lanes += 1
        path = f"{root}/lanes{entity_path(lane)}"
        labels, colors = zip(*styles.values(), strict=True)
        stream.log(path, rr.StateConfiguration(values=list(styles), labels=labels, colors=colors), static=True)
        changes = [i for i in range(len(states)) if i == 0 or states[i] != states[i - 1]]
        entries = [*(states[i] for i in changes), ""]
        times = time_columns(np.array([*changes, len(states)]) + first)
        stream.send_columns(path, times, rr.StateChange.columns(state=entries))

    def truth(lane: str, first: int, values: NDArray[np.bool_], words: tuple[str, str] = ("true", "false")) -> None:
        styles = {"true": (words[0], TRUE), "false": (words[1], FALSE)}
        send(lane, first, np.where(values, "true", "false").tolist(), styles)

    conditions = [condition for condition, _ in episode.steps]
    width = len(str(_columns(episode)))
    if episode.in_force is not None:
        styles = {str(i): (_skill(episode, i), step_color(i)) for i in range(_columns(episode))}
        styles |= {NONE_HOLDS: (NONE_HOLDS, FALSE), EVENLY: (EVENLY, FALSE)}
        send(f"{0:0{width}}_in_force", 0, states_in_force(episode), styles)
    for number in range(_columns(episode)):
        sentence = conditions[number] if conditions else "condition"
        if episode.qaf is not None:
            truth(lane_name(number, width, sentence), 0, episode.qaf[:, number])
        if episode.believed is not None:
            truth(f"{number + 1:0{width}}b_as_the_evaluator_has_it", 0, episode.believed[:, number])
    if episode.success is not None:
        truth("success", 1, episode.success, ("success", "not yet"))
    return lanes


def lane_name(number: int, width: int, sentence: str) -> str:
    """ "2_the_drawer_is_open": the apostrophe becomes one that counts as a letter."""
    return f"{number + 1:0{width}}_" + sentence.replace("'", "\u02bc").replace(" ", "_")


def states_in_force(episode: RecordedEpisode) -> list[str]:
    """The number of the step in force in each row, or why there is none."""
    assert episode.in_force is not None
    answers = episode.answers
    nobody = np.full(len(episode), EVENLY)
    if answers is not None:
        nobody = np.where(answers.any(axis=1), EVENLY, NONE_HOLDS)
    return [
        str(step) if step != NOBODY else str(why) for step, why in zip(episode.in_force.tolist(), nobody, strict=True)
    ]


def _columns(episode: RecordedEpisode) -> int:
    found = [a.shape[1] for a in (episode.qaf, episode.believed, episode.skill_weights) if a is not None]
    return max([len(episode.steps), *found])


def _skill(episode: RecordedEpisode, number: int) -> str:
    return f"{number + 1} {episode.steps[number][1]}" if episode.steps else str(number + 1)
