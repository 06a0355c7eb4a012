"""Base classes of plan formats, and of the readers that find clauses in a text."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from lw_torchrl._util.files import read_toml
from lw_torchrl.language.expressions import Expression
from lw_torchrl.language.objects import WORDS
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.programs import Action, Node
from lw_torchrl.language.programs import Sequence as InTurn
from lw_torchrl.language.tasks import Task


@dataclass(frozen=True)
class Style:
    """A writing style for plans. It determines the content of each step."""

    explains: bool = False  # list the steps first, and write a reason before each clause
    goals: bool = False  # write a skill as the state to reach, if the step has a goal


@dataclass(frozen=True)
class PlanFormat:
    """A text format for plans: a writer, a reader and a prompt.

    ``prompt`` maps ``(examples, task, hints)`` to a prompt for a language model. The prompt shows example plans for
    other tasks, lines of hints, and then the task's name and description.
    """

    extension: str  # file extension, "py" or "md"
    encode: Callable[[ConditionalPlan], str]
    read: Callable[[str], Reading]  # parses any text into clauses; never raises
    prompt: Callable[[Sequence[ConditionalPlan], Task, Sequence[str]], str]
    style: Style = Style()  # also the style of plans in JSON, for models whose answers must follow a JSON Schema


@dataclass(frozen=True)
class Styled:
    """A function with its last argument, a style, already bound. Instances can be pickled and compared for equality."""

    function: Callable[..., str]
    style: Style

    def __call__(self, *arguments: Any) -> str:
        return self.function(*arguments, self.style)


PROGRAM_WORDS: Mapping[str, Any] = read_toml(files("lw_torchrl.language") / "data" / "programs.toml", ValueError)
"""The words by which the readers recognize programs."""

STYLES = {"basic": Style(), "chain": Style(explains=True), "goal": Style(explains=True, goals=True)}
"""The paper's three styles, by name."""

END = re.compile(r"\[eod\]|<\|(?:endoftext|end_of_text|im_end|eot_id)\|>")  # some models write their end token
_ITEM = re.compile(r"\s*\[?(\d{1,4})[.):\]]\s*(\S.*)")


@dataclass(frozen=True)
class Note:
    """A note about a line that was dropped or changed while a text was parsed. Line numbers start at 1."""

    line: int
    text: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.text}"


@dataclass(frozen=True)
class Clause:
    """A condition and its skill, as written in a text."""

    line: int  # line number of the condition, from 1
    condition: str | Expression  # "the robot's gripper is not above mug", or an expression over such texts
    skill: str  # "put gripper above mug"; "" if there is only a goal
    goal: str = ""  # the state to reach, "the robot's gripper is above mug"
    reason: str = ""  # the comment before the clause


@dataclass
class Section:
    """A section of a text, with the clauses for one task."""

    task: str  # the task's name; "" for text before the first name (it may continue the prompt)
    line: int  # number of the section's first line, from 1
    clauses: list[Clause] = field(default_factory=list)  # in the order of the text
    listed: str = ""  # the list of steps before the clauses, "1. first  2. second"
    tree: Node | None = None  # a program with control flow, which is compiled into clauses


@dataclass
class Reading:
    """A parsed text: at least one section, and notes on text that was left out."""

    sections: list[Section] = field(default_factory=lambda: [Section("", 1)])
    notes: list[Note] = field(default_factory=list)
    error: str = ""  # why the text cannot be read as a program

    @property
    def section(self) -> Section:
        """The current section, which is the last in ``sections``."""
        return self.sections[-1]

    def note(self, line: int, text: str) -> None:
        """Append a note on a line."""
        self.notes.append(Note(line, text))

    def open(self, task: str, line: int) -> None:
        """Begin a section for a task, unless the current section is for the same task and has no clauses yet."""
        if self.section.task != task or self.section.clauses:
            self.sections.append(Section(task, line))


def listed_steps(text: str, count: int) -> list[str]:
    """Parse a list of ``count`` steps ("1. first  2. second"); return [] if the text is not such a list."""
    for gap in (r"\s\s+(?=\[?\d)", r"\s(?=\[?\d{1,3}[.):\]]\s)"):
        items = [item(part) for part in re.split(gap, text.strip())]
        if len(items) == count and all(each and each[0] == number for number, each in enumerate(items, 1)):
            return [each[1] for each in items if each]
    return []


def item(text: str) -> tuple[int, str] | None:
    """Parse a list item such as "1. Put the gripper above the mug" into (number, text); return None for other text."""
    match = _ITEM.fullmatch(text)
    return (int(match[1]), match[2].strip()) if match else None


_CANONICAL = WORDS["canonical"]
_VERBS = frozenset(
    [*PROGRAM_WORDS["verbs"], *_CANONICAL["goes"]]
    + [word for table in ("synonyms", "verbs") for verb, words in _CANONICAL[table].items() for word in (verb, *words)]
)


def is_verb(words: Sequence[str]) -> bool:
    """Return whether the first word is a verb that an action can begin with."""
    return bool(words) and words[0].casefold() in _VERBS


def words_of(name: str) -> list[str]:
    """Split an identifier into lower-case words: "move_to" and "moveTo" give ["move", "to"]."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).replace("_", " ").replace("-", " ").lower().split()


def task_name(name: str) -> str:
    """Convert a function's name to a task's name: "door_lock" and "DoorLock" give "door-lock"."""
    return "-".join(words_of(name)) or "?"


def is_for_any_task(name: str) -> bool:
    """Return whether a function's name is a generic one, such as "policy" or "step", instead of a task's name."""
    return " ".join(words_of(name)) in PROGRAM_WORDS["any_task"]


_CALL = re.compile(r"\b([A-Za-z]\w*)\(([^()]*)\)")
_DISTANCE = re.compile(
    r"\(?([\w' ]+?) (?:dist|distance)(?: to)? ([\w' ]+?)\)? *([<>])=? *(\d*\.?\d+)(?: ?(mm|cm|m)\b)?"
)
_METRES = {"mm": 0.001, "cm": 0.01}
_QUESTION = re.compile(r"(?:(?:is|are|does|has|do)\s+)?(.+?)\s*\?", re.IGNORECASE)


def is_near(distance: float, unit: str = "m") -> bool:
    """Return whether a distance threshold is from 0.5 to 10 cm, and can thus be read as "near" (4 cm)."""
    return 0.005 <= distance * _METRES.get(unit, 1.0) <= 0.1


def statement(text: str) -> str:
    """Convert a condition that is written as code or as a question to plain words.

    "IsNear(gripper, mug)" and "Is the gripper near the mug?" give "gripper near mug" and "the gripper near the mug".
    """

    def said(call: re.Match[str]) -> str:
        first, *others = (each.strip(" '\"") for each in call[2].split(","))
        words = " ".join([first, *words_of(call[1].removeprefix("is").removeprefix("Is")), *others])
        return words if call[0] == text else f"({words})"

    def near(match: re.Match[str]) -> str:
        states_near = is_near(float(match[4]), match[5] or "m")
        return f"{'not ' * (match[3] == '>')}({match[1]} near {match[2]})" if states_near else match[0]

    text = " ".join(_CALL.sub(said, text).replace("&&", "&").replace("||", "|").split())
    text = _DISTANCE.sub(near, text)
    text = re.sub(r"[!¬~]\s*(?:not\b\s*)?(?=[\w(])", "not ", re.sub(r"\s*!=\s*(?!true|false)", " is not ", text))
    question = _QUESTION.fullmatch(text)
    return (question[1] if question else text).replace(" & ", " and ").replace(" | ", " or ")


def command(text: str) -> str:
    """Convert an action that is written as code to plain words: "MoveTo(mug)" gives "move to mug"."""
    call = _CALL.fullmatch(text)
    return " ".join([*words_of(call[1]), *call[2].replace(",", " ").split()]) if call else text


_FENCE = re.compile(r"^[ \t]*(?:```|~~~).*$", re.MULTILINE)


def code_blocks(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line offset, text) for each fenced code block, or for the whole text if it has no fence."""
    if end := END.search(text):
        text = text[: end.start()]
    fences = [(match.start(), match.end()) for match in _FENCE.finditer(text)]
    if not fences:
        yield 0, text
    for (_, start), (end_at, _) in zip(fences[::2], [*fences[1::2], (len(text), 0)], strict=False):
        yield text.count("\n", 0, start), text[start:end_at]


_AND = re.compile(r",?\s(?:and|then)(?:\sthen)?\s(?=(\w+))")


def in_turn(text: str, line: int) -> Node:
    """Split a text such as "open the gripper and move above the puck" into a sequence of actions."""
    parts, start = list[Node](), 0
    for match in _AND.finditer(text):
        if match[1].lower() in PROGRAM_WORDS["motions"]:
            parts.append(Action(text[start : match.start()], line))
            start = match.end()
    parts.append(Action(text[start:], line))
    return parts[0] if len(parts) == 1 else InTurn(tuple(parts))
