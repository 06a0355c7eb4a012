"""Choose the reader that fits a text, and the section that holds the plan for the task."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeAlias

from lw_torchrl._util.checks import shown
from lw_torchrl._util.text import counted
from lw_torchrl.language.expressions import (
    FALSE,
    TRUE,
    Expression,
    all_of,
    as_expression,
    leaves,
    negate,
    replace_leaves,
)
from lw_torchrl.language.formats.base import Clause, Note, Reading, Section
from lw_torchrl.language.formats.code import CodeReading
from lw_torchrl.language.formats.labels import labelled_rules, without_asides
from lw_torchrl.language.formats.markup import table_rules
from lw_torchrl.language.formats.prose import ProseReading
from lw_torchrl.language.formats.python import PythonReading
from lw_torchrl.language.formats.sentences import SentenceReading
from lw_torchrl.language.formats.trees import TreeReading
from lw_torchrl.language.nearest import LIMIT, StepMapper
from lw_torchrl.language.plans import one_line, usual_goal
from lw_torchrl.language.programs import ProgramError, actions_of, compile_program
from lw_torchrl.language.skills import canonical_skill
from lw_torchrl.language.step_parser import skill_effect
from lw_torchrl.language.tasks import TASKS, Task

_Reader: TypeAlias = Callable[[str], Reading]
_MOST_COMPARED = 16  # maximum number of conditions in a guard that is compared with an effect
# Models sometimes answer in a format that was not requested, so every group of readers is tried.
_GROUPS: list[tuple[_Reader, ...]] = [(TreeReading,), (PythonReading, CodeReading), (ProseReading, SentenceReading)]
_CONTROL_WORDS = re.compile(r"\b(?:otherwise|or else|else,|unless)\b|\bgo (?:on |back )?to step\b", re.IGNORECASE)


_IT = r"(?:when|if|while|once|unless|otherwise,? if) it (?:is|isn't)\b"
# Lines that look like keys in YAML, but are conditions about an earlier line, or sentences after a label.
_PRONOUN = re.compile(
    rf"^[ \t]*(?:[-*] )?(?:{_IT}[^:\n]*:|[a-z][\w ]{{0,40}}: (?:the|if|when|unless|once)\b[^\"'{{}}\n]*"
    r" (?:if|unless|when|once) (?:it|the)\b)",
    re.IGNORECASE | re.MULTILINE,
)
# Conditions about "it": only the sentence reader knows which object the line before is about.
_ABOUT_IT = re.compile(rf"^[^\w\n]{{0,20}}(?:\d+[^\w\n]{{1,9}})?{_IT}", re.IGNORECASE | re.MULTILINE)


def read_any(text: str, mapper: StepMapper, read: _Reader | None) -> tuple[Reading, Section]:
    """Parse a text with the first group of readers that finds clauses for the task.

    Of this group, return the reading that keeps the most actions, and the section of that reading for the task.
    """
    text = labelled_rules(text)
    groups = list(_GROUPS if not _PRONOUN.search(text) else reversed(_GROUPS))
    if read is not None:
        groups.sort(key=lambda group: read not in group)
        groups = groups if read in groups[0] else [(read,), *groups]
    empty = list[tuple[Reading, Section]]()
    for number, group in enumerate(groups):
        is_prose, asides = ProseReading in group, list[Note]()
        plan = without_asides(text, asides) if is_prose else text
        best = first = _with_clauses(group[0], plan, mapper)
        empty.append(first)
        own = table_rules(_own_lines(plan, first[0], mapper.task)) if is_prose else plan
        is_about_it = _ABOUT_IT.search(own) is not None
        is_published = bool(first[1].task and first[1].clauses) and not first[0].notes
        is_free = read is None and is_prose and not (is_published and _CONTROL_WORDS.search(own) is None)
        # If code has functions for other tasks only, prose in it is a comment.
        is_comment = is_prose and any(part.task and part.clauses for pair in empty[:-1] for part in pair[0].sections)
        if len(group) > 1 and not is_comment and (is_free or _has_control(*first, own)):
            other = _with_clauses(group[1], own, mapper, any_name=read is None)
            if group[1] is SentenceReading and all(clause.condition in (TRUE, FALSE) for clause in other[1].clauses):
                other = first  # prose without any condition is not a plan
            empty.append(other)
            known = mapper if is_free else None
            ranks = [
                (_kept(pair[1], known), pair is other and is_about_it, -len(section_notes(*pair, mapper.task)))
                for pair in (first, other)
            ]
            best = other if ranks[1] > ranks[0] else first
        if best[1].clauses:
            best[0].notes += asides
            if number and read is not None:
                best[0].note(best[1].clauses[0].line, "the plan is not in the requested format")
            return best
    return next(
        (pair for pair in empty if pair[0].error), max(empty[:-1] or empty, key=lambda pair: len(pair[0].notes))
    )


def _with_clauses(read: _Reader, text: str, mapper: StepMapper, any_name: bool = False) -> tuple[Reading, Section]:
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
    own = [section for section in reading.sections if not section.task or _names(section.task, mapper.task)]
    if any_name and not any(section.clauses or section.tree for section in own):
        others = [task for task in TASKS.values() if not mapper.task.name.startswith(task.name)]
        own = [each for each in reading.sections if each.tree and not any(_names(each.task, task) for task in others)]
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
    """Return how many clauses of a section can be active. With a mapper, unknown conditions count as never true."""

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
        if section.task and not _names(section.task, task):
            lines[section.line - 1 : end - 1] = [""] * len(lines[section.line - 1 : end - 1])
    return "\n".join(lines)


def _ends(reading: Reading) -> list[tuple[Section, int]]:
    """Return each section with the number of the first line after it."""
    return [*zip(reading.sections, [*(each.line for each in reading.sections[1:]), sys.maxsize], strict=True)]


def section_notes(reading: Reading, section: Section, task: Task) -> list[Note]:
    """Return the parser's notes on the chosen section, and one note for each other section with clauses."""
    notes = []
    for other, end in _ends(reading):
        is_own = not other.task or _names(other.task, task)
        if other is section or section.tree is not None or (is_own and not other.clauses):
            notes += [note for note in reading.notes if other.line <= note.line < end]
        if other is not section and (
            steps := len(other.clauses) or (0 if other.tree is None else len([*actions_of(other.tree)]))
        ):
            what = "is another version" if _names(other.task, task) else "was not requested"
            name = repr(other.task) if other.task else "the text before any name"
            notes.append(Note(other.line, f"{name} {what}; {counted(steps, 'step')} left out"))
    return notes


def _names(name: str, task: Task) -> bool:
    """Return whether a name is the task's name, ignoring case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower()) == re.sub(r"[-/]", "", task.name)
