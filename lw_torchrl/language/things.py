"""The things of a task, by the names and other words that a text has for them."""

from __future__ import annotations

import re
from functools import lru_cache

from lw_torchrl.language.layout import places
from lw_torchrl.language.named_objects import GOAL, GRIPPER, NamedObject, typed
from lw_torchrl.language.phrases import HANDS
from lw_torchrl.language.tasks import Task

_NO_NAME = {"location", "target", "reach", "other", "side", "top", "edge"}  # words of names that name nothing alone
_GOAL = r"(?:the )?(?:reach |reacher )?(?:goal|target|destination)(?: (?:location|position|area|place|point|bin|spot))?"


def role_object(task: Task, name: str) -> NamedObject:
    """The object of a role: the task's, or the goal as "target location", which every observation has."""
    if name == GOAL and name not in task.object_names:
        x, y, z = places(task.layout.positions[-1])
        return NamedObject(GOAL, (x, y, z))
    return task.object(name)


def same_thing(task: Task, first: str, second: str) -> bool:
    """Whether two names are of one thing, or points on it."""
    return typed(role_object(task, first).position) == typed(role_object(task, second).position)


def is_goal(task: Task, name: str) -> bool:
    return same_thing(task, name, GOAL)


@lru_cache(maxsize=256)
def things(task: Task) -> tuple[str, ...]:
    """The names of things, without the gripper and the points on them."""
    return tuple(one.name for one in task.objects if one.name != GRIPPER and not any(one.offset))


def first_thing(task: Task) -> str | None:
    """The thing that a task is about: the first of its layout; None where it has only a goal, as in reach."""
    first = typed(places(task.layout.positions[1]))
    return next((name for name in things(task) if typed(task.object(name).position) == first), None)


def thing_of(task: Task, name: str) -> str:
    """The thing that a point is on; any other name itself."""
    return next((thing for thing in things(task) if same_thing(task, thing, name)), name)


def point_on(task: Task, name: str) -> str:
    """Where a thing is touched: the first point that the task names on it; itself if there is none."""
    if any(role_object(task, name).offset):
        return name
    points = (one.name for one in task.objects if any(one.offset) and same_thing(task, one.name, name))
    return next(points, name)


@lru_cache(maxsize=256)
def _names(task: Task) -> dict[str, str]:
    """Regular expressions of words to the name of what they call, the longest first."""
    found = HANDS | {name: name for name in task.object_names}
    words: dict[str, str] = {}
    for name in things(task):
        for word in re.findall(r"[a-z]+", name.replace("'s", "")):
            if word not in _NO_NAME:
                words.setdefault(word, name)
    longest = sorted(found, key=len, reverse=True)
    return (
        {re.escape(name): found[name] for name in longest}
        | {_GOAL: GOAL}
        | {f"{word}(?:'s)?": words[word] for word in words}
    )


def mark(text: str, task: Task) -> str:
    """A text with each thing that it names in <>: "put the gripper above <mug>"."""
    text = text.lower()
    for pattern, name in _names(task).items():
        text = re.sub(rf"(?<![\w<'-])(?:the )?(?:{pattern})(?![\w-])(?![^<]*>)", f"<{name}>", text)
    text = re.sub(r"(<[^>]*>) ?(?:handle|side|top|edge)\b", r"\1", text)
    return re.sub(r"(<[^>]*>)(?: \1)+", r"\1", text)
