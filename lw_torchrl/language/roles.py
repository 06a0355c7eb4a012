"""Roles: which thing each step of a plan moves (the gripper, or what it holds or pushes) to which target."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

from lw_torchrl.language.layout import places
from lw_torchrl.language.named_objects import GRIPPER, NamedObject, typed
from lw_torchrl.language.plans import ConditionalPlan, PlanStep
from lw_torchrl.language.skills import Skills, skills_for
from lw_torchrl.language.tasks import Task

_TARGET = "target location"
_NAMES_OF_THE_GOAL = (_TARGET, "reach target")
_ACTED_ON = re.compile(r"(?:^|, |and |then )\w+ (?:the )?<([^>]*)>")
_TOOL = re.compile(r"(?<!in line )(?<!level )(?<!aligned )\bwith (the )?(?=<)")


@dataclass(frozen=True)
class Roles:
    """What a step is about."""

    target: str | None  # the object or point to go to; None if unknown
    moved: str | None  # what is to arrive there, the robot's gripper or a thing; None if unknown
    source: Literal["skill", "words", "condition", "nothing"]  # what told it: a scripted skill, the text, the condition


def role_object(task: Task, name: str) -> NamedObject:
    """The object of a role: the task's, or the goal as "target location", which every observation has."""
    return _goal(task) if name == _TARGET and name not in task.object_names else task.object(name)


def _goal(task: Task) -> NamedObject:
    x, y, z = places(task.layout.positions[-1])
    return NamedObject(_TARGET, (x, y, z))


def plan_roles(plan: ConditionalPlan, skills: Skills | None = None) -> tuple[Roles, ...]:
    """The roles of each step of a plan.

    If the text is that of a scripted skill for the task, the skill's ``target`` and ``moved`` count. Otherwise the
    words of the text decide; if they name nothing of the task ("close the gripper around the puck" for a mug), the
    condition does. If the gripper goes to a thing and the condition compares it with a point on that thing, the point
    is the target. If the text moves a thing that the condition says is held, the thing is moved. ``skills`` are the
    scripted skills by text; None for the shipped ones, {} for words alone. "the target location" is the goal of all.

    Example:
        >>> from lw_torchrl.language.plan_files import load_plans
        >>> for roles in plan_roles(load_plans("MT50")["coffee-pull"])[1:]:
        ...     print(roles.moved, "->", roles.target)
        robot's gripper -> mug rim
        robot's gripper -> mug rim
        mug -> target location
    """
    task, allowed, found = plan.definition, skills_for(plan.definition, skills), []
    for step in plan.steps:
        roles = _of_skill(step, task, allowed) or _of_words(step, task) or _of_condition(step)
        roles = _carried(roles, step, task)
        found.append(replace(roles, target=_point(roles, step, task)))
    return tuple(found)


def _of_skill(step: PlanStep, task: Task, skills: Skills) -> Roles | None:
    if step.skill not in skills:
        return None
    skill = skills[step.skill].for_task(task)
    if skill.target == skill.moved:  # a move from where it is: away from what it was at
        way = _compared(step, gripper=True)
        return Roles(way[-1], GRIPPER, "skill") if way else None
    return Roles(skill.target, skill.moved, "skill")


def _of_words(step: PlanStep, task: Task) -> Roles | None:
    text, tool = _marked(step.skill, task)
    named = re.findall(r"<([^>]*)>", text)
    if not named or named == [GRIPPER]:
        return None
    movable = {typed(places(thing)) for thing in task.layout.positions[:-1]}
    acted_on = [name for name in _ACTED_ON.findall(text) if typed(role_object(task, name).position) in movable]
    target, moved = named[-1], acted_on[0] if acted_on else tool
    if moved == target:  # "push the button down", "lift the cube": alone, it is where the gripper goes, or is moved
        moved = tool or GRIPPER
        others = [b for a, b in _pairs(step) if GRIPPER not in (a, b) and _same_thing(a, target, task)]
        if tool is None and others:
            target, moved = others[-1], target
    elif moved is None:  # "move the puck to the target location" of a mug: what it holds
        held = [name for name in _compared(step, gripper=True) if not _same_thing(name, target, task)]
        moved = held[-1] if held else GRIPPER
    return Roles(target, moved, "words")


def _marked(skill: str, task: Task) -> tuple[str, str | None]:
    """The text with each of the task's things in <>, without the tool that it is done with, and the tool."""
    things = {**{name: name for name in task.object_names}, "gripper": GRIPPER}
    for word in sorted(things, key=len, reverse=True):  # "drawer handle" is no "drawer"
        pattern = rf"(?<![\w<-]){re.escape(word)}(?![\w-])(?![^<]*>)"
        skill = re.sub(pattern, f"<{things[word]}>", skill)
    if found := _TOOL.search(skill):
        tool, rest = skill[found.end() + 1 :].split(">", 1)
        return skill[: found.start()] + rest, tool
    return skill, None


def _pairs(step: PlanStep) -> list[tuple[str, str]]:
    return [(clause.subject, clause.object) for clause in step.condition.clauses if clause.object is not None]


def _compared(step: PlanStep, *, gripper: bool) -> list[str]:
    """The things that the condition compares with the gripper, or the subjects of those without it."""
    return [b if a == GRIPPER else a for a, b in _pairs(step) if (GRIPPER in (a, b)) == gripper]


def _of_condition(step: PlanStep) -> Roles:
    apart = [(b, a) for a, b in _pairs(step) if GRIPPER not in (a, b)]
    if apart and "gripper" not in step.skill.split():
        return Roles(*apart[-1], "condition")
    near = _compared(step, gripper=True)
    return Roles(near[-1], GRIPPER, "condition") if near else Roles(None, None, "nothing")


def _carried(roles: Roles, step: PlanStep, task: Task) -> Roles:
    """The roles; if the gripper is at a thing already, the text may bring that to the goal, or, held, to the target."""
    at = [name for name in _compared(step, gripper=True) if _holds(step, "near", name)]
    if roles.moved != GRIPPER or roles.target is None or not at:
        return roles
    thing = next(one.name for one in task.objects if _same_thing(one.name, at[-1], task) and not any(one.offset))
    if any(name in step.skill for name in _NAMES_OF_THE_GOAL) and _same_thing(at[-1], roles.target, task):
        goal = next((one.name for one in task.objects if typed(one.position) == typed(_goal(task).position)), _TARGET)
        return Roles(goal, GRIPPER if "gripper" in step.skill.split() else thing, "words")
    held = _holds(step, "closed", GRIPPER) and re.match(rf"\w+ the {re.escape(thing)}\b", step.skill)
    return replace(roles, moved=thing) if held and roles.target != thing else roles


def _holds(step: PlanStep, relation: str, name: str) -> bool:
    said = [clause for clause in step.condition.clauses if clause.predicate == relation and not clause.negated]
    return any(name in (clause.subject, clause.object) for clause in said)


def _same_thing(first: str, second: str, task: Task) -> bool:
    return typed(role_object(task, first).position) == typed(role_object(task, second).position)


def _point(roles: Roles, step: PlanStep, task: Task) -> str | None:
    """The target, or the point on it that the condition compares with the gripper."""
    named = {name for pair in _pairs(step) for name in pair}
    if roles.target is None or roles.moved != GRIPPER or roles.target in named:
        return roles.target
    points = [name for name in _compared(step, gripper=True) if _same_thing(name, roles.target, task)]
    return points[-1] if points else roles.target
