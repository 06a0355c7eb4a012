"""``lw-torchrl online``, RL from demonstrations, and ``offline``, what policies learn from spoilt data, run by run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

import lw_torchrl as lw
from lw_torchrl._checks import counted, shown
from lw_torchrl._files import read_json, shipped_policy
from lw_torchrl.cli import options
from lw_torchrl.cli.output import Output
from lw_torchrl.cli.runs import Job, Scheduled, command_line
from lw_torchrl.language.plans import Plans

if TYPE_CHECKING:
    from lw_torchrl.paper.online import OnlineRun

WEAKEST = "weakest"
ALGORITHMS = ("advantage", "td3", "sac", "residual", "ppo", "expert-iteration")
"""Our names of :data:`lw_torchrl.training.LEARNERS`."""


def online(
    tasks: Positional[tuple[str, ...]],  # each gets a policy of its own: names, MT10 or MT50
    /,
    schedule: Scheduled,  # which runs are done, and where
    methods: tuple[str, ...] = ("td3", "expert-iteration"),
    seeds: tuple[int, ...] = (0, 1, 2),  # of demonstrations, weights, episodes and minibatches
    frames: int | None = None,
    demonstrations: int = 1,  # of each task, without noise
    start: Path | None = None,  # a policy to begin with, of train; by default one is cloned from the demonstrations
    condition: options.Condition = "pcbc",
    plans: options.PlanSources = ("MT50",),
    task_file: options.TaskFile = None,
    episodes: int = 40,  # evaluated, on seeds that no training used, action noise 0.1
    step: str | None = None,
    logger: Literal["none", "csv", "tensorboard", "wandb", "rerun"] = "none",
    out: Path = Path("runs/online"),  # where everything goes; on a cluster, a folder that all its machines share
    json: options.Json = False,
) -> Output:
    """Train policies in their environment, beside demonstrations. If it is stopped, the same command resumes it.

    A run is a policy of one task, method and seed with its evaluation; the policy that it begins with is a run too.
    With --run any scheduler can do each by a command of its own; starts first. The summary is written when the command
    is run without it.

    Example: lw-torchrl online peg-insert-side hammer --methods td3 expert-iteration --seeds 0 1 2

    Args:
        methods: td3, sac and residual (a small network that corrects the start), half of each minibatch demonstrations;
            ppo; expert-iteration, behavioral cloning of demonstrations and of own successes; advantage, which learns
            online as offline; start, nothing; or yours, of lw.training.LEARNERS. The first is compared with the others,
            and with the start.
        frames: steps of the environment, the same for every method, of which start reads none; 60000 by default.
        step: of residual, correct the actions in this step of the task's plan alone, by 1 at most, and leave all others
            as they are: its number, from 1, or weakest, the one that failed episodes reached and did not pass. No other
            method reads it.
        logger: of success and losses, to logs/ beside each policy, of every method but start.
    """
    schedule.check(out)
    options.check_condition("condition", condition)
    for method in methods:
        known = (*ALGORITHMS, "start")
        options.check_listed("methods", method, known, "lw_torchrl.training:LEARNERS", ("algorithms",))
    logged = None if logger == "none" else logger
    for option, given in {"frames": frames, "logger": logged}.items():
        if given is not None and {*methods} == {"start"}:
            raise ValueError(f"--{option} is of the methods {', '.join(ALGORITHMS)}, --methods are start")
    if step is not None and "residual" not in methods:
        raise ValueError(f"--step is of the method residual, --methods are {', '.join(methods)}")
    if start is not None:
        options.check_saved("start", start)
        start = shipped_policy(start) or start
    tuned = None if step is None else _read_step(step)
    table = options.read_tasks(task_file, tasks)
    chosen = options.simulated("tasks", options.one_or_many(tasks), table)
    found = options.read_plans(plans, table)
    found.require(chosen)
    if isinstance(tuned, int) and start is None:
        for task in chosen:
            if tuned >= (there := len(found[task].steps)):
                raise ValueError(f"--step: the plan of {task!r} has {counted(there, 'step')}, got {step}")
    from lw_torchrl.paper.online import START, OnlineRecipe, OnlineRun
    from lw_torchrl.paper.runs import execute_run

    recipe = OnlineRecipe(demonstrations=demonstrations)
    if frames is not None:
        recipe = replace(recipe, config=replace(recipe.config, frames=frames))
    runs = [
        OnlineRun(task, method, seed, recipe, condition, start, episodes, tuned if method == "residual" else None)
        for stage in ((START,), tuple(method for method in dict.fromkeys(methods) if method != START))
        for seed in seeds
        for task in chosen
        for method in stage
    ]
    make = None if logger == "none" else partial(options.make_logger, logger)
    starts: dict[str, Job] = {}
    others: dict[str, Job] = {}
    for one in runs:
        stage = starts if one.method == START else others
        stage[str(one.folder)] = partial(execute_run, one, found, out, make_logger=make)
    typed: dict[str, Any] = {"demonstrations": demonstrations, "episodes": episodes, "frames": frames, "start": start}
    typed |= {"seeds": seeds, "methods": methods, "plans": plans, "condition": condition, "logger": logger}
    command = command_line("online", *tasks, step=step, task_file=task_file, out=out, **typed)
    summarize = partial(_summarize, runs, found, out)
    return schedule.execute(Output(json), [], [starts, others], command, summarize, _told_of_step)


def _read_step(given: str) -> int | str:
    """A step's number, counted from 0, or the word for the weakest."""
    if given == WEAKEST:
        return given
    if not given.isascii() or not given.isdigit() or not 1 <= len(given) <= 4 or int(given) < 1:
        raise ValueError(f"--step must be the number of a step, from 1, or {WEAKEST}, got {shown(given)}")
    return int(given) - 1


def _told_of_step(result: lw.EvaluationResult) -> str:
    """Of a run of one step: where failed episodes got stuck, which step was tuned, and what changed elsewhere."""
    config = result.config
    if "tuned" not in config:
        return ""
    tuned, elsewhere = config["tuned"], config["elsewhere"]
    stuck = [lw.evaluation.StuckStep(**step) for step in tuned.get("stuck", ())]
    lines = [lw.evaluation.stuck_table(stuck)] if stuck else []
    lines.append(f"tuned: step {tuned['step'] + 1}, {tuned['skill']}; success before {config['before']:.3f}")
    share = f"{elsewhere['outside']} of {elsewhere['states']} states are outside of it"
    return "\n".join([*lines, f"{share}: in {elsewhere['changed']} of them the action has changed"])


def _summarize(runs: Sequence[OnlineRun], plans: Plans, out: Path) -> dict[str, Any]:
    """A summary, tables and a figure, from the results on disk; returns what summary.json holds, by its group."""
    from lw_torchrl.paper.online import START
    from lw_torchrl.paper.runs import compare, load_result, write_summary

    found: dict[OnlineRun, lw.EvaluationResult] = {}
    for one in runs:
        result = load_result(one, plans, out)
        assert result is not None
        found[one] = result
    methods = [method for method in dict.fromkeys(one.method for one in runs) if method != START]
    order = [*methods, START]
    ordered = sorted(found.items(), key=lambda pair: (order.index(pair[0].method), pair[0].seed))
    comparison = compare(ordered)
    folder = out / runs[0].group
    curves = {
        task: {
            method: [
                [(round_["frames"], round_["success"]) for round_ in result.config["history"] if "success" in round_]
                for one, result in found.items()
                if (one.task, one.method) == (task, method)
            ]
            for method in methods
        }
        for task in sorted({one.task for one in runs})
    }
    starts = {task: one.mean for task, one in comparison.summaries[START].per_task.items()}
    text = f"{comparison.per_task()}\n\n{comparison.headline()}\n"
    print(f"\n{folder}\n{text}")
    summary = comparison.to_json() | {"curves": curves}
    write_summary(folder / "summary", text, summary)
    lw.evaluation.plot_learning_curves(curves, folder / "curves.png", starts=starts)
    print(f"summary.md, summary.json and curves.png are in {folder}")
    return {str(runs[0].group): summary}


Table = Literal["methods", "conditioning", "mt10", "quick", "all"]
Mixture = Literal["B", "W", "C"]
OfflineMethod = Literal[
    "advantage", "filtered-bc", "best-bc", "bc", "iql", "td3-bc", "cql", "iql-l1", "td3-bc-l1", "cql-l1"
]  # fmt: skip


def offline(
    table: Positional[Table],
    /,
    schedule: Scheduled,  # which runs are done, and where
    seeds: tuple[int, ...] = (0, 1, 2),  # of the data, the initial weights and the minibatches
    mixtures: tuple[Mixture, ...] = (),  # only these of the table's, B, W, C
    methods: tuple[OfflineMethod, ...] = (),  # only these of the table's
    plans: options.PlanSources = ("MT10",),
    reward: Literal["sparse", "cost", "dense_cost"] | None = None,
    beta: float | None = None,  # how sharply advantages weigh, instead of the recipe's
    distance: Literal["l1", "l2"] | None = None,  # between actions, in methods that imitate, instead of the recipe's
    steps: int | None = None,  # minibatches of each network, instead of the recipe's
    episodes: int = 20,  # evaluated for each task, on seeds that no data has, action noise 0.1
    out: Path = Path("runs/offline"),  # where everything goes; on a cluster, a folder that all its machines share
    json: options.Json = False,
) -> Output:
    """Learn policies offline, from scripts that were spoilt, and compare the methods.

    If it is stopped, the same command resumes it.

    The data are mixtures: B, of each task 20 episodes of plans carried out by scripts that are right in 30 of 100
    pieces, 20 in 60 of 100, 20 in none and 10 of chance; W, B without the second; C, 5 clean demonstrations, 20 in none
    and 10 of chance. A run is a dataset, the advantages of a mixture's rows, or a policy with its evaluation. With
    --run any scheduler can do each by a command of its own; datasets first, then advantages.

    Example: lw-torchrl offline methods --jobs 2

    Args:
        table: methods, ten of them on plans, in five tasks; conditioning, plans, descriptions or numbers of tasks,
            for the policy and for its critic; mt10, the best method in all of MT10; quick, two tasks, to try it; or all
            but the last.
        reward: what values are of, instead of the recipe's: sparse, the success; cost, of each step; dense_cost, what
            Meta-World's dense reward lacks.
    """
    schedule.check(out)
    known = options.read_plans(plans, options.read_tasks(None))
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

    typed: dict[str, Any] = {"reward": reward, "beta": beta, "distance": distance, "steps": steps, "mixtures": mixtures}
    typed |= {"methods": methods, "plans": plans, "seeds": seeds, "episodes": episodes, "out": out}
    command = command_line("offline", table, **typed)
    return schedule.execute(Output(json), [datasets, advantages], [jobs], command, summarize)
