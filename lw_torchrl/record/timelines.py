"""Where and when things stand in a recording: entity paths, and the timelines of episodes and of training."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

EPISODE_TIMELINE, SECONDS_TIMELINE, METRIC_TIMELINE = "step", "time", "global_step"
CONTROL_PERIOD = 0.0125
"""Seconds between two actions in Meta-World: 5 simulation steps of 2.5 ms, hence 80 Hz."""


def entity_path(*parts: str) -> str:
    """An absolute entity path of parts that may hold any character."""
    import rerun as rr

    return "".join("/" + rr.escape_entity_path_part(part) for part in parts)


def time_columns(steps: NDArray[np.int64], period: float = CONTROL_PERIOD) -> list[Any]:
    """The two timelines of an episode: steps, and seconds at ``period`` each."""
    import rerun as rr

    nanoseconds = (steps * round(period * 1e9)).astype("timedelta64[ns]")
    return [
        rr.TimeColumn(EPISODE_TIMELINE, sequence=steps),
        rr.TimeColumn(SECONDS_TIMELINE, duration=nanoseconds),
    ]
