"""Training observations in which what a plan's steps do not mention stands somewhere else."""

from __future__ import annotations

import re

import torch
from torch import Tensor

from lw_torchrl.language.observation import (
    FIRST,
    FIRST_QUATERNION,
    GOAL,
    OPENING,
    SECOND,
    SECOND_QUATERNION,
    a_step_before,
    places,
)
from lw_torchrl.language.plans import Plans, PlanStep
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.relative_positions import PlanRoles

# The numbers of each thing that an observation tells of, now and a step before: two objects, with their quaternions,
# and the goal, which has no past.
_THINGS = (slice(FIRST.start, FIRST_QUATERNION.stop), slice(SECOND.start, SECOND_QUATERNION.stop))
_PARTS = (*((thing, a_step_before(thing)) for thing in _THINGS), (GOAL,))
_PLACES = tuple({number for part in parts for number in places(part)} for parts in _PARTS)


def _names(step: PlanStep, task: Task) -> set[str]:
    names = {name for clause in step.condition.clauses for name in (clause.subject, clause.object) if name}
    text = step.skill
    for name in sorted(task.object_names, key=len, reverse=True):  # "drawer handle" is no "drawer"
        text, found = re.subn(rf"(?<![\w-]){re.escape(name)}(?![\w-])", " ", text)
        if found:
            names.add(name)
    return names


def mentioned(plans: Plans, tables: PlanTables, roles: PlanRoles | None = None) -> Tensor:
    """(T, S, 3) bool: whether a step mentions the first object, the second, the goal; with ``roles``, or moves it."""
    table = torch.zeros(len(plans), plans.num_steps, len(_PLACES), dtype=torch.bool)
    for task, plan in plans.items():
        for number, step in enumerate(plan.steps):
            for name in _names(step, plan.definition):
                for thing, place in enumerate(_PLACES):
                    if place.intersection(plan.definition.object(name).position):
                        table[tables.index.row(task), number, thing] = True
    if roles is not None:
        ends = torch.cat((roles.begin, roles.end), -1).flatten(2)  # (T, S, 6)
        for thing, place in enumerate(_PLACES):
            table[..., thing] |= torch.isin(ends, torch.tensor(sorted(place))).any(-1)
    return table


def swap_unmentioned(observation: Tensor, kept: Tensor, probability: float) -> Tensor:
    """Put what no step in force mentions where it is in another row of the batch.

    So a policy cannot rely on it: in one demonstration everything stands in one constellation, and the hand's way to
    the goal can as well be told from an object that has nothing to do with it. Drawn from PyTorch's global generator.

    ``kept`` (..., 3) bool tells whether the first object, the second and the goal are mentioned.
    """
    rows, kept = observation.reshape(-1, observation.shape[-1]), kept.reshape(-1, len(_PLACES))
    swapped, number, device = rows.clone(), len(rows), observation.device
    for thing, parts in enumerate(_PARTS):
        away = ~kept[:, thing] & (torch.rand(number, device=device) < probability)
        others = rows[torch.randint(number, (number,), device=device)]
        for part in parts:
            swapped[:, part] = torch.where(away.unsqueeze(-1), others[:, part], rows[:, part])
    return swapped.reshape(observation.shape)


def hide_opening(observation: Tensor, kept: Tensor, probability: float) -> Tensor:
    """Observations (..., 39) where the gripper's opening may be another row's, but where it is ``kept`` (...) bool."""
    opening = observation[..., OPENING]
    others = opening.flatten()[torch.randint(opening.numel(), opening.shape, device=opening.device)]
    hidden = torch.rand_like(opening) < probability
    observation = observation.clone()
    observation[..., OPENING] = torch.where(hidden & ~kept, others, opening)
    return observation
