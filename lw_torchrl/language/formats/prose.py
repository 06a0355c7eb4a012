"""The prose format of plans ("- When C, the robot should S."): a writer and a tolerant reader."""

import re
from collections.abc import Sequence
from dataclasses import replace

from lw_torchrl._util.checks import shown
from lw_torchrl.language.formats.base import END, Clause, PlanFormat, Reading, Style, Styled, item
from lw_torchrl.language.formats.markup import BULLET, WHEN, sentences, table_rules
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import ConditionalPlan, one_line
from lw_torchrl.language.tasks import TASKS, Task


def md(style: Style) -> PlanFormat:
    """Build the prose format for a style; the goal style writes "- When C, move the robot's gripper until G."

    Source: paper section 'Conditional Plan Generation', which compared plans in prose with plans in code.
    """

    return PlanFormat("md", Styled(_write, style), ProseReading, Styled(_prompt, style), style)


def _prompt(examples: Sequence[ConditionalPlan], task: Task, hints: Sequence[str], style: Style) -> str:
    about = "A robot that has one arm with a gripper does each task by the rules below it.\n"
    hint = "".join(f"{line}\n" for line in hints)
    return "\n".join([about, *(_write(plan, style) for plan in examples), hint + _opening(task)])


def _opening(task: Task) -> str:
    """Return the two lines that introduce a task's rules."""
    return f"The task `{task.name}`: {one_line(task.description)}\nThe robot does it reliably by these rules:\n"


def _write(plan: ConditionalPlan, style: Style) -> str:
    lines = []
    if style.explains:
        lines.append("Steps:  " + "  ".join(f"{number}. {step.skill}" for number, step in enumerate(plan.steps, 1)))
    for step, goal in zip(plan.steps, plan.goals, strict=True):
        reason = one_line(step.reason)
        if style.explains and reason and not _is_read(reason):
            lines.append(reason)
        if style.goals and goal is not None:
            lines.append(f"- When {step.condition}, move the robot's gripper until {goal}.")
        else:
            lines.append(f"- When {step.condition}, the robot should {step.skill}.")
    return _opening(plan.definition) + "".join(f"{line}\n" for line in lines)


# Headings: "The task `push`: ...", or a task's name on a line of its own.
_NAMED = re.compile(r"[\s#>*\"'`]*(?:the\s+)?task\b[\s:]*([`\"'“‘*]*)([A-Za-z0-9][\w-]*(?:/[\w-]+)?)", re.IGNORECASE)
_ALONE = re.compile(r"[\s#>*\"'`]*([a-z0-9]+(?:[-_][a-z0-9]+)*)[\s\"'`:,*]*")
_SHOULD = re.compile(
    r",?\s(?:then\s)?(?:the\s)?(?:robot|it)\s(?:should|must|needs to|has to|will|can|shall)\s(?:then\s|just\s)?",
    re.IGNORECASE,
)
_UNTIL = re.compile(r",?\s(?:then\s)?move\s(?:the\s)?(?:robot's\s)?gripper\suntil\s", re.IGNORECASE)
_COMMA = re.compile(r",\s(?:then\s)?")
MAY_BE_RULE = re.compile(
    r"\W*(?:(?:first|then|next|finally),?\s+)?(?:(?:it|the robot) should\b.*|[a-z]+ [^,.;]*)?"
    r"\b(?:when|whenever|if|once|in case|given|provided|as (?:long|soon) as|unless|upon|should|while|on)\b"
    r"[^.;]*\b(?:is|are|be)\b[^.;]*[.]?$|[^?]*\?\s+\w",
    re.IGNORECASE,
)
# A sentence that begins with one of these words after "When C, " is not a skill.
NO_SKILL = frozenset(("the", "a", "an", "it", "this", "that", "you", "we", "they", "there", "and", "or"))


def _is_read(line: str) -> bool:
    """Return whether the reader would parse a line as part of a plan rather than as a comment."""
    match = END.search(line) or _heading(line) or BULLET.match(line) or item(line) or _clause(1, line, bullet=False)
    return bool(match) or _listing(line) is not None


class ProseReading(Reading):
    """A reader of plans in prose.

    A clause is a bullet that begins with "When", "If" or the like. In a section without such bullets, a
    clause is a sentence "When C, the robot should S". Any other sentence becomes the reason for the next clause.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.bulleted: dict[int, bool] = {}  # whether a section's clauses are bullets, by section number
        self.reason: list[str] = []
        self.listing = False
        for number, line in enumerate(table_rules(text).splitlines(), 1):
            before, *cut = END.split(line, maxsplit=1)
            for sentence in sentences(before.strip()):
                self.read(number, sentence)
            if cut:
                self.note(number, "the answer ends here; later text is ignored")
                break

    def read(self, number: int, raw: str) -> None:
        """Parse one line."""
        line = " ".join(raw.split())
        bullet = BULLET.match(line)
        if name := _heading(line):
            self.open(name, number)
            self.listing = False
            self.reason.clear()
        elif (steps := _listing(raw)) is not None:
            self.listing, self.section.listed = True, steps
        elif clause := _clause(number, line, bullet is not None):
            self.add(clause, bullet is not None, line)
        elif self.listing and (numbered := item(line)):
            self.section.listed += f"  {numbered[0]}. {numbered[1]}"
            return
        elif bullet and not item(line):
            self.note(number, f"a rule without a condition or without a skill is left out: {shown(line)}")
        elif line and not line.startswith(("```", "~~~")) and not line.endswith(":"):
            self.reason.append(line)
            if len(line) <= 500 and MAY_BE_RULE.match(line):
                self.note(number, f"a sentence is not read as a rule: {shown(line)}")
        self.listing = self.listing and steps is not None

    def add(self, clause: Clause, bullet: bool, line: str) -> None:
        """Append a clause; if the section has bullets, treat a plain sentence as a reason instead."""
        place = len(self.sections)
        if bullet and not self.bulleted.get(place, True):
            self.section.clauses.clear()  # in a section with bullets, sentences are only reasons
        if bullet or not self.bulleted.get(place, False):
            self.bulleted[place] = bullet
            self.section.clauses.append(replace(clause, reason=" ".join(self.reason)))
            self.reason.clear()
        else:
            self.reason.append(line)


def _heading(line: str) -> str:
    """Return the name of the task in a heading; "" if the line is not a heading."""
    if (named := _NAMED.match(line)) and (named[1] or named[2].lower() in TASKS):
        return named[2].replace("_", "-").lower()
    if (alone := _ALONE.fullmatch(line)) and ("-" in alone[1] or alone[1].replace("_", "-") in TASKS):
        return alone[1].replace("_", "-")
    return ""


def _listing(line: str) -> str | None:
    """Return the text after "Steps:"; None if the line does not begin with "Steps:"."""
    match = re.match(r"[#*\s]*steps\s*:[*\s]*(.*)", line, re.IGNORECASE)
    return match[1] if match else None


def _clause(number: int, line: str, bullet: bool) -> Clause | None:
    """Parse a line as a clause; return None if the line is not a clause."""
    start = BULLET.match(line)
    match = WHEN.match(line, start.end() if start else 0)
    if not match:
        return None
    rest = match[2]
    should, until = _SHOULD.search(rest), _UNTIL.search(rest)
    if until and not (should and should.start() < until.start()):
        goal = re.sub(r"^it is\b", f"the {GRIPPER} is", _ended(rest[until.end() :]))
        if not goal:
            return None  # the text was cut off
        return Clause(number, rest[: until.start()], "", goal)
    if (should and match[1].lower() in ("when", "if", "whenever", "once")) or (should and bullet):
        return Clause(number, rest[: should.start()], _ended(rest[should.end() :]))
    comma = _COMMA.search(rest)
    if not bullet or not comma:
        return None
    skill = _ended(rest[comma.end() :])
    if skill.partition(" ")[0].lower() in NO_SKILL:
        return None
    return Clause(number, rest[: comma.start()], skill)


def _ended(text: str) -> str:
    """Strip the full stop, quotes and closing tags from the end of a sentence."""
    sentence = text.rstrip()
    while True:
        shorter = sentence.rstrip("\"'`,\\* ")
        before, tag, name = shorter.rpartition("</")
        if tag and name.endswith(">") and name[:-1].isalnum():
            shorter = before
        if shorter == sentence:
            return sentence.removesuffix(".")
        sentence = shorter
