"""HeldEvaluator: an evaluator that is asked every k steps of an episode, its answers held between, and shown late."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, Transform

from lw_torchrl._checks import Count, Natural, checked
from lw_torchrl._devices import device_of, in_blocks
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.query_evaluator import QueryEvaluator, evaluator_from_description
from lw_torchrl.transforms.camera import CameraTransform
from lw_torchrl.transforms.environment import HeldAnswers

_MOST = 2**16  # steps; a policy file with more would be refused


class HeldEvaluator(QueryEvaluator):
    """Another evaluator, asked every k steps, as suits a costly one: in step t of its episode, 0 at the reset, a row is
    given the answers of step every · ⌊max(t - delay, 0) / every⌋.
    Reads ``qaf_held_logits`` (B, S) float32 and gives them as they are. ``transform()`` writes them, behind the
    evaluator's own transform: it runs the evaluator, in eval mode and without gradients, on the rows whose answers are
    due, in blocks of one size, so that results do not depend on the number of rows. A ``_step`` or ``_reset`` mask
    counts for its rows alone; after ``load_state_dict`` the environment must be reset. Rows of a replay buffer have no
    such steps: train with the evaluator itself, and hold it when acting.

    Args:
        evaluator: what is asked; its plans are ``plans``.
        every: steps of a row's episode between questions, from 1 to 65,536.
        delay: steps until answers are shown, from 0 to 65,536; until then a row is given those of its reset.

    Raises:
        ValueError: it is a HeldEvaluator, or a number is out of its range; at call time, there are no held answers.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> held = lw.HeldEvaluator(lw.StateQueryEvaluator(plans), every=5, delay=2)
        >>> actor = lw.ScriptedSkillActor(plans, evaluator=held)
        >>> actor.in_keys
        ['observation', 'task_id', 'qaf_held_logits']
        >>> lw.evaluate(actor, tasks="reach", episodes_per_task=1, seed=1_000, max_steps=5).mean_success
        0.0

    Source: paper section 'Differentiability and Optimization', which proposes to evaluate queries less often.
    """

    @checked
    def __init__(self, evaluator: QueryEvaluator, *, every: Count = 1, delay: Natural = 0) -> None:
        if isinstance(evaluator, HeldEvaluator):
            raise ValueError("evaluator must be no HeldEvaluator: hold the one inside it, its .evaluator")
        super().__init__(evaluator.plans)
        self.evaluator, self.every, self.delay = evaluator, int(every), int(delay)
        for name, steps in (config := {"every": self.every, "delay": self.delay}).items():
            if steps > _MOST:
                raise ValueError(f"{name} must be at most {_MOST} steps, got {steps}")
        self.config, self.in_keys, self.text_encoder = config, ["qaf_held_logits"], evaluator.text_encoder

    def logits(self, *read: Tensor) -> Tensor:
        """The held logits (..., S), as they are."""
        (held,) = read
        if held is None:
            where = "in an environment; of rows of a replay buffer ask the evaluator inside, its .evaluator"
            raise ValueError(f"qaf_held_logits is needed, which HeldEvaluator.transform() writes {where}")
        return held

    def ask(self, tensordict: TensorDictBase) -> Tensor:
        """The evaluator's logits (n, S) float32 of n rows; each row's do not depend on the other rows."""
        with torch.no_grad(), evaluating(self.evaluator):
            asked = in_blocks(self.evaluator)(tensordict.to(device_of(self.evaluator)))
        found: Tensor = asked.get(self.evaluator.out_keys_source[0])
        return found

    def transform(self) -> Transform:
        """A new transform that asks, behind the evaluator's own."""
        options = {"in_keys": self.evaluator.in_keys, "out_key": self.in_keys[0], **self.config}
        asks = HeldAnswers(self.ask, self.plans.num_steps, **options)
        own = self.evaluator.transform()
        if own is None:
            return asks
        parts = list(own.transforms) if isinstance(own, Compose) else [own]
        for part in parts:
            if isinstance(part, CameraTransform) and self.every % part.every == 0:
                part.every = self.every  # those between would not be looked at
        return Compose(own, asks)

    def made_for(self, plans: Plans) -> HeldEvaluator:
        return HeldEvaluator(self.evaluator.made_for(plans), **self.config)

    def with_plans(self, plans: Plans) -> HeldEvaluator:
        return HeldEvaluator(self.evaluator.with_plans(plans), **self.config).train(self.training)

    def describe(self) -> dict[str, Any]:
        found = super().describe()
        return found | {"options": {**found["options"], "evaluator": self.evaluator.describe()}}

    @classmethod
    def from_options(cls, plans: Plans, options: Mapping[str, Any], text_encoder: TextEncoder | None) -> HeldEvaluator:
        numbers = dict(options)
        inside = numbers.pop("evaluator", None)
        if isinstance(inside, Mapping) and inside.get("kind") == cls.__name__:  # before any of a long nest is made
            raise ValueError("evaluator of a HeldEvaluator must be no HeldEvaluator")
        return cls(evaluator_from_description(inside, plans, text_encoder), **numbers)
