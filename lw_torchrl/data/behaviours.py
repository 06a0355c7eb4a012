"""Who acts in a dataset's episodes: Meta-World's experts, plans with scripted skills, sound or spoilt, chance."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from lw_torchrl._checks import check_choice, check_fields, check_int, check_probability, shown
from lw_torchrl._seeding import episode_generator
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor
from lw_torchrl.suites.suite import Suite, load_suite

_MOST_STEPS = 100_000
_OF_SEGMENTS = ("right", "otherwise", "shortest", "longest")


@dataclass(frozen=True)
class Behaviour:
    """Who acts in an episode, as a dataset's metadata say it; equal ones act alike.

    A behaviour of kind "segments" acts in pieces of an episode. In each it follows the plan by scripted skills with
    probability ``right``, and does something else otherwise. Its draws depend only on (task, seed, episode).

    Attributes:
        name: the label of its episodes.
        kind: "expert", Meta-World's script; "segments"; "policy", a trained one; or "imported", of others' episodes.
        right, shortest, longest: of "segments", the probability that a piece follows the plan, and a piece's steps.
        otherwise: of "segments", what it does elsewhere: "skill", any one of the plan's, or "action", one in [-1, 1].
        fingerprint: of the plans of "segments", or of a policy's description and weights; None until it is known, and
            of a function.

    Example:
        >>> Behaviour("half-right", right=0.5).otherwise
        'skill'
    """

    name: str
    kind: Literal["expert", "segments", "policy", "imported"] = "segments"
    right: float = 1.0
    otherwise: Literal["skill", "action"] = "skill"
    shortest: int = 8
    longest: int = 24
    fingerprint: str | None = None

    def __post_init__(self) -> None:
        check_fields(self, "behaviour: ")
        if not 0 < len(self.name) <= 100 or not self.name.isprintable() or self.name != self.name.strip():
            raise ValueError(f"behaviour: name must be a label of 1 to 100 characters, got {shown(self.name)}")
        object.__setattr__(self, "right", check_probability("behaviour: right", self.right))
        for field in ("shortest", "longest"):
            object.__setattr__(self, field, check_int(f"behaviour: {field}", getattr(self, field), minimum=1))
        if not self.shortest <= self.longest <= _MOST_STEPS:
            allowed = f"from shortest, {shown(self.shortest)}, to {_MOST_STEPS}"
            raise ValueError(f"behaviour: longest must be {allowed}, got {shown(self.longest)}")
        odd = [name for name in _OF_SEGMENTS if getattr(self, name) != getattr(Behaviour, name)]
        if self.kind != "segments" and odd:
            raise ValueError(f"behaviour: {', '.join(odd)} is of kind 'segments', got kind {self.kind!r}")

    @property
    def acts(self) -> Behaviour:
        """What it does given the same plans: two behaviours act alike if these are equal."""
        return replace(self, fingerprint=None) if self.kind == "segments" else self

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, stated: Any) -> Behaviour:
        """The behaviour that :meth:`to_json` gave; :class:`ValueError` or :class:`TypeError` if it is none."""
        if not isinstance(stated, Mapping) or set(stated) != set(names := cls.__dataclass_fields__):
            raise ValueError(f"policy must be an object of {', '.join(names)}, got {shown(stated)}")
        return cls(**stated)


EXPERT = Behaviour("expert", "expert")
NOISY = "noisy"  # the label of the expert's episodes where they are executed with noise
_SEGMENTS = (
    Behaviour("scripted"),
    Behaviour("spoilt-60", right=0.6),
    Behaviour("spoilt-30", right=0.3),
    Behaviour("wrong", right=0.0),
    Behaviour("random", right=0.0, otherwise="action"),
)
BEHAVIOURS: Mapping[str, Behaviour] = MappingProxyType({one.name: one for one in (EXPERT, *_SEGMENTS)})
"""By name: Meta-World's expert; plans with scripted skills; the same in 60 or 30 of 100 pieces, and any skill of the
plan in the others; any skill of the plan throughout; one action in [-1, 1] after another."""


def check_own_label(behaviour: Behaviour) -> None:
    """Raise :class:`ValueError` for a label that is another behaviour's."""
    if behaviour.name == NOISY or behaviour.acts != BEHAVIOURS.get(behaviour.name, behaviour.acts):
        others = ", ".join((*BEHAVIOURS, NOISY))
        raise ValueError(f"behaviour must be a label of its own, {behaviour.name!r} is another's: {others}")


def segment_plans(tasks: Iterable[str], suite: str | Suite = "metaworld") -> Plans:
    """The plans that behaviours of kind "segments" carry out, or spoil: the suite's; ValueError without."""
    suite, tasks = load_suite(suite), list(tasks)
    if suite.plans is None:
        what = f"suite {suite.name!r} has no plans, which this behaviour follows"
        raise ValueError(f"policy: {what}; give a policy of yours")
    suite.plans.require(tasks)
    return Plans([suite.plans[task] for task in tasks])


def behaviour_of(
    policy: Any, tasks: Iterable[str], name: str | None = None, suite: str | Suite = "metaworld"
) -> Behaviour:
    """The behaviour in these tasks of ``suite`` that an argument ``policy`` stands for, perhaps under another name."""
    if not isinstance(policy, (str, Behaviour, type)) and callable(policy):
        if name is None:
            raise ValueError("behaviour must name the policy in the dataset, behaviour='my-policy' say, got None")
        if not isinstance(policy, nn.Module):
            return Behaviour(name, "policy")
        if isinstance(policy, Policy) and policy.draws:
            why = "so its episodes would depend on num_envs and on interruptions"
            raise ValueError(f"policy: this {type(policy).__name__} draws in the order in which it is called, {why}")
        return Behaviour(name, "policy", fingerprint=policy_fingerprint(policy))
    if isinstance(policy, str):
        policy = BEHAVIOURS[check_choice("policy", policy, BEHAVIOURS)]
    if not isinstance(policy, Behaviour):
        raise TypeError(f"policy must be a name, a Behaviour, a module or a function, got {type(policy).__name__}")
    found: Behaviour = policy
    if found.kind in ("policy", "imported"):
        of = "of a trained policy; give the policy itself" if found.kind == "policy" else "of others: import_dataset"
        raise ValueError(f"policy: the Behaviour {found.name!r} is {of}")
    if found.kind == "segments":
        found = replace(found, fingerprint=segment_plans(tasks, suite).fingerprint)
    return found if name is None else replace(found, name=name)


def policy_fingerprint(policy: nn.Module) -> str:
    """A digest of a policy's description, or any module's class, of its weights and text vectors, which show another
    text encoder."""
    described = policy.describe() if isinstance(policy, Policy) else type(policy).__qualname__
    digest = sha256(json.dumps(described, sort_keys=True).encode())
    # Their signs, since the scale that they are brought to may round otherwise elsewhere.
    named = policy.named_buffers(remove_duplicate=False)
    texts = {name: vectors.sign() for name, vectors in named if name.rpartition(".")[2] == "text_vectors"}
    stated = {key: value for key, value in policy.state_dict().items() if isinstance(value, Tensor)}
    for key, value in sorted({**stated, **texts}.items()):
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.detach().cpu().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]


class SegmentActor(TensorDictModuleBase):
    """Acts as a :class:`Behaviour` of kind "segments", in episodes of ``max_steps`` that are run from their beginning.

    Reads ``observation`` (N, D) float32, ``task_id`` and ``episode`` (N,) int64, ``qaf`` (N, S) bool and ``_step``
    (N,) bool, the rows that count; writes ``action`` (N, A) float32 in [-1, 1]. An episode begins in a row whose task
    or episode differs from the last call's. ``plans`` has a plan for each task, of ``skills`` unless all is chance.
    """

    row_by_row = True  # no network: its rows need no blocks of one size

    def __init__(
        self, behaviour: Behaviour, plans: Plans, seed: int, max_steps: int, skills: Skills | None = None
    ) -> None:
        super().__init__()
        self.behaviour, self.plans, self.seed, self.max_steps = behaviour, plans, seed, max_steps
        chance = behaviour.right == 0 and behaviour.otherwise == "action"
        self.script = None if chance else ScriptedSkillActor(plans, skills=skills)
        self.in_keys = ["observation", "task_id", "qaf", "episode", "_step"]
        self.out_keys = ["action"]
        self._task = {task_id(task): plan.definition for task, plan in plans.items()}
        self._begun = torch.empty(0, 2, dtype=torch.int64)

    def _begin(self, rows: int) -> None:
        steps = rows, self.max_steps
        self._begun, self._done = torch.full((rows, 2), -1), torch.zeros(rows, dtype=torch.int64)
        self._right, self._skill = torch.zeros(steps, dtype=torch.bool), torch.zeros(steps, dtype=torch.int64)
        self._held = torch.zeros(*steps, self.plans.layout.action_size)

    def _draw(self, row: int, task: int, episode: int) -> None:
        how, definition = self.behaviour, self._task[task]
        draws = episode_generator("segments", definition, self.seed, episode)
        length = draws.integers(how.shortest, how.longest + 1, -(-self.max_steps // how.shortest))
        pieces = np.repeat(np.arange(len(length)), length)[: self.max_steps]
        right = draws.random(len(length)) < how.right
        skill = draws.integers(len(self.plans[definition.name].steps), size=len(length))
        held = draws.uniform(-1.0, 1.0, (len(length), self.plans.layout.action_size)).astype(np.float32)
        self._right[row] = torch.from_numpy(right[pieces])
        self._skill[row] = torch.from_numpy(skill[pieces])
        self._held[row] = torch.from_numpy(held[pieces])
        self._done[row] = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows = torch.arange(len(tensordict.get("task_id")))
        if len(self._begun) != len(rows):
            self._begin(len(rows))
        now = torch.stack((tensordict.get("task_id"), tensordict.get("episode")), -1)
        active: Tensor = tensordict.get("_step")
        for row in (active & (now != self._begun).any(-1)).nonzero().flatten().tolist():
            self._draw(row, *now[row].tolist())
        self._begun = torch.where(active.unsqueeze(-1), now, self._begun)
        step = self._done.clamp(max=self.max_steps - 1)
        self._done += active
        other = self._held[rows, step]
        if self.script is None:
            return tensordict.set("action", other)
        weights, actions = self.script.prepare(tensordict)
        if self.behaviour.otherwise == "skill":
            other = actions[rows, self._skill[rows, step]]
        follows = self._right[rows, step].unsqueeze(-1)
        return tensordict.set("action", torch.where(follows, (weights.unsqueeze(-1) * actions).sum(-2), other))
