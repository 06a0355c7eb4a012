"""PlanConditionedActor: the policy that a conditional plan makes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import torch

from lw_torchrl._checks import passes_on
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.conditioned_actor import ConditionedActor
from lw_torchrl.modules.plan_attention import Answers
from lw_torchrl.modules.plan_encoder import PlanEncoder
from lw_torchrl.modules.query_evaluator import QueryEvaluator, evaluator_from_description, plans_and_evaluator


class PlanConditionedActor(ConditionedActor):
    """Plan Conditioned Behavioral Cloning's policy: each skill's text is encoded to a latent, the conditions' truth
    gives attention over the steps, and the mixed latent and the observation give the action.

    Reads ``observation`` (B, 39) float32, ``task_id`` (B,) int64 and ``qaf`` (B, S) bool; writes ``action`` (B, 4)
    float32 in (-1, 1), ``skill_weights`` (B, S) float32 and ``skill_latent`` (B, D) float32; with a distribution also
    ``loc`` and ``scale`` (B, 4) float32, those of the Normal, and ``action_log_prob`` (B,) float32.

    Args:
        plans: a plan for each task it is to act in.
        **options: of :class:`ConditionedActor` and of :class:`PlanEncoder`; ``out_keys`` are the actor's.

    Attributes:
        skills: the K different skill texts, sorted.

    Raises:
        ValueError: at call time, a task_id without a plan, or ``qaf`` of other plans, as ``qaf_plan`` tells.
        ImportError: a skill's text is not shipped, and the extra ``[text]`` is not installed.

    Example:
        >>> import lw_torchrl as lw
        >>> from torchrl.envs import TransformedEnv
        >>> plans = lw.load_plans("MT10")
        >>> env = TransformedEnv(lw.LanguageWorldEnv("reach"), lw.QAFTransform(plans))
        >>> lw.PlanConditionedActor(plans)(env.reset())["action"].shape
        torch.Size([1, 4])
        >>> env.close()

    Source: paper section 'Plan Conditioning' and its figure of the architecture.
    """

    plan_options = True
    encoder_class = PlanEncoder
    encoder: PlanEncoder
    plans: Plans

    @passes_on(ConditionedActor.__init__, PlanEncoder.__init__)
    def __init__(self, plans: AnyPlans, **options: Any) -> None:
        super().__init__(plans, **options)
        self.skills = self.encoder.skills

    @property
    def evaluator(self) -> QueryEvaluator | None:
        """What answers the conditions in the place of ``qaf``; None where ``qaf`` does."""
        return self.encoder.evaluator

    @classmethod
    def for_plans(cls, plans: Plans, *, text_encoder: TextEncoder | None = None, **options: Any) -> Self:
        """One for the tasks of ``plans``; its ``evaluator`` may be a description, which recipes have."""
        if isinstance(asked := options.get("evaluator"), Mapping):
            options["evaluator"] = evaluator_from_description(asked, plans, text_encoder)
        return cls(plans, text_encoder=text_encoder, **options)

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> Self:
        plans, evaluator = plans_and_evaluator(found, text_encoder)
        made = cls(plans, evaluator=evaluator, text_encoder=text_encoder, **found["options"])
        made.encoder.check_rules(found)
        return made

    def with_evaluator(self, evaluator: QueryEvaluator, *, answers: Answers = "hard") -> PlanConditionedActor:
        """An actor on the same weights that asks an evaluator in the place of ``qaf``: training either trains both.

        Args:
            evaluator: of its plans; the actor's own is replaced.
            answers: as for the class; "hard", since the weights only know truth of 5 and -5.

        Example:
            >>> import lw_torchrl as lw
            >>> plans = lw.load_plans("MT10")
            >>> lw.PlanConditionedActor(plans).with_evaluator(lw.StateQueryEvaluator(plans)).in_keys
            ['observation', 'task_id']
        """
        options = self.config | {"answers": answers, "in_keys": self.in_keys[:2]}
        text_encoder = self.encoder.text_encoder
        with torch.random.fork_rng(devices=[]):
            plans = self.encoder.written
            other = PlanConditionedActor(plans, evaluator=evaluator, text_encoder=text_encoder, **options)
        other.encoder.texts, other.encoder.features, other.head = self.encoder.texts, self.encoder.features, self.head
        return other.train(self.training)

    def with_plans(self, plans: AnyPlans) -> PlanConditionedActor:
        """An actor that carries out other plans with the same weights: training either trains both."""
        encoder = self.encoder.with_plans(as_plans(plans))
        text_encoder = self.encoder.text_encoder
        options = dict(self.config)
        if self.head.actions != encoder.layout.action_size:
            options["action_size"] = self.head.actions
        other = PlanConditionedActor(plans, evaluator=encoder.evaluator, text_encoder=text_encoder, **options)
        other.encoder, other.head = encoder, self.head
        return other.train(self.training)
