"""canonical_plan: from a plan in anyone's words to what policies see of it, completed where it says too little."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from lw_torchrl._checks import checked
from lw_torchrl.language.canonical_steps import CanonicalPlan, CanonicalStep, motion_of
from lw_torchrl.language.named_objects import GOAL, GRIPPER
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, Plans, PlanStep, as_plans
from lw_torchrl.language.queries import Query, check_query
from lw_torchrl.language.roles import BY_HAND, VECTORS, Direction, Manner, Verb
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.things import first_thing, is_goal, point_on, role_object, same_thing, thing_of, things
from lw_torchrl.language.usual_states import covered
from lw_torchrl.language.wording import Reading, compared_with_gripper, read_steps

RULES = 2
"""The version of the rules by which plans are read, which a policy's file keeps; raised when they change."""
TRUSTED = 0.75
"""A plan keeps its own conditions if in this share of usual states it does what its motion needs."""


@checked
def canonical_plan(plan: ConditionalPlan, fallback: bool = False) -> ConditionalPlan:
    """Read a free-form plan and return it with a role for each step, completed where it says too little.

    Each step gets a verb, an object that is moved, a target and a direction (:class:`StepRole`), from its words, its
    conditions and the task's objects alone. Where the hand acts on an object that has a named point, the point stands
    for it. A plan whose conditions leave usual states out, or that closes the gripper around nothing, keeps its motion,
    objects and direction, and gets standard conditions. A plan without any motion becomes the fallback plan: grasp the
    first object and move it to the goal. A plan whose steps have roles already is not read again.

    Args:
        plan: a plan in any words.
        fallback: append the steps of the fallback plan, whose roles say ``fallback=True``. Policies try them when the
            plan makes no progress. Nothing is appended where the plan became the fallback plan, or has one.

    Returns:
        A plan for the same task with ``step.role`` and ``confidence``.

    Example:
        >>> import lw_torchrl as lw
        >>> written = [("gripper not above the mug", "put gripper over mug"), ("gripper near the mug", "grab it")]
        >>> written.append(("gripper near the mug", "put the mug at the goal"))
        >>> plan = canonical_plan(lw.ConditionalPlan.from_pairs("coffee-push", written))
        >>> [step.role.verb for step in plan.steps]
        ['approach', 'descend', 'close', 'carry']

    Source: ours; the paper encodes a skill's words as they are.
    """
    if not all(step.role for step in plan.steps):
        plan = read_canonical(plan).plan
    if not fallback or any(step.role.fallback for step in plan.steps if step.role):
        return plan
    other = default_plan(plan).plan.steps
    if [(step.condition, step.skill) for step in plan.steps] == [(step.condition, step.skill) for step in other]:
        return plan
    steps = [replace(step, reason="fallback", role=replace(step.role, fallback=True)) for step in other if step.role]
    return replace(plan, steps=(*plan.steps, *steps))


@checked
def canonical_plans(plans: AnyPlans, fallback: bool = False) -> Plans:
    """Apply :func:`canonical_plan` to each of ``plans``."""
    return Plans([canonical_plan(plan, fallback) for plan in as_plans(plans).values()])


@checked
def read_canonical(plan: ConditionalPlan) -> CanonicalPlan:
    read = read_steps(plan)
    left_out = tuple(step.skill for step, one in zip(plan.steps, read, strict=True) if one is None)
    steps = _steps(plan, read)
    trust = _trust(plan.definition, steps)
    if trust >= TRUSTED and _is_complete(steps):
        return CanonicalPlan(plan, steps, trust, "plan", steps, left_out)
    last = motion_of(steps)
    if last is None:
        return replace(default_plan(plan), trust=trust, read=steps, left_out=left_out)
    completed = _template(plan.definition, steps, last)
    return CanonicalPlan(plan, completed, trust, "completed", steps, left_out)


def default_plan(plan: ConditionalPlan) -> CanonicalPlan:
    """The plan that is the same for all tasks: grasp the first thing and move it to the goal; without a thing, move the
    gripper there. ``plan`` says the task, and no more."""
    task = plan.definition
    thing = first_thing(task)
    if thing is None:
        named = things(task)
        goal = next((name for name in named if is_goal(task, name)), None)
        near = check_query(f"the gripper is near the {goal or named[0]}", task)
        target = GOAL if goal else named[0]
        steps = [CanonicalStep(_negated(near), "reach", GRIPPER, target, "reach")]
        steps.append(CanonicalStep(near, "hold", GRIPPER, target, "reach"))
        return CanonicalPlan(plan, tuple(steps), 0.0, "default")
    last = CanonicalStep(check_query("the gripper is closed", task), "move", thing, GOAL, "grasp", sure=0.0)
    return CanonicalPlan(plan, _template(task, (), last), 0.0, "default")


def with_reserve(plan: CanonicalPlan) -> CanonicalPlan:
    """The same plan with :func:`default_plan` in reserve, unless that is what it is."""
    return plan if plan.source == "default" else replace(plan, reserve=default_plan(plan.written).steps)


def _negated(query: Query) -> Query:
    return Query(tuple(replace(clause, negated=not clause.negated) for clause in query.clauses))


def _steps(plan: ConditionalPlan, read: Sequence[Reading | None]) -> tuple[CanonicalStep, ...]:
    """The readings as steps that know what they are done for."""
    task = plan.definition
    told = [(step, one) for step, one in zip(plan.steps, read, strict=True) if one and one.moved and one.target]
    grasping = any(one.verb == "close" or one.verb in ("carry", "move") for _, one in told)
    first = first_thing(task)
    steps = []
    for number, (step, one) in enumerate(told):
        verb, direction = one.verb, one.direction
        purpose = _purpose([other for _, other in told[number:]] + [other for _, other in told[:number][::-1]])
        manner = _manner(one)
        if verb in BY_HAND:
            verb, manner, direction = _coming(one, purpose if not grasping else None)
        target, moved = str(one.target), str(one.moved)
        if moved == GRIPPER and first is not None and same_thing(task, target, first):
            target = _compared_point(step, task, target) or point_on(task, target)
        condition = _at_points(step.condition, task)
        toward = purpose.toward if direction == "goal" and purpose is not None else None
        steps.append(CanonicalStep(condition, verb, moved, target, manner, direction, step.skill, one.sure, toward))
    return tuple(_over_walls(steps, task))


def _coming(one: Reading, purpose: Reading | None) -> tuple[Verb, Manner, Direction | None]:
    """How a hand comes, with which verb, manner and direction, for a ``purpose``; None for one that grasps."""
    if purpose is None:
        return ("descend" if one.verb == "beside" else one.verb), "grasp", None
    manner = _manner(purpose)
    if manner == "push":
        return ("beside" if one.verb == "descend" else one.verb), manner, purpose.direction
    if manner == "press":
        return ("push" if one.verb == "descend" else one.verb), manner, purpose.direction
    direction = one.direction or (purpose.direction if manner == "pull" else None)
    return ("descend" if one.verb == "beside" else one.verb), manner, direction


def _compared_point(step: PlanStep, task: Task, thing: str) -> str | None:
    """The point on a thing that a step's condition compares with the gripper; None if there is none."""
    near = compared_with_gripper(step)
    points = (one for one in near if any(role_object(task, one).offset) and same_thing(task, one, thing))
    return next(points, None)


def _purpose(ahead: Sequence[Reading]) -> Reading | None:
    """The next step, or else the last before, that moves something."""
    return next((one for one in ahead if one.verb not in BY_HAND), None)


def _manner(one: Reading) -> Manner:
    if one.verb in ("push", "pull"):
        return "press" if one.verb == "push" and one.direction == "down" else one.verb
    return "reach" if one.verb in ("reach", "hold") else "grasp"


def _at_points(condition: Query, task: Task) -> Query:
    """A condition whose clauses about the gripper and the first thing are about where that is touched."""
    first = first_thing(task)

    def at(name: str | None) -> Any:
        return point_on(task, name) if name and name != GRIPPER and first and same_thing(task, name, first) else name

    return Query(
        tuple(
            replace(clause, subject=at(clause.subject), object=at(clause.object))
            if clause.object is not None and GRIPPER in (clause.subject, clause.object)
            else clause
            for clause in condition.clauses
        )
    )


def _over_walls(steps: Sequence[CanonicalStep], task: Task) -> list[CanonicalStep]:
    """ "lift the puck over the wall", then "move it to the goal", is one way through the air to the goal."""
    found = list(steps)
    for number, step in enumerate(steps):
        after = next((one for one in steps[number + 1 :] if one.verb in ("carry", "move")), None)
        fixed = not any(isinstance(number, int) for number in role_object(task, step.target).position)
        if step.verb != "carry" or not fixed or after is None or same_thing(task, step.target, after.target):
            continue
        if same_thing(task, step.moved, after.moved):
            found[number] = replace(step, moved=after.moved, target=after.target)
    return found


def _is_complete(steps: Sequence[CanonicalStep]) -> bool:
    """Whether a plan moves something and, if it grasps, comes to the thing and closes the gripper before."""
    verbs = [one.verb for one in steps]
    moving = [number for number, verb in enumerate(verbs) if verb in ("carry", "move")]
    if any(one.verb == "pull" and "handle" not in one.target.split() for one in steps):
        return False  # a handle can be hooked; anything else is held better in closed fingers
    if motion_of(steps) is None:
        return False
    if not moving:
        return True
    closing = verbs.index("close") if "close" in verbs else len(verbs)
    return closing < min(moving) and any(verb in ("approach", "descend") for verb in verbs[:closing])


def _template(task: Task, steps: Sequence[CanonicalStep], last: CanonicalStep) -> tuple[CanonicalStep, ...]:
    """The motion of a plan, ``last``, at the thing that the plan names, with conditions that cover the usual states."""
    if last.manner == "reach":
        return tuple(steps)
    if any(one.verb == "carry" and (one.moved, one.target) == (last.moved, last.target) for one in steps):
        last = replace(last, verb="carry")
    point = _touched(task, steps)
    above, near, over, level = (
        check_query(f"the gripper is {relation} the {point}", task)
        for relation in ("above", "near", "vertically aligned with", "forward aligned with")
    )
    opened, closed = (check_query(f"the gripper is {state}", task) for state in ("open", "closed"))

    def by_hand(verb: Verb, manner: Manner, *conditions: Query, way: Direction | None = None) -> CanonicalStep:
        every = Query(tuple(clause for one in conditions for clause in one.clauses))
        return CanonicalStep(every, verb, GRIPPER, point, manner, way, sure=0.0)

    away = _negated(near)
    if last.manner in ("grasp", "pull"):
        held = thing_of(task, point)
        if last.verb == "pull":
            way = last.direction if last.direction in VECTORS else None
            last = replace(last, verb="move", manner="grasp", moved=held, target=held if way else GOAL, direction=way)
        elif last.moved == GRIPPER:
            last = replace(last, moved=held)
        both = Query((*near.clauses, *closed.clauses))
        return (
            by_hand("approach", "grasp", _negated(above), away),
            by_hand("descend", "grasp", above, away),
            by_hand("close", "grasp", near, opened),
            replace(last, condition=both),
        )
    way = last.direction
    if last.manner == "press":
        down = by_hand("approach", "press", _negated(over), way=way)
        return down, replace(last, condition=over, target=point)
    if way == "away":
        return by_hand("beside", "push", _negated(level), way=way), replace(last, condition=level, target=point)
    come = by_hand("approach", "push", _negated(over), way=way), by_hand("beside", "push", over, away, way=way)
    return *come, replace(last, condition=near, target=point)


def _touched(task: Task, steps: Sequence[CanonicalStep]) -> str:
    """Where the hand acts: on the thing that it first comes down to, else on the one that it first goes over."""
    hands = [one for one in steps if one.moved == GRIPPER != one.target and not is_goal(task, one.target)]
    found = min(hands, key=lambda one: one.verb == "approach", default=None)
    name = first_thing(task) if found is None else found.target
    assert name is not None
    return point_on(task, name)


def _has_sides(steps: Sequence[CanonicalStep]) -> bool:
    """Whether a plan pushes a thing from several sides, and says for each how to come there."""
    sides = {one.target for one in steps if one.verb == "push"}
    return len(sides) > 1 and all(any(one.target == side and one.verb in BY_HAND for one in steps) for side in sides)


def _trust(task: Task, steps: Sequence[CanonicalStep]) -> float:
    """In which share of usual states of a motion a step is in force, and all that are do what the motion needs."""
    last = motion_of(steps)
    if last is None:
        return 0.0
    if last.manner == "reach" or _has_sides(steps):
        return 1.0
    motion = "pull" if last.verb == "pull" else last.manner
    return covered(task, _touched(task, steps), motion, [(step.condition, step.verb) for step in steps])


def worth(plan: ConditionalPlan) -> tuple[bool, float, float]:
    """By what plans for a task compare where nobody can try them: whether it says a motion, its trust, and how sure its
    steps are on average. The larger tuple is the better plan."""
    found = read_canonical(plan)
    sure = sum(step.sure for step in found.read) / (len(found.read) + len(found.left_out))
    return found.source != "default", found.trust, sure


def most_trusted(plans: Iterable[ConditionalPlan]) -> ConditionalPlan:
    """Of several plans for a task the one of most :func:`worth`; of equals the first.

    Raises:
        ValueError: there is none.

    Example:
        >>> import lw_torchrl as lw
        >>> bad = lw.ConditionalPlan.from_pairs("push", [("gripper is open", "ponder")])
        >>> good = lw.ConditionalPlan.from_pairs("push", [("gripper is open", "put the puck at the goal")])
        >>> most_trusted([bad, good]) is good
        True
    """
    if not (listed := list(plans)):
        raise ValueError("plans must be at least one, got none")
    return max(listed, key=worth)
