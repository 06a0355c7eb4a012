"""What a plan format is: how a plan is written and asked for, and what a reader finds in a text."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.tasks import Task


@dataclass(frozen=True)
class Style:
    """What is said of each step."""

    explains: bool = False  # the steps are listed first, and a reason stands before each clause
    goals: bool = False  # a skill is written as the state that it is to reach, if it has one


@dataclass(frozen=True)
class PlanFormat:
    """A way to write a plan.

    ``prompt`` maps ``(examples, task, hints)`` to the text that asks a model for a plan of the task: the plans of other
    tasks, lines of hints, then the task's name and description.
    """

    extension: str  # of files that hold such texts, "py" or "md"
    encode: Callable[[ConditionalPlan], str]
    read: Callable[[str], Reading]  # finds the clauses in any text; it never raises
    prompt: Callable[[Sequence[ConditionalPlan], Task, Sequence[str]], str]
    style: Style = Style()  # what it writes for each step, for models that are constrained to a schema


STYLES = {"basic": Style(), "chain": Style(explains=True), "goal": Style(explains=True, goals=True)}
"""The paper's three styles by name."""

END = re.compile(r"\[eod\]|<\|(?:endoftext|end_of_text|im_end|eot_id)\|>")  # where some models say that they end
_ITEM = re.compile(r"\s*\[?(\d{1,4})[.):\]]\s*(\S.*)")


@dataclass(frozen=True)
class Note:
    """A remark on a line (from 1) of a text: that something was left out, or taken for something else."""

    line: int
    text: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.text}"


@dataclass(frozen=True)
class Clause:
    """A condition and what to do, in the words of the text."""

    line: int  # where the condition stands, from 1
    condition: str  # "the robot's gripper is not above mug"
    skill: str  # "put gripper above mug"; "" if only a state to reach is said
    goal: str = ""  # that state, "the robot's gripper is above mug"
    reason: str = ""  # what the text says before the clause


@dataclass
class Section:
    """What a text says for one task."""

    task: str  # "" without a name: what goes on from where the prompt ended
    line: int  # where it begins
    clauses: list[Clause] = field(default_factory=list)  # in the order of the text
    listed: str = ""  # the steps listed before the clauses, "1. first  2. second"


@dataclass
class Reading:
    """All that a reader found in a text: at least one section, and what it left out."""

    sections: list[Section] = field(default_factory=lambda: [Section("", 1)])
    notes: list[Note] = field(default_factory=list)

    @property
    def section(self) -> Section:
        return self.sections[-1]

    def note(self, line: int, text: str) -> None:
        self.notes.append(Note(line, text))

    def open(self, task: str, line: int) -> None:
        """Begin the section of a task that is named here; a heading and a ``def`` right below it begin one together."""
        if self.section.task != task or self.section.clauses:
            self.sections.append(Section(task, line))


def listed_steps(text: str, count: int) -> list[str]:
    """The items of a list of ``count`` steps, "1. first  2. second"; empty if it is none. One space is accepted too."""
    for gap in (r"\s\s+(?=\[?\d)", r"\s(?=\[?\d{1,3}[.):\]]\s)"):
        items = [item(part) for part in re.split(gap, text.strip())]
        if len(items) == count and all(found and found[0] == number for number, found in enumerate(items, 1)):
            return [found[1] for found in items if found]
    return []


def item(text: str) -> tuple[int, str] | None:
    """The number and the words of an item of a list, "1. Put the gripper above the mug"."""
    found = _ITEM.fullmatch(text)
    return (int(found[1]), found[2].strip()) if found else None
