"""``lw-torchrl online``: RL from demonstrations, run by run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from lw_torchrl.cli.sources import check_saved, make_logger, one_or_many, read_plans, simulated
from lw_torchrl.cli.tables import Output
from lw_torchrl.cli.units import check_asked, elsewhere, report

if TYPE_CHECKING:
    from lw_torchrl.evaluation import EvaluationResult
    from lw_torchrl.language.plans import Plans
    from lw_torchrl.paper.online import OnlineRun

OnlineMethod = Literal["advantage", "td3", "sac", "residual", "ppo", "expert-iteration", "start"]
LoggerName = Literal["none", "csv", "tensorboard", "wandb"]


WEAKEST = "weakest"


def online(
    tasks: Positional[tuple[str, ...]],
    /,
    methods: tuple[OnlineMethod, ...] = ("td3", "expert-iteration"),
    seeds: tuple[int, ...] = (0, 1, 2),
    frames: int = 60_000,
    demonstrations: int = 1,
    start: Path | None = None,
    condition: Literal["pcbc", "dc", "one-hot"] = "pcbc",
    plans: tuple[str, ...] = ("MT50",),
    episodes: int = 40,
    step: str | None = None,
    launcher: Literal["local", "ray"] = "local",
    jobs: int = 1,
    logger: LoggerName = "none",
    run: str | None = None,
    list: bool = False,
    out: Path = Path("runs/online"),
    json: bool = False,
) -> Output:
    """Train policies in their environment, beside demonstrations. Stopped and started again it carries on.

    A run is a policy of one task, method and seed with its evaluation; the policy that it begins with is a run too.
    Each can be run by a command of its own, with --run, by any scheduler; starts first. The summary is written when
    the command is run without it.

    Example: lw-torchrl online peg-insert-side hammer --methods td3 expert-iteration --seeds 0 1 2

    Args:
        tasks: to train a policy for, each: names, MT10 or MT50.
        methods: td3, sac and residual (a small network that corrects the start), half of each minibatch demonstrations;
            ppo; expert-iteration, behavioral cloning of demonstrations and of own successes. The first is compared with
            the others, and with the start.
        seeds: of demonstrations, weights, episodes and minibatches.
        frames: steps of the environment, the same for every method.
        demonstrations: clean ones of each task.
        start: a policy to begin with, as train writes it; by default one is cloned from the demonstrations.
        condition: what that one is conditioned on: plans, the task's description, its number.
        plans: of the tasks: MT10, MT50, files or folders; where several have a plan for a task, the last one's counts.
        episodes: evaluated, on seeds that no training used, action noise 0.1.
        step: of residual, correct the actions in this step of the task's plan alone, by 1 at most, and leave all others
            as they are: its number, from 1, or weakest, the one that failed episodes came to and not beyond.
        launcher: local, on this machine; ray, on a Ray cluster, or on all cores of this machine.
        jobs: runs run at a time by the launcher local.
        logger: also log success and losses, to a folder logs beside each policy.
        run: run this one alone, such as pcbc/hammer/td3/seed0.
        list: print the names of the runs and do nothing.
        out: where everything goes; on a cluster, a folder that all its machines share.
        json: print one JSON document instead, see docs/cli.md.
    """
    check_asked(list, run, out, jobs)
    from lw_torchrl._checks import check_choice, counted
    from lw_torchrl.language.tasks import TASKS

    if start is not None:
        check_saved("start", start)
    tuned = None if step is None else _read_step(step)
    if tuned is not None and "residual" not in methods:
        raise ValueError(f"--step is of the method residual, --methods are {', '.join(methods)}")
    chosen = simulated("tasks", one_or_many(tasks), TASKS)
    found = read_plans(plans, TASKS)
    found.require(chosen)
    if isinstance(tuned, int) and start is None:
        for task in chosen:
            if tuned >= (there := len(found[task].steps)):
                raise ValueError(f"--step: the plan of {task!r} has {counted(there, 'step')}, got {step}")
    from lw_torchrl.cli.threads import use_one_thread
    from lw_torchrl.paper.online import START, OnlineRecipe, OnlineRun

    recipe = OnlineRecipe(demonstrations=demonstrations)
    recipe = replace(recipe, config=replace(recipe.config, frames=frames))
    whole = replace(recipe, config=replace(recipe.config, residual_scale=1.0))  # of a step: to any action at all
    runs = [
        OnlineRun(task, method, seed, recipe, condition, start, episodes)
        if tuned is None or method != "residual"
        else OnlineRun(task, method, seed, whole, condition, start, episodes, step=tuned)
        for stage in ((START,), tuple(method for method in dict.fromkeys(methods) if method != START))
        for seed in seeds
        for task in chosen
        for method in stage
    ]
    named = {str(one.folder): one for one in runs}
    output = Output(json)
    if list:
        output.show("runs", [*named], "\n".join(named))
        return output
    use_one_thread()
    if run is not None:
        result, said = _done(named[check_choice("run", run, named)], found, out, logger)
        print(said)
        output.show("run", run)
        if json:
            output.result(result)
    else:
        if launcher == "local" and jobs == 1:
            report(len(runs), (_done(one, found, out, logger)[1] for one in runs))
        else:
            given = [
                "online",
                *tasks,
                "--frames",
                str(frames),
                "--demonstrations",
                str(demonstrations),
                "--out",
                str(out),
            ]
            given += ["--seeds", *map(str, seeds), "--methods", *methods, "--plans", *plans]
            given += ["--condition", condition, "--episodes", str(episodes), "--logger", logger]
            given += [] if start is None else ["--start", str(start)]
            given += [] if step is None else ["--step", step]
            for first in (True, False):
                stage = [name for name, one in named.items() if (one.method == START) == first]
                report(len(stage), elsewhere(stage, given, launcher, jobs))
        output.show("summaries", {runs[0].group: _summarize(runs, found, out)})
    return output


def _done(one: OnlineRun, plans: Plans, out: Path, logger: LoggerName) -> tuple[EvaluationResult, str]:
    """Do a run; its result, and how it went in words."""
    from lw_torchrl.paper.online import execute_online

    make = None if logger == "none" else lambda file: make_logger(logger, file)
    result = execute_online(one, plans, out, make_logger=make)
    said = f"{one.folder}: success {result.mean_success:.3f}, {result.config['seconds']:.0f} s"
    return result, said if one.step is None else f"{said}\n{_told_of_step(result.config)}"


def _read_step(given: str) -> int | str:
    """A step's number, counted from 0, or the word for the weakest."""
    from lw_torchrl._checks import shown

    if given == WEAKEST:
        return given
    if not given.isascii() or not given.isdigit() or not 1 <= len(given) <= 4 or int(given) < 1:
        raise ValueError(f"--step must be the number of a step, from 1, or {WEAKEST}, got {shown(given)}")
    return int(given) - 1


def _told_of_step(config: dict[str, Any]) -> str:
    """Where failed episodes got stuck, which step was tuned, and that nothing changed elsewhere."""
    from lw_torchrl.evaluation import StuckStep, stuck_table

    tuned, elsewhere = config["tuned"], config["elsewhere"]
    lines = [stuck_table([StuckStep(**step) for step in tuned["stuck"]])] if "stuck" in tuned else []
    lines.append(f"tuned: step {tuned['step'] + 1}, {tuned['skill']}; success before {config['before']:.3f}")
    lines.append(
        f"{elsewhere['outside']} of {elsewhere['states']} states are outside of it: in {elsewhere['changed']} of them "
        "the action has changed"
    )
    return "\n".join(lines)


def _summarize(runs: list[OnlineRun], plans: Plans, out: Path) -> dict[str, Any]:
    """A summary, tables and a figure, from the results on disk; returns what summary.json holds."""
    from lw_torchrl._files import write_json, write_text
    from lw_torchrl.evaluation import MethodComparison, plot_learning_curves, summarize
    from lw_torchrl.paper.execution import load_result
    from lw_torchrl.paper.online import START, joined

    found: dict[OnlineRun, EvaluationResult] = {}
    for one in runs:
        result = load_result(one, plans, out)
        assert result is not None
        found[one] = result
    tasks, seeds = (sorted({getattr(one, name) for one in runs}) for name in ("task", "seed"))
    methods = [method for method in dict.fromkeys(one.method for one in runs) if method != START]
    by_method = {
        method: {
            seed: joined(
                [result for one, result in found.items() if (one.method, one.seed) == (method, seed) and result]
            )
            for seed in seeds
        }
        for method in (*methods, START)
    }
    comparison = MethodComparison({method: summarize(results) for method, results in by_method.items()})
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
        for task in tasks
    }
    starts = {task: one.mean for task, one in comparison.summaries[START].per_task.items()}
    text = f"{comparison.per_task()}\n\n{comparison.headline()}\n"
    print(f"\n{folder}\n{text}")
    summary = comparison.to_json() | {"curves": curves}
    write_json(folder / "summary.json", summary)
    write_text(folder / "summary.md", text)
    plot_learning_curves(curves, folder / "curves.png", starts=starts)
    print(f"summary.md, summary.json and curves.png are in {folder}")
    return summary
