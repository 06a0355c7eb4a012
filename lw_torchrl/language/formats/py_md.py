"""The container py_md: a chat message with the functions of :mod:`~lw_torchrl.language.formats.py` in fenced blocks."""

from __future__ import annotations

from collections.abc import Sequence

from lw_torchrl.language.formats.plan_format import PlanFormat, Style
from lw_torchrl.language.formats.py import opening, write
from lw_torchrl.language.formats.python_reader import read_python
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.tasks import Task


def py_md(style: Style) -> PlanFormat:
    """The format of a style in this container."""

    def encode(plan: ConditionalPlan) -> str:
        return f"This function does the task `{plan.task}`:\n\n{_fenced(write(plan, style))}"

    def prompt(examples: Sequence[ConditionalPlan], task: Task, hints: Sequence[str]) -> str:
        return (
            "I control a robot that has one arm with a gripper. A function says what the robot does: each `if` asks "
            "about the state, and its skill is carried out while the answer is yes. These functions do other tasks:\n\n"
            + _fenced("\n".join(write(plan, style) for plan in examples))
            + "".join(f"\n{line}" for line in hints)
            + ("\n" if hints else "")
            + f"\nPlease write the function for `{task.name}` in the same way, the whole of it in one block:\n\n"
            + _fenced(opening(task))
        )

    return PlanFormat("md", encode, read_python, prompt, style)


def _fenced(code: str) -> str:
    return f"```python\n{code}```\n"
