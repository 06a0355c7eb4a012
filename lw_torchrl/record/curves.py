"""The numbers of an episode over its steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.record.colors import FALSE, STEEL, Color, step_color
from lw_torchrl.record.recorded_episode import NOBODY, RecordedEpisode
from lw_torchrl.record.timelines import time_columns

if TYPE_CHECKING:
    from rerun import RecordingStream

ACTION_NAMES = ("dx", "dy", "dz", "gripper")


def log_curves(stream: RecordingStream, root: str, episode: RecordedEpisode) -> list[str]:
    """``root``/action, and, where there is any, /distance (cm), /reward, /skill_weights, /corrected; returns which."""
    rows = np.arange(len(episode))
    sent = ["action"]
    _send(stream, f"{root}/action", rows, episode.action, ACTION_NAMES)
    if (distance := episode.distance()) is not None:
        _send_distance(stream, f"{root}/distance", distance, episode)
        sent.append("distance")
    # A sparse reward is the success, which has a lane.
    if episode.reward is not None and not (
        episode.success is not None and np.array_equal(episode.reward, episode.success)
    ):
        _send(stream, f"{root}/reward", rows + 1, episode.reward[:, None], ["reward"], [STEEL])
        sent.append("reward")
    if episode.skill_weights is not None and episode.attends_softly:
        _send(stream, f"{root}/skill_weights", rows, episode.skill_weights, episode.skills)
        sent.append("skill_weights")
    if episode.corrected is not None:
        _send(stream, f"{root}/corrected", rows, episode.corrected[:, None], ["of the correction"])
        sent.append("corrected")
    return sent


def _send(
    stream: RecordingStream,
    path: str,
    steps: NDArray[np.int64],
    values: NDArray[np.float32],
    names: Sequence[str],
    colors: Sequence[Color] | None = None,
) -> None:
    import rerun as rr

    colors = colors or [step_color(i) for i in range(len(names))]
    stream.log(path, rr.SeriesLines(names=names, colors=colors, widths=[1.5] * len(names)), static=True)
    columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
    stream.send_columns(path, time_columns(steps), columns)


def _send_distance(stream: RecordingStream, path: str, distance: NDArray[np.float32], episode: RecordedEpisode) -> None:
    """One line in centimetres, in the colour of the step in force."""
    import rerun as rr

    assert episode.in_force is not None
    stream.log(path, rr.SeriesLines(names=["distance [cm]"], widths=[2.0]), static=True)
    colors = [FALSE if step == NOBODY else step_color(step) for step in episode.in_force.tolist()]
    columns = [*rr.Scalars.columns(scalars=distance * 100), *rr.SeriesLines.columns(colors=colors)]
    stream.send_columns(path, time_columns(np.arange(len(distance))), columns)
