"""Where the scripted skills of a plan are going, and how far what they move is from there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.skills import SkillError, load_skills
from lw_torchrl.language.tasks import Task


class Aim(NamedTuple):
    """What a scripted skill would do, in each of T rows.

    Attributes:
        point: T×3 float32, metres, where it is going; on an axis that it leaves alone, where it is.
        moved: T×3 float32, metres, what is to arrive there.
        relative: it goes by a distance from the hand, not to a place, so it never arrives.
    """

    point: NDArray[np.float32]
    moved: NDArray[np.float32]
    relative: bool

    @property
    def distance(self) -> NDArray[np.float32]:
        """T float32, metres; NaN for a relative one."""
        gap = np.linalg.norm(self.point - self.moved, axis=1)
        return np.full_like(gap, np.nan) if self.relative else gap


def aim_of(skill: str, task: Task, observation: NDArray[np.float32]) -> Aim | None:
    """The aim of the skill with this text in a task (T×39 observations); None where it is no scripted skill's."""
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
    point = np.where(np.asarray(found.gain) > 0, towards, moved).astype(np.float32)
    return Aim(point, moved, found.target == GRIPPER)
