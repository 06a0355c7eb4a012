"""The RecordedEpisode class: one episode as validated arrays, and the targets of the skills in the plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.skills import load_skills
from lw_torchrl.language.tasks import Task
from lw_torchrl.record.entities import STEP_TIME, check_image, time_columns
from lw_torchrl.record.meshes import Motion
from lw_torchrl.suites.suite import Suite

APART = 0.01  # two episodes diverge when the hand or an object is this far apart, metres
NO_STEP = -1  # used instead of a plan step's index if no single step is active


@runtime_checkable
class PlanLike(Protocol):
    """An object with ``steps``; each step has a ``condition`` (shown with ``str``) and a ``skill`` (a string)."""

    @property
    def steps(self) -> Sequence[Any]: ...


class TargetPose(NamedTuple):
    """Positions (T×3, metres) of a skill's target and of the moved object; equal on axes that the skill ignores."""

    position: NDArray[np.float32]
    moved: NDArray[np.float32]
    relative: bool  # whether the target moves with the hand, so that the hand never reaches the target

    @property
    def distance(self) -> NDArray[np.float32]:
        """The distance (T,) in metres between the moved object and its target; NaN for a relative target."""
        distance = np.linalg.norm(self.position - self.moved, axis=1)
        return np.full_like(distance, np.nan) if self.relative else distance


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode of T rows as validated arrays on the CPU; S is the number of plan steps."""

    action: NDArray[np.float32]  # T×A in [-1, 1] (in Meta-World: xyz displacement, gripper effort); A may be 0
    objects: dict[str, NDArray[np.float32]]  # name -> T×3 positions in metres; includes the gripper if layout is given
    layout: Layout | None = METAWORLD  # None if the robot's layout is unknown: only objects are drawn
    observation: NDArray[np.float32] | None = None  # T×D, described by the layout; metres, gripper opening in [0, 1]
    qaf: NDArray[np.bool_] | None = None  # T×S, whether each condition holds
    believed: NDArray[np.bool_] | None = None  # T×S, whether each condition holds according to a learned evaluator
    skill_weights: NDArray[np.float32] | None = None  # T×S, attention over the plan steps
    success: NDArray[np.bool_] | None = None  # T, success in the state after the row's action
    reward: NDArray[np.float32] | None = None  # T, reward of the row's action
    steps: tuple[tuple[str, str], ...] = ()  # S (condition, skill) texts; empty without a plan
    guards: tuple[Any, ...] = ()  # S conditions: queries, or other objects that ``str`` can show
    reasons: tuple[str, ...] = ()  # S texts: a plan step's comment, or the skill as originally written
    target_poses: tuple[TargetPose | None, ...] = ()  # S; None for a skill that is not scripted
    pixels: NDArray[np.uint8] | None = None  # T×H×W×C, the input images of the policy or the evaluator
    step_time: float = STEP_TIME  # seconds between two actions

    def __len__(self) -> int:
        return len(self.action)

    def times(self, steps: NDArray[np.int64]) -> list[Any]:
        """Return the columns of the episode's two timelines for the time steps ``steps``."""
        return time_columns(steps, self.step_time)

    def at(self, step: int) -> str:
        """Return a time step as text: "t = 80 (1.00 s)"."""
        return f"t = {step} ({step * self.step_time:.2f} s)"

    @property
    def answers(self) -> NDArray[np.bool_] | None:
        """The truth values (T×S) that the policy used, from a learned evaluator if there is one."""
        return self.qaf if self.believed is None else self.believed

    @property
    def goal(self) -> NDArray[np.float32] | None:
        """The goal positions (T×3, metres), or None without a layout."""
        if self.observation is None or self.layout is None:
            return None
        return np.ascontiguousarray(self.observation[:, self.layout.positions[-1]])

    @property
    def opening(self) -> NDArray[np.float32] | None:
        """The gripper opening (T,) from 0 to 1, or None without a layout."""
        return None if self.observation is None or self.layout is None else self.observation[:, self.layout.opening]

    @cached_property
    def active(self) -> NDArray[np.int64] | None:
        """The index (T,) of the active plan step, or -1 if there is none.

        The active step is the one with the largest weight or, without weights, the first whose condition holds.
        """
        if self.skill_weights is not None:
            weights = self.skill_weights
            if weights.shape[1] == 1:
                return np.zeros(len(self), np.int64)
            second, first = np.sort(weights, axis=1)[:, -2:].T
            return np.where(first - second > 1e-6, weights.argmax(axis=1), NO_STEP)
        if (answers := self.answers) is not None:
            return np.where(answers.any(axis=1), answers.argmax(axis=1), NO_STEP)
        return None

    @property
    def first_success(self) -> int | None:
        """The first time step at which the task is solved: one step after the row whose action solved the task."""
        if self.success is None or not self.success.any():
            return None
        return int(self.success.argmax()) + 1

    @cached_property
    def distance(self) -> NDArray[np.float32] | None:
        """The distance (T,) float32 in metres to the active skill's target; NaN in rows without a target."""
        if self.active is None:
            return None
        distance = np.full(len(self), np.nan, np.float32)
        for step, pose in enumerate(self.target_poses):
            if pose is not None:
                rows = self.active == step
                distance[rows] = pose.distance[rows]
        return None if np.isnan(distance).all() else distance

    def with_target_poses(self, task: Task, suite: Suite | None) -> RecordedEpisode:
        """Return a copy of the episode that also holds the target poses of the plan's scripted skills for the task
        ``task``."""
        skills = load_skills() if suite is None or suite.skills is None else suite.skills
        assert self.observation is not None
        positions = task.positions(torch.from_numpy(self.observation))
        poses: list[TargetPose | None] = [None] * len(self.steps)
        for step, (_, text) in enumerate(self.steps):
            if text in skills and skills[text].suits(task):
                skill = skills[text].for_task(task)
                moved = positions[skill.moved].numpy()
                target = positions[skill.target].numpy() + np.asarray(skill.offset, np.float32)
                position = np.where(np.asarray(skill.gain) > 0, target, moved).astype(np.float32)
                poses[step] = TargetPose(position, moved, skill.target == GRIPPER)
        return replace(self, target_poses=tuple(poses))

    @classmethod
    def from_rollout(
        cls,
        rollout: TensorDictBase,
        objects: Mapping[str, Any],
        plan: PlanLike | None = None,
        layout: Layout | None = METAWORLD,
        step_time: float = STEP_TIME,
    ) -> RecordedEpisode:
        """Validate a rollout and return the episode; see :meth:`lw_torchrl.RerunLogger.log_episode` for the keys."""
        if len(rollout.batch_size) != 1 or not rollout.batch_size[0]:
            hint = "; select one episode, rollout[i]" if len(rollout.batch_size) > 1 else ""
            raise ValueError(f"rollout must have batch size (T,) with T >= 1, got {tuple(rollout.batch_size)}{hint}")
        steps = tuple((str(step.condition), step.skill) for step in plan.steps) if plan is not None else ()
        length = rollout.batch_size[0]

        def column(key: Any, size: int | None) -> NDArray[Any]:
            value = rollout.get(key, None)
            if value is None:
                raise ValueError(f"rollout must have the key {key!r} ({length}×{size}), got {sorted(rollout.keys())}")
            return _array(value, f"rollout[{key!r}]", (length, size))

        def optional(key: Any, *, flat: bool = False, truth: bool = False) -> NDArray[Any] | None:
            """Return an array T×S with one column per plan step, without padding, or T if ``flat``. If ``truth``,
            numbers above 0.5 become True."""
            if rollout.get(key, None) is None:
                return None
            array, needed = column(key, None), 1 if flat else len(steps)
            if array.shape[1] < max(needed, 1):
                raise ValueError(f"rollout[{key!r}] must have at least {max(needed, 1)} columns, got {array.shape[1]}")
            array = array > 0.5 if truth and array.dtype != np.bool_ else array
            return array[:, 0] if flat else array[:, : needed or None]

        executed: Any = ("next", "executed_action")
        action_key = "action" if rollout.get(executed, None) is None else executed
        positions = {name: _array(value, f"objects[{name!r}]", (length, 3)) for name, value in objects.items()}
        if layout is not None:
            observation, action = column("observation", layout.size), column(action_key, layout.action_size)
            positions.setdefault(GRIPPER, observation[:, layout.positions[0]])
        else:
            observation, value = None, rollout.get(action_key, torch.zeros(length, 0))
            action = _array(value[:, None].flatten(1).float(), "rollout['action']", (length, None))
        logits, pixels = optional("qaf_logits"), rollout.get("pixels", None)
        return cls(
            action=action,
            objects=positions,
            layout=layout,
            observation=observation,
            qaf=optional("qaf", truth=True),
            believed=None if logits is None else logits > 0,
            skill_weights=optional("skill_weights"),
            success=optional(("next", "success"), flat=True, truth=True),
            reward=optional(("next", "reward"), flat=True),
            steps=steps,
            guards=() if plan is None else tuple(step.condition for step in plan.steps),
            reasons=() if plan is None else tuple(map(_reason, plan.steps)),
            pixels=None if pixels is None else np.stack([check_image("pixels", picture) for picture in pixels]),
            step_time=step_time,
        )


@dataclass(frozen=True)
class Ghost:
    """A re-run of an episode with a repaired part of the policy, drawn translucently; ``by`` describes the repair."""

    by: str
    episode: RecordedEpisode
    motion: Motion | None = None

    def parts_at(self, other: RecordedEpisode) -> int:
        """Return the first row in which the hand or an object is more than 1 cm away from its position in ``other``, or
        the last row if there is no such row."""
        length = min(len(self.episode), len(other))
        if self.episode.observation is None or other.observation is None or other.layout is None:
            return length - 1
        difference = self.episode.observation[:length] - other.observation[:length]
        distances = [np.linalg.norm(difference[:, place], axis=1) for place in other.layout.positions]
        apart = np.max(distances, axis=0) > APART
        return int(apart.argmax()) if apart.any() else length - 1


def _reason(step: Any) -> str:
    """Return the comment on a plan step, or, for a canonical plan, the original text of the step."""
    if (role := getattr(step, "role", None)) is None:
        return str(getattr(step, "reason", ""))
    written = f"as written: {role.written}" if role.written and role.written != step.skill else ""
    return "fallback" if role.fallback else written


def _array(value: Any, label: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """Convert ``value`` to an array; raise a ValueError unless it has ``shape`` (None: any size) and is finite."""
    tensor = torch.as_tensor(value).detach().cpu()
    if tensor.ndim != len(shape) or any(s not in (None, n) for s, n in zip(shape, tensor.shape, strict=True)):
        allowed = "×".join("S" if size is None else str(size) for size in shape)
        raise ValueError(f"{label} must have shape {allowed}, got {'×'.join(map(str, tensor.shape)) or 'a scalar'}")
    array = tensor.numpy() if tensor.dtype == torch.bool else tensor.to(torch.float32).numpy()
    if not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0][0])
        raise ValueError(f"{label} must be finite, got {array[row].tolist()} in row {row}")
    return array
