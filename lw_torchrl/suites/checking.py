"""check_suite: whether a suite's numbers mean what its layout says, measured in its own simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import typed
from lw_torchrl.language.objects import typed_position
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.suites.engine import Engine, EngineStep
from lw_torchrl.suites.suite import Suite

Array = NDArray[np.float64]
_Row = tuple[str, str, str, bool]
_AXES = {"x": "right", "y": "away from the robot", "z": "up"}
_STEPS, _COUNTED, _SHARE = 14, 4, 0.25  # of a movement, and of its last steps; a slow hand takes some to get going
_SETTLING = 30
_LAG, _CLOSING = 4, 13  # what is measured of Meta-World: steps that its hand goes on for, and that its fingers take
_LOWEST = 0.15  # metres: where a hand that is pressed down is at most; Meta-World's is at 0.046
_TABLE, _FLOATING = 0.02, 0.03  # metres: what "touching the table" allows; where a thing no longer seems meant to lie


@dataclass(frozen=True)
class Finding:
    """A measurement in a task: its subject, its result, the layout's value, and whether they agree."""

    task: str
    what: str
    measured: str
    wanted: str
    right: bool


@typed
def check_suite(suite: Suite, *, seed: int = 0) -> list[Finding]:
    """Run a few steps of each task and compare what happens with the suite's layout; success is never looked at.

    It checks the engine's answers, that a seed fixes an episode, that inactive rows rest, the numbers of the step
    before, each axis of the displacement, how far the hand moves in a step (``reach``) and how long it goes on
    afterwards, that objects stay while it moves, the gripper's opening and closing, whether these take no longer than
    Meta-World's (``binary_gripper``), and how high objects rest above the table. It needs two rows of each task.

    Returns:
        A :class:`Finding` for each measurement, in the order of the tasks.

    Example:
        >>> from lw_torchrl.suites import check_suite, load_suite
        >>> all(one.right for one in check_suite(load_suite("fetch")) if one.task == "fetch/pick-and-place")
        True
    """
    found: list[Finding] = []
    heights: list[float] = []
    for task in suite.tasks:
        with closing(suite.make_engine([task, task], reward="sparse", num_threads=1)) as engine:
            bench = _Bench(suite, task, engine, seed)
            found += [Finding(task, *row) for row in bench.rows()]
            heights += bench.heights
    if suite.layout.displacement is not None and min(heights, default=0.0) > _LOWEST:
        lowest = f"z = {min(heights) * 100:.1f} cm"
        found.append(Finding("all", "the lowest of things and pressed hands", lowest, "z counts from the table", False))
    return found


class _Bench:
    """Two rows of a task: the first is moved, the second rests."""

    def __init__(self, suite: Suite, task: str, engine: Engine, seed: int) -> None:
        self.suite, self.layout, self.engine, self.seed = suite, suite.layout, engine, seed
        self.task = suite.tasks[task]
        self.hand = self.layout.positions[0]
        self.heights: list[float] = []

    def reset(self, seed: int | None = None) -> Array:
        found = self.engine.reset([0], [self.seed if seed is None else seed])
        return np.array(found)[0]

    def step(self, **effort: float) -> EngineStep:
        """One step of the first row: ``x``, ``y`` or ``z`` of the displacement, and ``close``."""
        layout, action = self.layout, np.zeros((2, self.layout.action_size), np.float32)
        if layout.displacement is not None:
            action[0, layout.displaced("check_suite")] = [effort.get(axis, 0.0) for axis in _AXES]
        action[0, layout.effort] = effort.get("close", 0.0) * layout.closes
        return self.engine.step(action, np.array([True, False]))

    def run(self, steps: int, **effort: float) -> list[Array]:
        return [self.step(**effort).observation[0].copy() for _ in range(steps)]

    def rows(self) -> Iterator[_Row]:
        one, two = (f"({rows}, {self.layout.size}) float64" for rows in (1, 2))
        answers: dict[str, tuple[str, Callable[[], Any]]] = {
            "observations of a reset": (two, lambda: self.engine.reset([0, 1], [self.seed, self.seed])),
            "a reset of one row of two": (one, lambda: self.engine.reset([0], [self.seed])),
            "a step": (f"EngineStep of {two}, (2,) float64, (2,) bool, (2,) bool", self.step),
        }
        for what, (wanted, ask) in answers.items():
            measured = _answer(ask())
            yield what, measured, wanted, measured == wanted
            if measured != wanted:
                return
        yield from self._episodes()
        yield from self._axes() if self.layout.displacement is not None else ()
        yield from self._gripper() if self.layout.gripper is not None else ()
        yield from self._things()

    def _episodes(self) -> Iterator[_Row]:
        layout, first = self.layout, self.reset()
        walk = [first, *self.run(3, x=0.5)]
        finite = bool(np.isfinite(walk).all())
        yield "the numbers", "finite" if finite else "NaN or infinite", "finite", finite
        self.reset(self.seed + 1)
        again = [self.reset(), *self.run(3, x=0.5)]
        same = np.array_equal(walk, again, equal_nan=True)
        yield "a seed fixes the episode", "the same" if same else "other numbers", "the same", same
        rested = self.step(x=0.5).observation[1]
        same = np.array_equal(rested, self.step(x=0.5).observation[1], equal_nan=True)
        yield "a row that is not active", "rests" if same else "goes on", "rests", same
        if layout.past is not None:
            pairs = [(walk[0], walk[0]), *pairwise(walk)]  # after a reset, the step before is the same
            kept = all(
                np.array_equal(now[layout.a_step_before(part)], old[part])
                for old, now in pairs
                for part in layout.present
            )
            yield "numbers of the step before", "those" if kept else "others", "those; after a reset, the present", kept
        gripper = self.task.objects[0].position
        place = tuple(range(self.hand.start, self.hand.stop))
        right = typed_position(gripper) == typed_position(place)
        yield "the gripper's position", f"obs{list(gripper)}", f"obs{list(place)}, the layout's hand", right

    def _axes(self) -> Iterator[_Row]:
        layout, late = self.layout, []
        for axis, name in enumerate(_AXES):
            self.reset()
            self.run(2 * _STEPS, z=_SHARE)  # away from the table and what stands on it
            self.run(_STEPS)
            way = self.run(_STEPS, **{name: _SHARE})
            moved = (way[-1] - way[-1 - _COUNTED])[self.hand] / _COUNTED / _SHARE
            told = ", ".join(f"{part * 100:.1f}" for part in moved)
            right = moved.argmax() == axis and abs(moved[axis] - layout.reach) < 0.35 * layout.reach
            wanted = f"{layout.reach * 100:.1f} cm along {name}"
            yield f"+{name} moves {_AXES[name]}", f"({told}) cm a step", wanted, bool(right)
            for number, thing in enumerate(layout.things, 1):
                went = float(np.abs(way[-1][thing.xyz] - way[0][thing.xyz]).max())
                if went > 0.5 * np.abs(moved).max() * _SHARE * (_STEPS - 1):
                    yield f"thing {number} as the hand moves", "goes along", "stays; in the table's frame", False
            late.append((self.run(_STEPS)[-1] - way[-1])[self.hand][axis] / layout.reach / _SHARE)
        self.reset()
        self.heights += [state[self.hand][2] for state in self.run(int(0.6 / layout.reach) + 1, z=-1.0)]
        slow = float(max(late))
        wanted = f"{_LAG} steps or fewer, as Meta-World's"
        yield "the hand goes on for", f"{slow:.1f} steps", wanted, slow < _LAG + 0.5

    def _gripper(self) -> Iterator[_Row]:
        layout = self.layout
        self.reset()
        opened = [state[layout.opening] for state in self.run(_SETTLING, close=-1.0)]
        closed = [state[layout.opening] for state in self.run(_SETTLING, close=1.0)]
        if max(opened) - min(closed) < 0.05:
            plan = None if self.suite.plans is None else self.suite.plans.get(self.task.name)
            said = plan is not None and _asks_for_fingers(plan)
            wanted = "0 to 1, since the plan asks whether it is both" if said else "that, or 0 to 1"
            yield "gripper", "it does not move", wanted, not said
            return
        yield "an open gripper", f"{opened[-1]:.2f}", "at least 0.95", opened[-1] >= 0.95
        yield "a closed gripper", f"{min(closed):.2f}", "at most 0.7", min(closed) <= 0.7
        steps = 1 + next(n for n, value in enumerate(closed) if value - min(closed) < 0.1)
        wanted = f"fewer than Meta-World's {_CLOSING}" if layout.binary_gripper else "any"
        yield "steps to close", str(steps), wanted, not layout.binary_gripper or steps < _CLOSING

    def _things(self) -> Iterator[_Row]:
        first = self.reset()
        for name, place in self.task.openings.items():
            yield f"opening of the {name}", f"{first[place]:.2f}", "from 0 to 1", bool(-0.05 <= first[place] <= 1.05)
        resting = self.run(5)[-1]
        for number, thing in enumerate(self.layout.things, 1):
            if not first[thing.xyz].any():
                continue  # the task lacks it
            self.heights.append(height := float(resting[thing.position + 2]))
            wanted = f"{_TABLE * 100:.0f} cm or less where it lies on the table"
            yield f"thing {number} rests at", f"z = {height * 100:.1f} cm", wanted, not _TABLE < height < _FLOATING


def _answer(found: Any) -> str:
    """Describe what an engine returned by its shape and precision."""
    if isinstance(found, EngineStep):
        return f"EngineStep of {', '.join(map(_answer, found))}"
    return f"{found.shape} {found.dtype}" if isinstance(found, np.ndarray) else type(found).__name__


def _asks_for_fingers(plan: ConditionalPlan) -> bool:
    """Whether conditions ask both whether the gripper is open and whether it is closed."""
    asked = {clause.predicate for step in plan.steps for clause in step.condition.clauses if clause.object is None}
    return {"open", "closed"} <= asked
