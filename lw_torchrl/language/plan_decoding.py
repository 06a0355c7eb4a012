"""Decode a language model's text into a plan for one task, with notes on omissions and changes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lw_torchrl._util.checks import check_choice, shown, typed
from lw_torchrl.language.drafts import without_drafts
from lw_torchrl.language.expressions import (
    FALSE,
    Expression,
    all_of,
    as_expression,
    count_mentions,
    leaves,
    negate,
    replace_leaves,
)
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.base import Clause, Note, Reading, Section, listed_steps
from lw_torchrl.language.formats.detection import read_any, section_notes
from lw_torchrl.language.formats.prose import ProseReading
from lw_torchrl.language.formats.sentences import SentenceReading
from lw_torchrl.language.library import expand
from lw_torchrl.language.nearest import MappedQuery, StepMapper
from lw_torchrl.language.plans import MOST_STEPS, ConditionalPlan, PlanStep, one_line
from lw_torchrl.language.polarity import instruction
from lw_torchrl.language.programs import Action, Block, Branch, Done, Node, ProgramError, tidy
from lw_torchrl.language.queries import MOST_CLAUSES, Query
from lw_torchrl.language.roles import ignored_words
from lw_torchrl.language.skills import Skills, canonical_skill
from lw_torchrl.language.step_parser import skill_effect
from lw_torchrl.language.tasks import TASKS, Task, Tasks, get_task
from lw_torchrl.language.thoughts import without_thoughts
from lw_torchrl.language.unread import unread


@dataclass(frozen=True)
class DecodedStep:
    """A clause of a text and the result of parsing it. Distances are from 0 (an exact query or skill) to 1."""

    line: int  # line number in the text, from 1
    written_condition: str  # the condition as written
    written_skill: str  # the skill as written: "put gripper above mug" for ``robot.put("gripper above mug")``
    condition: Query | None  # the nearest query; None if no query is within the limit
    condition_distance: float  # the largest distance of the condition's clauses
    scripted: str | None  # the text of the nearest scripted skill; None if no skill is within the limit
    skill_distance: float
    written_goal: str = ""  # the state to reach, as written; "" without a goal
    goal: Query | None = None  # the query nearest to the goal; None if no query is within the limit
    goal_distance: float = 0.0
    dropped: str = ""  # why the clause is not a step of the plan; "" if the clause is a step


@dataclass(frozen=True)
class DecodedPlan:
    """The plan that :func:`decode_plan` found in a text.

    Attributes:
        plan: the plan, with queries as conditions and skills as written; None if the text has no plan.
        scripted: the plan with the nearest scripted skills, without steps that have none; None if no step is left.
    """

    plan: ConditionalPlan | None
    scripted: ConditionalPlan | None
    reason: str  # why the text has no plan; "" if it has a plan
    notes: tuple[Note, ...]  # remarks on omissions and changes, in the order of the lines
    steps: tuple[DecodedStep, ...]  # all clauses for the task, including dropped clauses

    @property
    def all_scripted(self) -> bool:
        """Whether the text contains a plan in which every step has a scripted skill."""
        return self.plan is not None and self.scripted is not None and len(self.scripted.steps) == len(self.plan.steps)


_CODE_SPAN = re.compile(r"(?<![`\w])`([^`\n]* [^`\n]*)`(?![`\w])")  # of several words, unlike a task's name
_PUBLISHED = re.compile(r'^- When [^“”„«]*, (?:the robot should|move the robot)|check\("', re.MULTILINE)
# Typographic characters that models write instead of ASCII characters; an empty string deletes the character.
_TYPOGRAPHY = str.maketrans(
    {**dict.fromkeys("“”„‟«»", '"'), **dict.fromkeys("\u200b\u200c\u200d\u2060\ufeff\xad\ufe0f", ""), "\u20e3": ")"}
    | {"\xa0": " ", "\u202f": " ", "\u2011": "-", "－": "-", "，": ", ", "。": ". ", "：": ": ", "；": "; "}
)
_FENCED = re.compile(r"^[ \t]*(```|~~~)(?:.*\n)*?[ \t]*(?:\1.*$|\Z)", re.MULTILINE)
_SECOND_CONDITION = re.compile(r"(?:if|when|whenever|while|once|unless|as long as) \w", re.IGNORECASE)
_MOST_NOTES = 50  # maximum number of notes on the lines of a text without a plan
_LONGEST = 65_536  # maximum number of characters to parse


@typed
def decode_plan(
    text: str, task: str | Task, format: str | None = None, *, skills: Skills | None = None, tasks: Tasks = TASKS
) -> DecodedPlan:
    """Decode any text from a language model into a plan. The text is never executed, and no text raises an error.

    Only clauses for ``task`` are used: those under a function or heading with the task's name, and those before the
    first name, because the answer may continue the prompt. If the text has several versions of the plan, the longest is
    used (the first of equally long ones). Reasoning between tags such as ``<think>`` and ``</think>`` is ignored. The
    text may be in a format other than the requested one.

    The plan may be a program: Python with ``elif``, ``else``, ``or``, ``while``, early ``return`` and helper functions;
    a behaviour tree, rules or a state machine in JSON or YAML; or prose with "otherwise" and "repeat until". Each
    action becomes a step, guarded by all conditions on the path to it. Parts that a plan cannot express are left out,
    with a note.

    Each condition clause outside the query language is replaced with the query nearest in edit distance; if no query is
    near enough, the step is dropped. ``plan`` keeps the skills as written; ``scripted`` has the nearest scripted
    skills instead.

    Args:
        text: the model's answer; only the first 65,536 characters and 1,000 steps are used.
        format: the requested format, a name in :data:`~lw_torchrl.PLAN_FORMATS`; None to detect it from the content.
        skills: the scripted skills to choose from; None for the shipped skills.
        tasks: the known tasks by name, as from :func:`~lw_torchrl.load_tasks`.

    Example:
        >>> answer = "When the gripper isn't above puck, the robot should put gripper above puck."
        >>> step = decode_plan(answer, "push", "basic_md").scripted.steps[0]
        >>> print(step.condition, "->", step.skill)
        the robot's gripper is not above the puck -> place the gripper above the puck

    Source: paper sections 'Conditional Plan Generation' and 'LLM Experiments'.
    """
    owner = get_task(task, tasks)
    read = None if format is None else PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].read
    return decode_as(text, read, StepMapper(owner, skills))


def decode_as(text: str, read: Callable[[str], Reading] | None, mapper: StepMapper) -> DecodedPlan:
    """Decode a plan like :func:`decode_plan`, with a mapper and the format's reader ``read`` (None for any format)."""
    owner, notes = mapper.task, list[Note]()
    text = without_drafts(without_thoughts(text, notes), notes)
    if "\n" not in text.strip():
        text = text.replace("\\n", "\n")  # a backslash and an n instead of a line break
    text = _CODE_SPAN.sub(r"\1", text if _PUBLISHED.search(text) else _plain_characters(text))
    if len(text) > _LONGEST:
        notes.append(
            Note(text.count("\n", 0, _LONGEST) + 1, f"the remaining {len(text) - _LONGEST} characters are not read")
        )
    reading, section = read_any(text[:_LONGEST], mapper, read)
    if further := section.clauses[MOST_STEPS:]:
        reading.note(further[0].line, f"the plan has more than {MOST_STEPS} steps; {len(further)} are left out")
        del section.clauses[MOST_STEPS:]
    listed = listed_steps(section.listed, len(section.clauses)) or [""] * len(section.clauses)
    clauses = [  # a clause may have a goal instead of a skill, or a skill in quotes
        replace(clause, skill=_unquoted(clause.skill) or words or _as_skill(clause.goal, mapper))
        for clause, words in zip(section.clauses, listed, strict=True)
    ]
    steps = [_mapped(clause, mapper, notes) for clause in clauses]
    notes += section_notes(reading, section, owner)
    is_prose = isinstance(reading, ProseReading | SentenceReading)
    if read is None or is_prose or not clauses:
        read_text = text if is_prose or not clauses else _outside_code(text)
        notes += unread(read_text, clauses, notes, is_prose and read is None)

    def plan(skills: Sequence[str | None]) -> ConditionalPlan | None:
        kept = tuple(
            PlanStep(step.condition, skill, clause.reason, step.goal)
            for step, skill, clause in zip(steps, skills, clauses, strict=True)
            if not step.dropped and step.condition is not None and skill is not None
        )
        return ConditionalPlan(owner.name, kept, owner) if kept else None

    written, scripted = plan([step.written_skill for step in steps]), plan([step.scripted for step in steps])
    reason = "" if written is not None else _why_none(reading, steps, owner, text)
    if written is None and not steps:
        noted = {note.line for note in notes}
        rest = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if number not in noted]
        notes += [Note(number, f"the line is not read: {shown(line)}") for number, line in rest if line][:_MOST_NOTES]
    return DecodedPlan(written, scripted, reason, tuple(sorted(notes, key=lambda note: note.line)), tuple(steps))


def _outside_code(text: str) -> str:
    """Replace the fenced blocks of a text with blank lines; return "" for a text without fences."""
    blocks = _FENCED.sub(lambda block: "\n" * block[0].count("\n"), text)
    return blocks if blocks != text else ""


def _plain_characters(text: str) -> str:
    """Replace typographic characters with ASCII characters."""
    text = text.translate(_TYPOGRAPHY)
    if re.match(r"\s*(?:```\w*\s*)?[{\[]", text) and '"' not in text:  # JSON with other quotes
        text = re.sub("[‘’‚‛＂″`「」『』]", '"', text)
    return text


def decode_program(program: str | Node, task: Task, library: Mapping[str, str] | None = None) -> DecodedPlan:
    """Decode a program in any format, or a tree of :mod:`lw_torchrl.language.programs`, like :func:`decode_plan`.

    Args:
        library: texts of programs that ``program`` calls by name; see :func:`~lw_torchrl.language.library.expand`.
    """
    mapper = StepMapper(task, None)

    def tree(text: str) -> Node:
        section = read_any(text, mapper, None)[1]
        if section.tree is not None:
            return section.tree
        return Block(
            tuple(Branch(as_expression(c.condition), Action(c.skill, c.line, c.goal)) for c in section.clauses)
        )

    if library:
        try:
            program = expand(tree(program) if isinstance(program, str) else program, library, tree)
        except (RecursionError, ProgramError) as error:
            return DecodedPlan(None, None, str(error), (), ())
    if isinstance(program, str):
        return decode_as(program, None, mapper)

    def read(text: str) -> Reading:
        return Reading([Section("", 1, tree=program)])

    return decode_as(" ", read, mapper)


def _unquoted(text: str) -> str:
    """Remove the quotation marks around a text, but not those around words inside it."""
    return text.strip('"') if text.startswith('"') else text


def _as_skill(goal: str, mapper: StepMapper) -> str:
    """Convert a goal to a skill: "the robot's gripper is above mug" gives "move gripper above mug"."""
    if " is " not in goal and (query := mapper.query(goal).query) is not None:
        goal = str(query)  # "gripper above mug"
    skills = []
    for state in re.split(r"\s+and\s+", goal):
        match = re.match(r"(?:the\s+)?(?:robot's\s+)?(.+?)\s+is\s+(.+)", state)
        moved, place = match.groups() if match else ("until", state)
        is_opening = moved == "gripper" and place in ("open", "closed")
        skills.append(f"{place.removesuffix('d')} the gripper" if is_opening else f"move {moved} {place}")
    return " and ".join(skills)


def _mapped(clause: Clause, mapper: StepMapper, notes: list[Note]) -> DecodedStep:
    """Map a clause to a query and a scripted skill, and append a note for each change made to the clause."""

    def note(text: str) -> None:
        notes.append(Note(clause.line, text))

    said = clause.condition
    guard = as_expression(_unquoted(one_line(said)) if isinstance(said, str) else said)  # When "...", ...
    count = count_mentions(guard)
    written = str(guard) if count <= MOST_CLAUSES else f"a condition with {count} parts"
    condition, distance, unknown = _mapped_guard(clause, guard, mapper, notes)
    text, aside, exception = instruction(clause.skill)
    if exception and condition is not None:
        except_if, distance, _ = mapper.query(exception)
        unknown = [exception] if except_if is None else []
        if except_if is not None:
            note(f"the exception {shown(exception)} is read as {str(except_if)!r} (distance {distance:.2f})")
            condition = Query(all_of([condition.expression, negate(except_if.expression)]))
        condition = None if unknown else condition
        clause = replace(clause, skill=f"{text}, {aside}" if aside else text)
    goal, goal_distance, exact_goal = mapper.query(clause.goal) if clause.goal else MappedQuery(None, 0.0)
    goal = None if goal is None else goal.present
    dropped = ""
    try:
        words = canonical_skill(clause.skill, mapper.task)
    except ValueError as error:
        words, dropped = " ".join(clause.skill.split()), str(error)
    scripted, skill_distance = mapper.skill(words)
    if condition is None:
        dropped = "" if isinstance(clause.condition, str) else f"{shown(words)}: "
        first = shown(unknown[0]) if unknown else ""
        far = f"no query is near enough to the condition {first} (distance {distance:.2f})"
        dropped += far if unknown else "the condition is never true, or it is too long"
    if not text:
        dropped = f"the skill {shown(clause.skill)} commands no action"
    elif _SECOND_CONDITION.match(text):
        dropped = f"the skill {shown(text)} begins with another condition; join both with 'and'"
    if dropped:
        note(f"a step is left out: {dropped}")
    else:
        if ignored := ignored_words(clause.skill, mapper.task):
            note(f"{shown(ignored)} is left out: a step cannot express it")
        if clause.goal and goal is None:
            note(f"no query is near enough to the goal {shown(clause.goal)} (distance {goal_distance:.2f})")
        elif clause.goal and not exact_goal:
            note(f"the goal {shown(clause.goal)} is read as {str(goal)!r} (distance {goal_distance:.2f})")
        if scripted is None:
            note(f"no scripted skill is near enough to {shown(words)} (distance {skill_distance:.2f})")
        elif scripted != words:
            note(f"the skill {shown(words)} is nearest to the scripted {scripted!r} (distance {skill_distance:.2f})")
    mapped = (condition, distance, scripted, skill_distance, clause.goal, goal, goal_distance, dropped)
    return DecodedStep(clause.line, written, words, *mapped)


def _mapped_guard(
    clause: Clause, guard: Expression, mapper: StepMapper, notes: list[Note]
) -> tuple[Query | None, float, list[str]]:
    """Map the texts in a guard to queries; return the resulting query, the largest distance, and the unknown texts.

    A text is unknown if no query is near enough. It then counts as never true, so that its ``else`` branch is kept.
    """
    distances, unknown = [0.0], list[str]()
    is_text = guard.kind == "leaf" and not guard.negated  # if unknown, the note on the dropped step names it

    def query(leaf: Any) -> Expression:
        if isinstance(leaf, Done):
            effect = skill_effect(leaf.text, mapper.task)
            return FALSE if effect is None else effect.expression
        mapped, distance, exact = mapper.query(leaf)
        distances.append(distance)
        if mapped is None:
            unknown.append(leaf)
        if not exact and (mapped is not None or not is_text):
            how = "counts as never true" if mapped is None else f"is read as {str(mapped)!r}"
            text = f"the condition {shown(leaf)} {how} (distance {distance:.2f})"
            if is_text or all(note.text != text for note in notes):
                notes.append(Note(clause.line, text))
        return FALSE if mapped is None else mapped.expression

    if len(leaves(guard)) > MOST_CLAUSES:
        return None, 0.0, []
    try:
        mapped = tidy(replace_leaves(tidy(guard), query))
    except ValueError:
        return None, 1.0, []
    query_as_written = mapper.query(str(guard)).query if isinstance(clause.condition, str) else None
    fits = mapped != FALSE and count_mentions(mapped) <= MOST_CLAUSES
    return query_as_written or (Query(mapped) if fits else None), max(distances), unknown


def _why_none(reading: Reading, steps: list[DecodedStep], task: Task, text: str) -> str:
    """Return the reason why no plan was found in a text."""
    if steps:
        return f"all steps for {task.name} were dropped ({len(steps)}), the first because {steps[0].dropped}"
    if reading.error:
        return reading.error
    if not text.strip():
        return "the text is empty"
    if others := sorted({other.task for other in reading.sections if other.clauses}):
        return f"the text has no steps for {task.name}, only for {', '.join(map(shown, others))}"
    return f"the text has no steps for {task.name} or any other task"
