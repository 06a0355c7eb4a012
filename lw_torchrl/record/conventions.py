"""What all parts of a recording share: entity paths, timelines, colours."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb
else:

    class _Later:
        """A module that is imported when something of it is first used."""

        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, attribute: str) -> Any:
            found = getattr(import_module(self._name), attribute)
            setattr(self, attribute, found)
            return found

    rr, rrb = _Later("rerun"), _Later("rerun.blueprint")

EPISODE_TIMELINE, SECONDS_TIMELINE, METRIC_TIMELINE = "step", "time", "global_step"
CONTROL_PERIOD = 0.0125  # seconds between two actions in Meta-World: 5 simulation steps of 2.5 ms, hence 80 Hz

Color = tuple[int, ...]
TRUE, FALSE = (70, 170, 105), (52, 56, 64)
STEEL, GOLD, GREEN = (205, 210, 220), (255, 200, 60), (90, 220, 120)
_SERIES = ("50aaff", "ff9646", "6ed778", "e16ee1", "f0d750", "64d7d7", "fa6e78", "aa96fa")
SERIES_COLORS: tuple[Color, ...] = tuple(tuple(bytes.fromhex(one)) for one in _SERIES)


def step_color(step: int) -> Color:
    """The colour of a step of a plan, counted from 0, wherever it is shown."""
    return SERIES_COLORS[step % len(SERIES_COLORS)]


def entity_path(*parts: str) -> str:
    """An absolute entity path of parts that may hold any character."""
    return "".join("/" + rr.escape_entity_path_part(part) for part in parts)


def changes(values: NDArray[Any]) -> NDArray[np.int64]:
    """The rows of T×K values that differ from the row before; the first is one."""
    return np.flatnonzero(np.concatenate([[True], (values[1:] != values[:-1]).any(axis=1)]))


def time_columns(steps: NDArray[np.int64], period: float = CONTROL_PERIOD) -> list[Any]:
    """The two timelines of an episode: steps, and seconds at ``period`` each."""
    nanoseconds = (steps * round(period * 1e9)).astype("timedelta64[ns]")
    return [rr.TimeColumn(EPISODE_TIMELINE, sequence=steps), rr.TimeColumn(SECONDS_TIMELINE, duration=nanoseconds)]
