"""SkillProgram: the scripted skills of many tasks as index tensors, run for a mixed batch in one call."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lw_torchrl._util.checks import check_choice
from lw_torchrl.language.objects import coordinate_indices
from lw_torchrl.language.skills import ScriptedSkill, Skills, load_skills
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import Task, get_task, one_layout, task_ids


class _Tables(NamedTuple):
    """The skills (S) of each task; the first dimension is of tasks (T) where compiled, of rows where selected."""

    target: Tensor  # (T, 3*S) int64, index of each coordinate of where to
    moved: Tensor  # (T, 3*S) int64, of what is to arrive there
    gain: Tensor  # (T, 3*S) float64
    shift: Tensor  # (T, 3*S) float64, gain times offset
    effort: Tensor  # (T, S, A) float64, zeros and the gripper's
    constants: Tensor  # (T, C) float64, read as if they followed the observation


class SkillProgram(nn.Module):
    """Lists of scripted skills compiled once; every skill of every row acts in one call.

    Args:
        skills: task name (or :class:`Task`) to its skills, each a :class:`ScriptedSkill` or the text of one.
        table: where texts are looked up; None for the shipped skills.

    Example:
        >>> from lw_torchrl.language.tasks import task_id
        >>> program = SkillProgram({"push": ["place the gripper above the puck"]})
        >>> program(torch.zeros(1, 39), torch.tensor([task_id("push")])).shape
        torch.Size([1, 1, 4])

    Source: paper section 'Scripted Skills'.
    """

    def __init__(self, skills: Mapping[str | Task, Sequence[str | ScriptedSkill]], table: Skills | None = None) -> None:
        known = load_skills() if table is None else table
        if not skills:
            raise ValueError("skills must name at least one task, got an empty mapping")

        def look_up(skill: str | ScriptedSkill) -> ScriptedSkill:
            return skill if isinstance(skill, ScriptedSkill) else known[check_choice("skill", skill, known)]

        found: dict[Task, list[ScriptedSkill]] = {}
        for task, listed in ((get_task(name), listed) for name, listed in skills.items()):
            if isinstance(listed, (str, ScriptedSkill)) or not listed:
                raise ValueError(f"skills[{task.name!r}] must be a list of at least one skill, got {listed!r}")
            found[task] = [look_up(skill).for_task(task) for skill in listed]
        super().__init__()
        self.layout = layout = one_layout(found)
        self._displaced = layout.displaced("scripted skills")
        self.num_skills = max(map(len, found.values()))  # S, the length of the longest list
        index = TaskIndex(task_ids(task.name for task in found))
        constants = [0.0]
        place = torch.full((len(found), 2, self.num_skills, 3), layout.size)
        numbers = torch.zeros(len(found), 2, self.num_skills, 3, dtype=torch.float64)  # gain, gain times offset
        effort = torch.zeros(len(found), self.num_skills, layout.action_size, dtype=torch.float64)
        for task, listed in found.items():
            t = index.row(task.name)
            for s, skill in enumerate(listed):
                ends = task.object(skill.target), task.object(skill.moved)
                for side, end in enumerate(ends):
                    place[t, side, s] = torch.tensor(coordinate_indices(end.position, constants, layout.size))
                offsets = torch.tensor([skill.offset, *(end.offset for end in ends)], dtype=torch.float64)
                numbers[t, 0, s] = torch.tensor(skill.gain, dtype=torch.float64)
                numbers[t, 1, s] = numbers[t, 0, s] * (offsets[0] + offsets[1] - offsets[2])
                effort[t, s, layout.effort] = layout.closes * skill.gripper
        fixed = torch.tensor([constants] * len(found), dtype=torch.float64)
        (target, moved), (gain, shift) = place.flatten(2).unbind(1), numbers.flatten(2).unbind(1)
        self._tables = TaskTables(index, _Tables(target, moved, gain, shift, effort, fixed), "tasks without skills")

    def forward(self, observation: Tensor, task_id: Tensor) -> Tensor:
        """The action of each skill, of observation (..., D) float, as the tasks' layout says, and task_id (...) int64.

        Returns:
            (..., S, A) of the observation's dtype: an action of the layout, in Meta-World displacement xyz and gripper
            effort, each in [-1, 1]; zeros beyond the task's last skill. A task without skills is a :class:`ValueError`.
        """
        size, ids = self.layout.size, tuple(task_id.shape)
        if observation.shape[-1:] != (size,) or ids != observation.shape[:-1]:
            got = f"{tuple(observation.shape)} and {ids}"
            raise ValueError(f"observation must be of shape (..., {size}) and task_id of (...), got {got}")
        tables = self._tables.select(task_id.reshape(-1), observation)
        state = torch.cat((observation.reshape(-1, size), tables.constants), 1)
        way = state.gather(1, tables.target) - state.gather(1, tables.moved)
        shift = torch.addcmul(tables.shift, tables.gain, way).clamp_(-1.0, 1.0)
        action = tables.effort.clone()
        action[..., self._displaced] = shift.unflatten(1, (-1, 3))
        return action.reshape(*task_id.shape, self.num_skills, self.layout.action_size)
