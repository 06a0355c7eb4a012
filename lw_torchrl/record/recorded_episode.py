"""RecordedEpisode: one episode as checked arrays, and where its plan's skills move things to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.skills import SkillError, load_skills
from lw_torchrl.language.tasks import Task

NOBODY = -1
"""In the place of a step's number: no step is in force alone."""


class PlanLike(Protocol):
    """Anything with ``steps`` that have a ``condition``, whose ``str`` is English, and a ``skill``, a string."""

    @property
    def steps(self) -> Sequence[Any]: ...


class TargetPose(NamedTuple):
    """What a scripted skill moves (``moved``) and where to (``position``), each T×3 float32, metres.

    On an axis that the skill leaves alone they are equal. A ``relative`` one goes by a distance from the hand, not to a
    place, so it never arrives.
    """

    position: NDArray[np.float32]
    moved: NDArray[np.float32]
    relative: bool

    @property
    def distance(self) -> NDArray[np.float32]:
        """T float32, metres; NaN for a relative one."""
        gap = np.linalg.norm(self.position - self.moved, axis=1)
        return np.full_like(gap, np.nan) if self.relative else gap


def target_pose(skill: str, task: Task, observation: NDArray[np.float32]) -> TargetPose | None:
    """The target pose of a skill's text in a task (T×39 observations); None where no scripted skill has this text."""
    known = load_skills().get(skill)
    if known is None:
        return None
    try:
        found = known.for_task(task)
    except SkillError:
        return None
    positions = task.positions(torch.from_numpy(observation))
    moved = positions[found.moved].numpy()
    towards = positions[found.target].numpy() + np.asarray(found.offset, np.float32)
    position = np.where(np.asarray(found.gain) > 0, towards, moved).astype(np.float32)
    return TargetPose(position, moved, found.target == GRIPPER)


@dataclass(frozen=True)
class RecordedEpisode:
    """T rows of one episode, checked, on the CPU; S is the number of steps of its plan.

    Attributes:
        observation: T×39 float32; metres, gripper opening in [0,1] at index 3, goal at 36:39.
        action: T×4 float32, displacement xyz and gripper effort in [-1,1].
        objects: name -> T×3 float32 position in metres; the gripper is among them.
        qaf: T×S bool, truth of each condition, or None.
        believed: T×S bool, what a learned evaluator takes for it, or None.
        skill_weights: T×S float32, attention over the steps, or None.
        success: T bool, of the state that the row's action led to, or None.
        reward: T float32, likewise, or None.
        corrected: T float32, how much of a correction counts, or None.
        steps: the S (condition, skill) texts; empty where there is no plan.
        target_poses: of each step; None where its skill is no scripted one.
    """

    observation: NDArray[np.float32]
    action: NDArray[np.float32]
    objects: dict[str, NDArray[np.float32]]
    qaf: NDArray[np.bool_] | None
    believed: NDArray[np.bool_] | None
    skill_weights: NDArray[np.float32] | None
    success: NDArray[np.bool_] | None
    reward: NDArray[np.float32] | None
    corrected: NDArray[np.float32] | None
    steps: tuple[tuple[str, str], ...]
    target_poses: tuple[TargetPose | None, ...] = ()

    @property
    def skills(self) -> list[str]:
        """A text for each column of skill_weights: "1 grasp the handle", or "1" where there is no plan."""
        count = 0 if self.skill_weights is None else self.skill_weights.shape[1]
        texts = [f" {skill}" for _, skill in self.steps] or [""] * count
        return [f"{i}{text}" for i, text in enumerate(texts, 1)]

    @property
    def answers(self) -> NDArray[np.bool_] | None:
        """The truth that the policy went by: the learned evaluator's, where there is one."""
        return self.qaf if self.believed is None else self.believed

    @cached_property
    def in_force(self) -> NDArray[np.int64] | None:
        """T, the step with the largest weight, or without weights the first that holds; -1 where none stands out."""
        if self.skill_weights is not None:
            weights = self.skill_weights
            if weights.shape[1] == 1:
                return np.zeros(len(self), np.int64)
            second, first = np.sort(weights, axis=1)[:, -2:].T
            return np.where(first - second > 1e-6, weights.argmax(axis=1), NOBODY)
        if (answers := self.answers) is not None:
            return np.where(answers.any(axis=1), answers.argmax(axis=1), NOBODY)
        return None

    @property
    def attends_softly(self) -> bool:
        """Whether weights ever lie between 0 and 1."""
        weights = self.skill_weights
        return weights is not None and bool(((weights > 1e-3) & (weights < 1 - 1e-3)).any())

    @property
    def first_success(self) -> int | None:
        """The step at which the task was first seen done: one more than the row whose action did it."""
        if self.success is None or not self.success.any():
            return None
        return int(self.success.argmax()) + 1

    def distance(self) -> NDArray[np.float32] | None:
        """T float32, metres: how far what the skill in force moves is from where it goes; NaN where it goes nowhere."""
        if self.in_force is None:
            return None
        found = np.full(len(self), np.nan, np.float32)
        for step, pose in enumerate(self.target_poses):
            if pose is not None:
                rows = self.in_force == step
                found[rows] = pose.distance[rows]
        return None if np.isnan(found).all() else found

    def with_target_poses(self, task: Task) -> RecordedEpisode:
        """The episode with the target poses of its plan's skills in ``task``."""
        poses = tuple(target_pose(skill, task, self.observation) for _, skill in self.steps)
        return replace(self, target_poses=poses)

    def __len__(self) -> int:
        return len(self.observation)

    @classmethod
    def from_rollout(
        cls, rollout: TensorDictBase, objects: Mapping[str, Any], plan: PlanLike | None = None
    ) -> RecordedEpisode:
        """Check a rollout; see :meth:`lw_torchrl.RerunLogger.log_episode` for the keys and the errors."""
        if not isinstance(rollout, TensorDictBase):
            raise TypeError(f"rollout must be a TensorDict, got {type(rollout).__name__}")
        if len(rollout.batch_size) != 1 or not rollout.batch_size[0]:
            hint = "; take one episode, rollout[i]" if len(rollout.batch_size) > 1 else ""
            raise ValueError(f"rollout must have batch size (T,) with T >= 1, got {tuple(rollout.batch_size)}{hint}")
        steps = tuple((str(step.condition), step.skill) for step in plan.steps) if plan is not None else ()
        length = rollout.batch_size[0]
        executed = ("next", "executed_action")
        action = "action" if rollout.get(executed, None) is None else executed
        logits = _of_steps(rollout, "qaf_logits", length, len(steps))
        return cls(
            observation=_column(rollout, "observation", length, 39),
            action=_column(rollout, action, length, 4),
            objects=_positions(objects, rollout, length),
            qaf=_truth(rollout, "qaf", length, len(steps)),
            believed=None if logits is None else logits > 0,
            skill_weights=_of_steps(rollout, "skill_weights", length, len(steps)),
            success=_flat(_truth(rollout, ("next", "success"), length, 1)),
            reward=_flat(_of_steps(rollout, ("next", "reward"), length, 1)),
            corrected=_flat(_of_steps(rollout, "action_corrected", length, 1)),
            steps=steps,
        )


def _array(value: Any, label: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """``value`` as an array of ``shape`` (None: any size) without NaN or infinity, or a ValueError."""
    tensor = torch.as_tensor(value).detach().cpu()
    allowed = "×".join("S" if size is None else str(size) for size in shape)
    if tensor.ndim != len(shape) or any(s not in (None, n) for s, n in zip(shape, tensor.shape, strict=True)):
        raise ValueError(f"{label} must have shape {allowed}, got {'×'.join(map(str, tensor.shape)) or 'a scalar'}")
    if tensor.dtype == torch.bool:
        return tensor.numpy()
    array = tensor.to(torch.float32).numpy()
    if not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0][0])
        raise ValueError(f"{label} must be finite, got {array[row].tolist()} in row {row}")
    return array


def _column(rollout: TensorDictBase, key: Any, length: int, size: int | None) -> NDArray[Any]:
    value = rollout.get(key, None)
    if value is None:
        found = ", ".join(sorted(map(str, rollout.keys())))
        raise ValueError(f"rollout must have the key {key!r} ({length}×{size}), got {found or 'no keys'}")
    return _array(value, f"rollout[{key!r}]", (length, size))


def _of_steps(rollout: TensorDictBase, key: Any, length: int, steps: int) -> NDArray[Any] | None:
    """An optional column with at least ``steps`` columns; those beyond are padding and dropped."""
    if rollout.get(key, None) is None:
        return None
    array = _column(rollout, key, length, None)
    if array.shape[1] < max(steps, 1):
        raise ValueError(f"rollout[{key!r}] must have a column for each of {steps} plan steps, got {array.shape[1]}")
    return array[:, :steps] if steps else array


def _truth(rollout: TensorDictBase, key: Any, length: int, steps: int) -> NDArray[np.bool_] | None:
    array = _of_steps(rollout, key, length, steps)
    if array is not None and array.dtype != np.bool_:
        raise ValueError(f"rollout[{key!r}] must be bool, got {rollout.get(key).dtype}")
    return array


def _flat(array: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if array is None else array[:, 0]


def _positions(objects: Any, rollout: TensorDictBase, length: int) -> dict[str, NDArray[np.float32]]:
    if not isinstance(objects, Mapping):
        raise TypeError(f"objects must map names to T×3 positions, got {type(objects).__name__}")
    for name in objects:
        if not isinstance(name, str) or not name:
            raise TypeError(f"objects must be named by non-empty strings, got {name!r}")
    checked = {name: _array(value, f"objects[{name!r}]", (length, 3)) for name, value in objects.items()}
    if GRIPPER not in checked:
        checked[GRIPPER] = _column(rollout, "observation", length, 39)[:, :3]
    return checked
