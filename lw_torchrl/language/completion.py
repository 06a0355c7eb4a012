"""Complete an underspecified plan with the standard steps for its motion, such as approaching and grasping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lw_torchrl.language.coverage import moves_before_grasp, role_of, touched_point, true_around
from lw_torchrl.language.expressions import Expression, all_of, any_of, leaves, negate
from lw_torchrl.language.objects import GOAL, GRIPPER
from lw_torchrl.language.plans import PlanStep
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.roles import BY_HAND, VECTORS, Direction, Manner, StepRole, Verb, motion_of
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

    The order of the steps or their conditions must show that no step moves the object before the grasp.
    """
    roles = [role_of(step) for step in steps]
    verbs = [role.verb for role in roles]
    if any(role.verb == "pull" and "handle" not in role.target.split() for role in roles):
        return False  # only a handle can be hooked; other objects must be grasped before pulling
    if {"carry", "move"}.isdisjoint(verbs):
        return motion_of(roles) is not None
    if "close" not in verbs or {"approach", "descend"}.isdisjoint(verbs):
        return False
    first, close = (min(map(verbs.index, {*verbs} & {*group})) for group in (("carry", "move"), ("close",)))
    in_order = close < first and not {"approach", "descend"}.isdisjoint(verbs[:close])
    return in_order or not moves_before_grasp(task, steps)


def completed(task: Task, steps: Sequence[PlanStep], motion: StepRole) -> tuple[PlanStep, ...]:
    """Build the steps that carry out ``motion`` on the object that the given steps touch.

    Each given step replaces the standard step with the same action, and keeps its own condition where that is right.
    """
    if motion.manner == "reach":
        return tuple(steps)
    roles, lifted = [role_of(step) for step in steps], _lifted(task, steps)
    if any(role.verb == "carry" and (role.moved, role.target) == (motion.moved, motion.target) for role in roles):
        motion = replace(motion, verb="carry")
    point, written = touched_point(task, roles), motion
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
        # Fingers around a wide object do not close, but are no longer wide open. A layout's own threshold
        # for "open" suits the objects of its suite.
        opened = gripper_is("open" if "open" in task.layout.thresholds else "wide open")
        held = Query((*near.clauses, *negated(opened).clauses))
        standard = (
            by_hand("approach", "grasp", negated(above), away),
            by_hand("descend", "grasp", above, away),
            by_hand("close", "grasp", near, opened),
            *(_own_motions(task, lifted, held) or [step_of(held, motion)]),
        )
        return _with_own(task, lifted, standard, written)
    way, motion = motion.direction, replace(motion, target=point)
    if motion.manner == "press":
        standard = by_hand("approach", "press", negated(over), way=way), step_of(over, motion)
    elif way == "away":
        level = gripper_is("forward aligned with", point)
        standard = by_hand("beside", "push", negated(level), way=way), step_of(level, motion)
    else:
        approach = by_hand("approach", "push", negated(over), way=way), by_hand("beside", "push", over, away, way=way)
        standard = *approach, step_of(near, motion)
    return _with_own(task, lifted, standard, written)


def _with_own(
    task: Task, steps: Sequence[PlanStep], standard: Sequence[PlanStep], motion: StepRole
) -> tuple[PlanStep, ...]:
    """Replace each standard step by the plan's steps with the same action, and complete their conditions.

    If a plan step is active at a hand position where the standard step is not, its condition gets the standard clauses
    that are false there. If the standard step is active where no plan step is, the condition of the last plan step with
    the same action is extended to that position.
    """
    several = sum(role_of(step).verb in ("carry", "move") for step in standard) > 1  # such steps come from the plan

    def is_same(role: StepRole, usual: StepRole) -> bool:
        if usual.verb in (*BY_HAND, "close"):
            return (role.verb, role.target) == (usual.verb, usual.target)
        moves = role.verb in ("carry", "move", "push", "pull") and not several
        return moves and (role.moved, role.target, role.direction) == (motion.moved, motion.target, motion.direction)

    usual, point = [step.condition for step in standard], touched_point(task, list(map(role_of, steps)))
    own = [(n, step) for n, each in enumerate(standard) for step in steps if is_same(role_of(step), role_of(each))]
    last = {n: at for at, (n, _) in enumerate(own)}
    kept: list[Query] = []
    for n, step in own:
        clauses: list[Clause] = []
        for clause in reversed(usual[n].clauses):
            three = Query(all_of([step.condition.expression, *clauses])), usual[n], Query((clause,))
            if any(0 in active and not {1, 2} & active for active in true_around(task, point, three)):
                clauses.append(clause)
        kept.append(Query(all_of([step.condition.expression, *clauses])))
    around = list(true_around(task, point, [*usual, *kept]))
    left_open = {n for active in around if max(active, default=0) < len(usual) for n in active}
    seen = {at - len(usual) for active in around for at in active}
    needed = left_open | {n for n, each in enumerate(standard) if role_of(each).written}
    made = {n: [standard[n]] for n in needed - {*last}}
    for at, ((n, step), condition) in enumerate(zip(own, kept, strict=True)):
        is_possible = at in seen or condition == step.condition
        if last[n] == at and n in left_open:
            condition = Query(any_of([condition.expression, usual[n].expression])) if is_possible else usual[n]
        elif not is_possible:
            continue
        role = replace(role_of(standard[n]), written=role_of(step).written, confidence=role_of(step).confidence)
        made.setdefault(n, []).append(step_of(condition, role))
    return tuple(step for n in sorted(made) for step in made[n])


def _own_motions(task: Task, steps: Sequence[PlanStep], held: Query) -> list[PlanStep]:
    """Return the plan's steps that move a held object, if they include different motions; otherwise return [].

    ``held`` replaces the clauses about the gripper. The last step is also active where none of the others is.
    """
    moving = [step for step in steps if role_of(step).verb in ("carry", "move") and not is_free(step)]
    distinct = {(role_of(step).moved, role_of(step).target, role_of(step).direction) for step in moving}
    if len(distinct) < 2 or any(map(is_obstacle, task.object_names)):  # an obstacle requires lifting the object
        return []
    guards = [_without_gripper(step.condition) for step in moving]
    guards[-1] = any_of([guards[-1], negate(any_of(guards))])
    queries = [Query(all_of([held.expression, guard])) for guard in guards]
    return [step_of(query, role_of(step)) for step, query in zip(moving, queries, strict=True)]


def _lifted(task: Task, steps: Sequence[PlanStep]) -> Sequence[PlanStep]:
    """Replace "lift the wrench up" with carrying the wrench to the target of its next motion, if there is one."""
    direct = list(steps)
    for number, step in enumerate(steps):
        role = role_of(step)
        others = (role_of(other) for other in (*steps[number + 1 :], *steps[:number]))
        same = (other for other in others if other.direction is None and same_object(task, other.moved, role.moved))
        after = next(same, None)
        if role.verb == "move" and role.direction == "up" and after is not None:
            direct[number] = step_of(step.condition, replace(after, verb="carry", written=role.written))
    return direct


def _without_gripper(condition: Query) -> Expression:
    """Remove the parts of a conjunction that mention the gripper."""
    whole = condition.expression
    parts = whole.parts if whole.kind == "all" else (whole,)
    names = [{name for clause in leaves(part) for name in (clause.subject, clause.object)} for part in parts]
    return all_of(part for part, mentioned in zip(parts, names, strict=True) if GRIPPER not in mentioned)
