"""PlanEncoder: what a conditional plan says is to be done, and where things are."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Compose, Transform

from lw_torchrl._checks import check_probability, checked
from lw_torchrl.language.canonical import RULES, read_canonical, with_reserve
from lw_torchrl.language.canonical_steps import CanonicalPlan, step_vectors
from lw_torchrl.language.layout import METAWORLD, Layout, places
from lw_torchrl.language.plans import AnyPlans, Plans, PlanStep, as_plans
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.networks import text_to_latent, unit_scale
from lw_torchrl.modules.observation_features import Features, ObservationFeatures
from lw_torchrl.modules.plan_attention import Answers, PlanAttention, attend, attention_logits
from lw_torchrl.modules.policy import Encoder, Encoding
from lw_torchrl.modules.query_evaluator import QueryEvaluator, ReadsPlans
from lw_torchrl.modules.relative_positions import PlanFocus, PlanRoles, RelativePositions
from lw_torchrl.transforms.fallback_turns import FallbackTurns
from lw_torchrl.transforms.qaf import plan_number_key, plan_program
from lw_torchrl.transforms.random_yaw import tilt_key, yaw_key

IN_FORCE = 0.01  # a step whose condition does not hold beside one that does has a weight of 1e-4


class PlanEncoder(ReadsPlans, Encoder):
    """Each skill's text is encoded to a latent, and the conditions' truth gives attention over the steps: the mixed
    latent, beside the observation's features, is what a plan says is to be done now.

    Reads ``observation`` (B, 39) float32, ``task_id`` (B,) int64 and ``qaf`` (B, S) bool; writes ``encoding``
    (B, D + F) float32.

    Args:
        plans: a plan for each task that will be seen.
        features: what is seen of the observation: "raw", the 39 numbers; "differences", the pairwise differences
            between hand, objects and goal, the hand's height and the gripper's opening; "relative", the differences
            alone; "opening", the gripper's opening alone, and "none", nothing, for ``roles``; "both", raw and
            differences.
        feature_noise: standard deviation of the noise on the normalised features while training.
        focus: also see the relative positions of what the steps in force compare, see :class:`PlanFocus`.
        roles: also see the target's position relative to what the step in force moves, see
            :class:`~lw_torchrl.modules.relative_positions.PlanRoles`: for tasks that were not demonstrated.
        canonical: see each plan in its canonical form, see :func:`~lw_torchrl.canonical_plan`: verbs and manners in the
            place of the texts, conditions that cover the usual states. ``plans`` are then these. None for ``roles``,
            which need it.
        reserve: when the plan's own steps get nowhere, try the default plan's, see
            :class:`~lw_torchrl.transforms.FallbackTurns`; ``plans`` then end with these. It needs ``canonical``.
        jitter: standard deviation, in metres, of noise on that position while training, where the gripper pushes.
        swap_unmentioned: the probability, in training, that an object or the goal is put where it is in another row,
            if no step in force mentions it, or with ``roles`` moves it or to it.
        latent_size: D.
        encoder_width, encoder_depth: hidden layers of the skill encoder.
        evaluator: answers the conditions in the place of ``qaf``, which is then not read; see :class:`QueryEvaluator`.
            With ``canonical`` those of the canonical plans.
        answers: what an evaluator's logit counts in the attention's softmax, where exact truth counts 5 and -5:
            "logit", the logit; "tanh", 5·tanh(logit / 2), the paper's 10·p - 5 of the probability p; "hard", 5 or -5
            by its sign, with the gradient of "tanh".
        text_encoder: texts to vectors (n, E) float32; None for the shipped sentence encoder.
        in_keys, out_keys: other names for what it reads and writes, in the order above; nested ones too.

    Attributes:
        skills: the K different skill texts, sorted.

    Raises:
        ValueError: as for :class:`PlanConditionedActor`; at call time, an evaluator's logits of another shape.
        TypeError: at call time, logits that are no floats.

    Example:
        >>> import lw_torchrl as lw
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torch import nn
        >>> trunk = PlanEncoder(lw.load_plans("MT10"))
        >>> head = TensorDictModule(nn.Linear(trunk.width, 1), in_keys=["encoding"], out_keys=["state_value"])
        >>> TensorDictSequential(trunk, head).in_keys
        ['observation', 'task_id', 'qaf']

    Source: paper section 'Plan Conditioning' and its figure of the architecture.
    """

    plan_options = True
    text_vectors: Tensor
    skill_index: Tensor
    mentioned: Tensor
    turns: Tensor

    @checked
    def __init__(
        self,
        plans: AnyPlans,
        *,
        features: Features = "differences",
        feature_noise: float = 0.0,
        focus: bool = False,
        roles: bool = False,
        canonical: bool | None = None,
        reserve: bool = False,
        jitter: float = 0.0,
        swap_unmentioned: float = 0.0,
        latent_size: int = 64,
        encoder_width: int = 128,
        encoder_depth: int = 1,
        evaluator: QueryEvaluator | None = None,
        answers: Answers = "logit",
        text_encoder: TextEncoder | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.written = as_plans(plans)
        canonical = roles if canonical is None else canonical
        if roles and not canonical:
            raise ValueError("canonical must be true with roles=True, which are those of canonical plans")
        if reserve and not canonical:
            raise ValueError("canonical must be true with reserve=True, which holds canonical steps")
        found = map(read_canonical, self.written.values() if canonical else ())
        self.canonical = {one.written.task: with_reserve(one) if reserve else one for one in found}
        seen_plans = Plans([one.plan for one in self.canonical.values()]) if canonical else self.written
        if canonical and evaluator is not None and evaluator.plans.fingerprint == self.written.fingerprint:
            evaluator = evaluator.with_plans(seen_plans)
        self.read_plans(seen_plans, evaluator, in_keys, out_keys, ("encoding",))
        if evaluator is not None and (focus or roles or swap_unmentioned):
            raise ValueError(
                "focus, roles and swap_unmentioned read exact truth, which an evaluator takes away; "
                "lw.evaluate(actor, evaluator=...) evaluates what has learned with it"
            )
        if features in ("opening", "none") and not (focus or roles):
            shows = "shows nothing of where things are; it needs roles=True or focus=True"
            raise ValueError(f"features={features!r} {shows}")
        if jitter and not roles:
            raise ValueError(f"jitter moves the way of the roles, and roles is False; got jitter={jitter}")
        if evaluator is None and answers != "logit":
            raise ValueError(f"answers={answers!r} needs an evaluator, whose logits it changes; evaluator is None")
        seen: dict[str, Any] = dict(features=features, feature_noise=feature_noise, focus=focus, roles=roles)
        seen |= dict(canonical=canonical, reserve=reserve, jitter=jitter)
        texts = dict(latent_size=latent_size, encoder_width=encoder_width, encoder_depth=encoder_depth)
        altered = {"swap_unmentioned": check_probability("swap_unmentioned", swap_unmentioned)}
        self.config: dict[str, Any] = {**seen, **altered, **texts, "in_keys": self.own_keys}
        if evaluator is not None:
            self.config["answers"] = answers
        self.text_encoder = text_encoder
        self.skills = self.plans.skills
        vectors = None if self.canonical else encoded(self.skills, text_encoder)
        self.attention = PlanAttention(self.plans)
        # The tables come from the plans, not from training: they are not part of the state that is saved.
        self.register_buffer("turns", _turns(self.canonical, self.attention.tables), persistent=False)
        index = self.attention.tables.skill_index
        if vectors is None:
            index, vectors = _canonical_skills(self.canonical, self.attention.tables)
        self.register_buffer("skill_index", index, persistent=False)
        self.register_buffer("text_vectors", unit_scale(vectors), persistent=False)
        self.latent_size = latent_size
        self.texts = text_to_latent(vectors.shape[1], latent_size, encoder_width, encoder_depth)
        self.focus = PlanFocus(self.plans, self.attention.tables, feature_noise) if focus else None
        self.roles = PlanRoles(self.canonical, self.attention.tables, feature_noise, jitter) if roles else None
        about = mentioned(self.plans, self.attention.tables, self.roles)
        self.register_buffer("mentioned", about, persistent=False)
        self.features = ObservationFeatures(features, feature_noise, self.plans.layout)

    @property
    def width(self) -> int:
        return super().width + sum(part.width for part in self._relative)

    @property
    def _relative(self) -> list[RelativePositions]:
        return [part for part in (self.focus, self.roles) if part is not None]

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """What no trained parameter touches: attention (B, S), the index of each step's skill (B, S) int64, and the
        observation's features (B, F). With an evaluator, the mask of real steps (B, S) bool in the attention's place,
        and behind the features what the evaluator reads."""
        observation, task, *rest = self.read(tensordict)
        rows = self.attention.tables.rows(task)
        if self.evaluator is not None:
            asked = [tensordict.get(key) for key in self.evaluator.in_keys]
            return self._in_turn(tensordict, rows), self.skill_index[rows], self.features(observation), *asked
        self.attention.tables.refuse_others(tensordict.get(plan_number_key(self.in_keys[2]), None), rows)
        weights = self.attention.over_steps(rest[0], rows, self._in_turn(tensordict, rows))
        if self.training:
            observation = self._augmented(observation, weights, rows)
        yaw = tensordict.get(yaw_key(self.in_keys[0]), None)
        relative = [] if self.focus is None else [self.focus(observation, weights, rows, yaw)]
        if self.roles is not None:
            tilt = tensordict.get(tilt_key(self.in_keys[0]), None)
            relative.append(self.roles(observation, weights, rows, yaw, tilt))
        seen = torch.cat((self.features(observation), *relative), -1) if relative else self.features(observation)
        return weights, self.skill_index[rows], seen

    def transform(self) -> Transform | None:
        asked = super().transform()
        if not self.config["reserve"]:
            return asked
        turns = FallbackTurns(self.plans.layout, in_keys=self.own_keys[:1])
        return turns if asked is None else Compose(asked, turns)

    def _in_turn(self, tensordict: TensorDictBase, rows: Tensor) -> Tensor:
        """(B, S) bool, the steps whose turn it is: the plan's own, or those in reserve."""
        if not self.config["reserve"]:
            return self.attention.mask[rows]
        turn = tensordict.get("turn", None)
        return self.turns[rows, torch.zeros_like(rows) if turn is None else turn % 2]

    def _augmented(self, observation: Tensor, weights: Tensor, rows: Tensor) -> Tensor:
        in_force = weights > IN_FORCE
        if probability := self.config["swap_unmentioned"]:
            kept = (in_force.unsqueeze(-1) & self.mentioned[rows]).any(-2)
            observation = swap_unmentioned(observation, kept, probability, self.plans.layout)
        return observation

    def fit_contacts(self, observation: Tensor, task_id: Tensor) -> None:
        """As :meth:`PlanRoles.fit`."""
        if self.roles is not None:
            truth = plan_program(self.plans)(observation, task_id)
            rows = self.attention.tables.rows(task_id)
            observation, truth, rows = (found.to(self.turns.device) for found in (observation, truth, rows))
            self.roles.fit(observation, self.attention.over_steps(truth, rows, self.turns[rows, 0]), rows)

    def check_rules(self, found: Mapping[str, Any]) -> None:
        """Raise :class:`ValueError` if a description is of a policy that saw plans by other rules than these."""
        if self.canonical and found.get("rules") != RULES:
            made = f"version {found['rules']!r:.20}" if "rules" in found else "those before version 1"
            raise ValueError(
                f"it was trained with {made} of the rules for canonical plans, here is {RULES}: train it again"
            )

    def weights(self, *prepared: Tensor) -> Tensor:
        """From what :meth:`prepare` gives to the attention (B, S)."""
        if self.evaluator is None:
            return prepared[0]
        steps, _, _, *asked = prepared
        logits = self.evaluator.answers(*asked)
        if logits.shape != steps.shape:
            wanted = f"{tuple(steps.shape)}, a row for each observation, got shape {tuple(logits.shape)}"
            raise ValueError(f"logits of {type(self.evaluator).__name__} must be {wanted}")
        return attend(attention_logits(logits, self.config["answers"]), steps)

    def encode(self, *prepared: Tensor) -> Encoding:
        weights = self.weights(*prepared)
        # A product with (B, K) is faster than picking (B, S, D) latents, forwards and backwards.
        latents = self.latents()
        over_skills = weights.new_zeros((*weights.shape[:-1], len(latents))).scatter_add(-1, prepared[1], weights)
        return Encoding(over_skills.to(latents.dtype) @ latents, prepared[2], weights)

    def latents(self) -> Tensor:
        """(K, D), the latent of each skill; of canonical plans, of each kind of step."""
        return self.texts(self.text_vectors)

    def describe(self) -> dict[str, Any]:
        rules = {"rules": RULES} if self.canonical else {}
        return {**super().describe(), "plans": self.written.to_json(), **rules}

    @property
    def trust(self) -> dict[str, float]:
        """Of each task, how far its plan as written is trusted; empty if the policy does not see canonical plans."""
        return {task: found.trust for task, found in self.canonical.items()}

    def with_plans(self, plans: AnyPlans) -> PlanEncoder:
        evaluator = None if self.evaluator is None else self.evaluator.with_plans(as_plans(plans))
        other = PlanEncoder(plans, evaluator=evaluator, text_encoder=self.text_encoder, **self.config)
        other.texts, other.features = self.texts, self.features.for_layout(other.plans.layout)
        if self.roles is not None and other.roles is not None:
            other.roles.share_contact(self.roles)
        return other.train(self.training)


def _turns(plans: Mapping[str, CanonicalPlan], tables: PlanTables) -> Tensor:
    """(T, 2, S) bool, the steps of a plan's own turn, and of that in reserve."""
    found = tables.mask.unsqueeze(1).repeat(1, 2, 1)
    for task, plan in plans.items():
        if plan.reserve:
            found[tables.index.row(task), 0, len(plan.steps) :] = False
            found[tables.index.row(task), 1, : len(plan.steps)] = False
    return found


def _canonical_skills(plans: Mapping[str, CanonicalPlan], tables: PlanTables) -> tuple[Tensor, Tensor]:
    """The index (T, S) int64 of each step's vector, and the different vectors (K, E) float32."""
    index, different = torch.zeros_like(tables.skill_index), dict[tuple[float, ...], int]()
    for task, plan in sorted(plans.items()):
        for number, vector in enumerate(step_vectors(plan)):
            index[tables.index.row(task), number] = different.setdefault(tuple(vector), len(different))
    return index, torch.tensor([*different])


def _names(step: PlanStep, task: Task) -> set[str]:
    names = {name for clause in step.condition.clauses for name in (clause.subject, clause.object) if name}
    text = step.skill
    for name in sorted(task.object_names, key=len, reverse=True):  # "drawer handle" is no "drawer"
        text, found = re.subn(rf"(?<![\w-]){re.escape(name)}(?![\w-])", " ", text)
        if found:
            names.add(name)
    return names


def mentioned(plans: Plans, tables: PlanTables, roles: PlanRoles | None = None) -> Tensor:
    """(T, S, P) bool: whether a step mentions each thing of the layout, and the goal; with ``roles``, or moves it."""
    of_parts = [{number for part in parts for number in places(part)} for parts in plans.layout.parts]
    table = torch.zeros(len(plans), plans.num_steps, len(of_parts), dtype=torch.bool)
    for task, plan in plans.items():
        for number, step in enumerate(plan.steps):
            for name in _names(step, plan.definition):
                for thing, place in enumerate(of_parts):
                    if place.intersection(plan.definition.object(name).position):
                        table[tables.index.row(task), number, thing] = True
    if roles is not None:
        ends = torch.cat((roles.begin, roles.end), -1).flatten(2)  # (T, S, 6)
        for thing, place in enumerate(of_parts):
            table[..., thing] |= torch.isin(ends, torch.tensor(sorted(place))).any(-1)
    return table


def swap_unmentioned(observation: Tensor, kept: Tensor, probability: float, layout: Layout = METAWORLD) -> Tensor:
    """Put what no step in force mentions where it is in another row of the batch, drawn from PyTorch's global
    generator, so that a policy cannot rely on it. ``kept`` (..., P) bool tells which things, and the goal, are."""
    rows, kept = observation.reshape(-1, observation.shape[-1]), kept.reshape(-1, len(layout.parts))
    swapped, number, device = rows.clone(), len(rows), observation.device
    for thing, parts in enumerate(layout.parts):
        away = ~kept[:, thing] & (torch.rand(number, device=device) < probability)
        others = rows[torch.randint(number, (number,), device=device)]
        for part in parts:
            swapped[:, part] = torch.where(away.unsqueeze(-1), others[:, part], rows[:, part])
    return swapped.reshape(observation.shape)
