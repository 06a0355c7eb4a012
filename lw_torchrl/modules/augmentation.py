"""Training observations in which what a plan's steps do not mention stands somewhere else."""

from __future__ import annotations

import re

import torch
from torch import Tensor

from lw_torchrl.language.layout import METAWORLD, Layout, places
from lw_torchrl.language.plans import Plans, PlanStep
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.relative_positions import PlanRoles


def _names(step: PlanStep, task: Task) -> set[str]:
    names = {name for clause in step.condition.clauses for name in (clause.subject, clause.object) if name}
    text = step.skill
    for name in sorted(task.object_names, key=len, reverse=True):  # "drawer handle" is no "drawer"
        text, found = re.subn(rf"(?<![\w-]){re.escape(name)}(?![\w-])", " ", text)
        if found:
            names.add(name)
    return names


def mentioned(plans: Plans, tables: PlanTables, roles: PlanRoles | None = None) -> Tensor:
    """(T, S, P) bool: whether a step mentions each thing of the layout, and the goal; with ``roles``, or moves it."""
    of_parts = [{number for part in parts for number in places(part)} for parts in plans.layout.parts]
    table = torch.zeros(len(plans), plans.num_steps, len(of_parts), dtype=torch.bool)
    for task, plan in plans.items():
        for number, step in enumerate(plan.steps):
            for name in _names(step, plan.definition):
                for thing, place in enumerate(of_parts):
                    if place.intersection(plan.definition.object(name).position):
                        table[tables.index.row(task), number, thing] = True
    if roles is not None:
        ends = torch.cat((roles.begin, roles.end), -1).flatten(2)  # (T, S, 6)
        for thing, place in enumerate(of_parts):
            table[..., thing] |= torch.isin(ends, torch.tensor(sorted(place))).any(-1)
    return table


def swap_unmentioned(observation: Tensor, kept: Tensor, probability: float, layout: Layout = METAWORLD) -> Tensor:
    """Put what no step in force mentions where it is in another row of the batch.

    So a policy cannot rely on it: in one demonstration everything stands in one constellation, and the hand's way to
    the goal can as well be told from an object that has nothing to do with it. Drawn from PyTorch's global generator.

    ``kept`` (..., P) bool tells whether each thing of the layout, and the goal, are mentioned.
    """
    rows, kept = observation.reshape(-1, observation.shape[-1]), kept.reshape(-1, len(layout.parts))
    swapped, number, device = rows.clone(), len(rows), observation.device
    for thing, parts in enumerate(layout.parts):
        away = ~kept[:, thing] & (torch.rand(number, device=device) < probability)
        others = rows[torch.randint(number, (number,), device=device)]
        for part in parts:
            swapped[:, part] = torch.where(away.unsqueeze(-1), others[:, part], rows[:, part])
    return swapped.reshape(observation.shape)


def hide_opening(observation: Tensor, kept: Tensor, probability: float, layout: Layout = METAWORLD) -> Tensor:
    """Observations (..., D) where the gripper's opening may be another row's, but where it is ``kept`` (...) bool."""
    opening = observation[..., layout.opening]
    others = opening.flatten()[torch.randint(opening.numel(), opening.shape, device=opening.device)]
    hidden = torch.rand_like(opening) < probability
    observation = observation.clone()
    observation[..., layout.opening] = torch.where(hidden & ~kept, others, opening)
    return observation
