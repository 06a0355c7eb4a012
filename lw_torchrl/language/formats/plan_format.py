"""What a plan format is, and the three styles that each container has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lw_torchrl.language.formats.written import Reading
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.tasks import Task


@dataclass(frozen=True)
class Style:
    """What is said of each step, whatever contains it.

    Attributes:
        explains: the steps are listed first, and a reason stands before each clause.
        goals: a skill is written as the state that it is to reach, where it has one.
    """

    explains: bool = False
    goals: bool = False


@dataclass(frozen=True)
class PlanFormat:
    """A way to write a plan.

    Attributes:
        extension: of files that hold such texts, "py" or "md".
        encode: a plan to its text.
        read: any text to what it says, clause by clause; it never raises. ``decode_plan`` makes a plan of it.
        prompt: ``(examples, task, hints)`` to the text that asks a model for a plan of the task: the plans of other
            tasks, lines of hints, then the task's name and description.
        style: what it says of each step, for models that are held to a schema.
    """

    extension: str
    encode: Callable[[ConditionalPlan], str]
    read: Callable[[str], Reading]
    prompt: Callable[[Sequence[ConditionalPlan], Task, Sequence[str]], str]
    style: Style = Style()


STYLES = {"basic": Style(), "chain": Style(explains=True), "goal": Style(explains=True, goals=True)}
"""The paper's three styles by name."""


def one_line(text: str) -> str:
    """A text without the ends of its lines: a description or a reason."""
    return " ".join(text.split())
