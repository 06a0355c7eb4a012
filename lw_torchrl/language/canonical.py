"""Canonical plans: parse a free-form plan into verbs, objects and targets, and complete an underspecified plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import typed
from lw_torchrl._util.files import read_toml
from lw_torchrl.language.expressions import Expression, all_of, any_of, evaluate, leaves, negate, replace_leaves
from lw_torchrl.language.layout import places
from lw_torchrl.language.objects import GOAL, GRIPPER, Coordinate
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, Plans, PlanStep, as_plans
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.relations import STATES, comparisons
from lw_torchrl.language.roles import BY_HAND, VECTORS, Direction, Manner, StepRole, Verb, motion_of
from lw_torchrl.language.step_parser import ParsedStep, compared_with_gripper, is_free, is_obstacle, parse_steps
from lw_torchrl.language.tasks import (
    Task,
    first_object,
    get_task,
    is_goal,
    object_of,
    point_on,
    role_object,
    same_object,
    whole_objects,
)

MIN_COVERAGE = 0.75
"""The minimum fraction of typical states that a plan must cover to keep its own conditions."""
Source = Literal["plan", "completed", "fallback"]
_SOURCES = {"plan": "its own steps", "completed": "completed", "fallback": "replaced by the fallback plan"}


@dataclass(frozen=True)
class CanonicalReport:
    """A report on how :func:`canonical_plan` parses a plan.

    ``source`` is "plan" if the plan keeps its own steps. ``source`` is "completed" if these steps do not cover the
    typical states: the plan keeps its motion, objects and direction, but gets standard conditions. ``source`` is
    "fallback" if the plan has no motion and is replaced by the fallback plan.
    """

    written: ConditionalPlan
    plan: ConditionalPlan  # the canonical form
    source: Source
    read: tuple[PlanStep, ...]  # the plan's own steps as parsed, even if ``plan`` has different steps
    left_out: tuple[str, ...]  # the skills that could not be parsed
    is_read: tuple[bool, ...]  # whether each step of ``written`` is in ``read``

    def notes(self) -> list[dict[str, Any]]:
        """Return a JSON row for each step of ``written``, then one for each step that replaces the plan's own.

        The keys are ``written`` (None for an added step); ``skill``, ``verb``, ``moved``, ``target`` and ``condition``
        (None for a step that was left out); and ``seen``, whether policies see the step.
        """

        def note(step: PlanStep, seen: bool) -> dict[str, Any]:
            role = _role(step)
            parsed = {"skill": step.skill, "verb": role.verb, "moved": role.moved, "target": role.target}
            return {"written": role.written or None, **parsed, "condition": str(step.condition), "seen": seen}

        is_own, read = self.source == "plan", iter(self.read)
        nothing = dict.fromkeys(("skill", "verb", "moved", "target", "condition"))
        return [
            note(next(read), is_own) if is_read else {"written": step.skill, **nothing, "seen": False}
            for step, is_read in zip(self.written.steps, self.is_read, strict=True)
        ] + [note(step, True) for step in self.plan.steps if not is_own]


@typed
def canonical_plan(plan: ConditionalPlan, fallback: bool = False) -> ConditionalPlan:
    """Convert a free-form plan to a plan with a role for each step, and complete an underspecified plan.

    Each step gets a verb, an object that moves, a target and a direction (:class:`StepRole`), which are inferred from
    the step's words, its condition and the task's objects only. If the object that the hand touches has a named point,
    this point replaces the object. A plan whose conditions miss typical states, or that moves an object without
    grasping it first, keeps its motion, objects and direction, but gets standard conditions. A plan without any motion
    is replaced by :func:`fallback_plan`. A plan that already has roles is not parsed again.

    Args:
        plan: a plan in free-form English.
        fallback: append the steps of the fallback plan, with ``fallback=True`` in their roles: policies try these steps
            when the plan makes no progress, and carry or slide the object in turn. A plan that has them is unchanged.

    Example:
        >>> import lw_torchrl as lw
        >>> written = [("gripper not above the mug", "put gripper over mug"), ("gripper near the mug", "grab it")]
        >>> written.append(("gripper near the mug", "put the mug at the goal"))
        >>> plan = canonical_plan(lw.ConditionalPlan.from_pairs("coffee-push", written))
        >>> [step.role.verb for step in plan.steps]
        ['approach', 'descend', 'close', 'carry']

    Source: ours; the paper encodes each skill text without parsing it.
    """
    if any(step.role is None for step in plan.steps):
        plan = explain_canonical(plan).plan
    if not fallback or any(_role(step).fallback for step in plan.steps):
        return plan
    other = fallback_plan(plan.definition).steps
    if _role(slide := other[-1]).verb == "move":
        carry = _step(slide.condition, replace(_role(slide), verb="carry"))
        verbs = {_role(step).verb for step in plan.steps}
        slid = "move" in verbs or verbs.isdisjoint(("carry", "push", "pull"))
        other = (*other[:-1], carry, slide) if slid else (*other, carry)  # first the motion that the plan did not try
    steps = [replace(step, reason="fallback", role=replace(_role(step), fallback=True)) for step in other]
    return replace(plan, steps=(*plan.steps, *steps))


@typed
def canonical_plans(plans: AnyPlans, fallback: bool = False) -> Plans:
    """Apply :func:`canonical_plan` to each plan in ``plans``."""
    return Plans([canonical_plan(plan, fallback) for plan in as_plans(plans).values()])


@typed
def explain_canonical(plan: ConditionalPlan) -> CanonicalReport:
    """Report step by step how :func:`canonical_plan` parses a plan.

    Example:
        >>> import lw_torchrl as lw
        >>> written = [("gripper is open", "place the gripper above the mug"), ("gripper is closed", "ponder")]
        >>> report = explain_canonical(lw.ConditionalPlan.from_pairs("coffee-push", written))
        >>> report.source, report.left_out
        ('fallback', ('ponder',))
    """
    task, parsed = plan.definition, parse_steps(plan)
    read = _with_roles(plan, parsed)
    motion = _final_motion(read)
    source: Source
    if _is_complete(read) and _covered(task, read) >= MIN_COVERAGE:
        source, steps = "plan", read
    elif motion is not None:
        source, steps = "completed", _completed(task, read, motion)
    else:
        source, steps = "fallback", fallback_plan(task).steps
    left_out = tuple(step.skill for step, reading in zip(plan.steps, parsed, strict=True) if reading is None)
    explained = []
    for number, step in enumerate(steps):
        written = _role(step).written
        reasons = [_SOURCES[source]] if number == 0 else []
        reasons += [f"as written: {written}"] if written and written != step.skill else []
        explained.append(replace(step, reason="; ".join(reasons)))
    canonical = ConditionalPlan(plan.task, tuple(explained), task)
    return CanonicalReport(plan, canonical, source, read, left_out, tuple(map(_has_role, parsed)))


def fallback_plan(task: str | Task) -> ConditionalPlan:
    """Build the generic plan for a task: grasp the first object and move that object to the goal.

    In a task without objects, the plan moves the gripper to the goal.
    """
    task = get_task(task)
    held = first_object(task)
    if held is not None:
        return plan_of_motion(task, StepRole("move", held, GOAL, "grasp", confidence=0.0))
    names = whole_objects(task)
    goal = next((name for name in names if is_goal(task, name)), None)
    # Without an object and without a named goal, the first named place is the target.
    near, target = _gripper_is("near", goal or names[0]), GOAL if goal else names[0]
    approach = _step(_negated(near), StepRole("reach", GRIPPER, target, "reach"))
    return ConditionalPlan(task.name, (approach, _step(near, StepRole("hold", GRIPPER, target, "reach"))), task)


def plan_of_motion(task: str | Task, motion: StepRole) -> ConditionalPlan:
    """Build the plan with standard conditions that carries out ``motion`` on a task's first object."""
    task = get_task(task)
    return ConditionalPlan(task.name, _completed(task, (), motion), task)


def _role(step: PlanStep) -> StepRole:
    assert step.role is not None
    return step.role


def _step(condition: Query, role: StepRole) -> PlanStep:
    return PlanStep(condition, role.skill, role=role)


def _gripper_is(predicate: str, name: str | None = None) -> Query:
    return Query((Clause(GRIPPER, predicate, name),))


def _negated(query: Query) -> Query:
    return Query(negate(query.expression))


def _has_role(each: ParsedStep | None) -> bool:
    return each is not None and bool(each.moved and each.target)


def _with_roles(plan: ConditionalPlan, parsed: Sequence[ParsedStep | None]) -> tuple[PlanStep, ...]:
    """Return the steps that could be parsed, each with its role."""
    task = plan.definition
    pairs = [(step, each) for step, each in zip(plan.steps, parsed, strict=True) if each and _has_role(each)]
    read = [each for _, each in pairs]
    grasping = any(each.verb in ("close", "carry", "move") for each in read)
    first = first_object(task)
    steps = []
    for number, (step, each) in enumerate(pairs):
        verb, manner, direction = each.verb, _manner(each), each.direction
        # The purpose is the next step (or this one) that moves an object; otherwise the last such step before.
        purpose = next((other for other in (*read[number:], *read[:number][::-1]) if other.verb not in BY_HAND), None)
        if verb in BY_HAND:
            verb, manner, direction = _approach(each, purpose if not grasping else None)
        target, moved = str(each.target), str(each.moved)
        if moved == GRIPPER and first is not None and same_object(task, target, first):
            target = _compared_point(step, task, target) or point_on(task, target)
        toward = purpose.toward if direction == "goal" and purpose is not None else None
        role = StepRole(verb, moved, target, manner, direction, toward, step.skill, each.confidence)
        steps.append(_step(_at_points(step.condition, task), role))
    return tuple(_over_walls(steps, task))


def _approach(each: ParsedStep, purpose: ParsedStep | None) -> tuple[Verb, Manner, Direction | None]:
    """Return (verb, manner, direction) of a step that prepares for the step ``purpose``; None stands for a grasp."""
    verb = "descend" if each.verb == "beside" else each.verb
    if purpose is None:
        return verb, "grasp", None
    manner = _manner(purpose)
    if manner == "push":
        return ("beside" if each.verb == "descend" else each.verb), manner, purpose.direction
    if manner == "press":
        return ("push" if each.verb == "descend" else each.verb), manner, purpose.direction
    return verb, manner, each.direction or (purpose.direction if manner == "pull" else None)


def _compared_point(step: PlanStep, task: Task, name: str) -> str | None:
    """Return the point on an object that a step's condition compares with the gripper, if any."""
    near = sorted(compared_with_gripper(step), key=task.object_names.index)
    points = (other for other in near if any(role_object(task, other).offset) and same_object(task, other, name))
    return next(points, None)


def _manner(each: ParsedStep) -> Manner:
    """Return the manner of a step that moves an object or reaches a place; "grasp" for any other verb."""
    if each.verb in ("push", "pull"):
        return "press" if each.verb == "push" and each.direction == "down" else each.verb
    return "reach" if each.verb in ("reach", "hold") else "grasp"


def _at_points(condition: Query, task: Task) -> Query:
    """In clauses about the gripper, replace the task's first object with the point to touch."""
    first = first_object(task)

    def at(name: str) -> str:
        return point_on(task, name) if name != GRIPPER and first and same_object(task, name, first) else name

    def touched(clause: Clause) -> Clause:
        if clause.object is None or GRIPPER not in (clause.subject, clause.object):
            return clause
        return replace(clause, subject=at(clause.subject), object=at(clause.object))

    if condition.is_conjunction:
        return Query(tuple(map(touched, condition.clauses)))
    return Query(replace_leaves(condition.expression, touched))


def _over_walls(steps: Sequence[PlanStep], task: Task) -> list[PlanStep]:
    """Redirect "lift the puck over the wall" to the target of a later step such as "move the puck to the goal"."""
    direct = list(steps)
    for number, step in enumerate(steps):
        role = _role(step)
        later = (_role(other) for other in steps[number + 1 :])
        moving = (other for other in later if other.verb in ("carry", "move"))
        after = next((other for other in moving if not same_object(task, role.target, other.target)), None)
        is_fixed = not any(isinstance(at, int) for at in role_object(task, role.target).position)
        if role.verb in ("carry", "move") and is_fixed and after and same_object(task, role.moved, after.moved):
            direct[number] = _step(step.condition, replace(role, verb="carry", moved=after.moved, target=after.target))
    return direct


def _final_motion(steps: Sequence[PlanStep]) -> StepRole | None:
    """Return the motion that ends at the goal, in a plan in any order; otherwise the last motion."""
    moving = [step for step in steps if _role(step).verb in ("carry", "move") and not is_free(step)]
    to_goal = [step for step in moving if _role(step).target == GOAL]
    return motion_of([_role(step) for step in to_goal or steps])


def _is_complete(steps: Sequence[PlanStep]) -> bool:
    """Return whether a plan has a motion and, if the motion needs a grasp, first approaches and grasps the object."""
    roles = [_role(step) for step in steps]
    verbs = [role.verb for role in roles]
    moving = next((number for number, verb in enumerate(verbs) if verb in ("carry", "move")), None)
    if any(role.verb == "pull" and "handle" not in role.target.split() for role in roles):
        return False  # a handle can be hooked; any other object must be grasped before pulling
    if moving is None:
        return motion_of(roles) is not None
    return "close" in verbs[:moving] and not {"approach", "descend"}.isdisjoint(verbs[: verbs.index("close")])


def _completed(task: Task, steps: Sequence[PlanStep], motion: StepRole) -> tuple[PlanStep, ...]:
    """Build the steps with standard conditions that carry out ``motion`` on the object that the given steps touch."""
    roles = [_role(step) for step in steps]
    if motion.manner == "reach":
        return tuple(steps)
    if any(role.verb == "carry" and (role.moved, role.target) == (motion.moved, motion.target) for role in roles):
        motion = replace(motion, verb="carry")
    point = _touched(task, roles)
    above, near, over = (_gripper_is(relation, point) for relation in ("above", "near", "vertically aligned with"))
    away = _negated(near)

    def by_hand(verb: Verb, manner: Manner, *conditions: Query, way: Direction | None = None) -> PlanStep:
        both = Query(tuple(clause for query in conditions for clause in query.clauses))
        return _step(both, StepRole(verb, GRIPPER, point, manner, way, confidence=0.0))

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
        opened = _gripper_is("open" if "open" in task.layout.thresholds else "wide open")
        held = Query((*near.clauses, *_negated(opened).clauses))
        return (
            by_hand("approach", "grasp", _negated(above), away),
            by_hand("descend", "grasp", above, away),
            by_hand("close", "grasp", near, opened),
            *(_own_motions(task, steps, held) or [_step(held, motion)]),
        )
    way, motion = motion.direction, replace(motion, target=point)
    if motion.manner == "press":
        return by_hand("approach", "press", _negated(over), way=way), _step(over, motion)
    if way == "away":
        level = _gripper_is("forward aligned with", point)
        return by_hand("beside", "push", _negated(level), way=way), _step(level, motion)
    approach = by_hand("approach", "push", _negated(over), way=way), by_hand("beside", "push", over, away, way=way)
    return *approach, _step(near, motion)


def _own_motions(task: Task, steps: Sequence[PlanStep], held: Query) -> list[PlanStep]:
    """Return the plan's own motions of a held object, if there are several, with ``held`` instead of their conditions
    on the gripper. The last one is also active where no other is.
    """
    moving = _lifted(task, [step for step in steps if _role(step).verb in ("carry", "move") and not is_free(step)])
    distinct = {(_role(step).moved, _role(step).target, _role(step).direction) for step in moving}
    if len(distinct) < 2 or any(map(is_obstacle, task.object_names)):  # an object is lifted over an obstacle
        return []
    guards = [_without_gripper(step.condition) for step in moving]
    guards[-1] = any_of([guards[-1], negate(any_of(guards))])
    return [
        _step(Query(all_of([held.expression, guard])), _role(step)) for step, guard in zip(moving, guards, strict=True)
    ]


def _lifted(task: Task, steps: Sequence[PlanStep]) -> list[PlanStep]:
    """Turn "lift the wrench up" into a carry to the target of the next motion of the same object, if there is one."""
    direct = list(steps)
    for number, step in enumerate(steps):
        role = _role(step)
        others = (_role(other) for other in (*steps[number + 1 :], *steps[:number]))
        same = (other for other in others if other.direction is None and same_object(task, other.moved, role.moved))
        after = next(same, None)
        if role.direction == "up" and after is not None:
            direct[number] = _step(step.condition, replace(after, verb="carry", written=role.written))
    return direct


def _without_gripper(condition: Query) -> Expression:
    """Remove the parts of a conjunction that mention the gripper."""
    whole = condition.expression
    parts = whole.parts if whole.kind == "all" else (whole,)
    names = [{name for clause in leaves(part) for name in (clause.subject, clause.object)} for part in parts]
    return all_of(part for part, mentioned in zip(parts, names, strict=True) if GRIPPER not in mentioned)


def _touched(task: Task, roles: Sequence[StepRole]) -> str:
    """Return the point that the hand touches: the target of the first step other than "approach", else of any step."""
    hands = [role for role in roles if role.moved == GRIPPER != role.target and not is_goal(task, role.target)]
    hand = min(hands, key=lambda role: role.verb == "approach", default=None)
    name = first_object(task) if hand is None else hand.target
    assert name is not None
    return point_on(task, name)


def _has_sides(roles: Sequence[StepRole]) -> bool:
    """Return whether a plan has pushes from several sides, each with an approach to that side."""
    sides = {role.target for role in roles if role.verb == "push"}
    return len(sides) > 1 and all(any(role.target == side and role.verb in BY_HAND for role in roles) for side in sides)


def _covered(task: Task, steps: Sequence[PlanStep]) -> float:
    """Return the fraction of typical states of the plan's motion in which the active steps do what the motion needs."""
    roles = [_role(step) for step in steps]
    motion = motion_of(roles)
    if motion is None:
        return 0.0
    # Reaching and pushing from several sides have no typical states.
    if motion.manner == "reach" or _has_sides(roles):
        return 1.0
    manner = "pull" if motion.verb == "pull" else motion.manner
    return _coverage(task, _touched(task, roles), manner, [(step.condition, _role(step).verb) for step in steps])


# The typical states are synthetic: objects and goal at fixed positions, and the hand at offsets from the touched point.
_Floats = NDArray[np.float32]
_OBJECTS = ((0.0, 0.6, 0.02), (0.2, 0.7, 0.02), (-0.2, 0.7, 0.02), (0.0, 0.8, 0.02))
_GOAL = (0.1, 0.8, 0.2)
_MOTIONS = read_toml(files("lw_torchrl.language") / "data" / "motions.toml", ValueError)
_MOTIONS |= {motion: _MOTIONS["coming"] + _MOTIONS[motion] for motion in ("grasp", "pull")}
_TYPICAL = {
    motion: [(offset, opening, lift, {*verbs.split()}) for hands, opening, lift, verbs in rows for offset in hands]
    for motion, rows in _MOTIONS.items()
}


def _coverage(task: Task, point: str, motion: str, steps: Sequence[tuple[Query, Verb]]) -> float:
    """Return the fraction of typical states in which at least one step is active and every active step is right."""
    good = 0
    for offset, opening, lift, verbs in _TYPICAL[motion]:
        state = _state(task, point, offset, opening, lift)
        active = {verb for query, verb in steps if _holds(query, task, state)}
        good += bool(active) and active <= verbs
    return good / len(_TYPICAL[motion])


def _state(task: Task, point: str, offset: Sequence[float], opening: float, lift: float) -> _Floats:
    """Build an observation with the hand at ``offset`` from ``point`` and the touched object raised by ``lift`` (m)."""
    touched, layout = role_object(task, point), task.layout
    state = np.zeros(layout.size, np.float32)
    for place, xyz in zip(layout.positions[1:-1], _OBJECTS, strict=False):
        state[place] = xyz
    state[layout.positions[-1]] = _GOAL
    if at := [number for number in touched.position if isinstance(number, int)]:
        state[at[-1]] += np.float32(lift)
    hand = _position(touched.position, state) + _floats(touched.offset) + _floats(offset)
    state[list(places(layout.positions[0]))] = hand
    state[layout.opening] = opening
    return state


def _floats(numbers: Sequence[float]) -> _Floats:
    return np.array(numbers, np.float32)


def _position(position: Sequence[Coordinate], state: _Floats) -> _Floats:
    """Return a position (3,) in a state, in metres."""
    return _floats([state[at] if isinstance(at, int) else at for at in position])


def _holds(query: Query, task: Task, state: _Floats) -> bool:
    if query.is_conjunction:  # much faster, since it ends at the first clause that is false
        return all(_is_true(clause, task, state) for clause in query.clauses)
    return evaluate(query.expression, {leaf: _is_true(leaf, task, state) for leaf in leaves(query.expression)})


def _is_true(clause: Clause, task: Task, state: _Floats) -> bool:
    """Evaluate a clause without torch, in the precision and the order of operations of QueryProgram."""
    second, shift = _floats((0.0, 0.0, 0.0)), np.zeros(3)
    if clause.predicate in STATES:
        first = _floats((0.0, 0.0, state[task.openings[clause.subject]]))
    else:
        subject = task.object(clause.subject)
        first, shift = _position(subject.position, state), np.array(subject.offset)
        if clause.object is not None:
            other = task.object(clause.object)
            second, shift = _position(other.position, state), shift - other.offset
    truth = True
    for part in comparisons(clause.predicate, task.layout):
        d = first - second + _floats(shift + np.array((0.0, 0.0, part.raise_z)))
        d = d[["xyz".index(axis) for axis in part.axes]]
        value, threshold = np.sqrt((d * d).sum()) if part.length else d[0], np.float32(part.threshold)
        truth &= bool({"<": value < threshold, ">": value > threshold, "<=": value <= threshold}[part.sense])
    return truth != clause.negated


def canonical_like(plans: Plans, reference: Plans | None) -> Plans:
    """Convert plans to canonical form if ``reference`` is canonical, with fallback steps if the reference has them."""
    if reference is None or not reference.has_roles or plans.has_roles:
        return plans
    roles = [step.role for plan in reference.values() for step in plan.steps]
    return canonical_plans(plans, fallback=any(role is not None and role.fallback for role in roles))
