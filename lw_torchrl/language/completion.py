"""Completion of an underspecified plan: standard steps carry out its motion on the object that it touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lw_torchrl.language.coverage import moves_before_grasp, role_of, touched_point
from lw_torchrl.language.expressions import Expression, all_of, any_of, leaves, negate
from lw_torchrl.language.objects import GOAL, GRIPPER
from lw_torchrl.language.plans import PlanStep
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.roles import VECTORS, Direction, Manner, StepRole, Verb, motion_of
from lw_torchrl.language.step_parser import is_free, is_obstacle
from lw_torchrl.language.tasks import Task, object_of, same_object


def step_of(condition: Query, role: StepRole) -> PlanStep:
    return PlanStep(condition, role.skill, role=role)


def gripper_is(predicate: str, name: str | None = None) -> Query:
    return Query((Clause(GRIPPER, predicate, name),))


def negated(query: Query) -> Query:
    return Query(negate(query.expression))


def is_complete(task: Task, steps: Sequence[PlanStep]) -> bool:
    """Return whether a plan has a motion and, if the motion needs a grasp, first approaches and grasps the object.

    The list shows what comes first, or else the conditions: no step moves the object before it is grasped.
    """
    roles = [role_of(step) for step in steps]
    verbs = [role.verb for role in roles]
    if any(role.verb == "pull" and "handle" not in role.target.split() for role in roles):
        return False  # a handle can be hooked; any other object must be grasped before pulling
    if {"carry", "move"}.isdisjoint(verbs):
        return motion_of(roles) is not None
    if "close" not in verbs or {"approach", "descend"}.isdisjoint(verbs):
        return False
    first, close = (min(map(verbs.index, {*verbs} & {*group})) for group in (("carry", "move"), ("close",)))
    in_order = close < first and not {"approach", "descend"}.isdisjoint(verbs[:close])
    return in_order or not moves_before_grasp(task, steps)


def completed(task: Task, steps: Sequence[PlanStep], motion: StepRole) -> tuple[PlanStep, ...]:
    """Build the steps with standard conditions that carry out ``motion`` on the object that the given steps touch."""
    roles = [role_of(step) for step in steps]
    if motion.manner == "reach":
        return tuple(steps)
    if any(role.verb == "carry" and (role.moved, role.target) == (motion.moved, motion.target) for role in roles):
        motion = replace(motion, verb="carry")
    point = touched_point(task, roles)
    above, near, over = (gripper_is(relation, point) for relation in ("above", "near", "vertically aligned with"))
    away = negated(near)

    def by_hand(verb: Verb, manner: Manner, *conditions: Query, way: Direction | None = None) -> PlanStep:
        both = Query(tuple(clause for query in conditions for clause in query.clauses))
        return step_of(both, StepRole(verb, GRIPPER, point, manner, way, confidence=0.0))

    # Complete a pull as a grasp, which also holds objects that the fingers cannot hook.
    if motion.manner in ("grasp", "pull"):
        moved = object_of(task, point)
        if motion.verb == "pull":
            way = motion.direction if motion.direction in VECTORS else None
            goal = moved if way else GOAL
            motion = replace(motion, verb="move", manner="grasp", moved=moved, target=goal, direction=way)
        elif motion.moved == GRIPPER:
            motion = replace(motion, moved=moved)
        if motion.verb == "move" and steps and any(map(is_obstacle, task.object_names)):
            motion = replace(motion, verb="carry")
        # Around a wide object fingers are never closed. A layout with its own threshold knows its objects.
        opened = gripper_is("open" if "open" in task.layout.thresholds else "wide open")
        held = Query((*near.clauses, *negated(opened).clauses))
        return (
            by_hand("approach", "grasp", negated(above), away),
            by_hand("descend", "grasp", above, away),
            by_hand("close", "grasp", near, opened),
            *(_own_motions(task, steps, held) or [step_of(held, motion)]),
        )
    way, motion = motion.direction, replace(motion, target=point)
    if motion.manner == "press":
        return by_hand("approach", "press", negated(over), way=way), step_of(over, motion)
    if way == "away":
        level = gripper_is("forward aligned with", point)
        return by_hand("beside", "push", negated(level), way=way), step_of(level, motion)
    approach = by_hand("approach", "push", negated(over), way=way), by_hand("beside", "push", over, away, way=way)
    return *approach, step_of(near, motion)


def _own_motions(task: Task, steps: Sequence[PlanStep], held: Query) -> list[PlanStep]:
    """Return the plan's own motions of a held object, if there are several, with ``held`` instead of their conditions
    on the gripper. The last one is also active where no other is.
    """
    moving = _lifted(task, [step for step in steps if role_of(step).verb in ("carry", "move") and not is_free(step)])
    distinct = {(role_of(step).moved, role_of(step).target, role_of(step).direction) for step in moving}
    if len(distinct) < 2 or any(map(is_obstacle, task.object_names)):  # an object is lifted over an obstacle
        return []
    guards = [_without_gripper(step.condition) for step in moving]
    guards[-1] = any_of([guards[-1], negate(any_of(guards))])
    return [
        step_of(Query(all_of([held.expression, guard])), role_of(step))
        for step, guard in zip(moving, guards, strict=True)
    ]


def _lifted(task: Task, steps: Sequence[PlanStep]) -> list[PlanStep]:
    """Turn "lift the wrench up" into a carry to the target of the next motion of the same object, if there is one."""
    direct = list(steps)
    for number, step in enumerate(steps):
        role = role_of(step)
        others = (role_of(other) for other in (*steps[number + 1 :], *steps[:number]))
        same = (other for other in others if other.direction is None and same_object(task, other.moved, role.moved))
        after = next(same, None)
        if role.direction == "up" and after is not None:
            direct[number] = step_of(step.condition, replace(after, verb="carry", written=role.written))
    return direct


def _without_gripper(condition: Query) -> Expression:
    """Remove the parts of a conjunction that mention the gripper."""
    whole = condition.expression
    parts = whole.parts if whole.kind == "all" else (whole,)
    names = [{name for clause in leaves(part) for name in (clause.subject, clause.object)} for part in parts]
    return all_of(part for part, mentioned in zip(parts, names, strict=True) if GRIPPER not in mentioned)
