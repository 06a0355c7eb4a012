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

from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.skills import load_skills
from lw_torchrl.language.tasks import Task
from lw_torchrl.record.entities import STEP_TIME, time_columns
from lw_torchrl.record.meshes import Motion
from lw_torchrl.suites.suite import Suite

APART = 0.01  # metres between two episodes that have parted
NOBODY = -1  # in the place of a step's number: no step is in force alone


class PlanLike(Protocol):
    """Anything with ``steps`` that have a ``condition``, whose ``str`` is English, and a ``skill``, a string."""

    @property
    def steps(self) -> Sequence[Any]: ...


class TargetPose(NamedTuple):
    """What a scripted skill moves (``moved``) and where to (``position``), each T×3 float32, metres.

    Equal on an axis that the skill leaves alone. A ``relative`` one goes by a distance from the hand: it never arrives.
    """

    position: NDArray[np.float32]
    moved: NDArray[np.float32]
    relative: bool

    @property
    def distance(self) -> NDArray[np.float32]:
        """T float32, metres; NaN for a relative one."""
        gap = np.linalg.norm(self.position - self.moved, axis=1)
        return np.full_like(gap, np.nan) if self.relative else gap


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode of T rows as checked arrays on the CPU; S is the number of steps of its plan."""

    observation: NDArray[np.float32]  # T×D, as the layout says; metres, gripper opening in [0,1]
    action: NDArray[np.float32]  # T×A, of Meta-World displacement xyz and gripper effort, in [-1,1]
    objects: dict[str, NDArray[np.float32]]  # name -> T×3 position in metres; the gripper is among them
    qaf: NDArray[np.bool_] | None  # T×S, truth of each condition
    believed: NDArray[np.bool_] | None  # T×S, what a learned evaluator takes for it
    skill_weights: NDArray[np.float32] | None  # T×S, attention over the steps
    success: NDArray[np.bool_] | None  # T, of the state that the row's action led to
    reward: NDArray[np.float32] | None  # T, likewise
    corrected: NDArray[np.float32] | None  # T, how much of a correction counts
    steps: tuple[tuple[str, str], ...]  # the S (condition, skill) texts; empty where there is no plan
    target_poses: tuple[TargetPose | None, ...] = ()  # of each step; None where its skill is no scripted one
    layout: Layout = METAWORLD
    reasons: tuple[str, ...] = ()  # what the plan says of each step, how it was written for one
    pixels: NDArray[np.uint8] | None = None  # T×H×W×3, what the policy or its evaluator saw
    step_time: float = STEP_TIME  # seconds between two actions

    def times(self, steps: NDArray[np.int64]) -> list[Any]:
        """Return the timelines of these steps."""
        return time_columns(steps, self.step_time)

    def at(self, step: int) -> str:
        """Return the words for a time step, "t = 80 (1.00 s)", which differ from those for a plan's step."""
        return f"t = {step} ({step * self.step_time:.2f} s)"

    @property
    def answers(self) -> NDArray[np.bool_] | None:
        """The truth that the policy used: the learned evaluator's if there is one."""
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
    def first_success(self) -> int | None:
        """The step at which the task was first seen as done: one after the row whose action did it."""
        if self.success is None or not self.success.any():
            return None
        return int(self.success.argmax()) + 1

    @cached_property
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

    def with_target_poses(self, task: Task, suite: Suite | None) -> RecordedEpisode:
        """Return the episode with the target poses of its plan's skills in ``task``."""
        scripted = load_skills() if suite is None or suite.skills is None else suite.skills
        positions = task.positions(torch.from_numpy(self.observation))
        poses: list[TargetPose | None] = [None] * len(self.steps)
        for step, (_, text) in enumerate(self.steps):
            if text in scripted and scripted[text].suits(task):
                skill = scripted[text].for_task(task)
                moved = positions[skill.moved].numpy()
                towards = positions[skill.target].numpy() + np.asarray(skill.offset, np.float32)
                position = np.where(np.asarray(skill.gain) > 0, towards, moved).astype(np.float32)
                poses[step] = TargetPose(position, moved, skill.target == GRIPPER)
        return replace(self, target_poses=tuple(poses))

    def __len__(self) -> int:
        return len(self.observation)

    @classmethod
    def from_rollout(
        cls,
        rollout: TensorDictBase,
        objects: Mapping[str, Any],
        plan: PlanLike | None = None,
        layout: Layout = METAWORLD,
        step_time: float = STEP_TIME,
    ) -> RecordedEpisode:
        """Check a rollout; see :meth:`lw_torchrl.RerunLogger.log_episode` for the keys and the errors."""
        if len(rollout.batch_size) != 1 or not rollout.batch_size[0]:
            hint = "; take one episode, rollout[i]" if len(rollout.batch_size) > 1 else ""
            raise ValueError(f"rollout must have batch size (T,) with T >= 1, got {tuple(rollout.batch_size)}{hint}")
        steps = tuple((str(step.condition), step.skill) for step in plan.steps) if plan is not None else ()
        length = rollout.batch_size[0]

        def column(key: Any, size: int | None) -> NDArray[Any]:
            value = rollout.get(key, None)
            if value is None:
                raise ValueError(f"rollout must have the key {key!r} ({length}×{size}), got {sorted(rollout.keys())}")
            return _array(value, f"rollout[{key!r}]", (length, size))

        def optional(key: Any, *, flat: bool = False, truth: bool = False) -> NDArray[Any] | None:
            """A column for each step of the plan, or a flat one; what is beyond them is padding and dropped."""
            if rollout.get(key, None) is None:
                return None
            array, needed = column(key, None), 1 if flat else len(steps)
            if array.shape[1] < max(needed, 1):
                columns = f"a column for each of {needed} plan steps, got {array.shape[1]}"
                raise ValueError(f"rollout[{key!r}] must have {columns}")
            if truth and array.dtype != np.bool_:
                raise ValueError(f"rollout[{key!r}] must be bool, got {rollout.get(key).dtype}")
            return array[:, 0] if flat else array[:, : needed or None]

        logits, observation = optional("qaf_logits"), column("observation", layout.size)
        places = {name: _array(value, f"objects[{name!r}]", (length, 3)) for name, value in objects.items()}
        places.setdefault(GRIPPER, observation[:, layout.positions[0]])
        pixels = rollout.get("pixels", None)
        executed = ("next", "executed_action")
        return cls(
            observation=observation,
            action=column("action" if rollout.get(executed, None) is None else executed, layout.action_size),
            objects=places,
            qaf=optional("qaf", truth=True),
            believed=None if logits is None else logits > 0,
            skill_weights=optional("skill_weights"),
            success=optional(("next", "success"), flat=True, truth=True),
            reward=optional(("next", "reward"), flat=True),
            corrected=optional("action_corrected", flat=True),
            steps=steps,
            layout=layout,
            step_time=step_time,
            reasons=tuple(getattr(step, "reason", "") for step in plan.steps) if plan is not None else (),
            pixels=None if pixels is None else pixels.numpy(force=True),
        )


@dataclass(frozen=True)
class MendedRecording:
    """The same episode as it goes with a part replaced, ``by`` something: the ghost beside it."""

    by: str
    episode: RecordedEpisode
    motion: Motion | None = None

    def parts_at(self, other: RecordedEpisode) -> int:
        """The first row in which the hand or a thing is elsewhere, by more than a centimetre; else the last of both."""
        length = min(len(self.episode), len(other))
        gap = np.zeros(length)
        for place in other.layout.positions:
            apart = self.episode.observation[:length, place] - other.observation[:length, place]
            gap = np.maximum(gap, np.linalg.norm(apart, axis=1))
        return int((gap > APART).argmax()) if (gap > APART).any() else length - 1


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
