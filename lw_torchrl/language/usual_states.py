"""Usual states of a motion, made up: where the hand may be, and what a plan should do there."""

from __future__ import annotations

from collections.abc import Sequence

from lw_torchrl.language.queries import Query
from lw_torchrl.language.tasks import Task, task_id
from lw_torchrl.language.things import role_object
from lw_torchrl.language.wording import Verb

_THINGS = ((0.0, 0.6, 0.02), (0.2, 0.7, 0.02), (-0.2, 0.7, 0.02), (0.0, 0.8, 0.02))
_State = tuple[tuple[float, float, float], float, float, frozenset[str]]


def _usual(*rows: tuple[Sequence[tuple[float, float, float]], float, float, str]) -> list[_State]:
    return [(at, opening, lift, frozenset(verbs.split())) for hands, opening, lift, verbs in rows for at in hands]


_COMING = (
    ([(0.1, 0.1, 0.15), (-0.1, -0.05, 0.1)], 1.0, 0.0, "approach"),
    ([(0.0, 0.0, 0.12), (0.008, 0.0, 0.06)], 1.0, 0.0, "descend"),
)
_USUAL: dict[str, list[_State]] = {
    "grasp": _usual(
        *_COMING,
        ([(0.0, 0.0, 0.01), (0.01, -0.01, 0.02), (0.0, 0.01, 0.0)], 1.0, 0.0, "close"),
        ([(0.0, 0.0, 0.01), (0.01, 0.0, 0.02), (0.0, 0.0, -0.01)], 0.4, 0.0, "close carry move"),
        ([(0.0, 0.0, 0.01), (0.01, 0.0, 0.02), (0.0, 0.0, -0.01)], 0.4, 0.1, "carry move"),
    ),
    "pull": _usual(*_COMING, ([(0.0, 0.0, -0.01), (0.01, -0.01, -0.02), (0.0, 0.01, -0.03)], 1.0, 0.0, "pull")),
    "press": _usual(
        ([(0.1, 0.1, 0.15)], 0.3, 0.0, "approach"),
        ([(0.0, 0.0, 0.1)], 0.3, 0.0, "push approach"),
        ([(0.005, 0.0, 0.06), (0.005, 0.0, 0.03), (0.005, 0.0, 0.01)], 0.3, 0.0, "push"),
    ),
    "push": _usual(
        ([(0.15, 0.1, 0.15)], 0.3, 0.0, "approach beside"),
        ([(0.0, 0.0, 0.12)], 0.3, 0.0, "beside descend approach"),
        (
            [(0.0, 0.0, 0.0), (0.01, 0.0, 0.01), (0.0, 0.015, 0.0), (-0.015, 0.0, 0.0), (0.0, 0.0, 0.02)],
            0.3,
            0.0,
            "push",
        ),
    ),
}
"""Where the hand may be from where it touches, metres; the gripper's opening; how far the thing was lifted, metres;
and the verbs that do there what the motion needs."""


def covered(task: Task, point: str, motion: str, steps: Sequence[tuple[Query, Verb]]) -> float:
    """In which share of the usual states of a ``motion`` at a point a step is in force, and all that are do what the
    motion needs; ``steps`` are conditions and verbs."""
    import torch  # here, since words alone should not wait for it

    from lw_torchrl.language.query_program import QueryProgram

    touched, layout = role_object(task, point), task.layout
    states, wanted = [], []
    for offset, opening, lift, verbs in _USUAL[motion]:
        state = torch.zeros(layout.size)
        for place, xyz in zip(layout.positions[1:-1], _THINGS, strict=False):
            state[place] = torch.tensor(xyz)
        state[layout.positions[-1]] = torch.tensor((0.1, 0.8, 0.2))
        at = [number for number in touched.position if isinstance(number, int)]
        if at:
            state[at[-1]] += lift
        where = [state[number] if isinstance(number, int) else torch.tensor(number) for number in touched.position]
        state[layout.positions[0]] = torch.stack(where) + torch.tensor(touched.offset) + torch.tensor(offset)
        state[layout.opening] = opening
        states.append(state)
        wanted.append(verbs)
    program = QueryProgram({task: [condition for condition, _ in steps]})
    truth = program(torch.stack(states), torch.full((len(states),), task_id(task.name)))
    good = 0
    for holds, verbs in zip(truth.tolist(), wanted, strict=True):
        in_force = {verb for (_, verb), true in zip(steps, holds, strict=True) if true}
        good += bool(in_force) and in_force <= verbs
    return good / len(states)
