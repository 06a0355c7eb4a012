"""Collection policies: Meta-World's experts, scripted skills that follow plans (possibly perturbed), random actions."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from lw_torchrl._util.checks import Count, Probability, check_choice, shown, typed_fields
from lw_torchrl._util.registry import ReadOnlyDict
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
    """A collection policy (behaviour), as described in a dataset's metadata; two equal behaviours act identically.

    A behaviour of kind "segments" divides an episode into segments. With probability ``right`` a segment follows the
    plan with scripted skills; other segments are perturbed. The random draws depend only on (task, seed, episode).

    Attributes:
        name: the label of the episodes.
        kind: "expert" (Meta-World's script), "segments", "policy" (a trained policy) or "imported" (another dataset).
        right: for "segments", the probability that a segment follows the plan.
        otherwise: for "segments", the content of the other segments: "skill" (a random skill of the plan) or "action"
            (a random action).
        shortest, longest: for "segments", the minimum and maximum number of time steps in a segment.
        fingerprint: a digest of the plans of "segments", or of a policy's description and weights; None for a function.

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
            raise ValueError(f"behaviour: longest must be at least shortest ({self.shortest}), got {self.longest}")

    @property
    def acts(self) -> Behaviour:
        """The behaviour without the plans' fingerprint, for comparing behaviours of datasets with different tasks."""
        return replace(self, fingerprint=None) if self.kind == "segments" else self

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


EXPERT: Behaviour = Behaviour("expert", "expert")
NOISY = "noisy"  # the label of expert episodes with action noise
_SEGMENTS = (
    Behaviour("scripted"),
    Behaviour("noisy-60", right=0.6),
    Behaviour("noisy-30", right=0.3),
    Behaviour("wrong", right=0.0),
    Behaviour("random", right=0.0, otherwise="action"),
)
BEHAVIOURS: Mapping[str, Behaviour] = ReadOnlyDict({behaviour.name: behaviour for behaviour in (EXPERT, *_SEGMENTS)})
"""The shipped collection policies by name: "expert" (Meta-World's script), "scripted" (scripted skills that follow the
plan), "noisy-60" and "noisy-30" (scripted skills in 60 % or 30 % of the segments, random skills of the plan in the
others), "wrong" (only random skills of the plan) and "random" (random actions in [-1, 1]).
"""


def segment_plans(tasks: Iterable[str], suite: str | Suite = "metaworld") -> Plans:
    """Return the suite's plans for tasks; raise ValueError if the suite has no plans."""
    suite, tasks = load_suite(suite), list(tasks)
    if suite.plans is None:
        raise ValueError(f"policy: suite {suite.name!r} has no plans for this behaviour to follow; pass a policy")
    suite.plans.require(tasks)
    return Plans([suite.plans[task] for task in tasks])


def behaviour_of(
    policy: Any, tasks: Iterable[str], name: str | None = None, suite: str | Suite = "metaworld"
) -> Behaviour:
    """Convert the argument ``policy`` of :func:`collect_demonstrations` to a behaviour with the label ``name``."""
    if not isinstance(policy, (str, Behaviour, type)) and callable(policy):
        if name is None:
            raise ValueError("behaviour must be a label for the policy, for example behaviour='my-policy'; got None")
        if not isinstance(policy, nn.Module):
            return Behaviour(name, "policy")
        if draws(policy):
            problem = f"policy: {type(policy).__name__} draws random numbers, so episodes would depend on num_envs"
            raise ValueError(f"{problem} and interruptions; use a deterministic policy")
        return Behaviour(name, "policy", fingerprint=policy_fingerprint(policy))
    if isinstance(policy, str):
        policy = BEHAVIOURS[check_choice("policy", policy, BEHAVIOURS)]
    if not isinstance(policy, Behaviour) or policy.kind in ("policy", "imported"):
        raise ValueError(f"policy must be a name, a Behaviour of segments, a module or a function, got {shown(policy)}")
    if policy.kind == "segments":
        policy = replace(policy, fingerprint=segment_plans(tasks, suite).fingerprint)
    return policy if name is None else replace(policy, name=name)


def policy_fingerprint(policy: nn.Module) -> str:
    """Return a digest of a policy's description (or class, if it cannot be described), weights and text vectors.

    The text vectors distinguish policies with different text encoders.
    """
    try:
        description: object = describe(policy)
    except TypeError:  # some submodule cannot be saved
        description = type(policy).__qualname__
    digest = sha256(json.dumps(description, sort_keys=True).encode())
    parts = policy.named_modules(remove_duplicate=False)
    vectors = ((name, getattr(part, "text_vectors", None)) for name, part in parts)
    # Use only the signs, because normalized vectors may be rounded differently on another machine.
    texts = {name: vector.sign() for name, vector in vectors if vector is not None}
    state = {key: value for key, value in policy.state_dict().items() if isinstance(value, Tensor)}
    for key, value in sorted({**state, **texts}.items()):
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.detach().cpu().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]


class SegmentActor(TensorDictModuleBase):
    """An actor that carries out a :class:`Behaviour` of kind "segments" in episodes of ``max_steps`` time steps.

    Reads ``observation`` (N, D) float32, ``task_id`` and ``episode`` (N,) int64, ``qaf`` (N, S) bool and ``_step``
    (N,) bool, which marks the running rows; writes ``action`` (N, A) float32 in [-1, 1]. A new episode begins when
    the task or episode of a row differs from the previous call. ``plans`` must have a plan for each task.
    """

    row_by_row = True  # without a network, the result does not depend on the number of rows

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
        self._begun = torch.empty(0, 2, dtype=torch.int64)  # the task id and the episode running in each row

    def _begin(self, rows: int) -> None:
        shape = rows, self.max_steps
        self._begun, self._step = torch.full((rows, 2), -1), torch.zeros(rows, dtype=torch.int64)
        self._right, self._skill = torch.zeros(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.int64)
        self._random_action = torch.zeros(*shape, self.plans.layout.action_size)

    def _draw(self, row: int, task: int, episode: int) -> None:
        """Draw all segments of an episode at once, so that they do not depend on the other running episodes."""
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
