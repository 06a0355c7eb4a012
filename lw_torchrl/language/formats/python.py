"""The Python formats of plans: a writer, and a tolerant reader that never executes the text."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from lw_torchrl._util.checks import shown
from lw_torchrl.language.formats.base import (
    END,
    PROGRAM_WORDS,
    Clause,
    PlanFormat,
    Reading,
    Style,
    Styled,
    item,
    task_name,
)
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import ConditionalPlan, PlanStep, function_head, one_line, quote
from lw_torchrl.language.queries import Query
from lw_torchrl.language.tasks import TASKS, Task


def py(style: Style) -> PlanFormat:
    """Build the format that writes a plan as a function: ``if check("…"):`` and ``robot.verb("…")`` for each step.

    The goal style writes a skill as the place for the gripper to reach,
    ``robot.move_gripper("above the puck", close_gripper=True)``, or as any other state to reach,
    ``robot.move_gripper(until="the puck is near the target location")``.

    Source: paper section 'Conditional Plan Generation' and its figure of a plan.
    """

    return PlanFormat("py", Styled(_write, style), PythonReading, Styled(_prompt, style), style)


def _prompt(examples: Sequence[ConditionalPlan], task: Task, hints: Sequence[str], style: Style) -> str:
    hint = "".join(f"# {line}\n" for line in hints)
    return "\n".join([*(_write(plan, style) for plan in examples), hint + function_head(task)])


def _write(plan: ConditionalPlan, style: Style) -> str:
    lines = []
    if style.explains:
        lines += ["# Steps:", *(f"#  {number}. {step.skill}" for number, step in enumerate(plan.steps, 1))]
    for number, (step, goal) in enumerate(zip(plan.steps, plan.goals, strict=True)):
        if style.explains and (reason := one_line(step.reason).lstrip("# ")):
            if number == 0 and re.match(r"\[?\d", reason):
                lines.append("#")  # otherwise a reason like "2. and so on" would continue the list
            lines.append(f"# {reason}")
        lines += [f"if check({quote(str(step.condition))}):", f"    robot.{_call(step, goal if style.goals else None)}"]
    return function_head(plan.definition) + "".join(f"    {line}\n" for line in lines)


def _call(step: PlanStep, goal: Query | None) -> str:
    """Return the method call for a step: its skill as a method, or ``move_gripper`` with the goal."""
    if goal is None:
        verb, _, details = step.skill.partition(" ")
        return f"{verb}({quote(details)})"
    first, *others = goal.clauses or [None]
    held = _HELD.get(" and ".join(map(str, others)))
    if not goal.is_conjunction or first is None or first.subject != GRIPPER or first.object is None or held is None:
        return f"move_gripper(until={quote(str(goal))})"
    return f"move_gripper({quote(str(first).removeprefix(f'the {GRIPPER} is '))}{held})"


_OPENED, _CLOSED = f"the {GRIPPER} is open", f"the {GRIPPER} is closed"
_HELD = {"": "", _OPENED: ", open_gripper=True", _CLOSED: ", close_gripper=True"}


def py_md(style: Style) -> PlanFormat:
    """Build the format that writes a plan as a chat message with the function in a fenced code block."""
    return PlanFormat("md", Styled(_write_message, style), PythonReading, Styled(_prompt_message, style), style)


def _fenced(code: str) -> str:
    return f"```python\n{code}```\n"


def _write_message(plan: ConditionalPlan, style: Style) -> str:
    return f"This function does the task `{plan.task}`:\n\n{_fenced(_write(plan, style))}"


def _prompt_message(examples: Sequence[ConditionalPlan], task: Task, hints: Sequence[str], style: Style) -> str:
    return (
        "I control a robot that has one arm with a gripper. A function says what the robot does: each `if` asks "
        "about the state, and its skill is carried out while the answer is yes. These functions do other tasks:\n\n"
        + _fenced("\n".join(_write(plan, style) for plan in examples))
        + "".join(f"\n{line}" for line in hints)
        + ("\n" if hints else "")
        + f"\nPlease write the function for `{task.name}` in the same way, the whole of it in one block:\n\n"
        + _fenced(function_head(task))
    )


# A Python string with any prefix. Possessive quantifiers (*+) keep the time linear for malformed text.
_STRING = r'(?:[fFrRbBuU]{0,2}(?:"(?:[^"\\]|\\.)*+"|\'(?:[^\'\\]|\\.)*+\'))'
_STRINGS = rf"{_STRING}(?:[\s+]*{_STRING})*"
_LITERAL = re.compile(r'"(?:[^"\\]|\\.?)*+("|\Z)|\'(?:[^\'\\]|\\.?)*+(\'|\Z)')  # or an unterminated string
_BRANCH = re.compile(r"(if|elif|while)\b\s*|(else)\s*:")
# An argument: an optional name, then strings or a plain value.
_ARGUMENT = re.compile(rf"(?:(\w+)\s*=\s*)?(?:({_STRINGS})|([^\s,()\"'][^,()\"']*))\s*(?:,\s*)?")
_PRINTED = re.compile(r"\s*print\(\s*(\"|')(.*)\1\s*\)\s*;?")
_DEF = re.compile(r"(?:async\s+)?def\b\s*(\w*)")
_CHECK = re.compile(rf"(and\b|or\b)?\s*(not\b)?\s*\(?\s*(?:self\.|robot\.)?check\s*\(\s*({_STRINGS})\s*\)?\s*")
_CALL = re.compile(r"(?:self\.)?robot\.(\w+)\s*\(\s*")
# A comment that may begin the section of a task: "# drawer-open: ...".
_HEADING = re.compile(r"#+\s*([A-Za-z][\w-]*)\s*:")
_CONTROL = re.compile(r"(?:return|break|continue|raise|assert|with)\b|[a-z_]\w*\s*=(?!=)|(?:elif|else)\b")
_DOCSTRING = re.compile(
    r"^[ \t]*(?:\w+[ \t]*=[ \t]*)?[rRuU]?(?:\"{3}[\s\S]*?\"{3}|'{3}[\s\S]*?'{3})[ \t]*$", re.MULTILINE
)
_MOST_JOINED = 6  # maximum number of lines of a statement


@dataclass
class _Block:
    """An open ``if`` statement."""

    indent: int
    line: int
    condition: str | None  # None if it cannot be parsed
    body: int | None = None  # indentation of the statement's block; None before the first line


class PythonReading(Reading):
    """A line-by-line reader of plans in Python. A skill in a nested ``if`` requires all enclosing conditions."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.blocks: list[_Block] = []
        self.reason: list[str] = []
        self.listing = False
        self.is_outside = False  # whether the last line was not part of a plan
        self.has_control = False  # whether the text has control flow that only CodeReading understands
        for number, line in _statements(self.without_docstrings(text)):
            if not self.read(number, line):
                break

    def without_docstrings(self, text: str) -> str:
        """Remove docstrings, which may contain example plans, if there are checks elsewhere; keep the line numbers."""

        def blank(match: re.Match[str]) -> str:
            return "\n" * match[0].count("\n")

        code = _DOCSTRING.sub(blank, text)
        if "check" not in code:
            return text
        for match in _DOCSTRING.finditer(text):
            if "check" in match[0]:
                self.note(1 + text.count("\n", 0, match.start()), "a docstring is left out")
        return code

    def note_control(self, number: int, text: str) -> None:
        """Append a note on control flow that only :class:`CodeReading` understands."""
        self.note(number, text)
        self.has_control = True

    def read(self, number: int, line: str) -> bool:
        """Parse one line, and return whether the answer continues after it."""
        code = line.strip()
        if END.match(code):
            self.note(number, "the answer ends here; later text is ignored")
            return False
        if code.startswith("#"):
            self.comment(number, line)
        elif code.startswith(("```", "~~~")):
            self.blocks.clear()
        elif code:
            self.listing = False
            self.code(number, line, code)
        return END.search(_bare(code)) is None

    def comment(self, number: int, line: str) -> None:
        """Parse a comment: a heading, a list of steps, or a reason."""
        words = line.strip().lstrip("#")
        numbered, heading = item(words), _HEADING.match(line)
        if heading and (name := task_name(heading[1])) in TASKS:
            self.open(name, number)
        elif re.fullmatch(r"\s*steps\s*:?\s*", words, re.IGNORECASE):
            self.listing = True
        elif self.listing and numbered:
            self.section.listed += f"  {numbered[0]}. {numbered[1]}"
        else:
            self.listing = False
            if words.strip():
                self.reason.append(words.strip())

    def open(self, name: str, number: int) -> None:
        """Begin the section of a task."""
        super().open(name, number)
        self.blocks.clear()
        self.reason.clear()
        self.listing = False

    def code(self, number: int, line: str, code: str) -> None:
        """Parse a line of code, and close the ``if`` blocks that do not contain the line."""
        indent = len(line) - len(line.lstrip())
        call, branch = _CALL.match(code), _BRANCH.match(code)
        # Models indent inconsistently, so blocks follow the actual indentation, not multiples of four.
        while self.blocks:  # close each block that does not contain the line
            last = self.blocks[-1]
            if last.body is None and call and indent == last.indent:
                break  # a call right below a condition is in its block, even without indentation
            if indent > last.indent and (last.body is None or indent >= last.body):
                break
            self.blocks.pop()
        if definition := _DEF.match(code):
            self.open(task_name(definition[1]), number)
        elif branch:
            self.branch(number, indent, code, branch)
        elif call:
            self.call(number, indent, code, call)
        elif code.startswith("robot."):
            self.note(number, f"the call is cut off: {shown(code)}")
        else:
            if not self.is_outside:  # one note for consecutive lines
                self.note(number, f"the text is not part of a plan: {shown(code)}")
            self.has_control |= _CONTROL.match(code) is not None and (bool(self.blocks) or "=" in code)
            self.is_outside = True
            return
        self.is_outside = False

    def branch(self, number: int, indent: int, code: str, branch: re.Match[str]) -> None:
        """Parse an ``if`` or ``else``, and the call on the same line if there is one."""
        condition, rest = (None, code[branch.end() :]) if branch[2] else self.condition(number, code, branch.end())
        if branch[2]:
            self.note_control(number, "'else' has no condition; the skills under it are left out")
        if branch[1] == "elif":
            self.note_control(number, "'elif' is read as 'if', without the negation of the conditions above")
        if self.blocks and self.blocks[-1].body is None:
            self.blocks[-1].body = indent
        self.blocks.append(_Block(indent, number, condition))
        if call := _CALL.match(rest):
            self.call(number, indent + 1, rest, call)
            _, _, more = rest.partition("); ")
            if more:
                self.note_control(number, f"{shown(more)} is left out")

    def condition(self, number: int, code: str, at: int) -> tuple[str | None, str]:
        """Parse an ``if``; return its condition (None if it cannot be parsed) and the code after its colon."""
        conditions: list[str] = []
        fault = ""
        while match := _CHECK.match(code, at):
            text = _unquoted(match[3])
            if match[1] == "or":
                fault = "a condition cannot contain 'or'"
            if match[2] and re.search(r"\band\b", text):
                fault = "a condition cannot negate a conjunction"
            conditions.append(f"not {text}" if match[2] else text)
            at = match.end()
        rest = code[at:].lstrip(" )")
        if not conditions:
            bare = _bare(code)
            cut = '"' in bare or not bare.rstrip().endswith(":")
            fault = f"the condition is cut off: {shown(code)}" if cut else f'expected check("..."), got {shown(code)}'
        elif not rest.startswith((":", "#")):
            fault = fault or (f'expected only check("..."), got {shown(code)}' if rest else "")
        if fault:
            self.note_control(number, fault)
        return (None if fault else " and ".join(conditions)), rest.lstrip(": ")

    def call(self, number: int, indent: int, code: str, call: re.Match[str]) -> None:
        """Parse the call of a skill, and append a clause that has the conditions of all open ``if`` blocks."""
        words, named, at = list[str](), dict[str, str](), call.end()
        code = code[:at] + re.sub(r"\bnot\s+([\"'])(.*?)\1", r"\1not (\2)\1", code[at:])  # until=not "..."
        while match := _ARGUMENT.match(code, at):
            value = _unquoted(match[2]) if match[2] else match[3].strip()
            if match[1]:
                named[match[1]] = value
                if match[2] and call[1] != "move_gripper" and match[1] not in ("goal", "until"):
                    words.append(f"{match[1]} {value}" if match[1] in PROGRAM_WORDS["prepositions"] else value)
            else:
                words.append(value)
            at = match.end()
        if code[at : at + 1] != ")" and (at < len(code) or not (words or named)):
            return self.note(number, f"the call is cut off: {shown(code)}")
        if not self.blocks:
            return self.note_control(number, f"a skill without a condition is left out: {shown(code)}")
        block = self.blocks[-1]
        if self.section.clauses and self.section.clauses[-1].line == block.line:
            self.note_control(number, "a second skill under the same condition becomes a separate step")
        block.body = indent if block.body is None else block.body
        conditions = [above.condition for above in self.blocks if above.condition is not None]
        if len(conditions) < len(self.blocks):
            return  # the note on the `if` gives the reason
        skill, goal = f"{call[1]} {' '.join(words)}", named.get("goal", "")
        if call[1] == "move_gripper":
            skill, goal = state_to_reach(" ".join(words), named)
        self.section.clauses.append(Clause(block.line, " and ".join(conditions), skill, goal, " ".join(self.reason)))
        self.reason.clear()


def state_to_reach(place: str, named: dict[str, str]) -> tuple[str, str]:
    """Return (skill, goal) for a call of ``robot.move_gripper``; either the skill or the goal is empty."""
    parts = [f"the {GRIPPER} is {place}"] if place else []
    parts += [text for name in ("until", "goal") if (text := named.get(name, ""))]
    for name, state in (("close_gripper", "closed"), ("open_gripper", "open")):
        if named.get(name) == "True":
            parts.append(f"the {GRIPPER} is {state}")
    return ("" if parts else "move gripper"), " and ".join(parts)


def _unquoted(strings: str) -> str:
    """Join adjacent string literals, and return their content without quotes and escapes."""
    bodies = [literal.lstrip("fFrRbBuU")[1:-1] for literal in re.findall(_STRING, strings)]
    return " ".join("".join(re.sub(r"\\(.)", r"\1", body) for body in bodies).split())


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Yield a (line number, statement) pair per statement; join multi-line calls and unwrap ``print("...")``."""
    lines = text.expandtabs(4).splitlines()
    at = 0
    while at < len(lines):
        line, start = lines[at], at
        if printed := _PRINTED.fullmatch(line):
            line = re.sub(r"\\(.)", r"\1", printed[2])
        at += 1
        joins = "check" in line or "robot." in line
        while joins and at < len(lines) and at - start < _MOST_JOINED:
            bare, code = _bare(line), lines[at].strip()
            if '"' in bare or bare.count("(") <= bare.count(")"):
                break  # no parenthesis is open, or a string is unterminated
            if not code or code.startswith(("#", "```", "def ", "robot.")) or _BRANCH.match(code):
                break  # the next line is a new statement
            line, at = f"{line} {code}", at + 1
        yield start + 1, line


def _bare(code: str) -> str:
    """Remove the string literals and the comment from a line of code; replace an unterminated string with a double
    quote."""
    return _LITERAL.sub(lambda literal: "" if literal[1] or literal[2] else '"', code).partition("#")[0]
