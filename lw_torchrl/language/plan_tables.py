"""PlanTables: the plans of many tasks as tensors, with a row for each task."""

from __future__ import annotations

import torch
from torch import Tensor

from lw_torchrl.language.plans import Plans
from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.value_checks import asserted, plain, readable


class PlanTables:
    """What transforms, attention and actors read of plans.

    Attributes:
        index: from task ids to rows, T of them.
        mask: (T, S) bool, the steps that there are.
        skill_index: (T, S) int64, the number of each step's skill in ``plans.skills``; 0 beyond the last step.
        number: (T,) int64, the number of each plan, as in :attr:`Plans.numbers`.
    """

    def __init__(self, plans: Plans) -> None:
        self.index = TaskIndex(plans)
        self._problem = f"tasks without a plan in {plans!r}"
        self.mask = torch.zeros(len(plans), plans.num_steps, dtype=torch.bool)
        self.skill_index = torch.zeros(len(plans), plans.num_steps, dtype=torch.int64)
        skill = {text: number for number, text in enumerate(plans.skills)}
        for row, task in enumerate(self.index.tasks):
            steps = plans[task].steps
            self.mask[row, : len(steps)] = True
            self.skill_index[row, : len(steps)] = torch.tensor([skill[step.skill] for step in steps])
        numbers = plans.numbers
        self.number = torch.tensor([numbers[task] for task in self.index.tasks])

    def rows(self, task_id: Tensor) -> Tensor:
        """The row of each task, (...) int64 to (...) int64; a task without a plan is a :class:`ValueError`."""
        return self.index.rows(task_id, self._problem)

    def refuse_others(self, number: Tensor | None, rows: Tensor) -> None:
        """Raise :class:`ValueError` where queries were answered of other plans than those of ``rows``, (...) int64.

        ``number``, (...) int64, is that of the plan whose queries were answered; 0 where unknown, None for all.
        """
        if number is None:
            return
        numbers = self.number
        if number.device != numbers.device:
            numbers = numbers.to(number.device)
            if plain(number, rows):
                self.number = numbers
        if asserted(number, rows):
            own = numbers[rows]
            torch._assert_async(((own == number) | (number == 0)).all(), "qaf answers other plans than the actor's")
        if not readable(number, rows):
            return
        own = numbers[rows]
        if not torch.equal(own, number) and (wrong := (own != number) & (number != 0)).any():
            tasks = ", ".join(self.index.tasks[row] for row in rows[wrong].unique().tolist()[:5])
            raise ValueError(
                f"qaf answers other plans than the actor's, for {tasks}: give QAFTransform the actor's plans, "
                "QAFTransform(actor.plans), or the actor those of QAFTransform, actor.with_plans(plans)"
            )
