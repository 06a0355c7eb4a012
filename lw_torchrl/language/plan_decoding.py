"""Decode a language model's text into a plan for one task, with notes on omissions and changes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from lw_torchrl._util.checks import check_choice, counted, shown, typed
from lw_torchrl.language.expressions import (
    FALSE,
    TRUE,
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
from lw_torchrl.language.formats.code import CodeReading
from lw_torchrl.language.formats.prose import ProseReading
from lw_torchrl.language.formats.python import PythonReading
from lw_torchrl.language.formats.sentences import SentenceReading
from lw_torchrl.language.formats.trees import TreeReading
from lw_torchrl.language.library import expand
from lw_torchrl.language.nearest import LIMIT, MappedQuery, StepMapper
from lw_torchrl.language.plans import MOST_STEPS, ConditionalPlan, PlanStep, one_line, usual_goal
from lw_torchrl.language.programs import Action, Block, Branch, Done, Node, ProgramError, compile_program, tidy
from lw_torchrl.language.queries import MOST_CLAUSES, Query
from lw_torchrl.language.skills import Skills, canonical_skill
from lw_torchrl.language.step_parser import skill_effect
from lw_torchrl.language.tasks import TASKS, Task, Tasks, get_task


@dataclass(frozen=True)
class DecodedStep:
    """A clause of a text and the result of parsing it. Distances are from 0 (an exact query or skill) to 1."""

    line: int  # line number in the text, from 1
    written_condition: str  # the condition as written
    written_skill: str  # the skill as written: "put gripper above mug" for ``robot.put("gripper above mug")``
    condition: Query | None  # the nearest query; None if no query is within the limit
    condition_distance: float  # the largest distance of a clause
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
        """Whether the text has a plan whose steps all have a scripted skill."""
        return self.plan is not None and self.scripted is not None and len(self.scripted.steps) == len(self.plan.steps)


_MOST_COMPARED = 16  # maximum number of conditions in a guard that is compared with an effect
_LONGEST = 65_536  # maximum number of characters to parse


@typed
def decode_plan(
    text: str, task: str | Task, format: str | None = None, *, skills: Skills | None = None, tasks: Tasks = TASKS
) -> DecodedPlan:
    """Decode any text from a language model into a plan. The text is never executed, and no text raises an error.

    Only clauses for ``task`` are used: clauses under a function or heading with the task's name, and clauses before any
    name, which continue the prompt. If the text has several versions of the plan, the first longest version is used.
    Thoughts, marked by ``</think>`` or the tags of other models, are ignored. Another format than the requested one is
    accepted.

    Programs are plans, too: Python with ``elif``, ``else``, ``or``, ``while``, early ``return`` and helper functions,
    behaviour trees, rules and state machines in JSON or YAML, and prose with "otherwise" and "repeat until". Each
    action becomes a step whose condition is that of its path. What cannot be expressed is left out, with a note.

    Each clause of a condition outside the query language is replaced by the nearest query by edit distance; without a
    near query the step is dropped. ``plan`` keeps the skills as written; ``scripted`` has the nearest scripted skills.

    Args:
        text: the model's answer; only the first 65,536 characters and 1,000 steps are used.
        format: the requested format, a name in :data:`~lw_torchrl.PLAN_FORMATS`; None to find it by the content.
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
    text = without_thoughts(text, notes)
    if len(text) > _LONGEST:
        notes.append(Note(text.count("\n", 0, _LONGEST) + 1, f"the rest of {len(text)} characters is not read"))
    reading, section = _read(text[:_LONGEST], mapper, read)
    if further := section.clauses[MOST_STEPS:]:
        reading.note(further[0].line, f"the plan has more than {MOST_STEPS} steps; {len(further)} are left out")
        del section.clauses[MOST_STEPS:]
    listed = listed_steps(section.listed, len(section.clauses)) or [""] * len(section.clauses)
    clauses = [  # a clause may have a goal instead of a skill
        clause if clause.skill else replace(clause, skill=words or _as_skill(clause.goal))
        for clause, words in zip(section.clauses, listed, strict=True)
    ]
    steps = [_mapped(clause, mapper, notes) for clause in clauses]
    notes += _section_notes(reading, section, owner)

    def plan(skills: Sequence[str | None]) -> ConditionalPlan | None:
        kept = tuple(
            PlanStep(step.condition, skill, clause.reason, step.goal)
            for step, skill, clause in zip(steps, skills, clauses, strict=True)
            if not step.dropped and step.condition is not None and skill is not None
        )
        return ConditionalPlan(owner.name, kept, owner) if kept else None

    written, scripted = plan([step.written_skill for step in steps]), plan([step.scripted for step in steps])
    reason = "" if written is not None else _why_none(reading, steps, owner, text)
    return DecodedPlan(written, scripted, reason, tuple(sorted(notes, key=lambda note: note.line)), tuple(steps))


def decode_program(program: str | Node, task: Task, library: Mapping[str, str] | None = None) -> DecodedPlan:
    """Decode a program in any format, or a tree of :mod:`lw_torchrl.language.programs`, like :func:`decode_plan`.

    Args:
        library: texts of programs that ``program`` calls by name; see :func:`~lw_torchrl.language.library.expand`.
    """
    mapper = StepMapper(task, None)

    def tree(text: str) -> Node:
        section = _read(text, mapper, None)[1]
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


def _same(name: str, task: Task) -> bool:
    """Return whether a name is the task's name, up to case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower()) == re.sub(r"[-/]", "", task.name)


# Models sometimes answer in a format that was not requested, so every group of readers is tried.
_GROUPS: tuple[tuple[Callable[[str], Reading], ...], ...] = (
    (TreeReading,),
    (PythonReading, CodeReading),
    (ProseReading, SentenceReading),
)
_CONTROL_WORDS = re.compile(r"\b(?:otherwise|or else|else,|unless)\b|\bgo (?:on |back )?to step\b", re.IGNORECASE)
# The published formats have none of these: questions, and conditions behind an action.
_FREE_WORDS = re.compile(
    r"\?|\bif (?:so|not|it isn't)\b"
    r"|^[ \t]*(?:\W+|\d+[.)] )?(?!when|if|once|while|as |the task)\w[^.\n]* (?:if|until|when) ",
    re.IGNORECASE | re.MULTILINE,
)


def _read(text: str, mapper: StepMapper, read: Callable[[str], Reading] | None) -> tuple[Reading, Section]:
    """Return the reading that keeps the most actions, of the first group of readers that finds any, and its section."""
    groups = list(_GROUPS)
    if read is not None:
        groups = [group for group in groups if read in group] + [group for group in groups if read not in group]
        groups = groups if read in groups[0] else [(read,), *groups]
    empty = list[tuple[Reading, Section]]()
    for number, group in enumerate(groups):
        best = first = _with_clauses(group[0], text, mapper)
        empty.append(first)
        own = _own_lines(text, first[0], mapper.task) if ProseReading in group else text
        is_free = read is None and ProseReading in group and _FREE_WORDS.search(own) is not None
        if len(group) > 1 and (is_free or _has_control(*first, own)):
            other = _with_clauses(group[1], own, mapper, any_name=read is None)
            if group[1] is SentenceReading and all(clause.condition in (TRUE, FALSE) for clause in other[1].clauses):
                other = first  # prose without any condition is not a plan
            empty.append(other)
            known = mapper if is_free else None
            best = max(
                first,
                other,
                key=lambda pair: (_kept(pair[1], known), -len(_section_notes(pair[0], pair[1], mapper.task))),
            )
        if best[1].clauses:
            if number and read is not None:
                best[0].note(best[1].clauses[0].line, "the plan is not in the requested format")
            return best
    return next((pair for pair in empty if pair[0].error), empty[0])


def _with_clauses(
    read: Callable[[str], Reading], text: str, mapper: StepMapper, any_name: bool = False
) -> tuple[Reading, Section]:
    """Parse a text, compile the programs for the task; return the result and its section with the most clauses.

    With ``any_name``, a function whose name is not a task's is a plan for the task if the text has no other.
    """

    def effect(skill: str) -> str | None:
        goal = mapper.query(skill.partition(" until ")[2]) if " until " in skill else None
        if goal is not None and goal.distance <= LIMIT / 2:
            return str(goal.query)
        with suppress(ValueError):
            words = canonical_skill(skill, mapper.task)
            query = usual_goal(words, mapper.task) or skill_effect(words, mapper.task)
            return None if query is None else str(query)
        return None

    def is_done(guard: Expression, effect: str) -> bool:
        if len(leaves(guard)) > _MOST_COMPARED:
            return False
        mapped = replace_leaves(guard, lambda leaf: _expression(mapper, leaf))
        return all_of([mapped, negate(_expression(mapper, effect))]) == FALSE

    try:
        reading = read(text)
    except (RecursionError, ProgramError) as error:
        reading = Reading(error=str(error) if isinstance(error, ProgramError) else "the text nests too deeply")
    own = [section for section in reading.sections if not section.task or _same(section.task, mapper.task)]
    if any_name and not any(section.clauses or section.tree for section in own):
        own = [
            each
            for each in reading.sections
            if each.tree and not any(_same(each.task, task) for task in TASKS.values())
        ]
        for section in own:
            reading.note(section.line, f"the function {shown(section.task)} is read as a plan for {mapper.task.name}")
    for section in own:
        if section.tree is not None:
            try:
                steps = compile_program(
                    section.tree, effect, lambda text: mapper.query(text).query is not None, is_done
                )
            except ProgramError as error:
                reading.error = str(error)
                continue
            section.clauses = [
                Clause(step.action.line, step.guard, one_line(step.action.text), step.action.goal) for step in steps
            ]
    return reading, max(own or [Section("", 1)], key=_kept)


def _expression(mapper: StepMapper, leaf: Any) -> Expression:
    query = mapper.query(leaf).query if isinstance(leaf, str) else None
    return as_expression(str(leaf)) if query is None else query.expression


def _kept(section: Section, mapper: StepMapper | None = None) -> int:
    """Return how many clauses of a section can be active; with a mapper, unknown conditions are never true."""
    conditions = [clause.condition for clause in section.clauses]
    return sum(
        each != FALSE and not (mapper and isinstance(each, str) and mapper.query(each).query is None)
        for each in conditions
    )


def _has_control(reading: Reading, section: Section, text: str) -> bool:
    """Return whether a text may have control flow that the reader of a published format does not understand."""
    if isinstance(reading, PythonReading):
        return reading.has_control or not section.clauses
    return not section.clauses or _CONTROL_WORDS.search(text) is not None


def _own_lines(text: str, reading: Reading, task: Task) -> str:
    """Blank the lines of the sections for other tasks."""
    lines = text.splitlines()
    for section, later in zip(reading.sections, [*reading.sections[1:], None], strict=True):
        if section.task and not _same(section.task, task):
            for number in range(section.line - 1, len(lines) if later is None else later.line - 1):
                lines[number] = ""
    return "\n".join(lines)


def _as_skill(goal: str) -> str:
    """Convert a goal to a skill: "the robot's gripper is above mug" gives "move gripper above mug"."""
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

    written = clause.condition if isinstance(clause.condition, str) else _written(clause.condition)
    written = " ".join(written.split())
    if isinstance(clause.condition, str):
        condition, distance, exact = mapper.query(written)
        unknown = [] if condition is not None else [written]
        if condition is not None and not exact:
            note(f"the condition {shown(written)} is read as {str(condition)!r} (distance {distance:.2f})")
    else:
        condition, distance, unknown = _mapped_guard(clause, mapper, notes)
    goal, goal_distance, exact_goal = mapper.query(clause.goal) if clause.goal else MappedQuery(None, 0.0)
    goal = None if goal is None else goal.present
    dropped = ""
    try:
        words = canonical_skill(clause.skill, mapper.task)
    except ValueError as error:
        words, dropped = " ".join(clause.skill.split()), str(error)
    scripted, skill_distance = mapper.skill(words)
    if condition is None:
        named = "" if isinstance(clause.condition, str) else f"{shown(words)}: "
        dropped = (
            f"{named}no query is near enough to the condition {shown(unknown[0])} (distance {distance:.2f})"
            if unknown
            else f"{named}its condition is never true, or too long"
        )
    if dropped:
        note(f"a step is left out: {dropped}")
    else:
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


def _written(guard: Expression) -> str:
    """Write the guard of an action, unless it is too long."""
    return str(guard) if count_mentions(guard) <= MOST_CLAUSES else f"a condition with {count_mentions(guard)} parts"


def _mapped_guard(clause: Clause, mapper: StepMapper, notes: list[Note]) -> tuple[Query | None, float, list[str]]:
    """Map the texts in a guard to queries; return the query, the largest distance, and the unknown texts.

    A text without a near query counts as never true, so that its ``else`` is kept.
    """
    guard, distances, unknown = clause.condition, [0.0], list[str]()
    assert isinstance(guard, Expression)

    def query(leaf: Any) -> Expression:
        if isinstance(leaf, Done):
            effect = skill_effect(leaf.text, mapper.task)
            return FALSE if effect is None else effect.expression
        mapped, distance, exact = mapper.query(leaf)
        distances.append(distance)
        if mapped is None:
            unknown.append(leaf)
        if not exact:
            how = "counts as never true" if mapped is None else f"is read as {str(mapped)!r}"
            text = f"the condition {shown(leaf)} {how} (distance {distance:.2f})"
            if all(note.text != text for note in notes):
                notes.append(Note(clause.line, text))
        return FALSE if mapped is None else mapped.expression

    if len(leaves(guard)) > MOST_CLAUSES:
        return None, 0.0, []
    try:
        mapped = tidy(replace_leaves(tidy(guard), query))
    except ValueError:
        return None, 1.0, []
    fits = mapped != FALSE and count_mentions(mapped) <= MOST_CLAUSES
    return (Query(mapped) if fits else None), max(distances), unknown


def _section_notes(reading: Reading, section: Section, task: Task) -> list[Note]:
    """Return the parser's notes on the chosen section, and one note for each other section with clauses."""
    ends = [later.line for later in reading.sections[1:]]
    notes = []
    for other, end in zip(reading.sections, [*ends, float("inf")], strict=True):
        if other is section or section.tree is not None or (not other.task and not other.clauses):
            notes += [note for note in reading.notes if other.line <= note.line < end]
        elif other.clauses:
            what = "is another version" if _same(other.task, task) else "was not requested"
            name = repr(other.task) if other.task else "the text before any name"
            notes.append(Note(other.line, f"{name} {what}; {counted(len(other.clauses), 'step')} left out"))
    return notes


def _why_none(reading: Reading, steps: list[DecodedStep], task: Task, text: str) -> str:
    """Return the reason why a text has no plan."""
    if steps:
        return f"all steps for {task.name} were dropped ({len(steps)}), the first because {steps[0].dropped}"
    if reading.error:
        return reading.error
    if not text.strip():
        return "the text is empty"
    if others := sorted({other.task for other in reading.sections if other.clauses}):
        return f"the text has no steps for {task.name}, only for {', '.join(map(shown, others))}"
    return f"the text has no steps for {task.name} or any other task"


_OPENS = r"<think(?:ing)?>|\[think\]|<\|channel\|>(?:analysis|commentary)"
_CLOSES = r"</think(?:ing)?>|\[/think\]|<\|channel\|>final[^\n]{0,80}?<\|message\|>"
_TAG = re.compile(f"(?P<opens>{_OPENS})|{_CLOSES}", re.IGNORECASE)
_LINE_ENDS = re.compile(r"[ \t\r]*(?:\n|\Z)")
_COMMENT = re.compile(r"#(?!\w)")  # "#2" is not a comment
_IS_JSON = re.compile(r"\s*(?:```\w*\s*)?\{")


def without_thoughts(text: str, notes: list[Note]) -> str:
    """Remove the model's thoughts, which may hold drafts, from an answer, and add a note. Line numbers do not change.

    A closing tag without an opening tag ends a thought that began before the text, if the closing tag ends its line and
    is not in a comment. An opening tag in a comment or a string is ignored. The tags of gpt-oss are never ignored. An
    answer in JSON has no thoughts.
    """
    # comment: whether the current position is in a comment; quotes: the number of quotes in the line so far.
    spans, opened, at, comment, quotes = list[tuple[int, int]](), None, 0, False, 0
    for tag in _TAG.finditer("" if _IS_JSON.match(text) else text):
        *lines, before = text[at : tag.start()].split("\n")
        if lines:
            comment, quotes = False, 0
        comment, quotes = comment or _COMMENT.search(before) is not None, quotes + before.count('"')
        at, special = tag.end(), tag[0].startswith("<|")
        if tag["opens"]:
            if opened is None and (special or not (comment or quotes % 2)):
                opened = tag.start()
        elif opened is not None:
            spans.append((opened, at))
            opened = None
        elif special or (not comment and _LINE_ENDS.match(text, at)):
            spans = [(0, at)]
    if opened is not None:
        spans.append((opened, len(text)))
    if not spans:
        return text
    how = "" if opened is None else ", and cut off there"
    notes.append(Note(text.count("\n", 0, spans[0][0]) + 1, f"a thought is left out{how}"))
    kept, at = list[str](), 0
    for start, end in spans:
        kept += [text[at:start], "\n" * text.count("\n", start, end)]
        at = end
    return "".join([*kept, text[at:]])
