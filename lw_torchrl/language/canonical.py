"""canonical_plan: read a free-form plan as verbs, objects and targets, and complete it where it says too little."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from lw_torchrl._util.checks import typed
from lw_torchrl.language.coverage import coverage
from lw_torchrl.language.objects import GOAL, GRIPPER
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, Plans, PlanStep, as_plans
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.roles import BY_HAND, VECTORS, Direction, Manner, StepRole, Verb, motion_of
from lw_torchrl.language.step_parser import ParsedStep, compared_with_gripper, parse_steps
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

MIN_CONFIDENCE = 0.75
"""A plan of at least this confidence keeps its own conditions."""
Source = Literal["plan", "completed", "fallback"]
_SOURCES = {"plan": "its own steps", "completed": "completed", "fallback": "replaced by the fallback plan"}


@dataclass(frozen=True)
class CanonicalReport:
    """How :func:`canonical_plan` read a plan.

    Its source is "plan", the plan's own steps; "completed", its motion, objects and direction with standard
    conditions, if its own do not cover the typical states; or "fallback", the fallback plan, if it has no motion.
    """

    written: ConditionalPlan
    plan: ConditionalPlan  # the canonical form
    source: Source
    read: tuple[PlanStep, ...]  # the plan's own steps as they were read, also where ``plan`` has others
    left_out: tuple[str, ...]  # the skills that could not be read

    def notes(self) -> list[dict[str, Any]]:
        """The result of each step as written, then the steps that replace them, if any, as JSON.

        The keys are ``written``, None for a step that the plan lacked; ``skill``, ``verb``, ``moved``, ``target`` and
        ``condition``, None for what was left out; ``confidence``; and ``seen``, whether policies see the step.
        """

        def note(step: PlanStep, seen: bool) -> dict[str, Any]:
            role = _role(step)
            names = {"skill": step.skill, "verb": role.verb, "moved": role.moved, "target": role.target}
            about = {"condition": str(step.condition), "confidence": role.confidence, "seen": seen}
            return {"written": role.written or None, **names, **about}

        own = self.source == "plan"
        notes = [note(step, own) for step in self.read] + [note(step, True) for step in self.plan.steps if not own]
        nothing = dict.fromkeys(("skill", "verb", "moved", "target", "condition"))
        return notes + [{"written": skill, **nothing, "confidence": 0.0, "seen": False} for skill in self.left_out]


@typed
def canonical_plan(plan: ConditionalPlan, fallback: bool = False) -> ConditionalPlan:
    """Read a free-form plan and return it with a role for each step, completed where it says too little.

    Each step gets a verb, an object that is moved, a target and a direction (:class:`StepRole`), from its words, its
    conditions and the task's objects alone. Where the hand acts on an object that has a named point, the point stands
    for it. A plan whose conditions leave typical states out, or that closes the gripper around nothing, keeps its
    motion, objects and direction, and gets standard conditions. A plan without any motion becomes
    :func:`fallback_plan`. A plan whose steps have roles already is not read again.

    Args:
        plan: a plan in any words.
        fallback: append the steps of the fallback plan, whose roles say ``fallback=True``. Policies try them when the
            plan makes no progress. Nothing is appended where the plan became the fallback plan, or has one.

    Example:
        >>> import lw_torchrl as lw
        >>> written = [("gripper not above the mug", "put gripper over mug"), ("gripper near the mug", "grab it")]
        >>> written.append(("gripper near the mug", "put the mug at the goal"))
        >>> plan = canonical_plan(lw.ConditionalPlan.from_pairs("coffee-push", written))
        >>> [step.role.verb for step in plan.steps]
        ['approach', 'descend', 'close', 'carry']

    Source: ours; the paper encodes a skill's words as they are.
    """
    if any(step.role is None for step in plan.steps):
        plan = explain_canonical(plan).plan
    if not fallback or any(_role(step).fallback for step in plan.steps):
        return plan
    other = fallback_plan(plan.definition).steps
    if [(step.condition, step.skill) for step in plan.steps] == [(step.condition, step.skill) for step in other]:
        return plan
    steps = [replace(step, reason="fallback", role=replace(_role(step), fallback=True)) for step in other]
    return replace(plan, steps=(*plan.steps, *steps))


@typed
def canonical_plans(plans: AnyPlans, fallback: bool = False) -> Plans:
    """Apply :func:`canonical_plan` to each of ``plans``."""
    return Plans([canonical_plan(plan, fallback) for plan in as_plans(plans).values()])


@typed
def explain_canonical(plan: ConditionalPlan) -> CanonicalReport:
    """Report how :func:`canonical_plan` reads a plan, step by step.

    Example:
        >>> import lw_torchrl as lw
        >>> written = [("gripper is open", "place the gripper above the mug"), ("gripper is closed", "ponder")]
        >>> report = explain_canonical(lw.ConditionalPlan.from_pairs("coffee-push", written))
        >>> report.source, report.plan.confidence, report.left_out
        ('fallback', 0.0, ('ponder',))
    """
    task, parsed = plan.definition, parse_steps(plan)
    read = _with_roles(plan, parsed)
    confidence, last = _confidence(task, read), motion_of([_role(step) for step in read])
    source: Source
    if confidence >= MIN_CONFIDENCE and _is_complete(read):
        source, steps = "plan", read
    elif last is not None:
        source, steps = "completed", _completed(task, read, last)
    else:
        source, steps = "fallback", fallback_plan(task).steps
    left_out = tuple(step.skill for step, reading in zip(plan.steps, parsed, strict=True) if reading is None)
    seen = []
    for number, step in enumerate(steps):
        written = _role(step).written
        reasons = [f"confidence {confidence:.2f}, {_SOURCES[source]}"] if number == 0 else []
        reasons += [f"as written: {written}"] if written and written != step.skill else []
        seen.append(replace(step, reason="; ".join(reasons)))
    canonical = ConditionalPlan(plan.task, tuple(seen), task, confidence)
    return CanonicalReport(plan, canonical, source, read, left_out)


def fallback_plan(task: str | Task) -> ConditionalPlan:
    """Return the generic plan for a task: grasp the first object and move it to the goal.

    In a task without an object the gripper moves to the goal.
    """
    task = get_task(task)
    held = first_object(task)
    if held is not None:
        steps = _completed(task, (), StepRole("move", held, GOAL, "grasp", confidence=0.0))
        return ConditionalPlan(task.name, steps, task)
    named = whole_objects(task)
    goal = next((name for name in named if is_goal(task, name)), None)
    near, target = _gripper_is("near", goal or named[0]), GOAL if goal else named[0]
    come = _step(_negated(near), StepRole("reach", GRIPPER, target, "reach"))
    return ConditionalPlan(task.name, (come, _step(near, StepRole("hold", GRIPPER, target, "reach"))), task)


def _role(step: PlanStep) -> StepRole:
    assert step.role is not None
    return step.role


def _step(condition: Query, role: StepRole) -> PlanStep:
    return PlanStep(condition, role.skill, role=role)


def _gripper_is(predicate: str, name: str | None = None) -> Query:
    return Query((Clause(GRIPPER, predicate, name),))


def _negated(query: Query) -> Query:
    return Query(tuple(replace(clause, negated=not clause.negated) for clause in query.clauses))


def _with_roles(plan: ConditionalPlan, parsed: Sequence[ParsedStep | None]) -> tuple[PlanStep, ...]:
    """Return the steps that could be read, with the purpose that each has in the plan."""
    task = plan.definition
    pairs = [(step, each) for step, each in zip(plan.steps, parsed, strict=True) if each and each.moved and each.target]
    read = [each for _, each in pairs]
    grasping = any(each.verb in ("close", "carry", "move") for each in read)
    first = first_object(task)
    steps = []
    for number, (step, each) in enumerate(pairs):
        verb, manner, direction = each.verb, _manner(each), each.direction
        # The first step from this one on that moves something, otherwise the last one before it.
        purpose = next((other for other in (*read[number:], *read[:number][::-1]) if other.verb not in BY_HAND), None)
        if verb in BY_HAND:
            verb, manner, direction = _coming(each, purpose if not grasping else None)
        target, moved = str(each.target), str(each.moved)
        if moved == GRIPPER and first is not None and same_object(task, target, first):
            target = _compared_point(step, task, target) or point_on(task, target)
        toward = purpose.toward if direction == "goal" and purpose is not None else None
        role = StepRole(verb, moved, target, manner, direction, toward, step.skill, each.confidence)
        steps.append(_step(_at_points(step.condition, task), role))
    return tuple(_over_walls(steps, task))


def _coming(each: ParsedStep, purpose: ParsedStep | None) -> tuple[Verb, Manner, Direction | None]:
    """Return the verb, manner and direction of a hand that comes for a ``purpose``; None for a plan that grasps."""
    down = "descend" if each.verb == "beside" else each.verb
    if purpose is None:
        return down, "grasp", None
    manner = _manner(purpose)
    if manner == "push":
        return ("beside" if each.verb == "descend" else each.verb), manner, purpose.direction
    if manner == "press":
        return ("push" if each.verb == "descend" else each.verb), manner, purpose.direction
    return down, manner, each.direction or (purpose.direction if manner == "pull" else None)


def _compared_point(step: PlanStep, task: Task, name: str) -> str | None:
    """Return the point on an object that a step's condition compares with the gripper; None if there is none."""
    near = sorted(compared_with_gripper(step), key=task.object_names.index)
    points = (other for other in near if any(role_object(task, other).offset) and same_object(task, other, name))
    return next(points, None)


def _manner(each: ParsedStep) -> Manner:
    if each.verb in ("push", "pull"):
        return "press" if each.verb == "push" and each.direction == "down" else each.verb
    return "reach" if each.verb in ("reach", "hold") else "grasp"


def _at_points(condition: Query, task: Task) -> Query:
    """Return a condition whose clauses about the gripper name the point where the first object is touched."""
    first = first_object(task)

    def at(name: str) -> str:
        return point_on(task, name) if name != GRIPPER and first and same_object(task, name, first) else name

    def touched(clause: Clause) -> Clause:
        if clause.object is None or GRIPPER not in (clause.subject, clause.object):
            return clause
        return replace(clause, subject=at(clause.subject), object=at(clause.object))

    return Query(tuple(map(touched, condition.clauses)))


def _over_walls(steps: Sequence[PlanStep], task: Task) -> list[PlanStep]:
    """Send "lift the puck over the wall" to the target of a later "move it to the goal", in one way through the air."""
    direct = list(steps)
    for number, step in enumerate(steps):
        role = _role(step)
        later = (_role(other) for other in steps[number + 1 :])
        after = next((other for other in later if other.verb in ("carry", "move")), None)
        fixed = not any(isinstance(at, int) for at in role_object(task, role.target).position)
        if role.verb != "carry" or not fixed or after is None or same_object(task, role.target, after.target):
            continue
        if same_object(task, role.moved, after.moved):
            direct[number] = _step(step.condition, replace(role, moved=after.moved, target=after.target))
    return direct


def _is_complete(steps: Sequence[PlanStep]) -> bool:
    """Return whether a plan moves something and, if it grasps, comes to the object and closes the gripper before."""
    roles = [_role(step) for step in steps]
    verbs = [role.verb for role in roles]
    moving = next((number for number, verb in enumerate(verbs) if verb in ("carry", "move")), None)
    if any(role.verb == "pull" and "handle" not in role.target.split() for role in roles):
        return False  # a handle can be hooked; anything else is held better in closed fingers
    if moving is None:
        return motion_of(roles) is not None
    return "close" in verbs[:moving] and not {"approach", "descend"}.isdisjoint(verbs[: verbs.index("close")])


def _completed(task: Task, steps: Sequence[PlanStep], last: StepRole) -> tuple[PlanStep, ...]:
    """Return the plan's motion, ``last``, at the object that it names, with standard conditions."""
    roles = [_role(step) for step in steps]
    if last.manner == "reach":
        return tuple(steps)
    if any(role.verb == "carry" and (role.moved, role.target) == (last.moved, last.target) for role in roles):
        last = replace(last, verb="carry")
    point = _touched(task, roles)
    above, near, over = (_gripper_is(relation, point) for relation in ("above", "near", "vertically aligned with"))
    away = _negated(near)

    def by_hand(verb: Verb, manner: Manner, *conditions: Query, way: Direction | None = None) -> PlanStep:
        both = Query(tuple(clause for query in conditions for clause in query.clauses))
        return _step(both, StepRole(verb, GRIPPER, point, manner, way, confidence=0.0))

    if last.manner in ("grasp", "pull"):
        held = object_of(task, point)
        if last.verb == "pull":
            way = last.direction if last.direction in VECTORS else None
            last = replace(last, verb="move", manner="grasp", moved=held, target=held if way else GOAL, direction=way)
        elif last.moved == GRIPPER:
            last = replace(last, moved=held)
        return (
            by_hand("approach", "grasp", _negated(above), away),
            by_hand("descend", "grasp", above, away),
            by_hand("close", "grasp", near, _gripper_is("open")),
            _step(Query((*near.clauses, *_gripper_is("closed").clauses)), last),
        )
    way, last = last.direction, replace(last, target=point)
    if last.manner == "press":
        return by_hand("approach", "press", _negated(over), way=way), _step(over, last)
    if way == "away":
        level = _gripper_is("forward aligned with", point)
        return by_hand("beside", "push", _negated(level), way=way), _step(level, last)
    come = by_hand("approach", "push", _negated(over), way=way), by_hand("beside", "push", over, away, way=way)
    return *come, _step(near, last)


def _touched(task: Task, roles: Sequence[StepRole]) -> str:
    """Return where the hand acts: where it first comes down to, else what it first goes over."""
    hands = [role for role in roles if role.moved == GRIPPER != role.target and not is_goal(task, role.target)]
    hand = min(hands, key=lambda role: role.verb == "approach", default=None)
    name = first_object(task) if hand is None else hand.target
    assert name is not None
    return point_on(task, name)


def _has_sides(roles: Sequence[StepRole]) -> bool:
    """Return whether a plan pushes an object from several sides, and describes the approach to each."""
    sides = {role.target for role in roles if role.verb == "push"}
    return len(sides) > 1 and all(any(role.target == side and role.verb in BY_HAND for role in roles) for side in sides)


def _confidence(task: Task, steps: Sequence[PlanStep]) -> float:
    """Return the fraction of typical states of the plan's motion in which its steps do what the motion needs."""
    roles = [_role(step) for step in steps]
    last = motion_of(roles)
    if last is None:
        return 0.0
    if last.manner == "reach" or _has_sides(roles):
        return 1.0
    motion = "pull" if last.verb == "pull" else last.manner
    return coverage(task, _touched(task, roles), motion, [(step.condition, _role(step).verb) for step in steps])


def worth(plan: ConditionalPlan) -> tuple[bool, float, float]:
    """Return a key to compare plans for a task, the larger is better: whether the plan has a motion, its confidence,
    and the mean confidence of its steps."""
    report = explain_canonical(plan)
    steps = sum(_role(step).confidence for step in report.read) / (len(report.read) + len(report.left_out))
    return report.source != "fallback", report.plan.confidence or 0.0, steps


def most_confident(plans: Iterable[ConditionalPlan]) -> ConditionalPlan:
    """Return the plan with the largest :func:`worth`, the first of equals."""
    if not (listed := list(plans)):
        raise ValueError("plans must be at least one, got none")
    return max(listed, key=worth)


def canonical_like(plans: Plans, reference: Plans | None) -> Plans:
    """Return plans in the form of ``reference``: canonical, with or without fallback, if the reference is."""
    if reference is None or not reference.has_roles or plans.has_roles:
        return plans
    roles = [step.role for plan in reference.values() for step in plan.steps]
    return canonical_plans(plans, fallback=any(role is not None and role.fallback for role in roles))
