"""Score a learned query evaluator: measure how often the evaluator answers held-out conditions correctly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lw_torchrl._util.checks import typed
from lw_torchrl._util.files import AnyPath, write_json
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.query_evaluator import ClauseEvaluator
from lw_torchrl.training.labelled_queries import LabelledQueries, TaskQueries

PARTS = {
    "states": "trained queries, held-out states",
    "queries": "held-out queries, held-out states",
    "tasks": "held-out tasks",
}
_ROWS = 256


@dataclass(frozen=True)
class PartScore:
    """Correct and total answer counts per predicate on one held-out split of :class:`LabelledQueries`."""

    correct: dict[str, tuple[int, int]]  # number of correct answers where the clause is false, and where it is true
    total: dict[str, tuple[int, int]]  # number of all answers where the clause is false, and where it is true

    @property
    def answers(self) -> int:
        """The number of answers."""
        return sum(map(sum, self.total.values()))

    def accuracy(self, predicate: str | None = None) -> float:
        """Return the fraction of correct answers, for one predicate or for all predicates (None)."""
        names = self.total if predicate is None else [predicate]
        return sum(sum(self.correct[name]) for name in names) / sum(sum(self.total[name]) for name in names)

    def balanced_accuracy(self, predicate: str | None = None) -> float:
        """Return the mean of the accuracies on false and true clauses; a truth value without answers is left out."""
        names = self.total if predicate is None else [predicate]
        tables = self.correct, self.total
        counts = [[sum(table[name][truth] for name in names) for table in tables] for truth in (0, 1)]
        rates = [correct / total for correct, total in counts if total]
        return sum(rates) / len(rates)

    @property
    def worst(self) -> list[str]:
        """The predicates, sorted by balanced accuracy, lowest first."""
        return sorted(self.total, key=lambda name: (self.balanced_accuracy(name), name))

    def to_json(self) -> dict[str, Any]:
        """Return the accuracies and the numbers of answers as JSON."""
        predicates = {
            name: self._rates(name) | {"false_and_true": list(self.total[name]), "right": list(self.correct[name])}
            for name in self.worst
        }
        return {"answers": self.answers, **self._rates(), "predicates": predicates}

    def _rates(self, predicate: str | None = None) -> dict[str, Any]:
        return {"accuracy": self.accuracy(predicate), "balanced_accuracy": self.balanced_accuracy(predicate)}


@dataclass(frozen=True)
class EvaluatorScore:
    """The score of an evaluator on held-out data."""

    parts: dict[str, PartScore]  # scores of the held-out splits "states", "queries" and "tasks", without empty splits
    about: dict[str, Any]  # a JSON description of the data and the splits

    def table(self, most: int = 4) -> str:
        """Return a text table of the accuracies, with up to ``most`` of the worst predicates of each held-out split."""
        lines = [f"{'':36}{'answers':>10}{'accuracy':>10}{'balanced':>10}"]
        for part, score in self.parts.items():
            rows: list[tuple[str, int, str | None]] = [(PARTS[part], score.answers, None)]
            rows += [(f"  {name}", sum(score.total[name]), name) for name in score.worst[:most]]
            for title, answers, name in rows:
                rates = f"{score.accuracy(name):10.4f}{score.balanced_accuracy(name):10.4f}"
                lines.append(f"{title:36}{answers:10}{rates}")
        return "\n".join(lines)

    def save(self, path: AnyPath) -> None:
        """Write the score to a JSON file."""
        write_json(path, {"about": self.about, "parts": {name: part.to_json() for name, part in self.parts.items()}})


@typed
def score_evaluator(evaluator: ClauseEvaluator, data: LabelledQueries) -> EvaluatorScore:
    """Score an evaluator on the held-out splits of the data. The evaluator's plans do not affect the score.

    Raises:
        ValueError: no data are held out.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("push", episodes_per_task=2, root=root + "/demos", max_steps=40)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", label="executed")
        ...     data = lw.training.LabelledQueries(replay, lw.training.QueryEvaluatorConfig())
        >>> untrained = lw.modules.StateQueryEvaluator(lw.load_plans("MT10"))
        >>> list(score_evaluator(untrained, data).parts)
        ['states', 'queries']
    """
    parts = {part: _score(evaluator, data.parts[part]) for part in PARTS if data.parts[part]}
    if not parts:
        raise ValueError("data must hold out states, queries or tasks to score an evaluator on")
    return EvaluatorScore(parts, data.describe())


def _score(evaluator: ClauseEvaluator, part: list[TaskQueries]) -> PartScore:
    score = PartScore({}, {})
    with torch.no_grad(), evaluating(evaluator):
        for queries in part:
            logits, truth = clause_logits(evaluator, queries)
            for table, counted in ((score.total, torch.ones_like(truth)), (score.correct, (logits > 0) == truth)):
                numbers = torch.stack([counted & ~truth, counted & truth], dim=-1).sum(0).tolist()
                for clause, (false, true) in zip(queries.clauses, numbers, strict=True):
                    before = table.get(clause.predicate, (0, 0))
                    table[clause.predicate] = before[0] + false, before[1] + true
    return score


def clause_logits(evaluator: ClauseEvaluator, queries: TaskQueries) -> tuple[Tensor, Tensor]:
    """Return the evaluator's logits (R, Q) for Q clauses in R states, and the true answers (R, Q)."""
    coded = evaluator.code([(queries.task, clause) for clause in queries.clauses])
    chunks = [
        evaluator.network(rows, coded.pick(torch.arange(len(coded.predicate)).expand(len(rows), -1)))
        for rows in queries.view(str(evaluator.in_keys[0])).split(_ROWS)
    ]
    return torch.cat(chunks), queries.truth
