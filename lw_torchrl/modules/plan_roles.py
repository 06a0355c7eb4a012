"""PlanRoles: the way from what a plan's steps move to where it is to go."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor

from lw_torchrl._checks import check_scale
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.observation import FIRST, HAND, places
from lw_torchrl.language.plan_tables import PlanTables
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.roles import Roles, plan_roles, role_object
from lw_torchrl.language.skill_words import closes, presses, pushes
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.plan_ways import Pair, PlanWays
from lw_torchrl.transforms.random_yaw import turn_vectors


def _moved_to_target(task: Task, steps: Sequence[Roles]) -> list[list[Pair]]:
    of = role_object
    return [[(of(task, one.moved), of(task, one.target))] if one.moved and one.target else [] for one in steps]


class PlanRoles(PlanWays):
    """From the thing that a step moves to its target, mixed by the attention over the steps.

    "lower the gripper around the puck" and "lower the gripper around the mug" are the same motion along this way, so
    that what was learned in one task is of use in another: 9 features, 0 for a step without roles (see
    :func:`plan_roles`).

    Where the gripper acts on a thing whose position is not where it is touched, the way ends at the *contact*: what
    demonstrations of the task show, see :meth:`fit`. A task that was never demonstrated has the points that its plan's
    conditions name.

    Args:
        plans: the plans.
        tables: theirs.
        noise: standard deviation of the noise on each feature while training.
        jitter: standard deviation, in metres, by which the way is moved up and down, and by half of it to the sides,
            while training, where the gripper pushes or pulls: things are touched at other places in other tasks.

    Attributes:
        contact: (T, 3) float32 buffer, metres, a row for each task as in ``tables``: from the first object to the hand
            while this acts on it; saved with the module.
        fitted: () bool buffer, whether demonstrations were asked for contacts; saved with the module.

    Source: ours; as the keypoints of task-axis controllers, read from words.
    """

    contact: Tensor
    fitted: Tensor
    at_contact: Tensor
    acts: Tensor
    pushes: Tensor

    def __init__(self, plans: Plans, tables: PlanTables, noise: float = 0.0, jitter: float = 0.0) -> None:
        told = {task: plan_roles(plan) for task, plan in plans.items()}
        super().__init__(plans, tables, lambda plan: _moved_to_target(plan.definition, told[plan.task]), 1, noise)
        self.jitter = check_scale("jitter", jitter)
        self.tables = tables
        at_contact, acts, pushing = (torch.zeros(len(plans), plans.num_steps, dtype=torch.bool) for _ in range(3))
        for task, plan in plans.items():
            for step, (said, roles) in enumerate(zip(plan.steps, told[task], strict=True)):
                if not roles.moved or not roles.target:
                    continue
                at = (tables.index.row(task), step)
                first = {name: _is_first(plan, name) for name in (roles.target, roles.moved)}
                by_hand = roles.moved == GRIPPER
                at_contact[at] = by_hand and first[roles.target]
                pushing[at] = by_hand and pushes(said.skill)
                touches = closes(said.skill) or (pushes(said.skill) and not presses(said.skill))
                acts[at] = first[roles.moved] or (at_contact[at] and touches)
        self.register_buffer("at_contact", at_contact, persistent=False)
        self.register_buffer("acts", acts, persistent=False)
        self.register_buffer("pushes", pushing, persistent=False)
        self.register_buffer("contact", torch.zeros(len(plans), 3))
        self.register_buffer("fitted", torch.tensor(False))
        self._kin: WeakSet[PlanRoles] = WeakSet([self])  # those of actors with the same weights

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kin": None}  # a copy has weights of its own

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._kin = WeakSet([self])

    @torch.no_grad()
    def fit(self, observation: Tensor, weights: Tensor, rows: Tensor) -> None:
        """Take the contacts from demonstrations, in place: the median of hand minus object while a step is in force
        that closes the gripper around the first object, pushes or pulls it, or moves it. What is pressed from above
        has none: it is gone through.

        Args:
            observation: (R, 39) float32.
            weights: (R, S) float32, the attention.
            rows: (R,) int64, as from :meth:`PlanTables.rows`.
        """
        held = (weights * self.acts[rows]).sum(-1) > 0.5
        away = observation[:, HAND] - observation[:, FIRST]
        for row in rows[held].unique().tolist():
            self.contact[row] = away[held & (rows == row)].median(0).values
        self.fitted.fill_(True)
        for one in self._kin:
            if one is not self:
                one._copy(self)

    @torch.no_grad()
    def take_contact(self, other: PlanRoles) -> None:
        """The contacts of the same tasks under other plans, now and whenever either is fitted."""
        self._kin = other._kin
        self._kin.add(self)
        self._copy(other)

    def _copy(self, other: PlanRoles) -> None:
        self.fitted.copy_(other.fitted)
        for task in self.tables.index.tasks:
            if task in other.tables.index.tasks:
                self.contact[self.tables.index.row(task)] = other.contact[other.tables.index.row(task)]

    def ways(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """As :meth:`PlanWays.ways`, to the contact where there is one."""
        way = super().ways(observation, weights, rows, yaw)
        share = (weights * self.at_contact[rows]).sum(-1, keepdim=True)
        contact = share * self.contact[rows]
        way = way + (contact if yaw is None else turn_vectors(contact, yaw)).unsqueeze(-2)
        if self.training and self.jitter:
            scale = self.jitter * way.new_tensor([0.5, 0.5, 1.0])
            pushed = (weights * self.pushes[rows]).sum(-1)[..., None, None] > 0.5
            way = way + pushed * scale * torch.randn_like(way)
        return way


def _is_first(plan: ConditionalPlan, name: str) -> bool:
    """Whether a name is that of the first object itself, not of a point beside it."""
    thing = role_object(plan.definition, name)
    return thing.position == places(FIRST) and not any(thing.offset)
