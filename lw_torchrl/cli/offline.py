"""``lw-torchrl offline``: what policies learn from spoilt data, run by run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from lw_torchrl.cli.sources import read_plans, read_tasks
from lw_torchrl.cli.tables import Output
from lw_torchrl.cli.units import check_asked, elsewhere, report

if TYPE_CHECKING:
    from lw_torchrl.evaluation import EvaluationResult
    from lw_torchrl.language.plans import Plans
    from lw_torchrl.paper.offline_runs import OfflineRun

Table = Literal["methods", "conditioning", "mt10", "quick", "all"]
Mixture = Literal["B", "W", "C"]
OfflineMethod = Literal["advantage", "filtered-bc", "best-bc", "bc", "iql", "td3-bc", "cql"]


def offline(
    table: Positional[Table],
    /,
    seeds: tuple[int, ...] = (0, 1, 2),
    mixtures: tuple[Mixture, ...] = (),
    methods: tuple[OfflineMethod, ...] = (),
    plans: tuple[str, ...] = ("MT10",),
    reward: Literal["sparse", "cost", "dense_cost"] | None = None,
    beta: float | None = None,
    distance: Literal["l1", "l2"] | None = None,
    steps: int | None = None,
    episodes: int = 20,
    launcher: Literal["local", "ray"] = "local",
    jobs: int = 1,
    run: str | None = None,
    list: bool = False,
    out: Path = Path("runs/offline"),
    json: bool = False,
) -> Output:
    """Learn policies offline, from scripts that were spoilt, and compare the methods. Stopped and started again it
    carries on.

    The data are mixtures: B, of each task 20 episodes of plans carried out by scripts that are right in 30 of 100
    pieces, 20 in 60 of 100, 20 in none and 10 of chance; W, B without the second; C, 5 clean demonstrations, 20 in none
    and 10 of chance. A run is a dataset, the advantages of a mixture's rows, or a policy with its evaluation. Each can
    be run by a command of its own, with --run, by any scheduler; datasets first, then advantages.

    Example: lw-torchrl offline methods --jobs 2

    Args:
        table: methods, seven of them on plans, in five tasks; conditioning, plans, descriptions or numbers of tasks,
            for the policy and for its critic; mt10, the best method in all of MT10; quick, two tasks, to see it run;
            or all but the last.
        seeds: of the data, the initial weights and the minibatches.
        mixtures: only these of the table's, B, W, C.
        methods: only these of the table's: advantage, filtered-bc, best-bc, bc, iql, td3-bc, cql.
        plans: MT10 or MT50 for ours, .plan files, .json files of pairs, or folders.
        reward: what values are of, instead of the recipe's: sparse, the success; cost, of each step; dense_cost, what
            Meta-World's dense reward lacks.
        beta: how sharply advantages weigh, instead of the recipe's.
        distance: between actions, in the methods that imitate, instead of the recipe's.
        steps: minibatches of each network, instead of the recipe's.
        episodes: evaluated for each task, on seeds that no data has, action noise 0.1.
        launcher: local, on this machine; ray, on a Ray cluster, or on all cores of this machine.
        jobs: runs run at a time by the launcher local.
        run: run this one alone, such as five/B/advantage-plan/seed0.
        list: print the names of the runs and do nothing.
        out: where everything goes; on a cluster, a folder that all its machines share.
        json: print one JSON document instead, see docs/cli.md.
    """
    check_asked(list, run, out, jobs)
    known = read_plans(plans, read_tasks(None))
    from lw_torchrl._checks import check_choice
    from lw_torchrl._files import read_json
    from lw_torchrl.cli.threads import use_one_thread
    from lw_torchrl.paper.mixtures import TASK_SETS
    from lw_torchrl.paper.offline_recipes import OfflineRecipe
    from lw_torchrl.paper.offline_tables import OFFLINE_TABLES, advantages_of, write_table
    from lw_torchrl.paper.offline_training import execute_offline, make_advantages

    changed = {"reward": reward, "beta": beta, "distance": distance, "steps": steps, "value_steps": steps}
    recipe = replace(OfflineRecipe(), **{name: value for name, value in changed.items() if value is not None})  # type: ignore[arg-type]
    tables = {
        name: [
            one
            for one in OFFLINE_TABLES[name].runs(seeds, recipe, episodes)
            if (not mixtures or one.mixture in mixtures) and (not methods or one.method in methods)
        ]
        for name in (OFFLINE_TABLES if table == "all" else [table])
        if table != "all" or name != "quick"
    }
    tables = {name: runs for name, runs in tables.items() if runs}
    if not tables:
        raise ValueError(f"--mixtures and --methods leave nothing of {table}")
    runs = {str(one.folder): one for chosen in tables.values() for one in chosen}
    datasets = {str(dataset.folder): dataset for one in runs.values() for dataset in one.datasets}
    advantages = advantages_of(runs.values())
    output = Output(json)
    if list:
        output.show("runs", [*datasets, *advantages, *runs], "\n".join([*datasets, *advantages, *runs]))
        return output
    for one in runs.values():
        known.require(TASK_SETS[one.tasks])
    use_one_thread()
    if run is not None:
        output.show("run", run)
    if run in datasets:
        datasets[run].make(out, progress=True)
    elif run in advantages:
        make_advantages(advantages[run], known, out, progress=True)
    elif run is not None:
        one = runs[check_choice("run", run, [*datasets, *advantages, *runs])]
        result = execute_offline(one, known, out)
        print(_said(run, result))
        if json:
            output.result(result)
    else:
        if launcher == "local" and jobs == 1:
            report(len(runs), _here(runs, known, out))
        else:
            given = ["offline", table, "--episodes", str(episodes), "--out", str(out), "--plans", *plans]
            given += ["--seeds", *map(str, seeds)]
            for name, value in (("--reward", reward), ("--beta", beta), ("--distance", distance), ("--steps", steps)):
                given += [] if value is None else [name, str(value)]
            for name, values in (("--mixtures", mixtures), ("--methods", methods)):
                given += [name, *values] if values else []
            for stage in (datasets, advantages, runs):
                report(len(stage), elsewhere(stage, given, launcher, jobs))
        summaries = {}
        for name, chosen in tables.items():
            results = {one: execute_offline(one, known, out) for one in chosen}
            print(f"\n{name}\n{write_table(name, chosen, results, out)}")
            print(f"\n{name}.md, {name}.json and {name}.png are in {out}")
            summaries[name] = read_json(out / f"{name}.json", "the summary")
        output.show("summaries", summaries)
    return output


def _said(name: str, result: EvaluationResult) -> str:
    return f"{name}: mean success {result.mean_success:.3f}, {result.config['seconds']:.0f} s"


def _here(runs: dict[str, OfflineRun], plans: Plans, out: Path) -> Iterator[str]:
    from lw_torchrl.paper.offline_training import execute_offline

    for name, one in runs.items():
        yield _said(name, execute_offline(one, plans, out))
