"""The tables of ``lw-torchrl offline``: which runs they compare, and what is written of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from lw_torchrl._files import write_json, write_text
from lw_torchrl.evaluation import EvaluationResult, MethodComparison, plot_methods, summarize
from lw_torchrl.evaluation.summary import markdown_table
from lw_torchrl.paper.mixtures import MIXTURES
from lw_torchrl.paper.offline_recipes import OFFLINE_METHODS, OfflineRecipe
from lw_torchrl.paper.offline_runs import Advantages, OfflineRun

_PLAN = "pcbc", "pcbc"
_SEEN = ("pcbc", "dc", "one-hot")
_BRACKETS = "Brackets are 95 % intervals, Student's t over seeds."


@dataclass(frozen=True)
class OfflineTable:
    """Runs that are compared.

    Attributes:
        tasks: a name of :data:`TASK_SETS`.
        rows: mixture to its rows, (method, actor, critic) each; the first is compared with each of the others.
    """

    tasks: str
    rows: Mapping[str, tuple[tuple[str, str, str], ...]]

    def runs(
        self, seeds: Iterable[int], recipe: OfflineRecipe, episodes: int, max_steps: int = 500
    ) -> list[OfflineRun]:
        """A run for each row and seed."""
        return [
            OfflineRun(self.tasks, mixture, seed, recipe, max_steps, *row, episodes)
            for mixture, rows in self.rows.items()
            for row in rows
            for seed in seeds
        ]


_METHODS = tuple((name, *_PLAN) for name in OFFLINE_METHODS)
_SHORT = tuple((name, *_PLAN) for name in ("advantage", "filtered-bc", "best-bc", "bc"))
_CONDITIONING = (
    *(("advantage", actor, critic) for actor in _SEEN for critic in _SEEN),
    *(("filtered-bc", actor, "pcbc") for actor in _SEEN),
)
OFFLINE_TABLES: Mapping[str, OfflineTable] = MappingProxyType(
    {
        "methods": OfflineTable("five", {"B": _METHODS, "W": _METHODS, "C": _SHORT}),
        "conditioning": OfflineTable("five", {"B": _CONDITIONING, "W": _CONDITIONING}),
        "mt10": OfflineTable("MT10", {"B": _SHORT[:2]}),
        "quick": OfflineTable("two", {"W": _SHORT[:2]}),
    }
)
"""By name: seven methods on plans; what actors and critics are conditioned on; all of MT10; two tasks, for a look."""


def advantages_of(runs: Iterable[OfflineRun]) -> dict[str, Advantages]:
    """The advantages that runs share, by their folder."""
    found = [run.advantages for run in runs]
    return {str(one.folder): one for one in found if one is not None}


def write_table(
    name: str, runs: Sequence[OfflineRun], results: Mapping[OfflineRun, EvaluationResult], out: Path
) -> str:
    """Write a table's Markdown, numbers and figure to ``out``; returns its head, to print."""
    mixtures = list(dict.fromkeys(run.mixture for run in runs))
    labels = list(dict.fromkeys(run.label for run in runs))
    compared: dict[str, MethodComparison] = {}
    for mixture in mixtures:
        found: dict[str, dict[int, EvaluationResult]] = {}
        for run in runs:
            if run.mixture == mixture:
                found.setdefault(run.label, {})[run.seed] = results[run]
        summaries = {label: summarize(each) for label, each in found.items()}
        compared[mixture] = MethodComparison(summaries)
    rows = [[label, *(_mean(compared[mixture], label) for mixture in mixtures)] for label in labels]
    head = markdown_table(["method, conditioned on", *mixtures], rows)
    parts = [f"# {name}: {runs[0].tasks} tasks, mean success", head, _BRACKETS]
    for mixture, one in compared.items():
        portions = ", ".join(f"{part.episodes} {part.behaviour}" for part in MIXTURES[mixture])
        parts += [f"## {mixture}: of each task {portions}", one.headline(), one.per_task()]
    write_text(out / f"{name}.md", "\n\n".join(parts) + "\n")
    told: dict[str, Any] = {mixture: one.to_json() for mixture, one in compared.items()}
    write_json(out / f"{name}.json", told)
    plot_methods({mixture: one.summaries for mixture, one in compared.items()}, out / f"{name}.png")
    return head


def _mean(compared: MethodComparison, label: str) -> str:
    return str(compared.summaries[label].mean) if label in compared.summaries else ""
