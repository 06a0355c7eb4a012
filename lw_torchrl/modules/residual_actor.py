"""ResidualActor: a small network beside a policy that stays as it is, for RL to correct it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import Transform

from lw_torchrl._checks import check_choice, check_int, check_scale, checked, shown
from lw_torchrl._keys import key_beside, read
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.conditioned_actor import ConditionedActor
from lw_torchrl.modules.networks import head
from lw_torchrl.modules.plan_encoder import IN_FORCE, PlanEncoder
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.registry import from_description


class ResidualActor(Policy):
    """A policy that stays as it is, and a small network that corrects its actions, at first by 0.

    Reads what the policy reads; writes ``action`` (B, 4) float32 in [-1, 1], the policy's plus ``scale`` times tanh of
    the network, cut off at ±1. The network sees the policy's encoding and its action.

    With ``steps``, the correction is multiplied by the attention to these steps. Where none of them is in force, as in
    other tasks, the action is the policy's, bit for bit. ``skill_weights`` (B, S) float32, the policy's, and
    ``action_corrected`` (B, 1) float32, what the correction is multiplied by, are then written too.

    Args:
        base: a :class:`~lw_torchrl.PlanConditionedActor` or :class:`~lw_torchrl.DescriptorConditionedActor` without a
            distribution. It is not trained any more, has no noise, and is not copied.
        scale: the largest correction of a number of the action.
        width, depth: hidden layers of the network; a tuple of widths says both.
        steps: task name to the numbers of its plan's steps, counted from 0, where actions are corrected; None for
            everywhere. All steps are in force where no condition of the plan holds, as for the policy.

    Raises:
        ValueError: a base with a distribution, or that mixes actions; steps that its plans do not have.

    Example:
        >>> import lw_torchrl as lw
        >>> base = lw.DescriptorConditionedActor("MT10")
        >>> state = lw.LanguageWorldEnv("reach").reset()
        >>> actor = lw.ResidualActor(base)
        >>> actor(state.copy())["action"].equal(base(state.copy())["action"])
        True
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.ResidualActor(lw.PlanConditionedActor(plans), steps={"pick-place": [3]})
        >>> plans["pick-place"].steps[3].skill, actor.out_keys
        ('move the puck to the target location', ['action', 'skill_weights', 'action_corrected'])

    Source: Johannink et al., 'Residual Reinforcement Learning for Robot Control'.
    """

    chosen: Tensor

    @checked
    def __init__(
        self,
        base: Policy,
        *,
        scale: float = 0.3,
        width: int | Sequence[int] = 256,
        depth: int = 2,
        steps: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(base, ConditionedActor):
            got = f"whose encoding the network reads, got {type(base).__name__}"
            raise TypeError(f"base must be a PlanConditionedActor or a DescriptorConditionedActor, {got}")
        if base.head.distribution is not None:
            raise ValueError(f"base must have no distribution, this one's is {base.head.distribution!r}")
        self.base = base.requires_grad_(False).eval()
        self.plans, self.tasks = base.plans, base.tasks
        self.in_keys, self.out_keys = base.in_keys, base.out_keys_source[:1]
        self.layout, actions = base.layout, base.layout.action_size
        self.network = head(base.encoder.width + actions, actions, width, depth)
        nn.init.zeros_(self.network[-1].weight)
        nn.init.zeros_(self.network[-1].bias)
        self.config = {"scale": check_scale("scale", scale), "width": width, "depth": depth}
        self.steps = None
        if steps is not None:
            if not isinstance(base.encoder, PlanEncoder):
                raise TypeError(f"steps are of plans, which the base, a {type(base).__name__}, does not read")
            self.steps = self.config["steps"] = check_steps(steps, base.encoder.plans)
            action, weights, *_ = base.out_keys_source
            self.out_keys = [action, weights, key_beside(action, "_corrected")]
            tables = base.encoder.attention.tables
            chosen = torch.zeros_like(tables.mask)  # (T, S)
            for task, numbers in self.steps.items():
                chosen[tables.index.row(task), numbers] = True
            self.register_buffer("chosen", chosen, persistent=False)

    def train(self, mode: bool = True) -> ResidualActor:
        """As a module's, but the base stays in eval mode: its features have no noise."""
        super().train(mode)
        self.base.eval()
        return self

    def definition(self, task: str) -> Task | None:
        return self.base.definition(task)

    def transform(self) -> Transform | None:
        return self.base.transform()

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """As the base's; with ``steps``, followed by the mask (B, S) bool of these among each row's steps."""
        prepared = self.base.prepare(tensordict)
        if self.steps is None:
            return prepared
        assert isinstance(self.base.encoder, PlanEncoder)
        (task,) = read(tensordict, self.in_keys[1:2])
        return *prepared, self.chosen[self.base.encoder.attention.tables.rows(task)]

    def act(self, *prepared: Tensor) -> tuple[Tensor, ...]:
        encoding = self.base.encoder.encode(*(prepared if self.steps is None else prepared[:-1]))
        action = self.base.head(encoding.joined)
        more = self.config["scale"] * torch.tanh(self.network(torch.cat((encoding.joined, action), -1)))
        if self.steps is None:
            return ((action + more).clamp(-1.0, 1.0),)
        assert encoding.weights is not None
        weight = weight_in_force(encoding.weights, prepared[-1])
        corrected = (action + weight * more).clamp(-1.0, 1.0)
        return torch.where(weight > 0, corrected, action), encoding.weights, weight

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"base": self.base.describe()}

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> ResidualActor:
        base = found["base"]
        if not isinstance(base, Mapping) or base.get("kind") in (cls.__name__, "ActorEnsemble"):
            raise ValueError("the base of a residual must be a policy that is neither a residual nor an ensemble")
        return cls(from_description(base, text_encoder), **found["options"])

    def with_plans(self, plans: AnyPlans) -> ResidualActor:
        """One on the same weights for other plans; :class:`ValueError` if these lack ``steps`` or their skills."""
        if self.steps is not None:
            assert self.plans is not None
            others = as_plans(plans)
            checked_steps = check_steps(self.steps, others).items()
            for task, number in [(task, number) for task, numbers in checked_steps for number in numbers]:
                was, now = (of[task].steps[number].skill for of in (self.plans, others))
                if was != now:
                    raise ValueError(f"steps of {task!r}: step {number} must have the skill {was!r}, got {now!r}")
        base = self.base.with_plans(plans)
        assert isinstance(base, ConditionedActor)
        other = ResidualActor(base, **self.config)
        other.network = self.network
        return other.train(self.training)


def check_steps(steps: Any, plans: Plans) -> dict[str, list[int]]:
    """Steps of plans as JSON, with tasks and steps sorted, if the plans have them."""
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
        if not found[task] or len({*found[task]}) < len(numbers):
            raise ValueError(f"{where} must be different ones of its plan's {there}, got {shown(numbers)}")
        if found[task][-1] >= there:
            raise ValueError(f"{where} must be from 0 to {there - 1}, got {shown(found[task][-1])}")
    return dict(sorted(found.items()))


def weight_in_force(weights: Tensor, chosen: Tensor) -> Tensor:
    """The attention (B, S) float32 on chosen steps (B, S) bool: (B, 1) float32, exactly 0 where none is in force."""
    return weights.masked_fill(~chosen | (weights <= IN_FORCE), 0.0).sum(-1, keepdim=True)
