"""check_suite: simulate a suite's tasks and verify that observations and actions match the suite's layout."""

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
from lw_torchrl.suites.engine import Engine, EngineStep
from lw_torchrl.suites.suite import Suite

Array = NDArray[np.float64]
_Row = tuple[str, str, str, bool | None]  # the fields of a Finding, without the task
_AXES = {"x": "right", "y": "away from the robot", "z": "up"}
# The hand's speed is measured over the last time steps of a movement at a quarter of full speed, after the start-up.
_STEPS, _COUNTED, _SHARE = 14, 4, 0.25
_SETTLING = 30  # time steps that a gripper may need to open or close
_RESTED = 4  # episodes in which the hand rests
_LAG, _CLOSING = 4, 13  # time steps until the hand is at rest and until the gripper is closed, in Meta-World
_LOWEST = 0.15  # metres: the maximum height of a hand pressed down onto the table; 0.046 in Meta-World
_TABLE, _FLOATING = 0.02, 0.03  # metres: lower objects lie on the table; higher objects are deliberately elsewhere


@dataclass(frozen=True)
class Finding:
    """A measurement in a task: the quantity, the measured value, the value expected from the layout, and whether the
    two agree (None if the user must judge)."""

    task: str
    what: str
    measured: str
    wanted: str
    right: bool | None


@typed
def check_suite(suite: Suite, *, seed: int = 0) -> list[Finding]:
    """Run a few time steps of two rows of each task, compare the results with the suite's layout, and return a
    :class:`Finding` for each measurement, ordered by task.

    The checks cover the interface (types and shapes, seeds, inactive rows, values of the previous step), the hand
    (direction of each axis, distance per time step, prompt stop), the gripper (it opens and closes, and, if
    ``binary_gripper``, no slower than in Meta-World), the objects (they stay in place while the hand moves, and rest at
    a plausible height above the table) and the success (not every episode succeeds while the hand rests).

    Example:
        >>> from lw_torchrl.suites import check_suite, load_suite
        >>> all(finding.right for finding in check_suite(load_suite("fetch")) if finding.task == "fetch/pick-and-place")
        True
    """
    findings: list[Finding] = []
    heights: list[float] = []
    for task in suite.tasks:
        with closing(suite.make_engine([task, task], reward="sparse", num_threads=1)) as engine:
            findings += [Finding(task, *row) for row in _Bench(suite, task, engine, seed, heights).rows()]
    if suite.layout.displacement is not None and min(heights, default=0.0) > _LOWEST:
        lowest = f"z = {min(heights) * 100:.1f} cm"
        findings.append(Finding("all", "the lowest object or hand", lowest, "z is the height above the table", False))
    return findings


class _Bench:
    """A two-row test batch of one task: row 0 receives actions that move the hand, row 1 stays inactive."""

    def __init__(self, suite: Suite, task: str, engine: Engine, seed: int, heights: list[float]) -> None:
        self.suite, self.layout, self.engine, self.seed, self.heights = suite, suite.layout, engine, seed, heights
        self.task, self.hand = suite.tasks[task], suite.layout.positions[0]

    def reset(self, seed: int | None = None) -> Array:
        return np.array(self.engine.reset([0], [self.seed if seed is None else seed]))[0]

    def step(self, **effort: float) -> EngineStep:
        """Step row 0 with displacements ``x``, ``y``, ``z`` and a gripper effort ``close``, each in [-1, 1]."""
        layout, action = self.layout, np.zeros((2, self.layout.action_size), np.float32)
        if layout.displacement is not None:
            action[0, layout.displaced("check_suite")] = [effort.get(axis, 0.0) for axis in _AXES]
        action[0, layout.effort] = effort.get("close", 0.0) * layout.closes
        return self.engine.step(action, np.array([True, False]))

    def run(self, steps: int, **effort: float) -> list[Array]:
        return [self.step(**effort).observation[0].copy() for _ in range(steps)]

    def rows(self) -> Iterator[_Row]:
        one_row, two_rows = (f"({rows}, {self.layout.size}) float64" for rows in (1, 2))
        answers: dict[str, tuple[str, Callable[[], Any]]] = {
            "observations after a reset": (two_rows, lambda: self.engine.reset([0, 1], [self.seed, self.seed])),
            "a reset of one of two rows": (one_row, lambda: self.engine.reset([0], [self.seed])),
            "a step": (f"EngineStep of {two_rows}, (2,) float64, (2,) bool, (2,) bool", self.step),
        }
        for what, (wanted, call) in answers.items():
            measured = _describe(call())
            yield what, measured, wanted, measured == wanted
            if measured != wanted:
                return
        yield from self._episodes()
        yield from self._axes() if self.layout.displacement is not None else ()
        yield from self._gripper() if self.layout.gripper is not None else ()
        yield from self._objects()
        successes = 0  # an episode may happen to start in a success state
        for seed in range(self.seed, self.seed + _RESTED):
            self.reset(seed)
            successes += any(self.step().success[0] for _ in range(_SETTLING))
        measured, wanted = f"in {successes} of {_RESTED} episodes", f"not in each of {_RESTED} episodes"
        yield f"success while the hand rests for {_SETTLING} steps", measured, wanted, successes < _RESTED

    def _episodes(self) -> Iterator[_Row]:
        layout, first = self.layout, self.reset()
        walk = [first, *self.run(3, x=0.5)]
        finite = bool(np.isfinite(walk).all())
        yield "observation values", "finite" if finite else "NaN or infinite", "finite", finite
        self.reset(self.seed + 1)
        again = [self.reset(), *self.run(3, x=0.5)]
        same = np.array_equal(walk, again, equal_nan=True)
        yield "a seed determines the episode", "same values" if same else "different values", "same values", same
        rested = self.step(x=0.5).observation[1]
        same = np.array_equal(rested, self.step(x=0.5).observation[1], equal_nan=True)
        yield "an inactive row", "unchanged" if same else "changed", "unchanged", same
        if layout.past is not None:
            pairs = [(walk[0], walk[0]), *pairwise(walk)]  # after a reset, both time steps have the same values
            columns = [(layout.a_step_before(part), part) for part in layout.present]
            kept = all(np.array_equal(now[past], old[part]) for old, now in pairs for past, part in columns)
            wanted = "equal to the previous observation (after a reset: to the current observation)"
            yield "values of the previous step", wanted if kept else "different", wanted, kept
        gripper, place = self.task.objects[0].position, tuple(range(self.hand.start, self.hand.stop))
        right = typed_position(gripper) == typed_position(place)
        yield "the gripper's position", f"obs{list(gripper)}", f"obs{list(place)}, the layout's hand", right

    def _axes(self) -> Iterator[_Row]:
        layout, late = self.layout, []
        for axis, name in enumerate(_AXES):
            self.reset()
            self.run(2 * _STEPS, z=_SHARE)  # away from the table and the objects on it
            self.run(_STEPS)
            path = self.run(_STEPS, **{name: _SHARE})
            moved = (path[-1] - path[-1 - _COUNTED])[self.hand] / _COUNTED / _SHARE
            measured = ", ".join(f"{part * 100:.1f}" for part in moved)
            right = moved.argmax() == axis and abs(moved[axis] - layout.reach) < 0.35 * layout.reach
            wanted = f"{layout.reach * 100:.1f} cm along {name}"
            if axis == 2 and np.abs(moved).max() < 1e-3 * layout.reach:
                nothing = "nothing: the hand stays in a plane"
                yield f"+{name} moves {_AXES[name]}", nothing, f"{wanted}, or nothing", True
                continue
            yield f"+{name} moves {_AXES[name]}", f"({measured}) cm a step", wanted, bool(right)
            for number, slot in enumerate(layout.things, 1):
                shift = float(np.abs(path[-1][slot.xyz] - path[0][slot.xyz]).max())
                if shift > 0.5 * np.abs(moved).max() * _SHARE * (_STEPS - 1):
                    yield f"object {number} as the hand moves", "moves with the hand", "stays on the table", False
            late.append((self.run(_STEPS)[-1] - path[-1])[self.hand][axis] / layout.reach / _SHARE)
        self.reset()
        self.heights += [state[self.hand][2] for state in self.run(int(0.6 / layout.reach) + 1, z=-1.0)]
        slow = float(max(late))
        yield "the hand stops after", f"{slow:.1f} steps", f"at most {_LAG}, as in Meta-World", slow < _LAG + 0.5

    def _gripper(self) -> Iterator[_Row]:
        layout = self.layout
        self.reset()
        opened = [state[layout.opening] for state in self.run(_SETTLING, close=-1.0)]
        closed = [state[layout.opening] for state in self.run(_SETTLING, close=1.0)]
        if max(opened) - min(closed) < 0.05:
            plan = None if self.suite.plans is None else self.suite.plans.get(self.task.name)
            clauses = [clause for step in plan.steps for clause in step.condition.clauses] if plan is not None else []
            needed = {"open", "closed"} <= {clause.predicate for clause in clauses if clause.object is None}
            wanted = "opens and closes, as the plan's conditions require" if needed else "fixed, or opens and closes"
            yield "gripper", "does not move", wanted, not needed
            return
        yield "an open gripper", f"{opened[-1]:.2f}", "at least 0.95", opened[-1] >= 0.95
        yield "a closed gripper", f"{min(closed):.2f}", "at most 0.7", min(closed) <= 0.7
        steps = 1 + next(n for n, value in enumerate(closed) if value - min(closed) < 0.1)
        wanted = f"fewer than Meta-World's {_CLOSING}" if layout.binary_gripper else "any"
        yield "steps to close", str(steps), wanted, not layout.binary_gripper or steps < _CLOSING

    def _objects(self) -> Iterator[_Row]:
        first = self.reset()
        for name, place in self.task.openings.items():
            yield f"opening of the {name}", f"{first[place]:.2f}", "from 0 to 1", bool(-0.05 <= first[place] <= 1.05)
        resting = self.run(5)[-1]
        for number, slot in enumerate(self.layout.things, 1):
            if not first[slot.xyz].any():
                continue  # this task has no such object
            self.heights.append(height := float(resting[slot.position + 2]))
            wanted = f"at most {_TABLE * 100:.0f} cm if it lies on the table, for the condition 'touching the table'"
            is_unclear = _TABLE < height < _FLOATING
            yield f"object {number} rests at", f"z = {height * 100:.1f} cm", wanted, None if is_unclear else True


def _describe(answer: Any) -> str:
    """Describe the type, shape and dtype of an engine's result."""
    if isinstance(answer, EngineStep):
        return f"EngineStep of {', '.join(map(_describe, answer))}"
    return f"{answer.shape} {answer.dtype}" if isinstance(answer, np.ndarray) else type(answer).__name__
