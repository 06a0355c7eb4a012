"""PlanConditionedActor: the policy that a conditional plan makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._checks import check_choice, checked
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.conditioned_actor import ConditionedActor, noise_of_features
from lw_torchrl.modules.encoder import Encoding
from lw_torchrl.modules.networks import DistributionName
from lw_torchrl.modules.observation_features import Features
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
        mix: "latents", decode the mixed latent, as in the paper; "actions", decode every step's latent and mix the
            actions.
        features: what the decoder sees of the observation: "raw", the 39 numbers; "differences", the pairwise
            differences between hand, objects and goal, the hand's height and the gripper's opening; "relative", the
            differences alone; "opening", the gripper's opening alone, for ``roles``; "both", raw and differences.
        feature_noise: standard deviation of the noise on the normalised features while training; None for 0.05, or 0
            with a distribution, whose likelihoods must not change from call to call.
        focus: the decoder also sees the relative positions of what the steps in force compare, see :class:`PlanFocus`.
        roles: the decoder also sees the target's position relative to what the step in force moves, see
            :class:`~lw_torchrl.modules.relative_positions.PlanRoles`: for tasks that were not demonstrated.
        jitter: standard deviation, in metres, of noise on that position while training, where the gripper pushes.
        swap_unmentioned: the probability, in training, that an object or the goal is put where it is in another row,
            if no step in force mentions it, or with ``roles`` moves it or to it.
        hide_opening: the probability, in training, that the gripper's opening is another row's, if no step in force
            closes it: it often tells which task this is.
        latent_size: D.
        width, depth: hidden layers of the action decoder; a tuple of widths says both.
        encoder_width, encoder_depth: hidden layers of the skill encoder.
        squash: keep each number of the action in (-1, 1) by tanh; without, as in the paper, the environment clips.
        distribution: None for a deterministic actor; for RL "tanh_normal", a Normal through tanh, or "normal", about
            the action, clipped by the environment: ``action`` is then drawn from it under
            ``set_exploration_type(ExplorationType.RANDOM)``, as collectors do, and its mode otherwise.
        init_std: the Normal's initial standard deviation, in every state.
        evaluator: answers the conditions in the place of ``qaf``, which is then not read; see :class:`QueryEvaluator`.
        answers: what an evaluator's logit counts in the attention's softmax, where exact truth counts 5 and -5:
            "logit", what it is; "tanh", 5·tanh(answer_scale·logit); "hard", 5 or -5 by its sign, with the gradient of
            "tanh".
        answer_scale: the scale in "tanh" and "hard"; 0.5 makes "tanh" the paper's 10·p - 5 of the probability p.
        text_encoder: texts to vectors (n, E) float32; None for the shipped sentence encoder.
        in_keys, out_keys: other names for what it reads and writes, in the order above; nested ones too.

    Attributes:
        skills: the K different skill texts, sorted.

    Raises:
        ValueError: at call time, a task_id without a plan, or ``qaf`` of other
            plans, as ``qaf_plan`` beside it tells.
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
    encoder: PlanEncoder
    plans: Plans

    @checked
    def __init__(
        self,
        plans: Plans | Mapping[str, ConditionalPlan],
        *,
        mix: Literal["latents", "actions"] = "latents",
        features: Features = "differences",
        feature_noise: float | None = None,
        focus: bool = False,
        roles: bool = False,
        jitter: float = 0.0,
        swap_unmentioned: float = 0.0,
        hide_opening: float = 0.0,
        latent_size: int = 64,
        width: int | tuple[int, ...] = 256,
        depth: int = 3,
        encoder_width: int = 128,
        encoder_depth: int = 1,
        squash: bool = True,
        distribution: DistributionName | None = None,
        init_std: float = 0.3,
        evaluator: QueryEvaluator | None = None,
        answers: Answers = "logit",
        answer_scale: float = 0.5,
        text_encoder: TextEncoder | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        check_choice("mix", mix, ("latents", "actions"))
        if mix == "actions" and distribution is not None:
            raise ValueError("mix must be 'latents' with a distribution: a mean of several actions has no likelihood")
        encoder = PlanEncoder(
            plans,
            features=features,
            feature_noise=noise_of_features(feature_noise, distribution),
            focus=focus,
            roles=roles,
            jitter=jitter,
            swap_unmentioned=swap_unmentioned,
            hide_opening=hide_opening,
            latent_size=latent_size,
            encoder_width=encoder_width,
            encoder_depth=encoder_depth,
            evaluator=evaluator,
            answers=answers,
            answer_scale=answer_scale,
            text_encoder=text_encoder,
            in_keys=in_keys,
        )
        super().__init__(
            encoder,
            ("skill_weights", "skill_latent"),
            width=width,
            depth=depth,
            squash=squash,
            distribution=distribution,
            init_std=init_std,
            out_keys=out_keys,
        )
        self.config["mix"] = mix
        self.skills = encoder.skills

    @property
    def evaluator(self) -> QueryEvaluator | None:
        """What answers the conditions in the place of ``qaf``; None for nothing."""
        return self.encoder.evaluator

    @classmethod
    def for_plans(
        cls, plans: Plans, *, text_encoder: TextEncoder | None = None, **options: Any
    ) -> PlanConditionedActor:
        """One for the tasks of ``plans``; its ``evaluator`` may be a description, which recipes have."""
        if isinstance(asked := options.get("evaluator"), Mapping):
            options["evaluator"] = evaluator_from_description(asked, plans, text_encoder)
        return cls(plans, text_encoder=text_encoder, **options)

    def extras(self, encoding: Encoding) -> tuple[Tensor, ...]:
        """Attention (B, S) and the mixed latent (B, D)."""
        assert encoding.weights is not None
        return encoding.weights, encoding.latent

    def act(self, *prepared: Tensor) -> tuple[Tensor, ...]:
        if self.config["mix"] == "latents":
            return super().act(*prepared)
        encoding = self.encoder.encode(*prepared)
        assert encoding.weights is not None
        steps = self.encoder.latents()[prepared[1]]  # (B, S, D)
        seen = encoding.features.unsqueeze(-2).expand(*steps.shape[:-1], -1)
        actions = self.head(encoding._replace(latent=steps, features=seen).joined)
        return (encoding.weights.unsqueeze(-1) * actions).sum(-2), *self.extras(encoding)

    @classmethod
    def from_description(
        cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None
    ) -> PlanConditionedActor:
        plans, evaluator = plans_and_evaluator(found, text_encoder)
        return cls(plans, evaluator=evaluator, text_encoder=text_encoder, **found["options"])

    def with_evaluator(
        self, evaluator: QueryEvaluator, *, answers: Answers = "hard", answer_scale: float = 0.5
    ) -> PlanConditionedActor:
        """An actor on the same weights that asks an evaluator in the place of ``qaf``: training either trains both.

        Args:
            evaluator: of its plans; the actor's own is replaced.
            answers, answer_scale: as for the class; "hard", since the weights only know truth of 5 and -5.

        Example:
            >>> import lw_torchrl as lw
            >>> plans = lw.load_plans("MT10")
            >>> lw.PlanConditionedActor(plans).with_evaluator(lw.StateQueryEvaluator(plans)).in_keys
            ['observation', 'task_id']
        """
        options = self.config | {"answers": answers, "answer_scale": answer_scale, "in_keys": self.in_keys[:2]}
        with torch.random.fork_rng(devices=[]):
            other = PlanConditionedActor(
                self.plans, evaluator=evaluator, text_encoder=self.encoder.text_encoder, **options
            )
        other.encoder.texts, other.encoder.features, other.head = self.encoder.texts, self.encoder.features, self.head
        return other.train(self.training)

    def with_plans(self, plans: Plans | Mapping[str, ConditionalPlan]) -> PlanConditionedActor:
        """An actor that carries out other plans with the same weights: training either trains both."""
        encoder = self.encoder.with_plans(as_plans(plans))
        text_encoder = self.encoder.text_encoder
        other = PlanConditionedActor(plans, evaluator=encoder.evaluator, text_encoder=text_encoder, **self.config)
        other.encoder, other.head = encoder, self.head
        return other.train(self.training)
