"""Scripted skills, stateless linear controllers of data/skills.toml, and what the words of any skill say."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cache, lru_cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from lw_torchrl._util.checks import check_choice, did_you_mean, shown, typed
from lw_torchrl._util.files import AnyPath, read_toml
from lw_torchrl._util.registry import ReadOnlyDict
from lw_torchrl.language.objects import GRIPPER, WORDS, is_number, is_triple
from lw_torchrl.language.tasks import TASKS, Task, Tasks, check_task, get_task

Triple = tuple[float, float, float]


class SkillError(ValueError):
    """A skill that cannot be read, or that a task cannot use."""


@dataclass(frozen=True)
class ScriptedSkill:
    """A linear controller: action xyz = clip(gain · (target + offset - moved), -1, 1), with a constant gripper effort.

    The target is an object or point; the robot's gripper makes the offset relative to the hand.

    Example:
        >>> skill = ScriptedSkill("place the gripper above the puck", "puck", offset=(0.0, 0.0, 0.1), gripper=-1.0)
        >>> skill.for_task("push").target
        'puck'

    Source: paper section 'Scripted Skills'.
    """

    text: str
    target: str
    moved: str = GRIPPER  # what is to arrive at the target: the robot's gripper, or an object that it holds or pushes
    offset: Triple = (0.0, 0.0, 0.0)  # metres, added to the target: x to the robot's right, y away from it, z up
    gain: Triple = (10.0, 10.0, 10.0)  # per axis, at least 0, action per metre; 0 leaves an axis alone
    gripper: float = 0.0  # effort in [-1, 1]; -1 opens, 1 closes
    goal: str = ""  # the state it steers to, as a query of the tasks that it suits; "" if no query says it
    variants: Mapping[str, ScriptedSkill] = field(default_factory=dict, hash=False, repr=False)  # by task name

    def __post_init__(self) -> None:
        def check(name: str, allowed: str, holds: Callable[[Any], bool]) -> None:
            if not holds(given := getattr(self, name)):
                raise SkillError(f"{name} of skill {self.text!r} must {allowed}, got {shown(given)}")

        for name in ("target", "moved"):
            check(name, "be the name of an object", lambda given: isinstance(given, str))
        check("goal", "be a query in words", lambda given: isinstance(given, str))
        for name in ("offset", "gain"):
            check(name, "be three numbers", is_triple)
        check("gain", "not be negative", lambda given: min(given) >= 0)
        check("gripper", "lie in [-1, 1]", lambda given: is_number(given) and -1 <= given <= 1)

    def for_task(self, task: str | Task) -> ScriptedSkill:
        """The skill as this task has it; :class:`SkillError` if it names objects that the task lacks."""
        found = get_task(task)
        skill = self.variants.get(found.name, self)
        for name in (skill.target, skill.moved):
            if name not in found.object_names:
                lacks = f"needs {name!r}, which task {found.name!r} lacks; it has {', '.join(found.object_names)}"
                raise SkillError(f"skill {self.text!r} {lacks}{did_you_mean(name, found.object_names)}")
        return skill

    def suits(self, task: str | Task) -> bool:
        """Whether the task has the objects that the skill names."""
        found = get_task(task)
        skill = self.variants.get(found.name, self)
        return {skill.target, skill.moved} <= set(found.object_names)


Skills = Mapping[str, ScriptedSkill]
_KEYS = tuple(f.name for f in fields(ScriptedSkill) if f.name not in ("text", "variants"))


def _skill(text: str, row: Any, tasks: Tasks) -> ScriptedSkill:
    if not isinstance(row, Mapping):
        raise SkillError(f"skill {text!r} must be a table, got {shown(row)}")
    given = dict(row)
    listed = given.pop("for", {})
    if not isinstance(listed, Mapping) or not all(isinstance(change, Mapping) for change in listed.values()):
        raise SkillError(f"for of skill {text!r} must map task names to tables, got {shown(listed)}")
    variants = {}
    for task, change in listed.items():
        try:
            variants[check_task(task, tasks)] = _skill(text, {**given, **change}, tasks)
        except ValueError as error:
            raise SkillError(f"for {task}: {error}") from error
    for key in given:
        check_choice(f"key of skill {text!r}", key, _KEYS)
    if "target" not in given:
        raise SkillError(f"skill {text!r} must name a target")
    gain = given.get("gain", 10.0)
    given["gain"] = (gain,) * 3 if isinstance(gain, (int, float)) else gain
    given |= {key: tuple(given[key]) for key in ("gain", "offset") if isinstance(given.get(key), list)}
    return ScriptedSkill(text, **given, variants=variants)


@cache
def _shipped() -> Skills:
    return ReadOnlyDict(_read(files("lw_torchrl.language") / "data" / "skills.toml", TASKS))


def _read(file: Path | Traversable, tasks: Tasks) -> dict[str, ScriptedSkill]:
    found = {}
    for text, row in sorted(read_toml(file, SkillError).items()):
        try:
            found[text] = _skill(text, row, tasks)
        except ValueError as error:
            raise SkillError(f"{file}: {error}") from error
    return found


@typed
def load_skills(path: AnyPath | None = None, *, tasks: Tasks = TASKS) -> Skills:
    """Return the scripted skills by their text.

    Args:
        path: a file like data/skills.toml, whose skills join ours or replace those with the same text; None for
            only ours. A malformed file is a :class:`SkillError`.
        tasks: whose names its ``for`` tables may have, as from :func:`~lw_torchrl.load_tasks`.

    Example:
        >>> load_skills()["place the gripper above the puck"].target
        'puck'
    """
    return _shipped() if path is None else ReadOnlyDict({**_shipped(), **_read(Path(path), tasks)})


@lru_cache(maxsize=256)
def _foreign_words(task: Task) -> frozenset[str]:
    """The words for things of the 50 tasks that this one lacks; points of things ("front", "center") do not count."""
    own = {word for name in task.object_names for word in name.split()}
    return frozenset(thing.name.split()[-1] for one in TASKS.values() for thing in one.published.objects) - own


def skills_for(task: Task, skills: Skills | None = None) -> Skills:
    """Return the skills that a task may use, of the shipped ones if none are given: it has the objects that they name,
    and their texts name nothing that only other tasks have, or they have a variant for it."""
    if skills is None:
        return _shipped_for(task)
    foreign = _foreign_words(task)

    def allows(skill: ScriptedSkill, text: str) -> bool:
        return skill.suits(task) and (task.name in skill.variants or not foreign & set(text.split()))

    return {text: skill for text, skill in skills.items() if allows(skill, text)}


@lru_cache(maxsize=256)
def _shipped_for(task: Task) -> Skills:
    return ReadOnlyDict(dict(skills_for(task, _shipped())))


_BEFORE_NOUN, _DIRECTIONS = (frozenset(WORDS["in_skills"][name]) for name in ("before_noun", "directions"))
_LONGEST_BEFORE = max(map(len, _BEFORE_NOUN))


def canonical_skill(skill: str, task: Task) -> str:
    """Return the skill in plain English: nouns at the beginning and after a word like "above" get an article, as in
    the paper; other nouns ("the coffee mug") are left alone."""
    first, _, details = " ".join(skill.split()).partition(" ")
    verb, *rest = first.replace("_", " ").split() or [""]
    if not re.fullmatch(r"[A-Za-z]\w*", verb):
        raise ValueError(f"skill must begin with a plain word like 'place', got {skill!r}")
    details = " ".join([*rest, _with_articles(details, task)]).strip()
    return f"{verb} {_with_articles(details, task)}".strip()


def _with_articles(details: str, task: Task) -> str:
    def article(match: re.Match[str]) -> str:
        end = match.start() - (details[match.start() - 1 : match.start()] == " ")
        start = max(0, end - _LONGEST_BEFORE - 1)  # no further: a text may be all nouns
        before = details[start:end].rpartition(" ")[2]
        return f"the {match[0]}" if not before or before in _BEFORE_NOUN else match[0]

    nouns = sorted({*task.object_names, "gripper"}, key=len, reverse=True)
    pattern = "|".join(re.escape(noun) for noun in nouns)
    return re.sub(rf"(?<![\w'-])(?:{pattern})(?![\w'-])", article, details)


def has_direction(skill: str) -> bool:
    """Return whether a skill says a direction in the plane, "to the left", "into the hole"."""
    return not _DIRECTIONS.isdisjoint(skill.split())
