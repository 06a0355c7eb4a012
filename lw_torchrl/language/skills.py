"""Scripted skills (the stateless linear controllers in data/skills.toml), and the canonical spelling of skill texts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache, lru_cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from lw_torchrl._util.checks import Finite, Scale, check_keys, did_you_mean, shown, typed, typed_fields
from lw_torchrl._util.files import AnyPath, read_toml
from lw_torchrl._util.registry import ReadOnlyDict
from lw_torchrl.language.objects import GRIPPER, WORDS
from lw_torchrl.language.tasks import TASKS, Task, Tasks, check_task, get_task


class SkillError(ValueError):
    """The error for a skill that cannot be parsed, or that a task cannot use."""


@typed_fields
@dataclass(frozen=True)
class ScriptedSkill:
    """A linear controller: action xyz = clip(gain · (target + offset - moved), -1, 1), with a constant gripper effort.

    The target is an object or a point. If the target is the robot's gripper, the offset is relative to the hand.

    Example:
        >>> skill = ScriptedSkill("place the gripper above the puck", "puck", offset=(0.0, 0.0, 0.1), gripper=-1.0)
        >>> skill.for_task("push").target
        'puck'

    Source: paper section 'Scripted Skills'.
    """

    text: str
    target: str
    moved: str = GRIPPER  # what moves to the target: the robot's gripper, or an object that the gripper holds or pushes
    offset: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)  # metres, added to the target: x right, y away, z up
    gain: tuple[Scale, Scale, Scale] = (10.0, 10.0, 10.0)  # action per metre along each axis; 0 disables an axis
    gripper: float = 0.0  # effort from -1 (open) to 1 (close)
    goal: str = ""  # the state that the skill steers to, as a query; "" if no query expresses that state
    variants: Mapping[str, ScriptedSkill] = field(default_factory=dict, hash=False, repr=False)  # by task name

    def __post_init__(self) -> None:
        if not -1 <= self.gripper <= 1:
            raise SkillError(f"gripper must be an effort from -1 to 1, got {self.gripper}")

    def for_task(self, task: str | Task) -> ScriptedSkill:
        """Return the skill's variant for a task; raise a SkillError if the task lacks an object of the skill."""
        owner = get_task(task)
        skill = self.variants.get(owner.name, self)
        for name in (skill.target, skill.moved):
            if name not in owner.object_names:
                lacks = f"needs {name!r}, which task {owner.name!r} lacks (objects: {', '.join(owner.object_names)})"
                raise SkillError(f"skill {self.text!r} {lacks}{did_you_mean(name, owner.object_names)}")
        return skill

    def suits(self, task: str | Task) -> bool:
        """Return whether the task has the skill's target and moved object."""
        owner = get_task(task)
        skill = self.variants.get(owner.name, self)
        return {skill.target, skill.moved} <= set(owner.object_names)


Skills = Mapping[str, ScriptedSkill]
_KEYS = tuple(f.name for f in fields(ScriptedSkill) if f.name not in ("text", "variants"))


def _skill(text: str, row: Any, tasks: Tasks) -> ScriptedSkill:
    check_keys("the skill", row, (*_KEYS, "for"), ["target"])
    values = dict(row)
    changes = values.pop("for", {})
    if not isinstance(changes, Mapping) or not all(isinstance(change, Mapping) for change in changes.values()):
        raise SkillError(f"'for' must map task names to tables, got {shown(changes)}")
    variants = {check_task(task, tasks): _skill(text, {**values, **change}, tasks) for task, change in changes.items()}
    gain = values.get("gain", 10.0)
    values["gain"] = (gain,) * 3 if isinstance(gain, (int, float)) else gain
    values |= {key: tuple(values[key]) for key in ("gain", "offset") if isinstance(values.get(key), list)}
    return ScriptedSkill(text, **values, variants=variants)


@cache
def _shipped() -> Skills:
    return ReadOnlyDict(_read(files("lw_torchrl.language") / "data" / "skills.toml", TASKS))


def _read(file: Path | Traversable, tasks: Tasks) -> dict[str, ScriptedSkill]:
    skills = {}
    for text, row in sorted(read_toml(file, SkillError).items()):
        try:
            skills[text] = _skill(text, row, tasks)
        except ValueError as error:
            raise SkillError(f"{file}: skill {text!r}: {error}") from error
    return skills


@typed
def load_skills(path: AnyPath | None = None, *, tasks: Tasks = TASKS) -> Skills:
    """Load the scripted skills, keyed by their texts.

    Args:
        path: a file in the format of data/skills.toml, whose skills are added to the shipped skills, replacing any
            with the same text; None for the shipped skills only.
        tasks: the tasks that the file's ``for`` tables may name, as returned by :func:`~lw_torchrl.load_tasks`.

    Raises:
        SkillError: the file is malformed; the message names the skill.

    Example:
        >>> load_skills()["place the gripper above the puck"].target
        'puck'
    """
    return _shipped() if path is None else ReadOnlyDict({**_shipped(), **_read(Path(path), tasks)})


@lru_cache(maxsize=256)
def _foreign_words(task: Task) -> frozenset[str]:
    """Return the last words of all object names in the 50 tasks, except words in this task's object names."""
    own = {word for name in task.object_names for word in name.split()}
    return frozenset(named.name.split()[-1] for each in TASKS.values() for named in each.published.objects) - own


def skills_for(task: Task, skills: Skills | None = None) -> Skills:
    """Return the skills that a task can use, chosen from ``skills`` (None for the shipped skills).

    A task can use a skill if the task has the skill's objects and the skill's text mentions no object found only in
    other tasks. A skill with a variant for the task may mention any object.
    """
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
    """Convert a skill to canonical spelling, with articles as in the paper.

    "the" is inserted before an object's name that follows the verb or a word like "above". All other text is unchanged.
    """
    first, _, details = " ".join(skill.split()).partition(" ")
    verb, *rest = first.replace("_", " ").split() or [""]
    if not re.fullmatch(r"[A-Za-z]\w*", verb):
        raise ValueError(f"skill must begin with a plain word like 'place', got {skill!r}")
    details = " ".join([*rest, _with_articles(details, task)]).strip()
    return f"{verb} {_with_articles(details, task)}".strip()


def _with_articles(details: str, task: Task) -> str:
    def article(match: re.Match[str]) -> str:
        end = match.start() - (details[match.start() - 1 : match.start()] == " ")
        start = max(0, end - _LONGEST_BEFORE - 1)  # look back a bounded distance, so that the time stays linear
        before = details[start:end].rpartition(" ")[2]
        return f"the {match[0]}" if not before or before in _BEFORE_NOUN else match[0]

    nouns = sorted({*task.object_names, "gripper"}, key=len, reverse=True)
    pattern = "|".join(re.escape(noun) for noun in nouns)
    return re.sub(rf"(?<![\w'-])(?:{pattern})(?![\w'-])", article, details)


def has_direction(skill: str) -> bool:
    """Return whether a skill mentions a direction in the plane: "to the left", "into the hole"."""
    return not _DIRECTIONS.isdisjoint(skill.split())
