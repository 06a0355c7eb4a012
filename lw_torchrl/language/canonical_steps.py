"""For modules/plan_encoder.py and modules/relative_positions.py until they read roles: to be deleted with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from lw_torchrl.language.canonical import canonical_plan, explain_canonical
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.roles import VECTORS as VECTORS
from lw_torchrl.language.roles import role_vectors


@dataclass(frozen=True)
class CanonicalPlan:
    written: ConditionalPlan
    plan: ConditionalPlan

    @property
    def trust(self) -> Any:
        return self.plan.confidence

    @property
    def every_step(self) -> list[Any]:
        return [step.role for step in self.plan.steps]

    @property
    def steps(self) -> list[Any]:
        return [role for role in self.every_step if not role.fallback]

    @property
    def reserve(self) -> list[Any]:
        return [role for role in self.every_step if role.fallback]


def read_canonical(plan: ConditionalPlan) -> CanonicalPlan:
    return CanonicalPlan(plan, explain_canonical(plan).plan)


def with_reserve(plan: CanonicalPlan) -> CanonicalPlan:
    return replace(plan, plan=canonical_plan(plan.plan, fallback=True))


def step_vectors(plan: CanonicalPlan) -> list[list[float]]:
    return role_vectors(plan.every_step)
