"""The coverage of a plan: the fraction of typical states in which the plan's active steps suit the plan's motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.resources import files
from itertools import product

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.files import read_toml
from lw_torchrl.language.expressions import Expression, Once, fold
from lw_torchrl.language.layout import places
from lw_torchrl.language.objects import GRIPPER, Coordinate
from lw_torchrl.language.plans import PlanStep
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.relations import STATES, comparisons
from lw_torchrl.language.roles import BY_HAND, StepRole, Verb, motion_of
from lw_torchrl.language.step_parser import is_obstacle
from lw_torchrl.language.tasks import Task, first_object, is_goal, point_on, role_object


def role_of(step: PlanStep) -> StepRole:
    """Return the role of a step of a canonical plan."""
    assert step.role is not None
    return step.role


def touched_point(task: Task, roles: Sequence[StepRole]) -> str:
    """Return the point that the hand touches: the target of its first motion, ignoring approaches if possible."""
    hands = [role for role in roles if role.moved == GRIPPER != role.target and not is_goal(task, role.target)]
    hands = [role for role in hands if not is_obstacle(role.target)] or hands
    hand = min(hands, key=lambda role: role.verb == "approach", default=None)
    name = first_object(task) if hand is None else hand.target
    assert name is not None
    return point_on(task, name)


def _has_sides(roles: Sequence[StepRole]) -> bool:
    """Return whether a plan has pushes from several sides, each with an approach to that side."""
    sides = {role.target for role in roles if role.verb == "push"}
    return len(sides) > 1 and all(any(role.target == side and role.verb in BY_HAND for role in roles) for side in sides)


def coverage_of(task: Task, steps: Sequence[PlanStep]) -> float:
    """Return the fraction of typical states in which some step is active and every active step suits the motion."""
    roles = [role_of(step) for step in steps]
    motion = motion_of(roles)
    if motion is None:
        return 0.0
    # No typical states are defined for reaching and for pushing from several sides.
    if motion.manner == "reach" or _has_sides(roles):
        return 1.0
    manner = "pull" if motion.verb == "pull" else motion.manner
    pairs = [(step.condition, role_of(step).verb) for step in steps]
    good = [
        bool(active) and active <= right for active, right in _active(task, touched_point(task, roles), manner, pairs)
    ]
    return sum(good) / len(good)


# The typical states are synthetic: objects and goal at fixed positions, and the hand at offsets from the touched point.
_Floats = NDArray[np.float32]
_Bools = NDArray[np.bool_]
_OBJECTS = ((0.0, 0.6, 0.02), (0.2, 0.7, 0.02), (-0.2, 0.7, 0.02), (0.0, 0.8, 0.02))
_GOAL = (0.1, 0.8, 0.2)
_MOTIONS = read_toml(files("lw_torchrl.language") / "data" / "motions.toml", ValueError)
_MOTIONS |= {motion: _MOTIONS["coming"] + _MOTIONS[motion] for motion in ("grasp", "pull")}
_TYPICAL = {
    motion: [(offset, opening, lift, {*verbs.split()}) for hands, opening, lift, verbs in rows for offset in hands]
    for motion, rows in _MOTIONS.items()
}
# Hand positions (metres from the touched point) and gripper openings, some of them at the relations' thresholds.
_PLANE = ((0.0, 0.0), (0.035, 0.01), (-0.01, -0.035), (-0.05, 0.02), (0.02, 0.07), (0.13, -0.1))
_AROUND = _PLANE, (-0.01, 0.01, 0.034, 0.08), (1.0, 0.8, 0.3)


def _active(
    task: Task, point: str, motion: str, steps: Sequence[tuple[Query, Verb]]
) -> Iterator[tuple[set[Verb], set[str]]]:
    """Yield, for each typical state, the verbs of the active steps and the right verbs."""
    states = np.stack([_state(task, point, *row[:3]) for row in _TYPICAL[motion]])
    truths = [(_holds(query, task, states), verb) for query, verb in steps]
    for number, (*_, verbs) in enumerate(_TYPICAL[motion]):
        yield {verb for truth, verb in truths if truth[number]}, verbs


def true_around(task: Task, point: str, conditions: Sequence[Query]) -> Iterator[set[int]]:
    """Yield the indices of the true conditions for each of several hand positions around a point."""
    states = np.stack([_state(task, point, (x, y, z), opening, 0.0) for (x, y), z, opening in product(*_AROUND)])
    truths = [_holds(query, task, states) for query in conditions]
    yield from ({number for number, truth in enumerate(truths) if truth[at]} for at in range(len(states)))


def moves_before_grasp(task: Task, steps: Sequence[PlanStep]) -> bool:
    """Return whether, in some typical state without a grasped object, a step that moves an object is active."""
    point = touched_point(task, [role_of(step) for step in steps])
    moving: list[tuple[Query, Verb]] = [
        (step.condition, "move") for step in steps if role_of(step).verb in ("carry", "move")
    ]
    return any(active for active, right in _active(task, point, "grasp", moving) if "move" not in right)


def _state(task: Task, point: str, offset: Sequence[float], opening: float, lift: float) -> _Floats:
    """Build an observation with the hand at ``offset`` from ``point`` and the touched object raised by ``lift`` (m)."""
    touched, layout = role_object(task, point), task.layout
    state = np.zeros(layout.size, np.float32)
    for place, xyz in zip(layout.positions[1:-1], _OBJECTS, strict=False):
        state[place] = xyz
    state[layout.positions[-1]] = _GOAL
    if at := [number for number in touched.position if isinstance(number, int)]:
        state[at[-1]] += np.float32(lift)
    hand = _position(touched.position, state[None])[0] + _floats(touched.offset) + _floats(offset)
    state[list(places(layout.positions[0]))] = hand
    state[layout.opening] = opening
    return state


def _floats(numbers: Sequence[float]) -> _Floats:
    return np.array(numbers, np.float32)


def _position(position: Sequence[Coordinate], states: _Floats) -> _Floats:
    """Return the coordinates (S, 3) of a named position in states (S, n), in metres."""
    columns = [states[:, at] if isinstance(at, int) else np.full(len(states), at, np.float32) for at in position]
    return np.stack(columns, 1)


def _holds(query: Query, task: Task, states: _Floats) -> _Bools:
    """Evaluate a query in states (S, n); a latch has the truth of its condition."""

    def visit(each: Expression, parts: list[_Bools]) -> _Bools:
        if each.kind == "leaf":
            is_latch = isinstance(each.leaf, Once)
            truth = fold(each.leaf.condition, visit) if is_latch else _is_true(each.leaf, task, states)
            return truth ^ each.negated
        truths: _Bools = np.reshape(parts, (-1, len(states)))  # also without parts
        joined: _Bools = np.all(truths, axis=0) if each.kind == "all" else np.any(truths, axis=0)
        return joined

    return fold(query.expression, visit)


def _is_true(clause: Clause, task: Task, states: _Floats) -> _Bools:
    """Evaluate a clause without torch, with the same precision and order of operations as QueryProgram."""
    second, shift = np.zeros((1, 3), np.float32), np.zeros(3)
    if clause.predicate in STATES:
        first = _position((0.0, 0.0, task.openings[clause.subject]), states)
    else:
        subject = task.object(clause.subject)
        first, shift = _position(subject.position, states), np.array(subject.offset)
        if clause.object is not None:
            other = task.object(clause.object)
            second, shift = _position(other.position, states), shift - other.offset
    truth = np.full(len(states), True)
    for part in comparisons(clause.predicate, task.layout):
        d = first - second + _floats(shift + np.array((0.0, 0.0, part.raise_z)))
        d = d[:, ["xyz".index(axis) for axis in part.axes]]
        value, threshold = np.sqrt((d * d).sum(1)) if part.length else d[:, 0], np.float32(part.threshold)
        truth &= {"<": value < threshold, ">": value > threshold, "<=": value <= threshold}[part.sense]
    return truth ^ clause.negated
