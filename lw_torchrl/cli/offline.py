"""``lw-torchrl offline``: what policies learn from spoilt data, run by run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from lw_torchrl._files import read_json
from lw_torchrl.cli.options import Json, PlanSources, read_plans, read_tasks
from lw_torchrl.cli.output import Output
from lw_torchrl.cli.runs import Job, Scheduled

Table = Literal["methods", "conditioning", "mt10", "quick", "all"]
Mixture = Literal["B", "W", "C"]
OfflineMethod = Literal["advantage", "filtered-bc", "best-bc", "bc", "iql", "td3-bc", "cql"]


def offline(
    table: Positional[Table],
    /,
    schedule: Scheduled,  # which runs are done, and where
    seeds: tuple[int, ...] = (0, 1, 2),  # of the data, the initial weights and the minibatches
    mixtures: tuple[Mixture, ...] = (),  # only these of the table's, B, W, C
    methods: tuple[OfflineMethod, ...] = (),  # only these of the table's
    plans: PlanSources = ("MT10",),
    reward: Literal["sparse", "cost", "dense_cost"] | None = None,
    beta: float | None = None,  # how sharply advantages weigh, instead of the recipe's
    distance: Literal["l1", "l2"] | None = None,  # between actions, in methods that imitate, instead of the recipe's
    steps: int | None = None,  # minibatches of each network, instead of the recipe's
    episodes: int = 20,  # evaluated for each task, on seeds that no data has, action noise 0.1
    out: Path = Path("runs/offline"),  # where everything goes; on a cluster, a folder that all its machines share
    json: Json = False,
) -> Output:
    """Learn policies offline, from scripts that were spoilt, and compare the methods.

    If it is stopped, the same command resumes it.

    The data are mixtures: B, of each task 20 episodes of plans carried out by scripts that are right in 30 of 100
    pieces, 20 in 60 of 100, 20 in none and 10 of chance; W, B without the second; C, 5 clean demonstrations, 20 in none
    and 10 of chance. A run is a dataset, the advantages of a mixture's rows, or a policy with its evaluation. With
    --run any scheduler can do each by a command of its own; datasets first, then advantages.

    Example: lw-torchrl offline methods --jobs 2

    Args:
        table: methods, seven of them on plans, in five tasks; conditioning, plans, descriptions or numbers of tasks,
            for the policy and for its critic; mt10, the best method in all of MT10; quick, two tasks, to try it; or all
            but the last.
        reward: what values are of, instead of the recipe's: sparse, the success; cost, of each step; dense_cost, what
            Meta-World's dense reward lacks.
    """
    schedule.check(out)
    known = read_plans(plans, read_tasks(None))
    from lw_torchrl.paper.offline import OfflineRun, offline_runs, write_table
    from lw_torchrl.paper.recipes import OFFLINE_TABLES, OfflineRecipe
    from lw_torchrl.paper.runs import execute_run

    changed = {"reward": reward, "beta": beta, "distance": distance, "steps": steps, "value_steps": steps}
    recipe = replace(OfflineRecipe(), **{name: value for name, value in changed.items() if value is not None})  # type: ignore[arg-type]
    tables: dict[str, list[OfflineRun]] = {}
    for name in [name for name in OFFLINE_TABLES if name != "quick"] if table == "all" else [table]:
        for one in offline_runs(OFFLINE_TABLES[name], seeds, recipe, episodes):
            if (not mixtures or one.mixture in mixtures) and (not methods or one.method in methods):
                tables.setdefault(name, []).append(one)
    if not tables:
        raise ValueError(f"--mixtures and --methods leave nothing of {table}")
    runs = [one for wanted in tables.values() for one in wanted]
    for one in () if schedule.list else runs:
        known.require(one.scope)
    datasets: dict[str, Job] = {
        str(dataset.folder): partial(dataset.collect, out, progress=True) for one in runs for dataset in one.datasets
    }
    advantages: dict[str, Job] = {
        str(own.folder): partial(own.make, known, out, progress=True)
        for one in runs
        if (own := one.advantages) is not None
    }
    jobs: dict[str, Job] = {str(one.folder): partial(execute_run, one, known, out) for one in runs}

    def summarize() -> dict[str, Any]:
        summaries = {}
        for name, wanted in tables.items():
            results = {one: execute_run(one, known, out) for one in wanted}
            print(f"\n{name}\n{write_table(name, wanted, results, out)}")
            print(f"\n{name}.md, {name}.json and {name}.png are in {out}")
            summaries[name] = read_json(out / f"{name}.json", "the summary")
        return summaries

    command: list[object] = ["offline", table, "--episodes", episodes, "--out", out]
    command += ["--plans", *plans, "--seeds", *seeds]
    for option, value in (("--reward", reward), ("--beta", beta), ("--distance", distance), ("--steps", steps)):
        command += [] if value is None else [option, value]
    for option, values in (("--mixtures", mixtures), ("--methods", methods)):
        command += [option, *values] if values else []
    return schedule.execute(Output(json), [datasets, advantages], [jobs], command, summarize)
