"""PlanConditionedActor: the policy that a conditional plan makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._checks import check_choice, check_scale
from lw_torchrl._keys import as_keys
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules.decoder import ActionDecoder, text_to_latent, unit_scale
from lw_torchrl.modules.mentions import mentioned, swap_unmentioned
from lw_torchrl.modules.observation_features import Features
from lw_torchrl.modules.plan_attention import PlanAttention, attend
from lw_torchrl.modules.plan_focus import PlanFocus
from lw_torchrl.modules.policy import Policy, TextEncoding
from lw_torchrl.modules.query_evaluator import QueryEvaluator, evaluator_from_description
from lw_torchrl.transforms.qaf import QAFTransform, plan_number_key

_IN_FORCE = 0.01  # a step whose condition does not hold beside one that does has a weight of 1e-4


def _check_evaluator(evaluator: QueryEvaluator | None, plans: Plans, reads_truth: float) -> QueryEvaluator | None:
    if evaluator is None:
        return None
    if reads_truth:
        raise ValueError("focus and swap_unmentioned read the queries' exact truth, which an evaluator takes away")
    if evaluator.plans.fingerprint != plans.fingerprint:
        raise ValueError("evaluator must be of the actor's plans, it answers the conditions of others")
    return evaluator


class PlanConditionedActor(Policy):
    """Plan Conditioned Behavioral Cloning's policy: each skill's text is encoded to a latent, the conditions' truth
    gives attention over the steps, the mixed latent and the observation give the action.

    Reads ``observation`` (B, 39) float32, ``task_id`` (B,) int64 and ``qaf`` (B, S) bool; writes ``action`` (B, 4)
    float32 in (-1, 1), ``skill_weights`` (B, S) float32 and ``skill_latent`` (B, D) float32.

    Args:
        plans: a plan for each task it is to act in.
        mix: "latents", decode the mixed latent, as in the paper; "actions", decode every step's latent and mix the
            actions.
        features: what the decoder sees of the observation: "raw", the 39 numbers; "differences", the pairwise
            differences between hand, objects and goal, the hand's height and the gripper's opening; "relative", the
            differences alone; "both", see :class:`ObservationFeatures`.
        feature_noise: standard deviation of the noise on the normalised features while training.
        focus: the decoder also sees the way between the things that the steps in force compare, see :class:`PlanFocus`.
        swap_unmentioned: the probability with which, in training, an object or the goal is put where it is in another
            row, where no step in force mentions it.
        latent_size: D.
        width, depth: hidden layers of the action decoder; a tuple of widths says both.
        encoder_width, encoder_depth: hidden layers of the skill encoder.
        squash: keep each number of the action in (-1, 1) by tanh; without, as in the paper, the environment clips.
        evaluator: answers the conditions in the place of ``qaf``, which is then not read; see :class:`QueryEvaluator`.
        text_encoder: texts to vectors (n, E) float32; None for the shipped sentence encoder.
        in_keys, out_keys: other names for what it reads and writes, in the order above; nested ones too.

    Attributes:
        plans: the plans.
        skills: the K different skill texts, sorted.

    Raises:
        ValueError: a wrong option, with the allowed ones; at call time, a task_id without a plan, or ``qaf`` of other
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
    text_vectors: Tensor
    skill_index: Tensor
    mentioned: Tensor

    def __init__(
        self,
        plans: Plans | Mapping[str, ConditionalPlan],
        *,
        mix: Literal["latents", "actions"] = "latents",
        features: Features = "differences",
        feature_noise: float = 0.05,
        focus: bool = False,
        swap_unmentioned: float = 0.0,
        latent_size: int = 64,
        width: int | tuple[int, ...] = 256,
        depth: int = 3,
        encoder_width: int = 128,
        encoder_depth: int = 1,
        squash: bool = True,
        evaluator: QueryEvaluator | None = None,
        text_encoder: TextEncoding | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.plans: Plans = as_plans(plans)
        self.tasks = tuple(self.plans)
        read = ("observation", "task_id") if evaluator is not None else ("observation", "task_id", "qaf")
        own = as_keys("in_keys", in_keys, read)
        self.in_keys = list(dict.fromkeys([*own, *([] if evaluator is None else evaluator.in_keys)]))
        self.out_keys = as_keys("out_keys", out_keys, ("action", "skill_weights", "skill_latent"))
        self._answered = plan_number_key(own[-1])
        self.evaluator = _check_evaluator(evaluator, self.plans, focus or swap_unmentioned)
        check_choice("mix", mix, ("latents", "actions"))
        if check_scale("swap_unmentioned", swap_unmentioned) > 1.0:
            raise ValueError(f"swap_unmentioned must be a probability, at most 1, got {swap_unmentioned}")
        self.config: dict[str, Any] = {
            "mix": mix,
            "features": features,
            "feature_noise": feature_noise,
            "focus": focus,
            "swap_unmentioned": swap_unmentioned,
            "latent_size": latent_size,
            "width": width,
            "depth": depth,
            "encoder_width": encoder_width,
            "encoder_depth": encoder_depth,
            "squash": squash,
            "in_keys": own,
            "out_keys": self.out_keys,
        }
        self.text_encoder = text_encoder
        self.skills = self.plans.skills
        vectors = (encode_texts if text_encoder is None else text_encoder)(self.skills)
        if vectors.ndim != 2 or len(vectors) != len(self.skills):
            raise ValueError(f"text_encoder must give ({len(self.skills)}, E), got shape {tuple(vectors.shape)}")
        self.attention = PlanAttention(self.plans)
        # The tables come from the plans, not from training: they are not part of the state that is saved.
        self.register_buffer("text_vectors", unit_scale(vectors), persistent=False)
        self.register_buffer("skill_index", self.attention.tables.skill_index, persistent=False)
        self.register_buffer("mentioned", mentioned(self.plans, self.attention.tables), persistent=False)
        self.encoder = text_to_latent(vectors.shape[1], latent_size, encoder_width, encoder_depth)
        self.focus = PlanFocus(self.plans, self.attention.tables, feature_noise) if focus else None
        more = 0 if self.focus is None else self.focus.width
        self.decoder = ActionDecoder(latent_size, features, feature_noise, width, depth, squash, more)

    @classmethod
    def for_plans(
        cls, plans: Plans, *, text_encoder: TextEncoding | None = None, **options: Any
    ) -> PlanConditionedActor:
        return cls(plans, text_encoder=text_encoder, **options)

    def transform(self) -> QAFTransform | None:
        """Query answers, unless an evaluator gives them."""
        if self.evaluator is not None:
            return None
        return QAFTransform(self.plans, in_keys=self.in_keys[:2], out_keys=self.in_keys[2:])

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """What no trained parameter touches: attention (B, S), the index of each step's skill (B, S) int64, and the
        observation's features (B, F). With an evaluator, in the attention's place the steps that there are (B, S) bool,
        and behind the features what the evaluator reads."""
        observation, task, *rest = self.read(tensordict)
        rows = self.attention.tables.rows(task)
        if self.evaluator is not None:
            asked = [tensordict.get(key) for key in self.evaluator.in_keys]
            return self.attention.mask[rows], self.skill_index[rows], self.decoder.features(observation), *asked
        self.attention.tables.refuse_others(tensordict.get(self._answered, None), rows)
        weights = self.attention.over_steps(rest[0], rows)
        if self.training and self.config["swap_unmentioned"]:
            kept = ((weights > _IN_FORCE).unsqueeze(-1) & self.mentioned[rows]).any(-2)
            observation = swap_unmentioned(observation, kept, self.config["swap_unmentioned"])
        seen = self.decoder.features(observation)
        if self.focus is not None:
            seen = torch.cat((seen, self.focus(observation, weights, rows)), -1)
        return weights, self.skill_index[rows], seen

    def act(self, *prepared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """From what :meth:`prepare` gives: action (B, 4), attention (B, S), skill latent (B, D)."""
        weights, index, seen, *asked = prepared
        if self.evaluator is not None:
            weights = attend(self.evaluator.logits(*asked), weights)
        latents = self.encoder(self.text_vectors)  # (K, D)
        # A product with (B, K) is faster than picking (B, S, D) latents, forwards and backwards.
        over_skills = weights.new_zeros((*weights.shape[:-1], len(self.skills))).scatter_add(-1, index, weights)
        latent = over_skills @ latents
        if self.config["mix"] == "latents":
            return self.decoder.decode(latent, seen), weights, latent
        steps = latents[index]
        each = seen.unsqueeze(-2).expand(*steps.shape[:-1], -1)
        return (weights.unsqueeze(-1) * self.decoder.decode(steps, each)).sum(-2), weights, latent

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        """Take the features' mean and standard deviation, in place, from observations (R, 39) float32; ``weights`` (R,)
        float32, with the sum 1, tell how much each counts."""
        self.decoder.features.fit(observation, weights)

    def describe(self) -> dict[str, Any]:
        found = super().describe() | {"plans": self.plans.to_json()}
        return found if self.evaluator is None else found | {"evaluator": self.evaluator.describe()}

    @classmethod
    def from_description(
        cls, found: Mapping[str, Any], text_encoder: TextEncoding | None = None
    ) -> PlanConditionedActor:
        plans = Plans.from_json(found["plans"])
        asked = found.get("evaluator")
        evaluator = None if asked is None else evaluator_from_description(asked, plans)
        return cls(plans, evaluator=evaluator, text_encoder=text_encoder, **found["options"])

    def with_plans(self, plans: Plans | Mapping[str, ConditionalPlan]) -> PlanConditionedActor:
        """An actor that carries out other plans with the same weights: training either trains both."""
        evaluator = None if self.evaluator is None else self.evaluator.with_plans(as_plans(plans))
        other = PlanConditionedActor(plans, evaluator=evaluator, text_encoder=self.text_encoder, **self.config)
        other.encoder, other.decoder = self.encoder, self.decoder
        return other.train(self.training)
