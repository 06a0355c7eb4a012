"""PlanFormat: how a plan is written and prompted for; and the clauses that a reader finds in a text."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.tasks import Task


@dataclass(frozen=True)
class Style:
    """The content of each step."""

    explains: bool = False  # list the steps first, and write a reason before each clause
    goals: bool = False  # write a skill as the state that it is to reach, if it has one


@dataclass(frozen=True)
class PlanFormat:
    """A way to write plans.

    ``prompt`` maps ``(examples, task, hints)`` to the text that asks a model for a plan: the plans of other tasks,
    lines of hints, then the task's name and description.
    """

    extension: str  # of files with such texts, "py" or "md"
    encode: Callable[[ConditionalPlan], str]
    read: Callable[[str], Reading]  # finds the clauses in any text; it never raises
    prompt: Callable[[Sequence[ConditionalPlan], Task, Sequence[str]], str]
    style: Style = Style()  # for models that are constrained to a schema


STYLES = {"basic": Style(), "chain": Style(explains=True), "goal": Style(explains=True, goals=True)}
"""The paper's three styles by name."""

END = re.compile(r"\[eod\]|<\|(?:endoftext|end_of_text|im_end|eot_id)\|>")  # some models write their end token
_ITEM = re.compile(r"\s*\[?(\d{1,4})[.):\]]\s*(\S.*)")


@dataclass(frozen=True)
class Note:
    """A remark on a line (from 1) of a text: it was left out, or read as something else."""

    line: int
    text: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.text}"


@dataclass(frozen=True)
class Clause:
    """A condition and its skill, in the words of the text."""

    line: int  # of the condition, from 1
    condition: str  # "the robot's gripper is not above mug"
    skill: str  # "put gripper above mug"; "" if there is only a goal
    goal: str = ""  # the state to reach, "the robot's gripper is above mug"
    reason: str = ""  # the comment before the clause


@dataclass
class Section:
    """The clauses for one task."""

    task: str  # "" before any name: such text continues the prompt
    line: int  # its first line
    clauses: list[Clause] = field(default_factory=list)  # in the order of the text
    listed: str = ""  # the list of steps before the clauses, "1. first  2. second"


@dataclass
class Reading:
    """The content of a text: at least one section, and notes on what was left out."""

    sections: list[Section] = field(default_factory=lambda: [Section("", 1)])
    notes: list[Note] = field(default_factory=list)

    @property
    def section(self) -> Section:
        return self.sections[-1]

    def note(self, line: int, text: str) -> None:
        self.notes.append(Note(line, text))

    def open(self, task: str, line: int) -> None:
        """Begin the section of a task. A heading and a ``def`` right below it begin one section together."""
        if self.section.task != task or self.section.clauses:
            self.sections.append(Section(task, line))


def listed_steps(text: str, count: int) -> list[str]:
    """Return the items of a list of ``count`` steps, "1. first  2. second"; [] if the text is not such a list."""
    for gap in (r"\s\s+(?=\[?\d)", r"\s(?=\[?\d{1,3}[.):\]]\s)"):
        items = [item(part) for part in re.split(gap, text.strip())]
        if len(items) == count and all(each and each[0] == number for number, each in enumerate(items, 1)):
            return [each[1] for each in items if each]
    return []


def item(text: str) -> tuple[int, str] | None:
    """Return the number and the words of a list's item, "1. Put the gripper above the mug"."""
    match = _ITEM.fullmatch(text)
    return (int(match[1]), match[2].strip()) if match else None
