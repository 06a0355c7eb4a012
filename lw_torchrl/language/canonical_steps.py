"""CanonicalPlan: the steps that policies see of a plan, what was written, and how far it can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

from lw_torchrl.language.plans import ConditionalPlan, PlanStep
from lw_torchrl.language.queries import Query
from lw_torchrl.language.roles import VECTORS as VECTORS
from lw_torchrl.language.roles import Direction, Manner, StepRole, Verb, role_vectors

_SOURCES = {"plan": "its own steps", "completed": "completed", "default": "the default plan in its place"}


@dataclass(frozen=True)
class CanonicalStep:
    """One step as policies see it.

    Attributes:
        condition: when it is done, with the points at which things are touched in place of the things.
        verb: what is done.
        moved, target: what is to arrive where: names of the task's objects, or "target location", the goal.
        manner: what it is done for.
        direction: where a thing is pushed, pulled or moved to; of a hand that comes to do so, too.
        toward: what a direction "goal" is to; None for the task's goal.
        written: the skill's own words; "" for a step that the plan lacked.
        sure: from 0, a guess, to 1, said in words.
    """

    condition: Query
    verb: Verb
    moved: str
    target: str
    manner: Manner
    direction: Direction | None = None
    written: str = ""
    sure: float = 1.0
    toward: str | None = None

    @property
    def skill(self) -> str:
        """The step in one wording for all plans, "carry the mug to the target location"."""
        return self.role.skill

    @property
    def role(self) -> StepRole:
        return StepRole(
            self.verb, self.moved, self.target, self.manner, self.direction, self.toward, self.written, self.sure
        )


@dataclass(frozen=True)
class CanonicalPlan:
    """What became of a plan.

    Attributes:
        written: the plan as it was given.
        steps: what policies see.
        trust: in which share of usual states the plan, as written, does what its motion needs; in [0, 1].
        source: "plan", its own steps; "completed", its motion, things and direction with conditions of ours, where
            its own do not cover the usual states; "default", the plan for all tasks, where it says no motion.
        read: the plan's own steps as they were read, also where ``steps`` are others.
        left_out: the skills that could not be read.
        reserve: steps that are tried when ``steps`` get nowhere, those of the default plan; none unless asked for.
    """

    written: ConditionalPlan
    steps: tuple[CanonicalStep, ...]
    trust: float
    source: Literal["plan", "completed", "default"]
    read: tuple[CanonicalStep, ...] = ()
    left_out: tuple[str, ...] = ()
    reserve: tuple[CanonicalStep, ...] = ()

    @property
    def every_step(self) -> tuple[CanonicalStep, ...]:
        """Its steps, and behind them those in reserve."""
        return self.steps + self.reserve

    @cached_property
    def plan(self) -> ConditionalPlan:
        """The steps as a plan, whose reasons hold what was written, and of the first the plan's trust."""
        steps = []
        for number, step in enumerate(self.every_step):
            told = [f"plan trusted {self.trust:.2f}, {_SOURCES[self.source]}"] if number == 0 else []
            role = replace(step.role, fallback=number >= len(self.steps))
            told += ["fallback"] if number >= len(self.steps) else []
            told += [f"as written: {step.written}"] if step.written and step.written != step.skill else []
            steps.append(PlanStep(step.condition, step.skill, "; ".join(told), role=role))
        return ConditionalPlan(self.written.task, tuple(steps), self.written.definition, self.trust)

    def notes(self) -> list[dict[str, Any]]:
        """What became of each step as written, then the steps that policies see instead, if they do, as JSON.

        The keys are ``written``, None for a step that the plan lacked; ``skill``, ``verb``, ``moved``, ``target`` and
        ``condition``, None for what was left out; ``sure``; and ``seen``, whether policies see it.
        """
        own = self.source == "plan"
        told = [_told(step, step.written, own) for step in self.read]
        told += [] if own else [_told(step, step.written or None, True) for step in self.steps]
        nothing = dict.fromkeys(("skill", "verb", "moved", "target", "condition"))
        return told + [{"written": skill, **nothing, "sure": 0.0, "seen": False} for skill in self.left_out]


def _told(step: CanonicalStep, written: str | None, seen: bool) -> dict[str, Any]:
    names = ("skill", "verb", "moved", "target")
    told = {name: getattr(step, name) for name in names} | {"condition": str(step.condition), "sure": step.sure}
    return {"written": written, **told, "seen": seen}


def motion_of(steps: Sequence[CanonicalStep]) -> CanonicalStep | None:
    """The last step that moves a thing; in a plan without one, the last that brings the gripper to its place."""
    moving = [one for one in steps if one.verb in ("carry", "move", "push", "pull")]
    return next(reversed(moving or [one for one in steps if one.verb == "reach"]), None)


def step_vectors(plan: CanonicalPlan) -> list[list[float]]:
    """For each step, what is told of it beside its roles: ones for its verb, its manner and, if MT10 demonstrates the
    plan's motion in a way of its own, for that. Verbs of the same motion share theirs."""
    return role_vectors([step.role for step in plan.plan.steps if step.role])
