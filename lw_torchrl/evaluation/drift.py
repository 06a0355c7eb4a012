"""condition_drift: where a policy's evaluator answers otherwise than the words of its conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase

from lw_torchrl._checks import checked
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.transforms.qaf import plan_program


@dataclass(frozen=True)
class Drift:
    """What a condition has come to mean.

    Attributes:
        task: its plan's.
        step: its number, from 0.
        condition: its words.
        states: how many were looked at.
        exact, believed: the share of them in which it holds by its words, and by the evaluator.
        agreement: the share in which both say the same.
    """

    task: str
    step: int
    condition: str
    states: int
    exact: float
    believed: float
    agreement: float


@checked
def condition_drift(policy: Any, states: TensorDictBase) -> list[Drift]:
    """Compare the answers of a policy's evaluator with the query answering function's.

    Args:
        policy: one with an evaluator, or an evaluator.
        states: (R,) rows with ``observation`` (R, 39) float32, ``task_id`` (R,) int64 and what the evaluator reads, of
            a replay buffer, ``replay[:]``, or a rollout.

    Returns:
        Each condition of the tasks that there are states of, those of the least agreement first.

    Raises:
        ValueError: the policy has no evaluator.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.Plans({"reach": lw.load_plans("MT10")["reach"]})
        >>> env = lw.LanguageWorldEnv("reach")
        >>> states = env.rollout(5).reshape(-1)
        >>> env.close()
        >>> len(condition_drift(lw.StateQueryEvaluator(plans), states))
        3
    """
    evaluator = policy if isinstance(policy, QueryEvaluator) else getattr(policy, "evaluator", None)
    if not isinstance(evaluator, QueryEvaluator):
        raise ValueError(f"policy must have an evaluator, {type(policy).__name__} has none")
    program, found = plan_program(evaluator.plans), []
    for task, plan in evaluator.plans.items():
        rows = states[states.get("task_id") == task_id(task)]
        if not len(rows):
            continue
        with torch.no_grad(), evaluating(evaluator):
            believed = evaluator.answers(*(rows.get(key) for key in evaluator.in_keys)) > 0
        exact = program(rows.get("observation"), rows.get("task_id"))
        shares = [part.double().mean(0).tolist() for part in (exact, believed, exact == believed)]
        for step, (one, *numbers) in enumerate(zip(plan.steps, *shares, strict=False)):
            found.append(Drift(task, step, str(one.condition), len(rows), *numbers))
    return sorted(found, key=lambda drift: (drift.agreement, drift.task, drift.step))


@checked
def drift_table(drifts: Sequence[Drift], most: int = 10) -> str:
    """The first so many as text."""
    lines = [f"{'agrees':>6} {'by its words':>12} {'believed':>8}  condition"]
    for one in drifts[:most]:
        where = f"{one.task}, step {one.step + 1}: {one.condition}"
        lines.append(f"{one.agreement:6.2f} {one.exact:12.2f} {one.believed:8.2f}  {where}")
    return "\n".join(lines)
