"""PlanFocus: where the things are, one from the other, that the plan's conditions compare."""

from __future__ import annotations

from lw_torchrl.language.plan_tables import PlanTables
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.modules.plan_ways import Pair, PlanWays

_PAIRS = 2  # of a step: those of its first and of its last clause that compares two things


def _compared(plan: ConditionalPlan) -> list[list[Pair]]:
    of = plan.definition.object
    each = [[(of(c.subject), of(c.object)) for c in step.condition.clauses if c.object] for step in plan.steps]
    return [[found[0], found[-1]] if found else [] for found in each]


class PlanFocus(PlanWays):
    """From the subject to the object of the conditions' clauses, mixed by the attention over the steps.

    A step's condition names what its skill is about: "the gripper is above the handle and not near the handle". So the
    way from gripper to handle stands in the same place as that from gripper to puck in another task, and what was
    learned there is of use here. Of each step the first and the last clause with two things: 18 features, 0 for a step
    without such a clause.

    Args:
        plans: the plans.
        tables: theirs.
        noise: standard deviation of the noise on each feature while training.
    """

    def __init__(self, plans: Plans, tables: PlanTables, noise: float = 0.0) -> None:
        super().__init__(plans, tables, _compared, _PAIRS, noise)
