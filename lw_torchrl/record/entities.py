"""Entity paths, timelines and colours that all parts of a recording share."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb
else:

    class _Later:
        """A module that is imported at the first use of one of its attributes."""

        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, attribute: str) -> Any:
            value = getattr(import_module(self._name), attribute)
            setattr(self, attribute, value)
            return value

    rr, rrb = _Later("rerun"), _Later("rerun.blueprint")

EPISODE_TIMELINE, SECONDS_TIMELINE, METRIC_TIMELINE = "step", "time", "global_step"
STEP_TIME = 0.0125  # seconds per step of an episode of an unknown suite: Meta-World's 80 Hz

Color = tuple[int, ...]
TRUE, FALSE = (70, 170, 105), (52, 56, 64)
STEEL, GOLD, GREEN = (205, 210, 220), (255, 200, 60), (90, 220, 120)
_SERIES = ("50aaff", "ff9646", "6ed778", "e16ee1", "f0d750", "64d7d7", "fa6e78", "aa96fa")
SERIES_COLORS: tuple[Color, ...] = tuple(tuple(bytes.fromhex(color)) for color in _SERIES)


def step_color(step: int) -> Color:
    """Return the colour of a plan's step, counted from 0; the same in all views."""
    return SERIES_COLORS[step % len(SERIES_COLORS)]


def entity_path(*parts: str) -> str:
    """Return an absolute entity path; its parts may hold any character."""
    return "".join("/" + rr.escape_entity_path_part(part) for part in parts)


def changes(values: NDArray[Any]) -> NDArray[np.int64]:
    """Return the first row of T×K values and all rows that differ from the row before."""
    return np.flatnonzero(np.concatenate([[True], (values[1:] != values[:-1]).any(axis=1)]))


def time_columns(steps: NDArray[np.int64], step_time: float) -> list[Any]:
    """Return the two timelines of an episode: steps, and seconds, ``step_time`` for each step."""
    nanoseconds = (steps * round(step_time * 1e9)).astype("timedelta64[ns]")
    return [rr.TimeColumn(EPISODE_TIMELINE, sequence=steps), rr.TimeColumn(SECONDS_TIMELINE, duration=nanoseconds)]
