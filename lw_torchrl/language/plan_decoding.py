"""Decode a language model's text into a plan for one task, with notes on omissions and changes."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
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
from lw_torchrl.language.formats.base import Clause, Note, Reading, Section, is_verb, listed_steps
from lw_torchrl.language.formats.clauses import PATTERNS
from lw_torchrl.language.formats.clauses import clauses as cut
from lw_torchrl.language.formats.code import CodeReading
from lw_torchrl.language.formats.markup import table_rules
from lw_torchrl.language.formats.prose import ProseReading
from lw_torchrl.language.formats.python import PythonReading
from lw_torchrl.language.formats.sentences import SentenceReading
from lw_torchrl.language.formats.trees import TreeReading
from lw_torchrl.language.library import expand
from lw_torchrl.language.nearest import LIMIT, MappedQuery, StepMapper
from lw_torchrl.language.plans import MOST_STEPS, ConditionalPlan, PlanStep, one_line, usual_goal
from lw_torchrl.language.polarity import instruction
from lw_torchrl.language.programs import (
    Action,
    Block,
    Branch,
    Done,
    Node,
    ProgramError,
    actions_of,
    compile_program,
    tidy,
)
from lw_torchrl.language.queries import MOST_CLAUSES, Query
from lw_torchrl.language.roles import ignored_words
from lw_torchrl.language.skills import Skills, canonical_skill
from lw_torchrl.language.step_parser import skill_effect
from lw_torchrl.language.tasks import TASKS, Task, Tasks, get_task
from lw_torchrl.language.thoughts import without_drafts, without_thoughts


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
        """Whether the text contains a plan in which every step has a scripted skill."""
        return self.plan is not None and self.scripted is not None and len(self.scripted.steps) == len(self.plan.steps)


_MOST_COMPARED = 16  # maximum number of conditions in a guard that is compared with an effect
# Typographic characters that models write instead of ASCII characters; an empty string deletes the character.
_PUBLISHED = re.compile(r'^- When [^“”„«]*, (?:the robot should|move the robot)|check\("', re.MULTILINE)
_TYPOGRAPHY = str.maketrans(
    {**dict.fromkeys("“”„‟«»", '"'), **dict.fromkeys("\u200b\u200c\u200d\u2060\ufeff\xad\ufe0f", ""), "\u20e3": ")"}
    | {"\xa0": " ", "\u202f": " ", "\u2011": "-", "－": "-", "，": ", ", "。": ". ", "：": ": ", "；": "; "}
)
_CLAUSES = re.compile(
    r"[^.;:,!?]*:|[^\w' -]+|\s-+\s|\b(?:and|or|then|but|otherwise|else|if|when|whenever|while|until|unless|once|because"
    r"|so that [^.,;]*|\w+ (?:phase|stage)|keep \w+ing(?= (?:until|while))|in case|provided"
    r"|(?:for )?as (?:long|soon) as|instead|finally|should|must|do\b.*|step\b.*|keep doing"
    r"|(?:go|start)\b.* (?:step|again).*)\b",
    re.IGNORECASE,
)
_SECOND_CONDITION = re.compile(r"(?:if|when|whenever|while|once|unless|as long as) \w", re.IGNORECASE)
_RESTARTS = ("repeat", "loop", "keep", "continue", "start", "begin", "return")
_MOST_NOTES = 50  # maximum number of notes on the lines of a text without a plan
_LONGEST = 65_536  # maximum number of characters to parse


@typed
def decode_plan(
    text: str, task: str | Task, format: str | None = None, *, skills: Skills | None = None, tasks: Tasks = TASKS
) -> DecodedPlan:
    """Decode any text from a language model into a plan. The text is never executed, and no text raises an error.

    Only clauses for ``task`` are used: those under a function or heading with the task's name, and those before the
    first name, because the answer may continue the prompt. If the text has several versions of the plan, the longest is
    used (of equally long ones, the first). Reasoning between tags such as ``<think>`` and ``</think>`` is ignored. The
    text may have another format than the requested one.

    A plan may be a program: Python with ``elif``, ``else``, ``or``, ``while``, early ``return`` and helper functions;
    a behaviour tree, rules or a state machine in JSON or YAML; or prose with "otherwise" and "repeat until". Each
    action becomes a step, guarded by all conditions on the path to it. Parts that a plan cannot express are left out,
    with a note.

    Each clause of a condition outside the query language is replaced by the nearest query by edit distance; if no query
    is near enough, the step is dropped. ``plan`` keeps the skills as written; ``scripted`` has the nearest scripted
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
        text = text.replace("\\n", "\n")  # two characters that stand for a new line
    text = text if _PUBLISHED.search(text) else _plain_characters(text)
    if len(text) > _LONGEST:
        notes.append(Note(text.count("\n", 0, _LONGEST) + 1, f"the remaining {len(text)} characters are not read"))
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
    if read is None and isinstance(reading, ProseReading | SentenceReading):
        said = [text for clause in clauses for text in (clause.skill, clause.reason)]
        notes += _unread_actions(text, [*said, *(note.text for note in notes)])
        notes += _unread_items(text, {clause.line for clause in clauses} | {note.line for note in notes})

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
        unread = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if number not in noted]
        notes += [Note(number, f"the line is not read: {shown(line)}") for number, line in unread if line][:_MOST_NOTES]
    return DecodedPlan(written, scripted, reason, tuple(sorted(notes, key=lambda note: note.line)), tuple(steps))


def _unread_actions(text: str, said: Sequence[str]) -> list[Note]:
    """Return a note for each action in prose whose words appear in neither a step nor another note."""
    known = [{*re.findall(r"[\w']+", each.lower())} for each in dict.fromkeys(said)]
    notes = list[Note]()
    for number, line in enumerate(text.splitlines(), 1):
        for phrase in (part.strip(" -'") for part in (_CLAUSES.split(line[:8_000]) if known else ())):
            words = {*re.findall(r"[\w']+", phrase.lower())} - {"the", "a", "it", "there", "first", "only"}
            if 1 < len(phrase.split()) <= 40 and is_verb(phrase.split()) and not any(words <= each for each in known):
                notes.append(Note(number, f"no step has the action {shown(phrase)}"))
    return notes[:_MOST_NOTES]


def _unread_items(text: str, known: Collection[int]) -> list[Note]:
    """Return a note for each bullet or numbered line outside ``known`` that has neither a condition nor an action."""
    notes = list[Note]()
    for number, line in enumerate(text.splitlines(), 1):
        item = PATTERNS["item"].match(line) if known and number not in known else None
        words = item[3].split() if item else []
        if 2 < len(words) <= 40 and words[0].lower() not in _RESTARTS and {c.kind for c in cut(item[3])} == {"say"}:  # type: ignore[index]
            notes.append(Note(number, f"the line is not read: {shown(line.strip())}"))
    return notes[:_MOST_NOTES]


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


_IT = r"(?:when|if|while|once|unless|otherwise,? if) it (?:is|isn't)\b"
# Lines that are keys in YAML, but begin with a condition about another line, or are sentences after a label.
_PRONOUN = re.compile(
    rf"^[ \t]*(?:[-*] )?(?:{_IT}[^:\n]*:|[a-z][\w ]{{0,40}}: (?:the|if|when|unless|once)\b[^\"'{{}}\n]*"
    r" (?:if|unless|when|once) (?:it|the)\b)",
    re.IGNORECASE | re.MULTILINE,
)
# Conditions about "it": the sentence reader knows what the line before is about.
_ABOUT_IT = re.compile(rf"^[^\w\n]{{0,20}}(?:\d+[^\w\n]{{1,9}})?{_IT}", re.IGNORECASE | re.MULTILINE)


def _read(text: str, mapper: StepMapper, read: Callable[[str], Reading] | None) -> tuple[Reading, Section]:
    """Parse a text with the first group of readers that finds clauses for the task.

    Of this group, return the reading that keeps the most actions, and the section of that reading for the task.
    """
    groups = list(_GROUPS if not _PRONOUN.search(text) else reversed(_GROUPS))
    if read is not None:
        groups.sort(key=lambda group: read not in group)
        groups = groups if read in groups[0] else [(read,), *groups]
    empty = list[tuple[Reading, Section]]()
    for number, group in enumerate(groups):
        best = first = _with_clauses(group[0], text, mapper)
        empty.append(first)
        is_prose = ProseReading in group
        own = table_rules(_own_lines(text, first[0], mapper.task)) if is_prose else text
        is_about_it = _ABOUT_IT.search(own) is not None
        is_published = bool(first[1].task and first[1].clauses) and not first[0].notes
        is_free = read is None and is_prose and not (is_published and _CONTROL_WORDS.search(own) is None)
        # In code with functions for other tasks only, prose is a comment.
        is_comment = is_prose and any(part.task and part.clauses for pair in empty[:-1] for part in pair[0].sections)
        if len(group) > 1 and not is_comment and (is_free or _has_control(*first, own)):
            other = _with_clauses(group[1], own, mapper, any_name=read is None)
            if group[1] is SentenceReading and all(clause.condition in (TRUE, FALSE) for clause in other[1].clauses):
                other = first  # prose without any condition is not a plan
            empty.append(other)
            known = mapper if is_free else None
            best = max(
                first,
                other,
                key=lambda pair: (
                    _kept(pair[1], known),
                    pair is other and is_about_it,
                    -len(_section_notes(pair[0], pair[1], mapper.task)),
                ),
            )
        if best[1].clauses:
            if number and read is not None:
                best[0].note(best[1].clauses[0].line, "the plan is not in the requested format")
            return best
    return next(
        (pair for pair in empty if pair[0].error), max(empty[:-1] or empty, key=lambda pair: len(pair[0].notes))
    )


def _with_clauses(
    read: Callable[[str], Reading], text: str, mapper: StepMapper, any_name: bool = False
) -> tuple[Reading, Section]:
    """Parse a text and compile the programs for the task; return the reading and the section with the most clauses.

    With ``any_name``, functions that are not named after any task are used if none has the task's name.
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
        others = [task for task in TASKS.values() if not mapper.task.name.startswith(task.name)]
        own = [each for each in reading.sections if each.tree and not any(_same(each.task, task) for task in others)]
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
            pairs = [(step.guard, step.action) for step in steps]
            section.clauses = [Clause(each.line, guard, one_line(each.text), each.goal) for guard, each in pairs]
    return reading, max(own or [Section("", 1)], key=_kept)


def _expression(mapper: StepMapper, leaf: Any) -> Expression:
    query = mapper.query(leaf).query if isinstance(leaf, str) else None
    return as_expression(str(leaf)) if query is None else query.expression


def _kept(section: Section, mapper: StepMapper | None = None) -> int:
    """Return how many clauses of a section can be active; with a mapper, unknown conditions are never true."""

    def can_be_true(each: str | Expression) -> bool:
        return each != FALSE and not (mapper and isinstance(each, str) and mapper.query(each).query is None)

    return sum(can_be_true(clause.condition) for clause in section.clauses)


def _has_control(reading: Reading, section: Section, text: str) -> bool:
    """Return whether a text may have control flow that the reader of a published format does not understand."""
    if isinstance(reading, PythonReading):
        return reading.has_control or not section.clauses
    return not section.clauses or _CONTROL_WORDS.search(text) is not None


def _own_lines(text: str, reading: Reading, task: Task) -> str:
    """Replace the lines of the sections for other tasks with empty lines."""
    lines = text.splitlines()
    for section, end in _ends(reading):
        if section.task and not _same(section.task, task):
            lines[section.line - 1 : end - 1] = [""] * len(lines[section.line - 1 : end - 1])
    return "\n".join(lines)


def _ends(reading: Reading) -> list[tuple[Section, int]]:
    """Return each section with the number of the first line after it."""
    return [*zip(reading.sections, [*(each.line for each in reading.sections[1:]), sys.maxsize], strict=True)]


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

    guard = as_expression(one_line(clause.condition) if isinstance(clause.condition, str) else clause.condition)
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
        dropped += (
            f"no query is near enough to the condition {shown(unknown[0])} (distance {distance:.2f})"
            if unknown
            else "the condition is never true, or it is too long"
        )
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
    is_text = guard.kind == "leaf" and not guard.negated  # if it is unknown, the step is left out by name

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


def _section_notes(reading: Reading, section: Section, task: Task) -> list[Note]:
    """Return the parser's notes on the chosen section, and one note for each other section with clauses."""
    notes = []
    for other, end in _ends(reading):
        is_own = not other.task or _same(other.task, task)
        if other is section or section.tree is not None or (is_own and not other.clauses):
            notes += [note for note in reading.notes if other.line <= note.line < end]
        if other is not section and (
            steps := len(other.clauses) or (0 if other.tree is None else len([*actions_of(other.tree)]))
        ):
            what = "is another version" if _same(other.task, task) else "was not requested"
            name = repr(other.task) if other.task else "the text before any name"
            notes.append(Note(other.line, f"{name} {what}; {counted(steps, 'step')} left out"))
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
