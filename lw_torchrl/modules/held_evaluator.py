"""HeldEvaluator: an evaluator that is asked every so many steps only, or whose answers come late."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, Transform

from lw_torchrl._blocks import BLOCK
from lw_torchrl._checks import check_int
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.query_evaluator import QueryEvaluator, evaluator_from_description
from lw_torchrl.transforms.camera import CameraTransform
from lw_torchrl.transforms.held_answers import HELD, HeldAnswers


class _Ask:
    """An evaluator as a transform asks it; no module, so that a transform's state does not hold its weights."""

    def __init__(self, evaluator: QueryEvaluator) -> None:
        self.evaluator = evaluator
        self.rows_at_once = getattr(evaluator, "rows_at_once", BLOCK)

    @torch.no_grad()
    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        with evaluating(self.evaluator):
            return self.evaluator(tensordict)


class HeldEvaluator(QueryEvaluator):
    """Another evaluator, which is asked at a row's reset and then every so many steps of its episode; in between its
    answers stay: for a model that is slow. With ``delay`` they come so many steps late: in step t, 0
    at the reset, a row is shown the answers of step every · ⌊max(t - delay, 0) / every⌋.

    The evaluator runs in the environment, by ``transform()``, on the rows whose answers are due, without gradients; a
    camera that it needs takes no other pictures. Here they are read: ``qaf_held_logits`` (B, S) float32 to
    ``qaf_logits`` (B, S) float32. It is for acting: a policy is trained with the evaluator itself.

    Args:
        evaluator: what is asked; its weights are shared.
        every: steps from one asking to the next.
        delay: steps until answers are shown; until then a row is shown those of its reset.

    Raises:
        TypeError: ``evaluator`` is no :class:`QueryEvaluator`.
        ValueError: it is held already; ``every`` under 1 or ``delay`` under 0.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> seldom = lw.HeldEvaluator(lw.StateQueryEvaluator(plans), every=5)
        >>> actor = lw.ScriptedSkillActor(plans, evaluator=seldom)
        >>> result = lw.evaluate(actor, tasks="reach", episodes_per_task=1, seed=1_000, max_steps=8)

    Source: paper section 'Differentiability and Optimization', which proposes to evaluate queries less often than at
    every step.
    """

    def __init__(self, evaluator: QueryEvaluator, *, every: int = 1, delay: int = 0) -> None:
        if not isinstance(evaluator, QueryEvaluator):
            raise TypeError(f"evaluator must be a QueryEvaluator, got {type(evaluator).__name__}")
        if isinstance(evaluator, HeldEvaluator):
            raise ValueError("evaluator must not be a HeldEvaluator itself: hold the one inside, .evaluator")
        super().__init__(evaluator.plans)
        self.evaluator = evaluator
        self.every, self.delay = check_int("every", every, minimum=1), check_int("delay", delay, minimum=0)
        self.in_keys = [HELD]

    def logits(self, *read: Tensor) -> Tensor:
        return read[0]

    def transform(self) -> Transform:
        """A new one, which asks; behind what takes the pictures, where it needs any."""
        inner = self.evaluator
        asks = HeldAnswers(_Ask(inner), inner.in_keys, inner.plans.num_steps, self.every, self.delay)
        before = inner.transform()
        if isinstance(before, CameraTransform):
            before.every = self.every
        return asks if before is None else Compose(before, asks)

    @property
    def text_encoder(self) -> TextEncoder | None:
        """Of the evaluator inside."""
        return getattr(self.evaluator, "text_encoder", None)

    @property
    def text_vectors(self) -> Tensor | None:
        """Of the evaluator inside."""
        return getattr(self.evaluator, "text_vectors", None)

    def with_plans(self, plans: Plans) -> HeldEvaluator:
        other = HeldEvaluator(self.evaluator.with_plans(plans), every=self.every, delay=self.delay)
        return other.train(self.training)

    def describe(self) -> dict[str, Any]:
        options = {"evaluator": self.evaluator.describe(), "every": self.every, "delay": self.delay}
        return {"kind": type(self).__name__, "options": options}

    @classmethod
    def from_options(cls, plans: Plans, options: Mapping[str, Any], text_encoder: TextEncoder | None) -> HeldEvaluator:
        inside = options.get("evaluator")
        if isinstance(inside, Mapping) and inside.get("kind") == cls.__name__:  # however deep it says that it goes
            raise ValueError("a HeldEvaluator cannot hold another")
        evaluator = evaluator_from_description(inside, plans, text_encoder)
        return cls(evaluator, every=options.get("every", 1), delay=options.get("delay", 0))
