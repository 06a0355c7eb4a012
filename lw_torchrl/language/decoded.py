"""What decoding a text gives: the plan, its steps as they were written and mapped, and notes."""

from __future__ import annotations

from dataclasses import dataclass

from lw_torchrl.language.formats.written import Note
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.queries import Query


@dataclass(frozen=True)
class DecodedStep:
    """One clause of a text, and what became of it.

    Distances are 0 for a text that is itself a query or a skill, and at most 1.

    Attributes:
        line: where it stands in the text, from 1.
        written_condition: the condition in the text's words.
        written_skill: the skill in the text's words, as a sentence: ``robot.put("gripper above mug")`` is "put gripper
            above mug".
        condition: the query it was mapped to; None if nothing is near enough.
        condition_distance: of the clause that is furthest from what it was taken for.
        scripted: the text of the scripted skill it was mapped to; None if nothing is near enough.
        skill_distance: between the skill and that one.
        written_goal: the state to reach in the text's words, "" if it says none.
        goal: the query that was mapped to; None if nothing is near enough.
        goal_distance: as ``condition_distance``.
        dropped: why it is no step of the plan; "" if it is one.
    """

    line: int
    written_condition: str
    written_skill: str
    condition: Query | None
    condition_distance: float
    scripted: str | None
    skill_distance: float
    written_goal: str = ""
    goal: Query | None = None
    goal_distance: float = 0.0
    dropped: str = ""


@dataclass(frozen=True)
class DecodedPlan:
    """What :func:`decode_plan` made of a text.

    Attributes:
        plan: the plan, its conditions as queries and its skills in the text's words; None if there is none.
        scripted: the same with the nearest scripted skills, what :class:`~lw_torchrl.ScriptedSkillActor` runs; steps
            whose skill is near none are left out. None if no step is left.
        reason: why there is no plan; "" if there is one.
        notes: what was left out and what was changed, each with its line, in the order of the lines.
        steps: the clauses for the task, those that were dropped included.
    """

    plan: ConditionalPlan | None
    scripted: ConditionalPlan | None
    reason: str
    notes: tuple[Note, ...]
    steps: tuple[DecodedStep, ...]

    @property
    def all_scripted(self) -> bool:
        """Whether there is a plan, and every step of it has a scripted skill."""
        return self.plan is not None and self.scripted is not None and len(self.scripted.steps) == len(self.plan.steps)
