"""Some steps of some plans, picked out: which there are, and how much they are in force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lw_torchrl._checks import check_choice, check_int, shown
from lw_torchrl.language.plan_tables import PlanTables
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.plan_encoder import IN_FORCE


def check_steps(steps: Any, plans: Plans) -> dict[str, list[int]]:
    """Steps of plans as JSON, the tasks sorted and their steps too.

    Args:
        steps: task name to the numbers of some of its plan's steps, counted from 0.
        plans: the plans.

    Raises:
        ValueError: a task that has no plan (with the nearest), a step that its plan does not have, one twice, or none.
        TypeError: it is no such mapping.

    Example:
        >>> import lw_torchrl as lw
        >>> check_steps({"pick-place": (3, 1)}, lw.load_plans("MT10"))
        {'pick-place': [1, 3]}
    """
    if not isinstance(steps, Mapping):
        raise TypeError(f"steps must map names of tasks to steps of their plans, got {shown(steps)}")
    if not steps:
        raise ValueError("steps must name a step of a plan at least, got none")
    found = {}
    for task, numbers in steps.items():
        there = len(plans[check_choice("steps: task", task, plans)].steps)
        where = f"steps of {task!r}"
        if isinstance(numbers, str) or not isinstance(numbers, Sequence):
            raise TypeError(f"{where} must be a list of numbers, got {shown(numbers)}")
        if len(numbers) > there:
            raise ValueError(f"{where} must be different ones of its plan's {there}, got {len(numbers)}")
        found[task] = sorted(check_int(where, number, minimum=0) for number in numbers)
        if not found[task] or len(set(found[task])) != len(found[task]):
            raise ValueError(f"{where} must be different ones of its plan's {there}, got {shown(numbers)}")
        if found[task][-1] >= there:
            raise ValueError(f"{where} must be from 0 to {there - 1}, got {shown(found[task][-1])}")
    return dict(sorted(found.items()))


def check_same_skills(steps: Mapping[str, Sequence[int]], plans: Plans, others: Plans) -> None:
    """Raise :class:`ValueError` unless the steps are in other plans too, with the skills of ``plans``."""
    for task, numbers in check_steps(steps, others).items():
        for number in numbers:
            ours, theirs = plans[task].steps[number].skill, others[task].steps[number].skill
            if ours != theirs:
                raise ValueError(f"steps of {task!r}: step {number} must have the skill {ours!r}, got {theirs!r}")


def as_table(steps: Mapping[str, Sequence[int]], tables: PlanTables) -> Tensor:
    """(T, S) bool, a row for each task as in ``tables``: true of the steps."""
    found = torch.zeros_like(tables.mask)
    for task, numbers in steps.items():
        found[tables.index.tasks.index(task), list(numbers)] = True
    return found


def weight_in_force(weights: Tensor, chosen: Tensor) -> Tensor:
    """How much of the attention is on chosen steps, from 0 to 1, and exactly 0 where none of them is in force.

    A step beside one whose condition holds has a weight of 1e-4 where its own does not: that is not in force.

    Args:
        weights: (B, S) float32, the attention.
        chosen: (B, S) bool.

    Returns:
        (B, 1) float32.

    Example:
        >>> weights = torch.tensor([[1e-4, 0.9999], [0.5, 0.5]])
        >>> weight_in_force(weights, torch.tensor([True, False]).expand(2, 2)).flatten().tolist()
        [0.0, 0.5]
    """
    return weights.masked_fill(~chosen | (weights <= IN_FORCE), 0.0).sum(-1, keepdim=True)
