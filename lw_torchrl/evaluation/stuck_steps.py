"""Where failed episodes got stuck: the steps of plans that are worth training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lw_torchrl._checks import check_choice, checked
from lw_torchrl.evaluation.plan_use import PlanUse


@dataclass(frozen=True)
class StuckStep:
    """A step of a plan, and how many failed episodes ended in it, or came no further.

    Attributes:
        task: the plan's.
        step: its number, counted from 0.
        condition, skill: its words.
        stuck: in how many failed episodes it was the one in charge in the last 50 steps.
        furthest: in how many failed episodes it was the last of the plan's steps that was in charge for a while.
        failed: episodes of the task that failed.
    """

    task: str
    step: int
    condition: str
    skill: str
    stuck: int
    furthest: int
    failed: int


@checked
def stuck_steps(use: PlanUse) -> list[StuckStep]:
    """Every step of the plans of the tasks that were seen, in their order.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> use = PlanUse(plans)
        >>> result = lw.evaluate(
        ...     lw.PlanConditionedActor(plans),
        ...     tasks="push",
        ...     episodes_per_task=2,
        ...     seed=1_000,
        ...     max_steps=60,
        ...     also_record=["qaf", "skill_weights"],
        ...     on_episode=use,
        ... )
        >>> [(step.skill, step.stuck) for step in stuck_steps(use)][0]
        ('place the gripper above the puck', 2)
    """
    return [
        StuckStep(
            task, number, str(step.condition), step.skill, found.stuck[number], found.furthest[number], found.failed
        )
        for task, found in use.tasks().items()
        for number, step in enumerate(use.plans[task].steps)
    ]


@checked
def weakest_step(use: PlanUse, task: str | None = None) -> StuckStep:
    """The step that most failed episodes came to and not beyond, the first of them if there are several.

    Not the step in which they ended: a puck that is dropped while it is carried lies there again, and the gripper ends
    above it, in the first step, which is sound. Plans are written in the order in which their steps come.

    Args:
        use: what evaluated episodes told.
        task: whose step; None for any.

    Raises:
        ValueError: a task that was not seen; no episode failed.
    """
    found = stuck_steps(use)
    if task is not None:
        check_choice("task", task, use.tasks())
        found = [step for step in found if step.task == task]
    weakest = max(found, key=lambda step: step.furthest, default=None)
    if weakest is None or not weakest.failed:
        raise ValueError("use must hold failed episodes for a step to be the weakest, none failed")
    return weakest


@checked
def stuck_table(steps: Sequence[StuckStep]) -> str:
    """A line for each step, counted from 1: how many failed episodes ended in it, and how many came no further.

    Example:
        >>> print(stuck_table([StuckStep("reach", 0, "the gripper is open", "close the gripper", 3, 5, 8)]))
        task   step  ended here  no further  skill              while
        reach     1      3 of 8      5 of 8  close the gripper  the gripper is open
    """
    rows = [("task", "step", "ended here", "no further", "skill", "while")]
    for s in steps:
        ended, reached = (f"{count} of {s.failed}" for count in (s.stuck, s.furthest))
        rows.append((s.task, str(s.step + 1), ended, reached, s.skill, s.condition))
    task, skill = (max(len(row[column]) for row in rows) for column in (0, 4))
    return "\n".join(
        f"{row[0]:{task}}  {row[1]:>4}  {row[2]:>10}  {row[3]:>10}  {row[4]:{skill}}  {row[5]}" for row in rows
    )
