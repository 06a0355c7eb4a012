"""check_suite: whether a suite's numbers mean what its layout says, measured in its own simulator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._checks import checked
from lw_torchrl.suites.suite import Suite

Array = NDArray[np.float64]
_AXES = {"x": "right", "y": "away from the robot", "z": "up"}
_STEPS, _COUNTED, _SHARE = 14, 4, 0.25  # of a movement, and of its last steps; a slow hand takes some to get going
_SETTLING = 30
_LAG, _CLOSING = 4, 13  # what is measured of Meta-World: steps that its hand goes on for, and that its fingers take
_TABLE, _FLOATING = 0.02, 0.03  # metres: what "touching the table" allows; where a thing no longer seems meant to lie


@dataclass(frozen=True)
class Finding:
    """What was measured of one task.

    Attributes:
        task: its name.
        what: what was looked at.
        measured: what was found, in words.
        wanted: what the layout says.
        right: whether they agree.
    """

    task: str
    what: str
    measured: str
    wanted: str
    right: bool


@checked
def check_suite(suite: Suite, *, seed: int = 0) -> list[Finding]:
    """Run a few steps of each task and compare what happens with the suite's layout; success is never looked at.

    Checked are the numbers' size and precision, that a seed fixes an episode, the numbers of the step before, each axis
    of the displacement, how far the hand moves in a step (``reach``) and how long it goes on afterwards, the gripper's
    opening and closing, whether these take no longer than Meta-World's (``binary_gripper``), and how high things rest
    above the table.

    Args:
        suite: its ``make_engine`` is asked for one row of each task.
        seed: of the episodes.

    Returns:
        A :class:`Finding` for each thing that was looked at, in the order of the tasks.

    Example:
        >>> from lw_torchrl.suites import check_suite, load_suite
        >>> all(one.right for one in check_suite(load_suite("fetch")) if one.task == "fetch/pick-and-place")
        True
    """
    found: list[Finding] = []
    for task in suite.tasks:
        with closing(suite.make_engine([task], reward="sparse", num_threads=1)) as engine:
            found += [Finding(task, *row) for row in _rows(suite, engine, seed)]
    return found


def _rows(suite: Suite, engine: Any, seed: int) -> Iterator[tuple[str, str, str, bool]]:
    layout = suite.layout
    active = np.ones(1, bool)

    def reset(number: int = seed) -> Array:
        return np.asarray(engine.reset([0], [number]))[0].copy()

    def run(steps: int, **effort: float) -> list[Array]:
        """Observations of steps with one action: ``x``, ``y`` or ``z`` of the displacement, and ``close``."""
        action = np.zeros((1, layout.action_size), np.float32)
        for axis, name in enumerate(_AXES):
            action[0, layout.displacement + axis] = effort.get(name, 0.0)
        action[0, layout.gripper] = effort.get("close", 0.0) * layout.closes
        return [engine.step(action, active).observation[0].copy() for _ in range(steps)]

    first = reset()
    size = f"{first.shape[-1]} numbers, {first.dtype}"
    yield "observation", size, f"{layout.size} numbers, float64", first.shape == (layout.size,) and first.dtype == float
    if first.shape != (layout.size,):
        return
    walk = run(3, x=0.5)
    reset(seed + 1)
    again = bool(np.array_equal(first, reset())) and all(map(np.array_equal, walk, run(3, x=0.5)))
    yield "a seed fixes the episode", "the same" if again else "other numbers", "the same", again
    if layout.past is not None:
        width = layout.past
        kept = all(np.array_equal(b[width : 2 * width], a[:width]) for a, b in pairwise(walk))
        yield "numbers of the step before", "those" if kept else "others", "those", kept
    hand = layout.positions[0]
    late = []
    for axis, name in enumerate(_AXES):
        reset()
        run(2 * _STEPS, z=_SHARE)  # away from the table and what stands on it
        run(_STEPS)
        way = [state[hand] for state in run(_STEPS, **{name: _SHARE})]
        moved = (way[-1] - way[-1 - _COUNTED]) / _COUNTED / _SHARE
        told = ", ".join(f"{part * 100:.1f}" for part in moved)
        right = moved.argmax() == axis and abs(moved[axis] - layout.reach) < 0.35 * layout.reach
        yield f"+{name} moves {_AXES[name]}", f"({told}) cm a step", f"{layout.reach * 100:.1f} cm along {name}", right
        late.append((run(_STEPS)[-1][hand] - way[-1])[axis] / layout.reach / _SHARE)
    slow = float(max(late))
    yield "the hand goes on for", f"{slow:.1f} steps", f"{_LAG} steps or fewer, as Meta-World's", slow < _LAG + 0.5
    reset()
    opened = [state[layout.opening] for state in run(_SETTLING, close=-1.0)]
    closed = [state[layout.opening] for state in run(_SETTLING, close=1.0)]
    if max(opened) - min(closed) < 0.05:
        yield "gripper", "it does not move", "that, or 0 to 1", True
    else:
        yield "an open gripper", f"{opened[-1]:.2f}", "at least 0.95", opened[-1] >= 0.95
        yield "a closed gripper", f"{min(closed):.2f}", "at most 0.7", min(closed) <= 0.7
        steps = 1 + next(n for n, value in enumerate(closed) if value - min(closed) < 0.1)
        yield (
            "steps to close",
            str(steps),
            f"fewer than Meta-World's {_CLOSING}" if layout.binary_gripper else "any",
            not layout.binary_gripper or steps < _CLOSING,
        )
    resting = [first, *([] if not layout.things else run(5))][-1]
    for number, thing in enumerate(layout.things):
        if not first[thing.xyz].any():
            continue  # the task lacks it
        height = float(resting[thing.position + 2])
        name = f"thing {number + 1} rests at"
        on = not _TABLE < height < _FLOATING
        yield name, f"z = {height * 100:.1f} cm", f"{_TABLE * 100:.0f} cm or less where it lies on the table", on
