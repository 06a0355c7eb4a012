"""Relative positions of the things that a plan's steps speak of, as features of a policy: PlanFocus and PlanRoles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor, nn

from lw_torchrl._checks import check_scale
from lw_torchrl.language.canonical_steps import VECTORS, CanonicalPlan
from lw_torchrl.language.layout import places
from lw_torchrl.language.named_objects import GOAL, GRIPPER, NamedObject, coordinate_indices
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.task_objects import role_object
from lw_torchrl.modules.observation_features import squash
from lw_torchrl.transforms.random_yaw import turn_observation, turn_vectors

_SCALE = 0.1  # metres
_FAR = 0.25  # metres, beyond which demonstrations say nothing
_LIFTED = 0.15  # metres above its target, on the way there
_AWAY = 0.15  # metres: a place to the left, for what is moved to the left
Pair = tuple[NamedObject, NamedObject]


class RelativePositions(nn.Module):
    """The positions of things relative to others, mixed by the attention over the steps: 9·P features, three
    differences of each pair, in units of 10 cm, and through tanh at 2 cm and at 10 cm.

    ``pairs`` gives of a plan, for each step, up to ``number`` P pairs: the thing from which, and the thing to which. A
    step that has fewer has 0 there. ``noise`` is each feature's standard deviation while training.
    """

    begin: Tensor
    end: Tensor
    offset: Tensor
    constants: Tensor

    def __init__(
        self,
        plans: Plans,
        tables: PlanTables,
        pairs: Callable[[ConditionalPlan], Sequence[Sequence[Pair]]],
        number: int,
        noise: float = 0.0,
    ) -> None:
        super().__init__()
        self.noise = check_scale("feature_noise", noise)
        self.width = 9 * number
        constants = [0.0]
        shape = (len(plans), plans.num_steps, number, 3)
        self.layout, size = plans.layout, plans.layout.size
        index = torch.full((2, *shape), size)  # the constant 0
        offset = torch.zeros(shape)
        for task, plan in plans.items():
            for step, found in enumerate(pairs(plan)):
                for one, ends in enumerate(found):
                    at = (tables.index.row(task), step, one)
                    for side, thing in enumerate(ends):
                        index[(side, *at)] = torch.tensor(coordinate_indices(thing.position, constants, size))
                        offset[at] += torch.tensor(thing.offset) * (2 * side - 1)
        # The tables come from the plans, not from training: they are not part of the state that is saved.
        self.register_buffer("begin", index[0], persistent=False)
        self.register_buffer("end", index[1], persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.register_buffer("constants", torch.tensor(constants), persistent=False)

    def positions(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """(..., 39) float32, attention (..., S) float32 and rows (...) int64, as from :meth:`PlanTables.rows`, to
        (..., P, 3) float32 metres. Fixed places and offsets are turned by ``yaw`` (...) float32, that of RandomYaw."""
        if yaw is not None:
            observation = turn_observation(observation, -yaw, self.layout)
        found = (weights[..., None, None] * self.of_steps(observation, rows)).sum(-3)
        return found if yaw is None else turn_vectors(found, yaw.unsqueeze(-1))

    def of_steps(self, observation: Tensor, rows: Tensor) -> Tensor:
        """(..., 39) float32 and rows (...) int64 to (..., S, P, 3) float32 metres, the positions of each step."""
        known = torch.cat((observation, self.constants.expand(*observation.shape[:-1], -1)), -1)
        begin, end = self.begin[rows], self.end[rows]  # (..., S, P, 3)
        flat = (*begin.shape[: rows.ndim], -1)
        found = (known.gather(-1, end.reshape(flat)) - known.gather(-1, begin.reshape(flat))).reshape(begin.shape)
        return found + self.offset[rows]

    def forward(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """As :meth:`positions`, to (..., 9·P) float32 features."""
        position = self.positions(observation, weights, rows, yaw).flatten(-2)
        found = torch.cat((position / _SCALE, *squash(position)), -1)
        return found + self.noise * torch.randn_like(found) if self.training and self.noise else found


def _compared(plan: ConditionalPlan) -> list[list[Pair]]:
    of = plan.definition.object
    each = [[(of(c.subject), of(c.object)) for c in step.condition.clauses if c.object] for step in plan.steps]
    return [[found[0], found[-1]] if found else [] for found in each]


class PlanFocus(RelativePositions):
    """From the subject to the object of the conditions' clauses, mixed by the attention over the steps.

    A step's condition names what its skill is about: "the gripper is above the handle and not near the handle". So the
    position of the handle relative to the gripper stands in the same place as that of the puck in another task, and
    what was learned there is of use here. Of each step the first and last clause with two things: 18 features, or 0s.
    """

    def __init__(self, plans: Plans, tables: PlanTables, noise: float = 0.0) -> None:
        super().__init__(plans, tables, _compared, 2, noise)


class PlanRoles(RelativePositions):
    """From the thing that a step moves to its target, mixed by the attention over the steps, and the step's direction.

    "lower the gripper around the puck" and "... the mug" are the same motion in this relative position, so that what
    was learned in one task is of use in another: 12 features, the 9 of a relative position and a unit vector, which is
    0 for a step without a direction. "push the dial to the right" points right, "push it toward the target location"
    from the thing to the goal. Positions farther than 25 cm count as 25 cm away.

    Where the gripper acts on a thing that is touched beside its position, the target is that of the *contact*, which
    demonstrations of the task show, see :meth:`fit`; a task without any has the points that it names. What is carried
    in such a task is lifted first, to 15 cm above its target, and comes down over it.

    ``jitter`` is the standard deviation, in metres, of the noise on the position's height while training, and half of
    it to the sides, where the gripper pushes or pulls. Saved with the module are ``contact`` (T, 3) float32, metres, a
    row for each task, from the first object to the hand while this acts on it, ``demonstrated`` (T,) bool, the tasks
    with demonstrations, and ``fitted`` () bool, whether demonstrations were asked for contacts.

    Source: ours; as the keypoints of task-axis controllers, read from words.
    """

    contact: Tensor
    demonstrated: Tensor
    fitted: Tensor
    at_contact: Tensor
    acts: Tensor
    pushes: Tensor
    lifts: Tensor
    direction: Tensor

    def __init__(
        self, canonical: Mapping[str, CanonicalPlan], tables: PlanTables, noise: float = 0.0, jitter: float = 0.0
    ) -> None:
        def moved_to_target(plan: ConditionalPlan) -> list[list[Pair]]:
            steps = canonical[plan.task].every_step
            return [[tuple(role_object(plan.definition, name) for name in (one.moved, one.target))] for one in steps]  # type: ignore[list-item]

        def ahead(plan: ConditionalPlan) -> list[list[Pair]]:
            task = plan.definition
            x, y, z = places(task.layout.positions[1])
            thing = NamedObject("first thing", (x, y, z))
            return [
                [(thing, role_object(task, step.toward or GOAL))] if step.direction == "goal" else []
                for step in canonical[plan.task].every_step
            ]

        plans = Plans([one.plan for one in canonical.values()])
        super().__init__(plans, tables, moved_to_target, 1, noise)
        self.width += 3
        self.jitter = check_scale("jitter", jitter)
        self.tables = tables
        shape = len(plans), plans.num_steps
        at_contact, acts, pushes, lifts = (torch.zeros(shape, dtype=torch.bool) for _ in range(4))
        direction = torch.zeros(*shape, 3)
        for task, found in canonical.items():
            for number, step in enumerate(found.every_step):
                at = (tables.index.row(task), number)
                by_hand, way = step.moved == GRIPPER, torch.tensor(VECTORS.get(step.direction or "", (0.0,) * 3))
                at_contact[at] = by_hand and _is_first(found.written, step.target)
                touches = step.verb in ("close", "pull") or (step.verb == "push" and step.manner == "push")
                acts[at] = _is_first(found.written, step.moved) or (at_contact[at] and touches)
                pushes[at] = step.verb in ("push", "pull")
                lifts[at] = step.verb == "carry"
                if step.verb == "move":  # a place beside where it is
                    self.offset[at] += _AWAY * way
                else:
                    direction[at] = way
        for name, table in (("at_contact", at_contact), ("acts", acts), ("pushes", pushes), ("lifts", lifts)):
            self.register_buffer(name, table, persistent=False)
        self.register_buffer("direction", direction, persistent=False)
        self.ahead = RelativePositions(plans, tables, ahead, 1)
        self.register_buffer("contact", torch.zeros(len(plans), 3))
        self.register_buffer("demonstrated", torch.zeros(len(plans), dtype=torch.bool))
        self.register_buffer("fitted", torch.tensor(False))
        self._sharing: WeakSet[PlanRoles] = WeakSet([self])  # those of actors with the same weights

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_sharing": None}  # a copy has weights of its own

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._sharing = WeakSet([self])

    @torch.no_grad()
    def fit(self, observation: Tensor, weights: Tensor, rows: Tensor) -> None:
        """Take the contacts from demonstrations, observations (R, 39) and attention (R, S) float32 with their rows (R,)
        int64, in place: the median of hand minus object while a step is in force that closes the gripper around the
        first object, pushes or pulls it, or moves it, but not where it is pressed from above."""
        held = (weights * self.acts[rows]).sum(-1) > 0.5
        hand, first, *_ = self.layout.positions
        away = observation[:, hand] - observation[:, first]
        for row in rows[held].unique().tolist():
            self.contact[row] = away[held & (rows == row)].median(0).values
        self.demonstrated[rows.unique()] = True
        self.fitted.fill_(True)
        for one in self._sharing:
            if one is not self:
                one._copy(self)

    @torch.no_grad()
    def share_contact(self, other: PlanRoles) -> None:
        """Have the contacts of the same tasks under other plans, now and whenever either is fitted."""
        self._sharing = other._sharing
        self._sharing.add(self)
        self._copy(other)

    def _copy(self, other: PlanRoles) -> None:
        self.fitted.copy_(other.fitted)
        for task in {*self.tables.index.tasks} & {*other.tables.index.tasks}:
            own, theirs = self.tables.index.row(task), other.tables.index.row(task)
            self.contact[own], self.demonstrated[own] = other.contact[theirs], other.demonstrated[theirs]

    def of_steps(self, observation: Tensor, rows: Tensor) -> Tensor:
        """As :meth:`RelativePositions.of_steps`, of the contact where there is one; what is carried is lifted first."""
        found = super().of_steps(observation, rows)
        found = found + (self.at_contact[rows][..., None] * self.contact[rows].unsqueeze(-2)).unsqueeze(-2)
        lifts = (self.lifts[rows] & ~self.demonstrated[rows].unsqueeze(-1))[..., None, None]
        beside, height = found[..., :2], found[..., 2:]
        far = beside.norm(dim=-1, keepdim=True)
        height = height + lifts * _LIFTED * ((far - 0.03) / 0.04).clamp(0.0, 1.0)
        rising = torch.where(lifts, ((0.06 - height) / 0.04).clamp(0.0, 1.0), 1.0)
        return torch.cat((beside * rising, height), -1)

    def positions(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """As :meth:`RelativePositions.positions`, with ``jitter`` while training."""
        found = super().positions(observation, weights, rows, yaw)
        if self.training and self.jitter:
            scale = self.jitter * found.new_tensor([0.5, 0.5, 1.0])
            pushed = (weights * self.pushes[rows]).sum(-1)[..., None, None] > 0.5
            found = found + pushed * scale * torch.randn_like(found)
        return found

    def directions(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """As :meth:`positions`, to (..., 3) float32, the direction of the step in force."""
        if yaw is not None:
            observation = turn_observation(observation, -yaw, self.layout)
        ahead = self.ahead.of_steps(observation, rows).squeeze(-2)
        each = self.direction[rows] + ahead / ahead.norm(dim=-1, keepdim=True).clamp(min=0.02)
        found = (weights.unsqueeze(-1) * each).sum(-2)
        return found if yaw is None else turn_vectors(found, yaw)

    def forward(
        self,
        observation: Tensor,
        weights: Tensor,
        rows: Tensor,
        yaw: Tensor | None = None,
        tilt: Tensor | None = None,
    ) -> Tensor:
        """As :meth:`positions`, to (..., 12) float32 features; ``tilt`` (..., 3, 3) float32 is that of RandomYaw."""
        position = self.positions(observation, weights, rows, yaw).flatten(-2)
        if tilt is not None:
            position = (tilt @ position.unsqueeze(-1)).squeeze(-1)
        position = position * (_FAR / position.norm(dim=-1, keepdim=True).clamp(min=_FAR))
        found = torch.cat((position / _SCALE, *squash(position), self.directions(observation, weights, rows, yaw)), -1)
        return found + self.noise * torch.randn_like(found) if self.training and self.noise else found


def _is_first(plan: ConditionalPlan, name: str) -> bool:
    """Whether a name is that of the first object itself, not of a point beside it."""
    thing = role_object(plan.definition, name)
    return thing.position == places(plan.definition.layout.things[0].xyz) and not any(thing.offset)
