"""Run the paper's experiments, or offline RL on noisy data, and compare the methods.

A run is a dataset, or the policy of one method and seed with its evaluation. Any scheduler can execute single runs with
--run, datasets first. The command without --run then writes the summary.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, Suppress, subcommand

import lw_torchrl as lw
from benchmarks.figures import plot_sorted_tasks
from benchmarks.paper import offline, recipes, runs
from benchmarks.paper.comparison import compare, write_summary
from benchmarks.paper.imitation import SCRIPTED, ImitationRun
from benchmarks.paper.offline import OfflineRun
from benchmarks.paper.published import published_curves
from benchmarks.paper.schedule import Job, Schedule, execute
from lw_torchrl.evaluation import EvaluationResult
from lw_torchrl.language.formats import PLAN_FORMATS


@dataclass(frozen=True, kw_only=True)
class Imitation(Schedule):
    """Train and evaluate policies as in the paper, and compare them with the published results."""

    experiment: Suppress[str] = "few-shot"
    """The subcommand."""
    out: Path = Path("runs/reproduce")
    """Folder for all results. If the command is stopped, run it again to resume."""
    methods: tuple[str, ...] | None = None
    """Methods to train: pcbc, dc or one-hot (policies conditioned on plans, descriptions or task ids), or scripted
    (plans with scripted skills). By default all; with --plans, all except scripted."""
    preset: Literal["strong", "paper", "one-network", "evaluator", "no-roles"] = "strong"
    """Recipe: strong (ours) or paper (as published, which takes hours). For few-shot also evaluator (a network in the
    policy answers the conditions) and one-network (the policy few-shot-mt50); for zero-shot also no-roles."""
    passes: int | None = None
    """Number of passes over the rows with --preset paper (default: 500)."""
    plans: tuple[str, ...] = ()
    """Plans to use for all 50 tasks: MT50, .plan files, .json files of pairs, or folders. If several sources have a
    plan for a task, the last one is used."""
    device: str = "cpu"
    """Device of the networks: cpu, cuda, cuda:1, mps, or auto."""


@dataclass(frozen=True, kw_only=True)
class Offline(Schedule):
    """Learn policies offline from noisy scripted policies, and compare the methods.

    The data are mixtures of episodes of each task. B: 20 episodes that follow the plan in 30 % of segments, 20 in 60 %,
    20 that never follow the plan, and 10 with random actions. W: B without the 60 % episodes. C: 5 clean
    demonstrations, 20 episodes that never follow the plan, and 10 with random actions.
    """

    table: Positional[Literal["methods", "conditioning", "mt10", "quick", "all"]]
    """Experiment: methods (ten methods on five tasks), conditioning (policy and critic conditioned on plans,
    descriptions or task ids), mt10 (the best method on MT10), quick (two tasks, as a test), or all (all except quick).
    """
    out: Path = Path("runs/offline")
    """Folder for all results. If the command is stopped, run it again to resume."""
    mixtures: tuple[Literal["B", "W", "C"], ...] = ()
    """Mixtures to run; by default all mixtures of the table."""
    methods: tuple[str, ...] = ()
    """Methods to run; by default all methods of the table."""
    reward: Literal["sparse", "cost", "dense_cost"] | None = None
    """Reward for learning values, instead of the recipe's: sparse (success), cost (a cost per step), or dense_cost
    (Meta-World's dense reward minus its maximum)."""
    beta: float | None = None
    """Inverse temperature of the advantage weights, instead of the recipe's."""
    distance: Literal["l1", "l2"] | None = None
    """Distance between actions in imitation losses, instead of the recipe's."""
    steps: int | None = None
    """Number of minibatches for each network, instead of the recipe's."""


def _subcommand(name: str, description: str) -> Any:
    return Annotated[Imitation, subcommand(name, default=Imitation(experiment=name), description=description)]


Experiment = (
    _subcommand("zero-shot", "100 demonstrations of each MT10 task, one policy for MT50.")
    | _subcommand("few-shot", "10 demonstrations of each MT50 task, one policy for MT50.")
    | _subcommand("one-shot", "100 demonstrations of each MT10 task and 1 of the target, one policy per target.")
    | _subcommand("scripted", "Plans with scripted skills.")
    | _subcommand("all", "The four experiments above.")
    | Annotated[Offline, subcommand("offline")]
)


def main(arguments: Sequence[str] | None = None) -> None:
    given = sys.argv[1:] if arguments is None else list(arguments)
    chosen: Any = tyro.cli(Experiment, args=given, prog="python -m benchmarks.paper", description=__doc__)
    (run_offline if isinstance(chosen, Offline) else run_imitation)(chosen, given)


def run_imitation(chosen: Imitation, arguments: Sequence[str]) -> None:
    presets: Mapping[str, recipes.Preset] = recipes.PRESETS[chosen.preset]
    if chosen.passes is not None:
        if chosen.preset != "paper":
            raise ValueError(f"--passes requires --preset paper, got --preset {chosen.preset}")
        presets = {name: replace(preset, passes=chosen.passes) for name, preset in presets.items()}
    settings = {"all": [*recipes.SETTINGS], SCRIPTED: ["few-shot"]}.get(chosen.experiment, [chosen.experiment])
    if missing := [name for name in settings if name not in presets]:
        raise ValueError(f"--preset {chosen.preset} is only for {', '.join(presets)}, got {', '.join(missing)}")
    methods = chosen.methods or ("pcbc", "dc", "one-hot", *(() if chosen.plans else (SCRIPTED,)))
    if chosen.preset in ("evaluator", "no-roles"):
        methods = ("pcbc",)
    if chosen.experiment == SCRIPTED:
        methods = (SCRIPTED,)
    load = cache(lambda skills: load_plans(chosen.plans or ("MT50",), skills))
    plans_name = "+".join(map(_plans_name, chosen.plans))
    chosen_runs = [
        ImitationRun(recipes.SETTINGS[name], method, seed, presets[name], chosen.episodes, plans_name)
        for name in settings
        for method in methods
        for seed in chosen.seeds
    ]
    datasets: dict[str, Job] = {
        str(dataset.folder): partial(dataset.collect, chosen.out, progress=True)
        for run in chosen_runs
        for dataset in run.datasets
    }
    jobs: dict[str, Job] = {
        str(run.folder): partial(runs.execute_run, run, load(run.skills), chosen.out, device=chosen.device)
        for run in chosen_runs
    }
    execute(chosen, arguments, [datasets], jobs, lambda: summarize_imitation(chosen_runs, load, chosen.out))


def load_plans(sources: Sequence[str], skills: Literal["own", "MT10"]) -> lw.Plans:
    """Load plans for all 50 tasks; ``skills`` selects the shipped plans. The last plan of a task is used."""
    plans: dict[str, lw.ConditionalPlan] = {}
    for source in sources:
        plans |= lw.load_plans(source, skills=skills) if source in ("MT10", "MT50") else lw.load_plans(source)
    loaded = lw.Plans(plans)
    loaded.require(lw.MT50)
    return loaded


def _plans_name(source: str) -> str:
    """Return the name of a plan source for a run's folder: the file or folder name, or MODEL-FORMAT for answers."""
    path = Path(source)
    return f"{path.parent.name}-{path.name}" if path.name in PLAN_FORMATS and path.parent.name else path.stem


def summarize_imitation(chosen: Sequence[ImitationRun], load: Any, out: Path) -> None:
    """Write a summary, tables and a figure for each setting, from the results on disk."""
    groups: dict[Path, list[ImitationRun]] = {}
    only_scripted = all(run.method == SCRIPTED for run in chosen)
    for run in chosen:
        groups.setdefault(run.folder.parent if only_scripted else run.group, []).append(run)
    for group, members in groups.items():
        results: list[tuple[ImitationRun, EvaluationResult]] = []
        for run in members:
            if (result := runs.load_result(run, load(run.skills), out)) is not None:
                results.append((run, result))
        # For presets with several evaluations, the best rate of each task and seed.
        best: dict[str, dict[str, list[float]]] = {}
        for method in dict.fromkeys(run.method for run in members):
            rated = [r.config["best"] for run, r in results if run.method == method and "best" in r.config]
            if rated:
                label = f"{method}, best of the last {min(one['of'] for one in rated)} evaluations"
                best[label] = {task: [one["rates"][task] for one in rated] for task in rated[0]["rates"]}
        means = {label: {task: sum(of) / len(of) for task, of in rates.items()} for label, rates in best.items()}
        setting = members[-1].setting.name
        comparison = compare(results, means | ({} if only_scripted else published_curves(setting, "PCBC", "DC")))
        folder, curves = out / group, {} if only_scripted else published_curves(setting)
        print(f"\n{group}\n{comparison.headline()}")
        text = f"{comparison.headline()}\n\n{comparison.per_task()}\n"
        write_summary(folder / "summary", text, comparison.to_json())
        drawn: dict[str, Any] = comparison.summaries | best
        plot_sorted_tasks(drawn, folder / "tasks.png", published=curves, title=f"{group}, last checkpoint")
        print(f"\nsummary.md, summary.json and tasks.png are in {folder}")


def run_offline(chosen: Offline, arguments: Sequence[str]) -> None:
    changed = {"reward": chosen.reward, "beta": chosen.beta, "distance": chosen.distance}
    changed |= {"steps": chosen.steps, "value_steps": chosen.steps}
    recipe = replace(
        recipes.OfflineRecipe(),
        **{name: value for name, value in changed.items() if value is not None},  # type: ignore[arg-type]
    )
    names = [name for name in recipes.OFFLINE_TABLES if name != "quick"] if chosen.table == "all" else [chosen.table]
    tables: dict[str, list[OfflineRun]] = {}
    for name in names:
        for run in offline.offline_runs(recipes.OFFLINE_TABLES[name], chosen.seeds, recipe, chosen.episodes):
            if run.mixture in (chosen.mixtures or [run.mixture]) and run.method in (chosen.methods or [run.method]):
                tables.setdefault(name, []).append(run)
    if not tables:
        raise ValueError(f"--mixtures and --methods leave no run of the table {chosen.table}")
    plans, out = lw.load_plans("MT10"), chosen.out
    chosen_runs = [run for table in tables.values() for run in table]
    datasets: dict[str, Job] = {
        str(dataset.folder): partial(dataset.collect, out, progress=True)
        for run in chosen_runs
        for dataset in run.datasets
    }
    advantages: dict[str, Job] = {
        str(run.advantages.folder): partial(run.advantages.make, plans, out, progress=True)
        for run in chosen_runs
        if run.advantages is not None
    }
    jobs: dict[str, Job] = {str(run.folder): partial(runs.execute_run, run, plans, out) for run in chosen_runs}

    def summarize() -> None:
        for name, table in tables.items():
            results = {run: runs.execute_run(run, plans, out) for run in table}
            print(f"\n{name}\n{offline.write_table(name, table, results, out)}")
            print(f"\n{name}.md, {name}.json and {name}.png are in {out}")

    execute(chosen, arguments, [datasets, advantages], jobs, summarize)


if __name__ == "__main__":
    main()
