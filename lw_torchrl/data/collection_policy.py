"""Collection policies: Meta-World's experts, plans with scripted skills, the same with wrong pieces, random actions."""

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

from lw_torchrl._util.checks import Count, Probability, check_choice, shown, typed_fields
from lw_torchrl._util.reproducibility import episode_generator
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.describe import describe
from lw_torchrl.modules.policy import draws
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor
from lw_torchrl.suites.suite import Suite, load_suite


@typed_fields
@dataclass(frozen=True)
class Behaviour:
    """The policy that collects an episode, as a dataset's metadata describe it; equal behaviours act alike.

    A behaviour of kind "segments" divides an episode into segments. In each it follows the plan by scripted skills with
    probability ``right``, and otherwise does something else. Its draws depend only on (task, seed, episode).

    Attributes:
        name: the label of its episodes.
        kind: "expert" (Meta-World's script), "segments", "policy" (a trained one) or "imported" (from other datasets).
        right: for "segments", the probability that a segment follows the plan.
        otherwise: for "segments", the others: "skill", a random skill of the plan, or "action", a random action.
        shortest, longest: for "segments", the number of steps of a segment.
        fingerprint: of the plans of "segments", or of a policy's description and weights; None for a function.

    Example:
        >>> Behaviour("half-right", right=0.5).otherwise
        'skill'
    """

    name: str
    kind: Literal["expert", "segments", "policy", "imported"] = "segments"
    right: Probability = 1.0
    otherwise: Literal["skill", "action"] = "skill"
    shortest: Count = 8
    longest: Count = 24
    fingerprint: str | None = None

    def __post_init__(self) -> None:
        if not self.name.strip() or not self.name.isprintable():
            raise ValueError(f"behaviour: name must be a printable label, got {shown(self.name)}")
        if self.shortest > self.longest:
            raise ValueError(f"behaviour: longest must be at least shortest, {self.shortest}, got {self.longest}")

    @property
    def acts(self) -> Behaviour:
        """The behaviour without the fingerprint of its plans: two behaviours act alike if these are equal."""
        return replace(self, fingerprint=None) if self.kind == "segments" else self

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


EXPERT: Behaviour = Behaviour("expert", "expert")
NOISY = "noisy"  # the label of an expert's episodes that are executed with noise
_SEGMENTS = (
    Behaviour("scripted"),
    Behaviour("noisy-60", right=0.6),
    Behaviour("noisy-30", right=0.3),
    Behaviour("wrong", right=0.0),
    Behaviour("random", right=0.0, otherwise="action"),
)
BEHAVIOURS: Mapping[str, Behaviour] = MappingProxyType(
    {behaviour.name: behaviour for behaviour in (EXPERT, *_SEGMENTS)}
)
"""By name: Meta-World's expert; plans with scripted skills; the same in 60 or 30 of 100 segments, and random skills of
the plan in the others; only random skills of the plan; random actions in [-1, 1]."""


def check_own_label(behaviour: Behaviour) -> None:
    """Raise :class:`ValueError` for a label that is another behaviour's."""
    if behaviour.name == NOISY or behaviour.acts != BEHAVIOURS.get(behaviour.name, behaviour.acts):
        raise ValueError(f"name {behaviour.name!r} is reserved (reserved: {', '.join((*BEHAVIOURS, NOISY))})")


def segment_plans(tasks: Iterable[str], suite: str | Suite = "metaworld") -> Plans:
    """Return the suite's plans for tasks; ValueError for a suite without plans."""
    suite, tasks = load_suite(suite), list(tasks)
    if suite.plans is None:
        raise ValueError(f"policy: suite {suite.name!r} has no plans for this behaviour to follow; give a policy")
    suite.plans.require(tasks)
    return Plans([suite.plans[task] for task in tasks])


def behaviour_of(
    policy: Any, tasks: Iterable[str], name: str | None = None, suite: str | Suite = "metaworld"
) -> Behaviour:
    """Return the behaviour that the argument ``policy`` stands for in tasks of ``suite``, with the label ``name``."""
    if not isinstance(policy, (str, Behaviour, type)) and callable(policy):
        if name is None:
            raise ValueError("behaviour must name the policy, behaviour='my-policy' for example")
        if not isinstance(policy, nn.Module):
            return Behaviour(name, "policy")
        if draws(policy):
            raise ValueError(
                f"policy: this {type(policy).__name__} draws random numbers in the order of its calls, so its episodes "
                "would depend on num_envs and on interruptions"
            )
        return Behaviour(name, "policy", fingerprint=policy_fingerprint(policy))
    if isinstance(policy, str):
        policy = BEHAVIOURS[check_choice("policy", policy, BEHAVIOURS)]
    if not isinstance(policy, Behaviour):
        raise TypeError(f"policy must be a name, a Behaviour, a module or a function, got {type(policy).__name__}")
    if policy.kind in ("policy", "imported"):
        raise ValueError(f"policy: the Behaviour {policy.name!r} only describes a policy; give the policy itself")
    behaviour = policy
    if behaviour.kind == "segments":
        behaviour = replace(behaviour, fingerprint=segment_plans(tasks, suite).fingerprint)
    return behaviour if name is None else replace(behaviour, name=name)


def policy_fingerprint(policy: nn.Module) -> str:
    """Return a digest of a policy's description (of any other module's class), weights and text vectors, which differ
    for another text encoder."""
    try:
        description: object = describe(policy)
    except TypeError:  # a part that cannot be saved
        description = type(policy).__qualname__
    digest = sha256(json.dumps(description, sort_keys=True).encode())
    parts = policy.named_modules(remove_duplicate=False)
    vectors = ((name, getattr(part, "text_vectors", None)) for name, part in parts)
    # Only the signs, because normalised vectors may be rounded differently on another machine.
    texts = {name: vector.sign() for name, vector in vectors if vector is not None}
    state = {key: value for key, value in policy.state_dict().items() if isinstance(value, Tensor)}
    for key, value in sorted({**state, **texts}.items()):
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.detach().cpu().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]


class SegmentActor(TensorDictModuleBase):
    """Act as a :class:`Behaviour` of kind "segments" in episodes of ``max_steps`` steps, from their beginning.

    Reads ``observation`` (N, D) float32, ``task_id`` and ``episode`` (N,) int64, ``qaf`` (N, S) bool and ``_step``
    (N,) bool, the rows that count; writes ``action`` (N, A) float32 in [-1, 1]. An episode begins in a row whose task
    or episode differs from the last call's. ``plans`` has a plan for each task.
    """

    row_by_row = True  # no network: its rows need no blocks of one size

    def __init__(
        self, behaviour: Behaviour, plans: Plans, seed: int, max_steps: int, skills: Skills | None = None
    ) -> None:
        super().__init__()
        self.behaviour, self.plans, self.seed, self.max_steps = behaviour, plans, seed, max_steps
        is_random = behaviour.right == 0 and behaviour.otherwise == "action"
        self.script = None if is_random else ScriptedSkillActor(plans, skills=skills)
        self.in_keys = ["observation", "task_id", "qaf", "episode", "_step"]
        self.out_keys = ["action"]
        self._task = {task_id(task): plan.definition for task, plan in plans.items()}
        self._begun = torch.empty(0, 2, dtype=torch.int64)  # the task and the episode of each row

    def _begin(self, rows: int) -> None:
        shape = rows, self.max_steps
        self._begun, self._step = torch.full((rows, 2), -1), torch.zeros(rows, dtype=torch.int64)
        self._right, self._skill = torch.zeros(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.int64)
        self._random_action = torch.zeros(*shape, self.plans.layout.action_size)

    def _draw(self, row: int, task: int, episode: int) -> None:
        """Draw all segments of an episode at once, so that they do not depend on what else runs."""
        behaviour, definition = self.behaviour, self._task[task]
        draws = episode_generator("segments", definition, self.seed, episode)
        length = draws.integers(behaviour.shortest, behaviour.longest + 1, -(-self.max_steps // behaviour.shortest))
        segment = np.repeat(np.arange(len(length)), length)[: self.max_steps]
        right = draws.random(len(length)) < behaviour.right
        skill = draws.integers(len(self.plans[definition.name].steps), size=len(length))
        action = draws.uniform(-1.0, 1.0, (len(length), self.plans.layout.action_size)).astype(np.float32)
        self._right[row] = torch.from_numpy(right[segment])
        self._skill[row] = torch.from_numpy(skill[segment])
        self._random_action[row] = torch.from_numpy(action[segment])
        self._step[row] = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows = torch.arange(len(tensordict.get("task_id")))
        if len(self._begun) != len(rows):
            self._begin(len(rows))
        now = torch.stack((tensordict.get("task_id"), tensordict.get("episode")), -1)
        active: Tensor = tensordict.get("_step")
        for row in (active & (now != self._begun).any(-1)).nonzero().flatten().tolist():
            self._draw(row, *now[row].tolist())
        self._begun = torch.where(active.unsqueeze(-1), now, self._begun)
        step = self._step.clamp(max=self.max_steps - 1)
        self._step += active
        other = self._random_action[rows, step]
        if self.script is None:
            return tensordict.set("action", other)
        weights, actions = self.script.skill_weights(tensordict), self.script.skill_actions(tensordict)
        if self.behaviour.otherwise == "skill":
            other = actions[rows, self._skill[rows, step]]
        follows = self._right[rows, step].unsqueeze(-1)
        return tensordict.set("action", torch.where(follows, (weights.unsqueeze(-1) * actions).sum(-2), other))
