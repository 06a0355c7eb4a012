"""Compiled scripted skills: the skills of many tasks as index tensors, evaluated for a mixed batch in one call."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lw_torchrl._util.checks import check_choice
from lw_torchrl.language.objects import coordinate_indices
from lw_torchrl.language.skills import ScriptedSkill, Skills, load_skills
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import Task, lists_by_task, one_layout, task_ids


class _Tables(NamedTuple):
    """The skills (S) of each task; the first dimension is tasks (T) or, after indexing by task, rows of a batch."""

    target: Tensor  # (T, 3*S) int64, index of each coordinate of the target
    moved: Tensor  # (T, 3*S) int64, index of each coordinate of the moved object
    gain: Tensor  # (T, 3*S) float64
    shift: Tensor  # (T, 3*S) float64, gain times offset
    effort: Tensor  # (T, S, A) float64, actions that are zero except for the gripper's effort
    constants: Tensor  # (T, C) float64, indexed as if they followed the observation


class SkillProgram(nn.Module):
    """A module that compiles scripted skills once and returns the action of every skill for every row of a batch.

    Args:
        skills: a mapping from task names (or :class:`Task`) to lists of skills (:class:`ScriptedSkill` or texts).
        table: the known skills by text; None for the shipped skills.

    Example:
        >>> from lw_torchrl.language.tasks import task_id
        >>> program = SkillProgram({"push": ["place the gripper above the puck"]})
        >>> program(torch.zeros(1, 39), torch.tensor([task_id("push")])).shape
        torch.Size([1, 1, 4])

    Source: paper section 'Scripted Skills'.
    """

    def __init__(self, skills: Mapping[str | Task, Sequence[str | ScriptedSkill]], table: Skills | None = None) -> None:
        known = load_skills() if table is None else table

        def skill_of(skill: str | ScriptedSkill) -> ScriptedSkill:
            return known[check_choice("skill", skill, known)] if isinstance(skill, str) else skill

        lists = lists_by_task("skills", skills)
        compiled = {task: [skill_of(skill).for_task(task) for skill in listed] for task, listed in lists.items()}
        super().__init__()
        self.layout = layout = one_layout(compiled)
        self._displaced = layout.displaced("scripted skills")
        self.num_skills = max(map(len, compiled.values()))  # the number of skills S in the longest list
        index = TaskIndex(task_ids(task.name for task in compiled))
        constants = [0.0]
        place = torch.full((len(compiled), 2, self.num_skills, 3), layout.size)
        numbers = torch.zeros(len(compiled), 2, self.num_skills, 3, dtype=torch.float64)  # gain, gain times offset
        effort = torch.zeros(len(compiled), self.num_skills, layout.action_size, dtype=torch.float64)
        for task, scripted in compiled.items():
            t = index.row(task.name)
            for s, skill in enumerate(scripted):
                ends = task.object(skill.target), task.object(skill.moved)
                for side, end in enumerate(ends):
                    place[t, side, s] = torch.tensor(coordinate_indices(end.position, constants, layout.size))
                offsets = torch.tensor([skill.offset, *(end.offset for end in ends)], dtype=torch.float64)
                numbers[t, 0, s] = torch.tensor(skill.gain, dtype=torch.float64)
                numbers[t, 1, s] = numbers[t, 0, s] * (offsets[0] + offsets[1] - offsets[2])
                effort[t, s, layout.effort] = layout.closes * skill.gripper
        fixed = torch.tensor([constants] * len(compiled), dtype=torch.float64)
        (target, moved), (gain, shift) = place.flatten(2).unbind(1), numbers.flatten(2).unbind(1)
        self._tables = TaskTables(index, _Tables(target, moved, gain, shift, effort, fixed), "tasks without skills")

    def forward(self, observation: Tensor, task_id: Tensor) -> Tensor:
        """Compute the actions of all skills of each row's task.

        Args:
            observation: (..., D) float, in the tasks' layout.
            task_id: (...) int64, ids of tasks with skills.

        Returns:
            (..., S, A) actions in the observation's dtype, each number in [-1, 1]; in Meta-World an action is the
            displacement (x, y, z) and the gripper's effort. Padding after the task's last skill is zero.

        Raises:
            ValueError: the inputs have a wrong shape, or a task has no skills.
        """
        size, ids = self.layout.size, tuple(task_id.shape)
        if observation.shape[-1:] != (size,) or ids != observation.shape[:-1]:
            shapes = f"{tuple(observation.shape)} and {ids}"
            raise ValueError(f"observation must have shape (..., {size}) and task_id shape (...), got {shapes}")
        tables = self._tables.select(task_id.reshape(-1), observation)
        state = torch.cat((observation.reshape(-1, size), tables.constants), 1)
        error = state.gather(1, tables.target) - state.gather(1, tables.moved)
        displacement = torch.addcmul(tables.shift, tables.gain, error).clamp_(-1.0, 1.0)
        action = tables.effort.clone()
        action[..., self._displaced] = displacement.unflatten(1, (-1, 3))
        return action.reshape(*task_id.shape, self.num_skills, self.layout.action_size)
