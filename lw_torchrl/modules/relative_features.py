"""FocusFeatures and RoleFeatures: relative positions of the objects that a plan's active steps refer to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any
from weakref import WeakSet

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._util.devices import check_finite
from lw_torchrl._util.keys import Keys, as_keys, key_beside, read
from lw_torchrl.language.layout import places
from lw_torchrl.language.objects import GOAL, GRIPPER, NamedObject, coordinate_indices
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, as_plans
from lw_torchrl.language.roles import VECTORS, StepRole
from lw_torchrl.language.task_index import PlanTables, one_per_row, pick
from lw_torchrl.language.tasks import role_object
from lw_torchrl.modules.attention import PlanAttention
from lw_torchrl.modules.features import Features, check_observation, squash
from lw_torchrl.transforms.augmentation import role_table
from lw_torchrl.transforms.qaf import plan_program
from lw_torchrl.transforms.random_yaw import turn_observation, turn_vectors

_SCALE = 0.1  # metres, the unit of positions in the features
_FAR = 0.25  # metres; longer relative positions, which are rare in demonstrations, are shortened to this length
_LIFTED = 0.15  # metres, the height at which an object is carried above its target
_AWAY = 0.15  # metres, the distance from the puck to the target of "move the puck to the left"
_KEYS = ("observation", "skill_weights", "task_id")
Pair = tuple[NamedObject, NamedObject]


class _RelativePositions(Features):
    """Base class for features that average relative positions of objects over plan steps, weighted by attention.

    ``pairs`` returns at most ``number`` = P pairs of objects for each plan step. The features contain the position of
    each pair's second object relative to the first, and zeros for missing pairs.
    """

    begin: Tensor
    end: Tensor
    offset: Tensor
    constants: Tensor

    def __init__(
        self,
        plans: AnyPlans,
        pairs: Callable[[ConditionalPlan], Sequence[Sequence[Pair]]],
        number: int,
        noise: float = 0.0,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        super().__init__(noise, as_keys("in_keys", in_keys, _KEYS), out_keys)
        self.plans = plans = as_plans(plans)
        self.tables = PlanTables(plans)
        self.width = 9 * number
        # A coordinate is an index into the observation with constants appended: the coordinates of fixed positions.
        # The first constant is 0. For a missing pair, both coordinates are this constant.
        constants = [0.0]
        shape = (len(plans), plans.num_steps, number, 3)
        self.layout, size = plans.layout, plans.layout.size
        index, offset = torch.full((2, *shape), size), torch.zeros(shape, dtype=torch.float32)
        for task, plan in plans.items():
            for step, pairs_of_step in enumerate(pairs(plan)):
                for place, pair in enumerate(pairs_of_step):
                    at = (self.tables.index.row(task), step, place)
                    for side, item in enumerate(pair):
                        index[(side, *at)] = torch.tensor(coordinate_indices(item.position, constants, size))
                        offset[at] += torch.tensor(item.offset, dtype=torch.float32) * (2 * side - 1)
        # The tables are computed from the plans, so the state_dict does not need them.
        self.register_buffer("begin", index[0], persistent=False)
        self.register_buffer("end", index[1], persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.register_buffer("constants", torch.tensor(constants, dtype=torch.float32), persistent=False)

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that reconstruct this module."""
        return {"plans": self.plans, "noise": self.noise, "in_keys": self.in_keys, "out_keys": self.out_keys_source}

    def with_plans(self, plans: AnyPlans) -> Any:
        """Return the same features for another set of plans."""
        return type(self)(**{**self.config, "plans": plans}).to(self.offset.device).train(self.training)

    def positions(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """Average relative positions (..., P, 3) in metres over plan steps, with the attention ``weights`` (..., S).

        ``rows`` (...) are task indices; ``yaw`` (...) is the angle in radians by which :class:`RandomYaw` rotated the
        observation (..., D).
        """
        if yaw is not None:  # fixed positions and offsets refer to the scene before its rotation
            observation = turn_observation(observation, -yaw, self.layout)
        positions = (weights[..., None, None] * self.of_steps(observation, rows)).sum(-3)
        return positions if yaw is None else turn_vectors(positions, yaw.unsqueeze(-1))

    def of_steps(self, observation: Tensor, rows: Tensor) -> Tensor:
        """Return the relative positions of each plan step, (..., S, P, 3) in metres."""
        numbers = torch.cat((observation, self.constants.expand(*observation.shape[:-1], -1)), -1)
        begin, end = pick(self.begin, rows), pick(self.end, rows)  # (..., S, P, 3)
        flat = (*begin.shape[: rows.ndim], begin.shape[rows.ndim :].numel())
        positions = numbers.gather(-1, end.reshape(flat)) - numbers.gather(-1, begin.reshape(flat))
        return positions.reshape(begin.shape) + pick(self.offset, rows)

    def _inputs(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        observation, weights, task_id = read(tensordict, self.in_keys)
        check_observation(observation, self.layout)
        check_finite("observation", observation)
        yaw = tensordict.get(key_beside(self.in_keys[0], "_yaw"), None)
        rows = self.tables.rows(one_per_row(task_id, observation))
        return observation.to(self.offset.dtype), weights.to(self.offset.dtype), rows, yaw

    def compute(self, tensordict: TensorDictBase) -> Tensor:
        position = self.positions(*self._inputs(tensordict)).flatten(-2)
        return torch.cat((position / _SCALE, *squash(position)), -1)


def _compared(plan: ConditionalPlan) -> list[list[Pair]]:
    """Return, for each plan step, the objects in the first and in the last clause that compares two objects."""
    item = plan.definition.object
    steps = [[(item(c.subject), item(c.object)) for c in step.condition.clauses if c.object] for step in plan.steps]
    return [[pairs[0], pairs[-1]] if pairs else [] for pairs in steps]


class FocusFeatures(_RelativePositions):
    """Relative positions of the objects that the conditions of the active plan steps compare.

    The same features contain the handle's position relative to the gripper in one task and the puck's in another task,
    so the policy can transfer its behavior between tasks.

    Reads ``observation`` (B, D) float32, ``skill_weights`` (B, S) float32 and ``task_id`` (B,) int64; writes
    ``features`` (B, 18). There are 9 numbers for each of two clauses, the first and the last that compare two objects:
    the second object's position relative to the first object, in units of 10 cm and squashed by tanh at 2 cm and at
    10 cm. A plan step without such clauses has zeros.

    Args:
        plans: the plans whose conditions name the objects.
        noise: standard deviation of the Gaussian noise during training.
        in_keys, out_keys: replacements for the default input and output keys; nested keys are allowed.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans, features=lw.modules.FocusFeatures(plans))
    """

    def __init__(
        self, plans: AnyPlans, noise: float = 0.0, *, in_keys: Keys | None = None, out_keys: Keys | None = None
    ) -> None:
        super().__init__(plans, _compared, 2, noise, in_keys, out_keys)


class RoleFeatures(_RelativePositions):
    """Features of the active plan step: the target's position relative to the moved object, and the motion direction.

    "lower the gripper around the puck" and "... the mug" are the same motion in these features, so policies can
    transfer it between tasks. Offsets longer than 25 cm are shortened to 25 cm. The targets are *contacts*, the points
    at which demonstrations touch an object, computed by :meth:`fit`. In a task without demonstrations, the
    target is the point that the plan names, and a carried object is first lifted to 15 cm above the target.

    Reads ``observation`` (B, D) float32, ``skill_weights`` (B, S) float32 and ``task_id`` (B,) int64, and the outputs
    of :class:`RandomYaw` and :class:`JitterTarget` if present; writes ``features`` (B, 12). These are the relative
    position, in units of 10 cm and squashed by tanh at 2 cm and 10 cm (9 numbers), and the direction, a unit vector, or
    zeros for a step without a direction.

    Args:
        plans: plans whose steps have roles, see :func:`~lw_torchrl.canonical_plans`.
        noise: standard deviation of the Gaussian noise during training.
        in_keys, out_keys: replacements for the default input and output keys; nested keys are allowed.

    Attributes:
        contact: (T, 3) float32 in metres, for each task the hand's position relative to the first object while the hand
            acts on the object.
        demonstrated: (T,) bool, whether a task has demonstrations.
        fitted: () bool, whether :meth:`fit` was called.

    Raises:
        ValueError: the plans have no roles.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.canonical_plans(lw.load_plans("MT10"))
        >>> lw.PlanConditionedActor(plans, features=lw.modules.RoleFeatures(plans)).features.width
        12

    Source: original to this library; like the keypoints of task-axis controllers, but derived from language.
    """

    contact: Tensor
    demonstrated: Tensor
    fitted: Tensor
    at_contact: Tensor
    acts: Tensor
    lifts: Tensor
    direction: Tensor

    def __init__(
        self, plans: AnyPlans, noise: float = 0.0, *, in_keys: Keys | None = None, out_keys: Keys | None = None
    ) -> None:
        plans = as_plans(plans)
        super().__init__(plans, _moved_to_target, 1, noise, in_keys, out_keys)
        self.width += 3
        shape = len(plans), plans.num_steps
        at_contact, acts = (torch.zeros(shape, dtype=torch.bool) for _ in range(2))
        lifts = role_table(plans, self.tables, lambda role: role.verb == "carry")
        direction = torch.zeros(*shape, 3, dtype=torch.float32)
        for task, plan in plans.items():
            for number, role in enumerate(_roles(plan)):
                at = (self.tables.index.row(task), number)
                way = torch.tensor(VECTORS.get(role.direction or "", (0.0,) * 3), dtype=torch.float32)
                at_contact[at] = role.moved == GRIPPER and _is_first(plan, role.target)
                touches = role.verb in ("close", "pull") or (role.verb == "push" and role.manner == "push")
                acts[at] = _is_first(plan, role.moved) or (at_contact[at] and touches)
                if role.verb == "move":  # the target is next to the object's current position
                    self.offset[at] += _AWAY * way
                else:
                    direction[at] = way
        for name, table in (("at_contact", at_contact), ("acts", acts), ("lifts", lifts), ("direction", direction)):
            self.register_buffer(name, table, persistent=False)
        self.ahead = _RelativePositions(plans, _ahead, 1)
        self.attention = PlanAttention(plans)
        self.register_buffer("contact", torch.zeros(len(plans), 3, dtype=torch.float32))
        self.register_buffer("demonstrated", torch.zeros(len(plans), dtype=torch.bool))
        self.register_buffer("fitted", torch.tensor(False))
        self._sharing: WeakSet[RoleFeatures] = WeakSet([self])  # features of actors that share weights

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_sharing": None}  # a copy or a pickle has its own contacts

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._sharing = WeakSet([self])

    def with_plans(self, plans: AnyPlans) -> RoleFeatures:
        """Return these features for another set of plans. For tasks in both sets, the two modules always share their
        contact points, even if one module is fitted later."""
        other: RoleFeatures = super().with_plans(plans)
        other._sharing = self._sharing
        other._sharing.add(other)
        other._copy(self)
        return other

    def share(self) -> None:
        """Copy the contact points to all modules created by :meth:`with_plans`; call it after changing the buffers."""
        for other in self._sharing:
            if other is not self:
                other._copy(self)

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        self.share()

    @torch.no_grad()
    def fit(self, rows: TensorDictBase, weights: Tensor | None = None) -> None:
        """Compute the contacts from demonstrations, in place.

        A contact is the median of hand position minus first-object position, over all time steps in which the active
        plan step grasps, pushes, pulls or moves the object, except presses from above.
        """
        observation, task_id = read(rows, [self.in_keys[0], self.in_keys[2]])
        observation, task_id = observation.reshape(-1, self.layout.size), task_id.reshape(-1)
        program = plan_program(self.plans)
        latches = rows.get("qaf_latches", None) if program.num_latches else None
        truth = program(observation, task_id, None if latches is None else latches.reshape(len(observation), -1))
        at = self.tables.rows(task_id)
        observation, truth, at = (tensor.to(self.contact.device) for tensor in (observation, truth, at))
        acting = (self.attention.weights(truth, at) * self.acts[at]).sum(-1) > 0.5
        hand, first, *_ = self.layout.positions
        contacts = observation[:, hand] - observation[:, first]
        for row in at[acting].unique().cpu().tolist():
            self.contact[row] = contacts[acting & (at == row)].median(0).values
        self.demonstrated[at.unique()] = True
        self.fitted.fill_(True)
        self.share()

    @torch.no_grad()
    def _copy(self, other: RoleFeatures) -> None:
        self.fitted.copy_(other.fitted)
        for task in {*self.tables.index.tasks} & {*other.tables.index.tasks}:
            own, theirs = self.tables.index.row(task), other.tables.index.row(task)
            self.contact[own], self.demonstrated[own] = other.contact[theirs], other.demonstrated[theirs]

    def of_steps(self, observation: Tensor, rows: Tensor) -> Tensor:
        """Return the relative positions of each plan step, with contacts as targets and carried objects lifted."""
        contact = pick(self.at_contact, rows)[..., None] * pick(self.contact, rows).unsqueeze(-2)
        positions = super().of_steps(observation, rows) + contact.unsqueeze(-2)
        lifts = (pick(self.lifts, rows) & ~pick(self.demonstrated, rows).unsqueeze(-1))[..., None, None]
        sideways, height = positions[..., :2], positions[..., 2:]
        # While the object is more than 3 to 7 cm to the side of its target, the target is raised by 15 cm. Until the
        # object is nearly at that height, it does not move sideways.
        distance = sideways.norm(dim=-1, keepdim=True)
        height = height + _LIFTED * ((distance - 0.03) / 0.04).clamp(0.0, 1.0) * lifts
        lifted = torch.where(lifts, ((0.06 - height) / 0.04).clamp(0.0, 1.0), 1.0)
        return torch.cat((sideways * lifted, height), -1)

    def directions(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """Return the direction (..., 3) of the active plan step; see :meth:`positions` for the arguments."""
        if yaw is not None:
            observation = turn_observation(observation, -yaw, self.layout)
        ahead = self.ahead.of_steps(observation, rows).squeeze(-2)
        directions = pick(self.direction, rows) + ahead / ahead.norm(dim=-1, keepdim=True).clamp(min=0.02)
        direction = (weights.unsqueeze(-1) * directions).sum(-2)
        return direction if yaw is None else turn_vectors(direction, yaw)

    def compute(self, tensordict: TensorDictBase) -> Tensor:
        inputs = self._inputs(tensordict)
        position = self.positions(*inputs)
        if (offset := tensordict.get("target_offset", None)) is not None:
            position = position + offset.unsqueeze(-2)
        position = position.flatten(-2)
        if (tilt := tensordict.get(key_beside(self.in_keys[0], "_tilt"), None)) is not None:
            position = (tilt @ position.unsqueeze(-1)).squeeze(-1)
        position = position * (_FAR / position.norm(dim=-1, keepdim=True).clamp(min=_FAR))
        return torch.cat((position / _SCALE, *squash(position), self.directions(*inputs)), -1)


def _roles(plan: ConditionalPlan) -> list[StepRole]:
    return [step.role for step in plan.steps if step.role is not None]


def _moved_to_target(plan: ConditionalPlan) -> list[list[Pair]]:
    task = plan.definition
    return [[(role_object(task, role.moved), role_object(task, role.target))] for role in _roles(plan)]


def _ahead(plan: ConditionalPlan) -> list[list[Pair]]:
    """Return [(first object, target)] for each plan step that moves toward the goal or an object, else []."""
    task = plan.definition
    x, y, z = places(task.layout.positions[1])
    first = NamedObject("first object", (x, y, z))
    return [
        [(first, role_object(task, role.toward or GOAL))] if role.direction == "goal" else [] for role in _roles(plan)
    ]


def _is_first(plan: ConditionalPlan, name: str) -> bool:
    """Return whether a name refers to the first object itself, rather than to a point next to the object."""
    item = role_object(plan.definition, name)
    return item.position == places(plan.definition.layout.things[0].xyz) and not any(item.offset)
