"""The container md: prose, a bullet for each step. "When C, the robot should S.", or in the goal style "When C, move
the robot's gripper until G."

Source: paper section 'Conditional Plan Generation', which tried plans in prose beside those in code.
"""

from __future__ import annotations

from collections.abc import Sequence

from lw_torchrl.language.formats.plan_format import PlanFormat, Style, one_line
from lw_torchrl.language.formats.prose_reader import is_comment, read_prose
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.tasks import Task


def md(style: Style) -> PlanFormat:
    """The format of a style in this container."""

    def prompt(examples: Sequence[ConditionalPlan], task: Task, hints: Sequence[str]) -> str:
        about = "A robot that has one arm with a gripper does each task by the rules below it.\n"
        said = "".join(f"{line}\n" for line in hints)
        return "\n".join([about, *(_write(plan, style) for plan in examples), said + _opening(task)])

    return PlanFormat("md", lambda plan: _write(plan, style), read_prose, prompt, style)


def _opening(task: Task) -> str:
    return f"The task `{task.name}`: {one_line(task.description)}\nThe robot does it reliably by these rules:\n"


def _write(plan: ConditionalPlan, style: Style) -> str:
    lines = []
    if style.explains:
        lines.append("Steps:  " + "  ".join(f"{number}. {step.skill}" for number, step in enumerate(plan.steps, 1)))
    for step, goal in zip(plan.steps, plan.goals, strict=True):
        reason = one_line(step.reason)
        if style.explains and reason and is_comment(reason):  # else it would be read as a step
            lines.append(reason)
        if style.goals and goal is not None:
            lines.append(f"- When {step.condition}, move the robot's gripper until {goal}.")
        else:
            lines.append(f"- When {step.condition}, the robot should {step.skill}.")
    return _opening(plan.definition) + "".join(f"{line}\n" for line in lines)
