"""Canonical plans: parse a free-form plan into verbs, objects and targets, and complete an underspecified plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from lw_torchrl._util.checks import typed
from lw_torchrl.language.completion import completed, gripper_is, is_complete, negated, step_of
from lw_torchrl.language.coverage import coverage_of, role_of, touched_point
from lw_torchrl.language.expressions import replace_leaves
from lw_torchrl.language.objects import GOAL, GRIPPER
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, Plans, PlanStep, as_plans
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.roles import BY_HAND, Direction, Manner, StepRole, Verb, ignored_words, motion_of
from lw_torchrl.language.step_parser import ParsedStep, compared_with_gripper, is_free, is_obstacle, parse_steps
from lw_torchrl.language.tasks import (
    Task,
    first_object,
    get_task,
    is_goal,
    point_on,
    role_object,
    same_object,
    whole_objects,
)

MIN_COVERAGE = 0.75
"""The fraction of typical states that a plan must cover at least to keep its own conditions."""
Source = Literal["plan", "completed", "fallback"]
SOURCES = {"plan": "its own steps", "completed": "completed", "fallback": "replaced by the fallback plan"}
"""A short description, for printing, of each source of a canonical plan's steps."""


@dataclass(frozen=True)
class CanonicalReport:
    """A report on how :func:`canonical_plan` parses a plan.

    ``source`` is "plan" if the plan keeps its own steps. ``source`` is "completed" if these steps do not cover the
    typical states: standard steps are added, and the plan's own conditions are restricted or extended where the
    standard ones differ. ``source`` is "fallback" if the plan has no motion and is replaced by the fallback plan.
    """

    written: ConditionalPlan
    plan: ConditionalPlan  # the canonical form
    source: Source
    read: tuple[PlanStep, ...]  # the plan's own steps as parsed, even if ``plan`` has different steps
    left_out: tuple[str, ...]  # the skills that could not be parsed
    is_read: tuple[bool, ...]  # whether each step of ``written`` is in ``read``

    def notes(self) -> list[dict[str, Any]]:
        """Return a JSON row for each step of ``written``, then one for each step that replaces the plan's steps.

        The keys are ``written`` (None for an added step); ``skill``, ``verb``, ``moved``, ``target`` and ``condition``
        (None for a step that was left out); ``seen`` (whether policies see the step); and ``ignored``, present only if
        words of the skill are ignored, such as "three times" or "without touching it".
        """

        def note(step: PlanStep, seen: bool) -> dict[str, Any]:
            role = role_of(step)
            parsed = {"skill": step.skill, "verb": role.verb, "moved": role.moved, "target": role.target}
            if ignored := ignored_words(role.written, self.plan.definition):
                parsed["ignored"] = ignored
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

    Each step gets a verb, an object that moves, a target and a direction (:class:`StepRole`), inferred only from the
    step's words, the step's condition and the task's objects. If the object that the hand touches has a named point,
    this point replaces the object. A plan whose conditions miss typical states, or that moves an object without
    grasping it first, is completed: missing steps are added, and its own conditions are changed where they differ
    from standard conditions. A plan without any motion is replaced by :func:`fallback_plan`. A plan that already has
    roles is not parsed again.

    Args:
        plan: a plan in free-form English.
        fallback: append the steps of the fallback plan, with ``fallback=True`` in their roles. Policies try these steps
            when the plan makes no progress, and alternate between carrying and sliding the object. A plan that already
            has fallback steps is unchanged.

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
    if not fallback or any(role_of(step).fallback for step in plan.steps):
        return plan
    other = fallback_plan(plan.definition).steps
    if role_of(slide := other[-1]).verb == "move":
        carry = step_of(slide.condition, replace(role_of(slide), verb="carry"))
        verbs = {role_of(step).verb for step in plan.steps}
        slid = "move" in verbs or verbs.isdisjoint(("carry", "push", "pull"))
        other = (*other[:-1], carry, slide) if slid else (*other, carry)  # first try the motion that the plan lacks
    steps = [replace(step, reason="fallback", role=replace(role_of(step), fallback=True)) for step in other]
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
    if is_complete(task, read) and coverage_of(task, read) >= MIN_COVERAGE:
        source, steps = "plan", _past_obstacles(task, read)
    elif motion is not None:
        source, steps = "completed", completed(task, read, motion)
    else:
        source, steps = "fallback", fallback_plan(task).steps
    left_out = tuple(step.skill for step, reading in zip(plan.steps, parsed, strict=True) if reading is None)
    explained = []
    for number, step in enumerate(steps):
        written = role_of(step).written
        reasons = [SOURCES[source]] if number == 0 else []
        reasons += [f"as written: {written}"] if written and written != step.skill else []
        reasons += [f"left out: {words}"] if (words := ignored_words(written, task)) else []
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
    near, target = gripper_is("near", goal or names[0]), GOAL if goal else names[0]
    approach = step_of(negated(near), StepRole("reach", GRIPPER, target, "reach"))
    return ConditionalPlan(task.name, (approach, step_of(near, StepRole("hold", GRIPPER, target, "reach"))), task)


def plan_of_motion(task: str | Task, motion: StepRole) -> ConditionalPlan:
    """Build the plan with standard conditions that carries out ``motion`` on a task's first object."""
    task = get_task(task)
    return ConditionalPlan(task.name, completed(task, (), motion), task)


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
        # The purpose is the next step (including this one) that moves an object, else the last such step before it.
        purpose = next((other for other in (*read[number:], *read[:number][::-1]) if other.verb not in BY_HAND), None)
        if verb in BY_HAND:
            verb, manner, direction = _approach(each, purpose if not grasping else None)
        target, moved = str(each.target), str(each.moved)
        if moved == GRIPPER and first is not None and same_object(task, target, first):
            target = _compared_point(step, task, target) or point_on(task, target)
        toward = purpose.toward if direction == "goal" and purpose is not None else None
        role = StepRole(verb, moved, target, manner, direction, toward, step.skill, each.confidence)
        steps.append(step_of(_at_points(step.condition, task), role))
    return tuple(_over_walls(steps, task))


def _approach(each: ParsedStep, purpose: ParsedStep | None) -> tuple[Verb, Manner, Direction | None]:
    """Return (verb, manner, direction) of a step that prepares ``purpose``; ``purpose=None`` stands for a grasp."""
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
        role = role_of(step)
        later = (role_of(other) for other in steps[number + 1 :])
        moving = (other for other in later if other.verb in ("carry", "move"))
        after = next((other for other in moving if not same_object(task, role.target, other.target)), None)
        is_fixed = not any(isinstance(at, int) for at in role_object(task, role.target).position)
        if role.verb in ("carry", "move") and is_fixed and after and same_object(task, role.moved, after.moved):
            direct[number] = step_of(
                step.condition, replace(role, verb="carry", moved=after.moved, target=after.target)
            )
    return direct


def _past_obstacles(task: Task, steps: Sequence[PlanStep]) -> tuple[PlanStep, ...]:
    """Redirect "move the gripper over the wall" to the point that the hand touches behind the wall."""
    roles = [role_of(step) for step in steps]
    return tuple(
        step_of(step.condition, replace(role, target=touched_point(task, roles)))
        if role.verb in BY_HAND and is_obstacle(role.target)
        else step
        for step, role in zip(steps, roles, strict=True)
    )


def _final_motion(steps: Sequence[PlanStep]) -> StepRole | None:
    """Return the motion that ends at the goal, at any place in the plan; otherwise the last motion."""
    moving = [step for step in steps if role_of(step).verb in ("carry", "move") and not is_free(step)]
    to_goal = [step for step in moving if role_of(step).target == GOAL]
    return motion_of([role_of(step) for step in to_goal or steps])


def canonical_like(plans: Plans, reference: Plans | None) -> Plans:
    """Convert plans to canonical form if ``reference`` is canonical, with fallback steps if the reference has them."""
    if reference is None or not reference.has_roles or plans.has_roles:
        return plans
    roles = [step.role for plan in reference.values() for step in plan.steps]
    return canonical_plans(plans, fallback=any(role is not None and role.fallback for role in roles))
