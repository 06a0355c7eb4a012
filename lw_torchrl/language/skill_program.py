"""SkillProgram: the scripted skills of many tasks as index tensors, run for a mixed batch in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from lw_torchrl._checks import unknown_name
from lw_torchrl.language.observation import OBSERVATION_SIZE
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import TASKS, Task, coordinate_index, get_task, task_id

_KEPT_ROWS = 4096  # of the last batch, the most to keep the tables of


class SkillProgram:
    """Lists of scripted skills compiled once; every skill of every row acts in one call.

    Args:
        skills: task name (or :class:`Task`) to its skills, each a :class:`ScriptedSkill` or the text of one.
        table: where texts are looked up; None for the shipped skills.

    Attributes:
        num_skills: S, the length of the longest list.

    Raises:
        SkillError: (a ValueError) a skill speaks of objects that its task lacks.
        ValueError: an unknown task or text (with the nearest).

    Example:
        >>> import torch
        >>> from lw_torchrl.language.tasks import task_id
        >>> program = SkillProgram({"push": ["place the gripper above the puck"]})
        >>> program(torch.zeros(1, 39), torch.tensor([task_id("push")])).shape
        torch.Size([1, 1, 4])

    Source: paper section 'Scripted Skills'.
    """

    def __init__(
        self,
        skills: Mapping[str | Task, Sequence[str | ScriptedSkill]],
        table: Mapping[str, ScriptedSkill] | None = None,
    ) -> None:
        known = load_skills() if table is None else table
        if not skills:
            raise ValueError("skills must name at least one task, got an empty mapping")
        for name, listed in skills.items():
            if isinstance(listed, (str, ScriptedSkill)) or not listed:
                raise ValueError(
                    f"skills[{get_task(name).name!r}] must be a list of at least one skill, got {listed!r}"
                )
        found = {
            get_task(task): [_look_up(skill, known).for_task(task) for skill in listed]
            for task, listed in skills.items()
        }
        self.num_skills = max(map(len, found.values()))
        self._column = torch.full((len(TASKS),), -1)
        constants = [0.0]
        index = torch.full((len(found), 2, self.num_skills, 3), OBSERVATION_SIZE)
        numbers = torch.zeros(len(found), 2, self.num_skills, 3, dtype=torch.float64)  # gain, gain times offset
        effort = torch.zeros(len(found), self.num_skills, 4, dtype=torch.float64)
        for t, (task, listed) in enumerate(found.items()):
            self._column[task_id(task.name)] = t
            for s, skill in enumerate(listed):
                target, moved = task.object(skill.target), task.object(skill.moved)
                index[t, 0, s] = torch.tensor([coordinate_index(c, constants) for c in target.position])
                index[t, 1, s] = torch.tensor([coordinate_index(c, constants) for c in moved.position])
                offsets = torch.tensor([skill.offset, target.offset, moved.offset], dtype=torch.float64)
                numbers[t, 0, s] = torch.tensor(skill.gain, dtype=torch.float64)
                numbers[t, 1, s] = numbers[t, 0, s] * (offsets[0] + offsets[1] - offsets[2])
                effort[t, s, 3] = skill.gripper
        self._tables = (*index.flatten(2).unbind(1), *numbers.flatten(2).unbind(1), effort)
        self._constants = torch.tensor(constants, dtype=torch.float64)
        self._last: tuple[Tensor, torch.dtype, tuple[Tensor, ...]] | None = None

    def _selected(self, task_ids: Tensor, observation: Tensor) -> tuple[Tensor, ...]:
        """The tables' rows for a batch, kept for the next: the rows of an environment keep their tasks."""
        if self._last is not None:
            ids, dtype, tables = self._last
            if dtype == observation.dtype and ids.device == observation.device and torch.equal(ids, task_ids):
                return tables
        row = self._column.to(task_ids.device)[task_ids.clamp(0, len(TASKS) - 1)]
        if not (known := (row >= 0) & (task_ids >= 0) & (task_ids < len(TASKS))).all():
            raise ValueError(f"task_id {int(task_ids[~known][0])} has no skills")
        moved = [table.to(observation if table.is_floating_point() else observation.device) for table in self._tables]
        tables = (*(table[row] for table in moved), self._constants.to(observation).expand(len(row), -1))
        if len(row) <= _KEPT_ROWS:
            self._last = (task_ids.clone(), observation.dtype, tables)
        return tables

    def __call__(self, observation: Tensor, task_id: Tensor) -> Tensor:
        """The action of each skill.

        Args:
            observation: (..., 39) float, Meta-World's vector, metres.
            task_id: (...) int64.

        Returns:
            (..., S, 4) of the observation's dtype: displacement xyz and gripper effort, each in [-1, 1]; zeros
            beyond the task's last skill.

        Raises:
            ValueError: a wrong shape, or a task without skills.
        """
        if observation.shape[-1:] != (OBSERVATION_SIZE,) or task_id.shape != observation.shape[:-1]:
            raise ValueError(
                f"observation must be of shape (..., {OBSERVATION_SIZE}) and task_id of (...), got "
                f"{tuple(observation.shape)} and {tuple(task_id.shape)}"
            )
        target, moved, gain, offset, effort, constants = self._selected(task_id.reshape(-1), observation)
        state = torch.cat((observation.reshape(-1, OBSERVATION_SIZE), constants), 1)
        shift = torch.addcmul(offset, gain, state.gather(1, target) - state.gather(1, moved)).clamp_(-1.0, 1.0)
        action = effort.clone()
        action[..., :3] = shift.unflatten(1, (-1, 3))
        return action.reshape(*task_id.shape, self.num_skills, 4)


def _look_up(skill: str | ScriptedSkill, table: Mapping[str, ScriptedSkill]) -> ScriptedSkill:
    if isinstance(skill, ScriptedSkill):
        return skill
    if skill not in table:
        raise unknown_name("skill", skill, table)
    return table[skill]
