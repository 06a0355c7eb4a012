"""coverage: whether a plan's conditions fit its motion, from typical states that are made up."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.files import read_toml
from lw_torchrl.language.layout import places
from lw_torchrl.language.objects import Coordinate
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.relations import STATES, comparisons
from lw_torchrl.language.roles import Verb
from lw_torchrl.language.tasks import Task, role_object

Floats = NDArray[np.float32]
_OBJECTS = ((0.0, 0.6, 0.02), (0.2, 0.7, 0.02), (-0.2, 0.7, 0.02), (0.0, 0.8, 0.02))
_GOAL = (0.1, 0.8, 0.2)
_MOTIONS = read_toml(files("lw_torchrl.language") / "data" / "motions.toml", ValueError)
_MOTIONS |= {motion: _MOTIONS["coming"] + _MOTIONS[motion] for motion in ("grasp", "pull")}
_TYPICAL = {
    motion: [(offset, opening, lift, {*verbs.split()}) for hands, opening, lift, verbs in rows for offset in hands]
    for motion, rows in _MOTIONS.items()
}


def coverage(task: Task, point: str, motion: str, steps: Sequence[tuple[Query, Verb]]) -> float:
    """Return the fraction of the typical states of a ``motion`` at a point in which at least one step is active and
    every active step does what the motion needs; ``steps`` are conditions and verbs."""
    good = 0
    for offset, opening, lift, verbs in _TYPICAL[motion]:
        state = _state(task, point, offset, opening, lift)
        active = {verb for query, verb in steps if all(_holds(clause, task, state) for clause in query.clauses)}
        good += bool(active) and active <= verbs
    return good / len(_TYPICAL[motion])


def _state(task: Task, point: str, offset: Sequence[float], opening: float, lift: float) -> Floats:
    touched, layout = role_object(task, point), task.layout
    state = np.zeros(layout.size, np.float32)
    for place, xyz in zip(layout.positions[1:-1], _OBJECTS, strict=False):
        state[place] = xyz
    state[layout.positions[-1]] = _GOAL
    if at := [number for number in touched.position if isinstance(number, int)]:
        state[at[-1]] += np.float32(lift)
    hand = _position(touched.position, state) + _floats(touched.offset) + _floats(offset)
    state[list(places(layout.positions[0]))] = hand
    state[layout.opening] = opening
    return state


def _floats(numbers: Sequence[float]) -> Floats:
    return np.array(numbers, np.float32)


def _position(position: Sequence[Coordinate], state: Floats) -> Floats:
    return _floats([state[at] if isinstance(at, int) else at for at in position])


def _holds(clause: Clause, task: Task, state: Floats) -> bool:
    """Return the truth of a clause, with the precision and the order of operations of QueryProgram."""
    second, shift = _floats((0.0, 0.0, 0.0)), np.zeros(3)
    if clause.predicate in STATES:
        first = _floats((0.0, 0.0, state[task.openings[clause.subject]]))
    else:
        subject = task.object(clause.subject)
        first, shift = _position(subject.position, state), np.array(subject.offset)
        if clause.object is not None:
            other = task.object(clause.object)
            second, shift = _position(other.position, state), shift - other.offset
    truth = True
    for part in comparisons(clause.predicate, task.layout):
        d = first - second + _floats(shift + np.array((0.0, 0.0, part.raise_z)))
        d = d[["xyz".index(axis) for axis in part.axes]]
        value, threshold = np.sqrt((d * d).sum()) if part.length else d[0], np.float32(part.threshold)
        truth &= bool({"<": value < threshold, ">": value > threshold, "<=": value <= threshold}[part.sense])
    return truth != clause.negated
