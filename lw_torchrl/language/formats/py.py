"""The container py: a function that looks like Python, ``if check("…"):`` and ``robot.verb("…")`` for each step.

In the goal style a skill is ``robot.move_gripper("above the puck", close_gripper=True)``, the place that the gripper is
to reach, or ``robot.move_gripper(until="the puck is near the target location")`` for any other state.
Source: paper section 'Conditional Plan Generation' and its figure of a plan.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from lw_torchrl.language.formats.chain_py import quote
from lw_torchrl.language.formats.plan_format import PlanFormat, Style, one_line
from lw_torchrl.language.formats.python_reader import read_python
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.plans import ConditionalPlan, PlanStep
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.tasks import Task


def py(style: Style) -> PlanFormat:
    """The format of a style in this container."""

    def prompt(examples: Sequence[ConditionalPlan], task: Task, hints: Sequence[str]) -> str:
        said = "".join(f"# {line}\n" for line in hints)
        return "\n".join([*(write(plan, style) for plan in examples), said + opening(task)])

    return PlanFormat("py", lambda plan: write(plan, style), read_python, prompt, style)


def opening(task: Task) -> str:
    """The lines with which the function of a task begins."""
    return f"# {task.name}: {one_line(task.description)}\ndef {task.name.replace('-', '_')}(robot):\n"


def write(plan: ConditionalPlan, style: Style) -> str:
    """The plan as a function."""
    lines = []
    if style.explains:
        lines += ["# Steps:", *(f"#  {number}. {step.skill}" for number, step in enumerate(plan.steps, 1))]
    for number, (step, goal) in enumerate(zip(plan.steps, plan.goals, strict=True)):
        if style.explains and (reason := one_line(step.reason).lstrip("# ")):
            if number == 0 and re.match(r"\[?\d", reason):
                lines.append("#")  # it would go on with the list
            lines.append(f"# {reason}")
        lines += [f"if check({quote(str(step.condition))}):", f"    robot.{_call(step, goal if style.goals else None)}"]
    return opening(plan.definition) + "".join(f"    {line}\n" for line in lines)


def _call(step: PlanStep, goal: Query | None) -> str:
    if goal is None:
        verb, _, details = step.skill.partition(" ")
        return f"{verb}({quote(details)})"
    first, *others = goal.clauses
    if first.subject != GRIPPER or first.object is None or others not in ([], [_OPEN], [_CLOSED]):
        return f"move_gripper(until={quote(str(goal))})"
    place = quote(str(first).removeprefix(f"the {GRIPPER} is "))
    held = {"open": ", open_gripper=True", "closed": ", close_gripper=True"}
    return f"move_gripper({place}{held[others[0].predicate] if others else ''})"


_OPEN, _CLOSED = Clause(GRIPPER, "open"), Clause(GRIPPER, "closed")
