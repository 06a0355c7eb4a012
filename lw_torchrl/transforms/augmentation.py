"""Augmentations for replay buffers, which prevent a policy from relying on irrelevant details of demonstrations."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import Transform

from lw_torchrl._util.checks import Probability, Scale, typed
from lw_torchrl._util.devices import plain
from lw_torchrl._util.keys import Keys, as_keys, check_apart, read
from lw_torchrl.language.layout import places
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.roles import StepRole
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import role_object
from lw_torchrl.transforms.qaf import read_truth

# A plan step with more attention is active. If any condition is true, a step with a false condition gets about 1e-4.
ACTIVE_WEIGHT = 0.01


class PlanAugmentation(Transform):
    """Base class for augmentations that depend on a row's active plan steps, those with attention above 0.01. In an
    environment, they raise a :class:`TypeError`."""

    steps: Tensor

    def transform_observation_spec(self, observation_spec: TensorSpec) -> NoReturn:
        name = type(self).__name__
        raise TypeError(f"{name} is only for replay buffers: in an environment it would change the policy's input")

    def table(self, name: str, device: torch.device) -> Tensor:
        """Return the buffer ``name`` on a device, and keep the buffer there for later batches."""
        table: Tensor = getattr(self, name)
        if table.device != device:
            table = table.to(device)
            if plain(table):
                setattr(self, name, table)
        return table

    def _read_plans(self, plans: AnyPlans) -> Plans:
        plans = as_plans(plans)
        self.fingerprint = plans.fingerprint  # identifies this transform in training checkpoints
        self._tables = PlanTables(plans)
        self.register_buffer("steps", self._tables.turns, persistent=False)  # (T, 6, S) bool
        return plans

    def answers(self, tensordict: TensorDictBase, keys: Keys) -> tuple[Tensor, Tensor, Tensor]:
        """Return ``qaf`` (B, S), row indices of the tables (B,) int64, and a mask (B, S) bool of the steps that are
        available in the current turn (see :class:`FallbackTurns`)."""
        qaf, rows = read_truth(tensordict, keys, self._tables)
        turn = tensordict.get("turn", None)
        steps = self.table("steps", rows.device)
        return qaf, rows, steps[rows, torch.zeros_like(rows) if turn is None else turn % steps.shape[1]]

    def active(self, tensordict: TensorDictBase, keys: Keys) -> tuple[Tensor, Tensor]:
        """Return a mask of the active plan steps (B, S) bool, and the row of each task in the tables (B,) int64."""
        qaf, rows, steps = self.answers(tensordict, keys)
        weights = (10.0 * qaf.to(torch.float32) - 5.0).masked_fill(~steps, -torch.inf).softmax(-1)
        return weights > ACTIVE_WEIGHT, rows


class SwapUnmentioned(PlanAugmentation):
    """An augmentation that moves each object that no active plan step mentions to its position in a random row.

    A plan step mentions an object, or the goal, if its condition or skill names it. Use this class in a replay
    buffer after a :class:`QAFTransform`, which must see the unchanged scene.

    Reads ``task_id`` (B,) int64 and ``qaf`` (B, S); changes ``observation`` (B, D) and ``("next", "observation")`` in
    the same way. An object keeps its position if a step that is active in either observation mentions it. Draws from
    PyTorch's global generator.

    Args:
        plans: the plans whose conditions ``qaf`` answers.
        probability: probability of replacing each object, and the goal, in each row.
        in_keys: replacements for the keys ``observation``, ``task_id`` and ``qaf``, in this order.

    Raises:
        ValueError: at call time, a key is missing, a task has no plan, or ``qaf`` belongs to other plans.
        TypeError: the transform is used in an environment.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> from tensordict import TensorDict
        >>> plans, reach = lw.load_plans("MT10"), torch.full((2,), lw.task_id("reach"))
        >>> rows = TensorDict(observation=torch.rand(2, 39), task_id=reach, batch_size=[2])
        >>> swap = lw.transforms.SwapUnmentioned(plans, 1.0)
        >>> swap(lw.QAFTransform(plans)(rows))["observation"].shape
        torch.Size([2, 39])

    Source: domain randomization.
    """

    mentioned: Tensor
    owner: Tensor

    @typed
    def __init__(self, plans: AnyPlans, probability: Probability, *, in_keys: Keys | None = None) -> None:
        keys = as_keys("in_keys", in_keys, ("observation", "task_id", "qaf"))
        super().__init__(in_keys=keys, out_keys=keys[:1])
        self.probability = probability
        plans = self._read_plans(plans)
        self.register_buffer("mentioned", mentioned(plans, self._tables), persistent=False)  # (T, S, P) bool
        owner = torch.full((plans.layout.size,), len(plans.layout.parts))
        for item, parts in enumerate(plans.layout.parts):  # an object may have several parts, such as its old position
            for part in parts:
                owner[part] = item
        self.register_buffer("owner", owner, persistent=False)  # (D,) int64, P for numbers that belong to no object

    def _kept(self, tensordict: TensorDictBase) -> Tensor:
        """Return whether each object, and the goal, keeps its position, (B, P) bool."""
        active, rows = self.active(tensordict, [self.in_keys[2], self.in_keys[1]])
        return (active.unsqueeze(-1) & self.table("mentioned", rows.device)[rows]).any(-2)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = tensordict.copy()  # replay[:] may return the storage itself
        key, task, qaf = self.in_keys
        observations = {key: read(tensordict, [key])[0]}
        kept = self._kept(tensordict)
        if not kept.numel():
            return tensordict  # there is no row to swap with
        following = tensordict.get("next", None)
        if following is not None and following.get(key, None) is not None:
            observations[unravel_key(("next", key))] = following.get(key)
            if following.get(qaf, None) is not None:  # the next observation has the row's task
                kept = kept | self._kept(following.copy().set(task, tensordict.get(task)))
        kept = kept.reshape(-1, kept.shape[-1])
        number, device = kept.shape[0], kept.device
        swaps, rows = [], []
        for item in range(kept.shape[-1]):
            drawn = torch.rand(number, device=device, dtype=torch.float32)
            swaps.append(~kept[:, item] & (drawn < self.probability))
            rows.append(torch.randint(number, (number,), device=device))
        owner = self.table("owner", device)
        swap = torch.stack([*swaps, torch.zeros_like(swaps[0])], -1).index_select(-1, owner)  # (n, D)
        row = torch.stack([*rows, rows[0]], -1).index_select(-1, owner)
        for name, values in observations.items():
            flat = values.reshape(number, -1)
            tensordict.set(name, torch.where(swap, flat.gather(0, row), flat).reshape(values.shape))
        return tensordict


class JitterTarget(PlanAugmentation):
    """An augmentation that draws a random target offset for rows in which an active plan step pushes or pulls.

    The offset models uncertain contact points: :class:`~lw_torchrl.modules.RoleFeatures` adds it to the target's
    position. For replay buffers, after a :class:`QAFTransform`. Reads ``task_id`` (B,) int64 and ``qaf`` (B, S); writes
    ``target_offset`` (B, 3) float32, metres: normal noise of ``std`` in z and ``std / 2`` in x and y, or 0 without such
    a step. Draws from PyTorch's global generator. Of TorchRL's losses, only BCLoss passes the offset to the features.

    Args:
        plans: canonical plans, see :func:`~lw_torchrl.canonical_plans`, whose conditions ``qaf`` answers.
        std: standard deviation of the offset in z, metres.
        in_keys: replacements for the keys ``task_id`` and ``qaf``, in this order.

    Raises:
        ValueError: the plans have no roles; at call time, see :class:`SwapUnmentioned`.
        TypeError: the transform is used in an environment.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> from tensordict import TensorDict
        >>> plans, reach = lw.canonical_plans(lw.load_plans("MT10")), torch.full((2,), lw.task_id("reach"))
        >>> rows = TensorDict(observation=torch.rand(2, 39), task_id=reach, batch_size=[2])
        >>> lw.transforms.JitterTarget(plans, 0.03)(lw.QAFTransform(plans)(rows))["target_offset"].shape
        torch.Size([2, 3])
    """

    pushes: Tensor
    scale: Tensor

    @typed
    def __init__(self, plans: AnyPlans, std: Scale, *, in_keys: Keys | None = None) -> None:
        super().__init__(in_keys=as_keys("in_keys", in_keys, ("task_id", "qaf")), out_keys=["target_offset"])
        check_apart(self.in_keys, self.out_keys)
        self.std = std
        plans = self._read_plans(plans)
        pushes = role_table(plans, self._tables, lambda role: role.verb in ("push", "pull"))
        self.register_buffer("pushes", pushes, persistent=False)  # (T, S) bool
        self.register_buffer("scale", std * torch.tensor([0.5, 0.5, 1.0], dtype=torch.float32), persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        active, rows = self.active(tensordict, self.in_keys[::-1])
        pushed = (active & self.table("pushes", rows.device)[rows]).any(-1, keepdim=True)
        offset = self.table("scale", rows.device) * torch.randn(*rows.shape, 3, device=rows.device, dtype=torch.float32)
        return tensordict.copy().set(self.out_keys[0], torch.where(pushed, offset, 0.0))


def mentioned(plans: Plans, tables: PlanTables) -> Tensor:
    """Return whether each plan step mentions each object of the layout and the goal (last), (T, S, P) bool."""
    numbers = [{number for part in parts for number in places(part)} for parts in plans.layout.parts]
    table = torch.zeros(*tables.mask.shape, len(numbers), dtype=torch.bool)
    for task, plan in plans.items():
        for number, step in enumerate(plan.steps):
            objects = [role_object(plan.definition, name) for name in step.mentions(plan.definition)]
            # An int is an index into the observation; a float is a constant coordinate in metres.
            indices = {place for item in objects for place in item.position if isinstance(place, int)}
            table[tables.index.row(task), number] = torch.tensor([not indices.isdisjoint(own) for own in numbers])
    return table


def role_table(plans: Plans, tables: PlanTables, holds: Callable[[StepRole], bool]) -> Tensor:
    """Return a mask (T, S) bool of steps whose role satisfies ``holds``; raise ValueError if a step has no role."""
    table = torch.zeros_like(tables.mask)
    for task, plan in plans.items():
        for number, step in enumerate(plan.steps):
            if step.role is None:
                raise ValueError(f"plans must come from lw.canonical_plans; step {number} of {task!r} has no role")
            table[tables.index.row(task), number] = holds(step.role)
    return table
