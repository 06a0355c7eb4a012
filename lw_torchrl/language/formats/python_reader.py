"""Reads plans in text that looks like Python, as models really write it. Nothing is executed, and nothing is an error.

Lines are matched against a few forms: ``def name(``, ``if check("…"):``, ``robot.verb("…")``, comments. All others are
passed over and noted. Blocks go by indentation, also where it is broken: an ``if`` within another one's block asks for
both.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from lw_torchrl._checks import shown
from lw_torchrl.language.formats.python_lines import (
    BRANCH,
    STRING,
    arguments,
    bare,
    is_cut,
    statements,
    task_name,
    unquoted,
)
from lw_torchrl.language.formats.written import END, Clause, Reading, item
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.tasks import TASKS

_DEF = re.compile(r"(?:async\s+)?def\b\s*(\w*)")
_CHECK = re.compile(
    rf"(and\b|or\b)?\s*(not\b)?\s*\(?\s*(?:self\.|robot\.)?check\s*\(\s*({STRING}(?:[\s+]*{STRING})*)\s*\)?\s*"
)
_CALL = re.compile(r"(?:self\.)?robot\.(\w+)\s*\(\s*")
_HEADING = re.compile(r"#+\s*([A-Za-z][\w-]*)\s*:")


@dataclass
class _Block:
    """An ``if``: where it stands, what it asks (None: nothing that could be read), and its block's indentation."""

    indent: int
    line: int
    condition: str | None
    body: int | None = None


def read_python(text: str) -> Reading:
    """What a text says in Python; see :class:`~lw_torchrl.language.formats.plan_format.PlanFormat`."""
    return _Reader(text).reading


class _Reader:
    def __init__(self, text: str) -> None:
        self.reading = Reading()
        self.section = self.reading.sections[0]
        self.blocks: list[_Block] = []
        self.reason: list[str] = []
        self.listing = False
        self.ignored: tuple[int, int, str] | None = None  # lines that are no part of a plan: from, to, the first
        for number, line in statements(text):
            if not self.read(number, line):
                break
        self.flush()

    def note(self, line: int, text: str) -> None:
        self.flush()
        self.reading.note(line, text)

    def ignore(self, number: int, line: str) -> None:
        first = self.ignored or (number, number, line)
        self.ignored = (first[0], number, first[2])

    def flush(self) -> None:
        """Note the lines that were passed over."""
        if self.ignored is not None:
            first, last, line = self.ignored
            self.ignored = None
            which = "is" if first == last else f"and what follows up to line {last} is"
            self.reading.note(first, f"{which} no part of a plan: {shown(line.strip())}")

    def read(self, number: int, line: str) -> bool:
        """Take a line in; False if the answer ends with it."""
        code = line.strip()
        if END.match(code):
            self.note(number, "the answer ends here")
            return False
        if code.startswith("#"):
            self.comment(number, line)
        elif code.startswith(("```", "~~~")):
            self.flush()
            self.blocks.clear()
        elif code:
            self.listing = False
            self.code(number, line, code)
        return END.search(bare(code)) is None

    def comment(self, number: int, line: str) -> None:
        said = line.strip().lstrip("#")
        found = item(said)
        heading = _HEADING.match(line)
        if heading and (name := task_name(heading[1])) in TASKS:
            self.open(name, number)
        elif re.fullmatch(r"\s*steps\s*:?\s*", said, re.IGNORECASE):
            self.listing = True
        elif self.listing and found:
            self.section.listed += f"  {found[0]}. {found[1]}"
        else:
            self.listing = False
            if said.strip():
                self.reason.append(said.strip())

    def open(self, name: str, number: int) -> None:
        self.section = self.reading.open(name, number)
        self.blocks.clear()
        self.reason.clear()
        self.listing = False

    def code(self, number: int, line: str, code: str) -> None:
        indent = len(line) - len(line.lstrip())
        call, branch = _CALL.match(code), BRANCH.match(code)
        waiting = bool(call and self.blocks and self.blocks[-1].body is None and indent == self.blocks[-1].indent)
        if not waiting:  # a call right below its condition belongs to it, however it is indented
            self.leave(indent)
        if found := _DEF.match(code):
            self.open(task_name(found[1]), number)
        elif branch:
            self.flush()
            self.branch(number, indent, code, branch)
        elif call:
            self.flush()
            self.call(number, indent, code, call)
        elif code.startswith("robot."):
            self.note(number, f"is cut off: {shown(code)}")
        else:
            self.ignore(number, line)

    def leave(self, indent: int) -> None:
        """End the blocks that a line of this indentation is not in."""
        while self.blocks:
            last = self.blocks[-1]
            if indent > last.indent and (last.body is None or indent >= last.body):
                return
            self.blocks.pop()

    def branch(self, number: int, indent: int, code: str, branch: re.Match[str]) -> None:
        condition, rest = (None, code[branch.end() :]) if branch[2] else self.asked(number, code, branch.end())
        if branch[2]:
            self.note(number, "an 'else' says no condition; what follows from it is left out")
        if branch[1] == "elif":
            self.note(number, "'elif' is taken for 'if': that what is above it does not hold is left out")
        if self.blocks and self.blocks[-1].body is None:
            self.blocks[-1].body = indent
        self.blocks.append(_Block(indent, number, condition))
        if call := _CALL.match(rest):
            self.call(number, indent + 1, rest, call)

    def asked(self, number: int, code: str, at: int) -> tuple[str | None, str]:
        """What an ``if`` asks, None if it cannot be read, and what stands behind its colon."""
        asked: list[str] = []
        fault = ""
        while match := _CHECK.match(code, at):
            text = unquoted(match[3])
            if match[1] == "or":
                fault = "an 'or' of conditions cannot be said in a plan"
            if match[2] and re.search(r"\band\b", text):
                fault = "the opposite of several conditions cannot be said in a plan"
            asked.append(f"not {text}" if match[2] else text)
            at = match.end()
        rest = code[at:].lstrip(" )")
        if not asked:
            cut = is_cut(code)
            fault = f"is cut off: {shown(code)}" if cut else f'asks nothing by check("..."): {shown(code)}'
        elif not rest.startswith(":") and not rest.startswith("#"):
            fault = fault or (f'is more than check("..."): {shown(code)}' if rest else "")
        if fault:
            self.note(number, fault)
        return (None if fault else " and ".join(asked)), rest.lstrip(": ")

    def call(self, number: int, indent: int, code: str, call: re.Match[str]) -> None:
        words, named, whole = arguments(code, call.end())
        if not whole:
            self.note(number, f"is cut off: {shown(code)}")
            return
        if not self.blocks:
            self.note(number, f"a skill without a condition is left out: {shown(code)}")
            return
        block = self.blocks[-1]
        if self.section.clauses and self.section.clauses[-1].line == block.line:
            self.note(number, "a second skill under the same condition is a step of its own")
        block.body = indent if block.body is None else block.body
        asked = [above.condition for above in self.blocks]
        if any(condition is None for condition in asked):
            return  # its `if` is noted
        skill, goal = _said(call[1], words, named)
        condition = " and ".join(condition for condition in asked if condition is not None)
        self.section.clauses.append(Clause(block.line, condition, skill, goal, " ".join(self.reason)))
        self.reason.clear()


def _said(verb: str, words: list[str], named: dict[str, str]) -> tuple[str, str]:
    """The skill and the goal of a call; either may be ""."""
    if verb != "move_gripper":
        return f"{verb} {' '.join(words)}", named.get("goal", "")
    place = " ".join(words)
    parts = [f"the {GRIPPER} is {place}"] if place else []
    parts += [text for name in ("until", "goal") if (text := named.get(name, ""))]
    for name, state in (("close_gripper", "closed"), ("open_gripper", "open")):
        if named.get(name) == "True":
            parts.append(f"the {GRIPPER} is {state}")
    return ("" if parts else "move gripper"), " and ".join(parts)
