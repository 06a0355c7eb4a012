"""How a query evaluator answers: how often it is right, whether its doubts are true, where it left its words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath, write_json
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.clause_evaluator import ClauseEvaluator
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.training.labelled_queries import Asked, LabelledQueries
from lw_torchrl.transforms.qaf import plan_program

BINS = 15
PARTS = {
    "states": "trained queries, held-out states",
    "queries": "held-out queries, held-out states",
    "tasks": "held-out tasks",
}
_ROWS = 256


@dataclass(frozen=True)
class PartScore:
    """How an evaluator answers one part of :class:`LabelledQueries`: by predicate, how often it was ``right`` and
    ``asked`` where the predicate does not hold, and where it holds; a negation counts with what it negates. The
    ``reliability``, (15, 3) float64, is of the answers by their probability that the predicate holds, in bins of equal
    width: how many there are, the sum of their probabilities, and how often the predicate holds."""

    right: dict[str, tuple[int, int]]
    asked: dict[str, tuple[int, int]]
    reliability: Tensor

    @property
    def answers(self) -> int:
        """How many answers there are."""
        return sum(map(sum, self.asked.values()))

    def accuracy(self, predicate: str | None = None) -> float:
        """The share of right answers, to one predicate or to all."""
        names = self.asked if predicate is None else [predicate]
        return sum(sum(self.right[name]) for name in names) / sum(sum(self.asked[name]) for name in names)

    def balanced_accuracy(self, predicate: str | None = None) -> float:
        """The mean of the shares of right answers where the predicate holds and where it does not; of a truth that
        never comes there is none."""
        names = self.asked if predicate is None else [predicate]
        pairs = [[sum(table[name][truth] for name in names) for table in (self.right, self.asked)] for truth in (0, 1)]
        shares = [right / asked for right, asked in pairs if asked]
        return sum(shares) / len(shares)

    @property
    def calibration_error(self) -> float:
        """The expected calibration error: how far the probabilities are from the shares, on average."""
        number, told, true = self.reliability.unbind(-1)
        return ((told - true).abs().sum() / number.sum()).item()

    @property
    def worst(self) -> list[str]:
        """The predicates, the one of the least balanced accuracy first."""
        return sorted(self.asked, key=lambda name: (self.balanced_accuracy(name), name))

    def to_json(self) -> dict[str, Any]:
        """The numbers, and those they are made of."""
        return {
            "answers": self.answers,
            "accuracy": self.accuracy(),
            "balanced_accuracy": self.balanced_accuracy(),
            "calibration_error": self.calibration_error,
            "predicates": {
                name: {
                    "accuracy": self.accuracy(name),
                    "balanced_accuracy": self.balanced_accuracy(name),
                    "false_and_true": list(self.asked[name]),
                    "right": list(self.right[name]),
                }
                for name in self.worst
            },
            "reliability": self.reliability.tolist(),
        }


@dataclass(frozen=True)
class EvaluatorReport:
    """How an evaluator answers what was held out: ``parts`` "states", "queries" and "tasks", as far as there are any;
    ``about`` says as JSON what was trained and held out."""

    parts: dict[str, PartScore]
    about: dict[str, Any]

    def table(self, most: int = 4) -> str:
        """The numbers as text, with so many of the worst predicates of each part."""
        lines = [f"{'':36}{'answers':>10}{'accuracy':>10}{'balanced':>10}{'calibration error':>19}"]
        for part, score in self.parts.items():
            both = f"{score.accuracy():10.4f}{score.balanced_accuracy():10.4f}"
            lines.append(f"{PARTS[part]:36}{score.answers:10}{both}{score.calibration_error:19.4f}")
            for name in score.worst[:most]:
                both = f"{score.accuracy(name):10.4f}{score.balanced_accuracy(name):10.4f}"
                lines.append(f"  {name:34}{sum(score.asked[name]):10}{both}")
        return "\n".join(lines)

    def save(self, path: AnyPath) -> None:
        """Write it as JSON."""
        write_json(path, {"about": self.about, "parts": {name: one.to_json() for name, one in self.parts.items()}})


@checked
def score_evaluator(evaluator: ClauseEvaluator, data: LabelledQueries) -> EvaluatorReport:
    """Ask an evaluator, of whatever plans, what the data hold out; :class:`ValueError` if that is nothing.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("push", episodes_per_task=2, root=root + "/demos", max_steps=40)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", label="executed")
        ...     data = lw.training.LabelledQueries(replay, lw.training.QueryEvaluatorConfig())
        >>> untrained = lw.StateQueryEvaluator(lw.load_plans("MT10"))
        >>> list(score_evaluator(untrained, data).parts)
        ['states', 'queries']
    """
    parts = {part: _score(evaluator, data, part) for part in PARTS if data.parts[part]}
    if not parts:
        raise ValueError("data must hold out states, queries or tasks, for an evaluator to be asked")
    return EvaluatorReport(parts, data.describe())


@torch.no_grad()
def _score(evaluator: ClauseEvaluator, data: LabelledQueries, part: str) -> PartScore:
    right: dict[str, tuple[int, int]] = {}
    asked: dict[str, tuple[int, int]] = {}
    reliability = torch.zeros(BINS, 3, dtype=torch.float64)
    with evaluating(evaluator):
        for one in data.parts[part]:
            for logits, truth in clause_logits(evaluator, one):
                for table, counted in ((asked, torch.ones_like(truth)), (right, (logits > 0) == truth)):
                    numbers = zip((counted & ~truth).sum(0).tolist(), (counted & truth).sum(0).tolist(), strict=True)
                    for clause, (false, true) in zip(one.clauses, numbers, strict=True):
                        before = table.get(clause.predicate, (0, 0))
                        table[clause.predicate] = before[0] + false, before[1] + true
                told = logits.double().sigmoid().reshape(-1)
                place = (told * BINS).long().clamp(max=BINS - 1)
                entries = torch.stack((torch.ones_like(told), told, truth.reshape(-1).double()), -1)
                reliability.index_add_(0, place, entries)
    return PartScore(right, asked, reliability)


def clause_logits(evaluator: ClauseEvaluator, asked: Asked) -> list[tuple[Tensor, Tensor]]:
    """Logits (R, Q) that the predicates hold, and their truth."""
    coded = evaluator.code([(asked.task, clause) for clause in asked.clauses])
    every = [
        evaluator.network(rows, coded.pick(torch.arange(len(coded.predicate)).expand(len(rows), -1)))
        for rows in asked.seen(str(evaluator.in_keys[0])).split(_ROWS)
    ]
    return [(torch.cat(every), asked.truth)]


@dataclass(frozen=True)
class Drift:
    """What the condition of a step, counted from 0, has come to mean: of the ``states`` looked at, the share in which
    it holds by its words, ``exact``, and by the evaluator, ``believed``, and the ``agreement`` of both."""

    task: str
    step: int
    condition: str
    states: int
    exact: float
    believed: float
    agreement: float


@checked
def condition_drift(policy: Any, states: TensorDictBase) -> list[Drift]:
    """Compare the answers of a policy's evaluator with the query answering function's, the least agreement first.

    Args:
        policy: an evaluator, or a policy with one, else :class:`ValueError`.
        states: (R,) rows with ``observation`` (R, 39) float32, ``task_id`` (R,) int64 and what the evaluator reads, of
            a replay buffer, ``replay[:]``, or a rollout; conditions of other tasks are left out.

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
