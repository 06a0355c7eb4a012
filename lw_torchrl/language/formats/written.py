"""What a text says of plans, before anything is made of it: clauses as they are written, each with its line."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

END = re.compile(r"\[eod\]|<\|(?:endoftext|end_of_text|im_end|eot_id)\|>")
"""What some models write where their answer ends; what follows is none of it."""
_ITEM = re.compile(r"\s*\[?(\d{1,4})[.):\]]\s*(\S.*)")


@dataclass(frozen=True)
class Note:
    """Something a reader of the text should know: that something was left out, or taken for something else.

    Attributes:
        line: the line it is about, from 1.
        text: what.
    """

    line: int
    text: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.text}"


@dataclass(frozen=True)
class Clause:
    """A condition and what to do, in the words of the text.

    Attributes:
        line: where the condition stands, from 1.
        condition: "the robot's gripper is not above mug".
        skill: "put gripper above mug"; "" if only a state to reach is said.
        goal: that state, "the robot's gripper is above mug"; "" if there is none.
        reason: what the text says before the clause.
    """

    line: int
    condition: str
    skill: str
    goal: str = ""
    reason: str = ""


@dataclass
class Section:
    """What a text says for one task.

    Attributes:
        task: the name it gives; "" where it gives none, but goes on from what the prompt began.
        line: where it begins.
        clauses: in the order of the text.
        listed: the steps it lists before the clauses, "1. first  2. second".
    """

    task: str
    line: int
    clauses: list[Clause] = field(default_factory=list)
    listed: str = ""


@dataclass
class Reading:
    """All that a reader found in a text: at least one section, and what it left out."""

    sections: list[Section] = field(default_factory=lambda: [Section("", 1)])
    notes: list[Note] = field(default_factory=list)

    def note(self, line: int, text: str) -> None:
        self.notes.append(Note(line, text))

    def open(self, task: str, line: int) -> Section:
        """The section of a task that is named here; a heading and a ``def`` right below it open one together."""
        last = self.sections[-1]
        if last.task != task or last.clauses:
            last = Section(task, line)
            self.sections.append(last)
        return last


def listed_steps(text: str, count: int) -> list[str]:
    """The items of a list of ``count`` steps, "1. first  2. second"; an empty list if it is no such list.

    Two spaces stand between items, in which there are none; a text that has only one is taken at its word too.
    """
    for gap in (r"\s\s+(?=\[?\d)", r"\s(?=\[?\d{1,3}[.):\]]\s)"):
        items = [item(part) for part in re.split(gap, text.strip())]
        if len(items) == count and all(found and found[0] == number for number, found in enumerate(items, 1)):
            return [found[1] for found in items if found]
    return []


def item(text: str) -> tuple[int, str] | None:
    """The number and the words of an item of a list, "1. Put the gripper above the mug"."""
    found = _ITEM.fullmatch(text)
    return (int(found[1]), found[2].strip()) if found else None
