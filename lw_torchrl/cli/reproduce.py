"""``lw-torchrl reproduce``: the paper's experiments, run by run; and ``demo``, a small one in one go."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from lw_torchrl.cli import options
from lw_torchrl.cli.output import Output
from lw_torchrl.cli.runs import Job, Scheduled, command_line
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import MT50, Task

if TYPE_CHECKING:
    from lw_torchrl.paper.imitation import ImitationRun

Experiment = Literal["zero-shot", "few-shot", "one-shot", "scripted", "all"]
SCRIPTED = "scripted"


def demo(out: Path | None = None, quick: bool = False, json: options.Json = False) -> Output:
    """Train a plan-conditioned policy on MT10 and show it: demonstrations, training, evaluation, a recording.

    Takes some minutes on two cores. If it is stopped, the same command resumes it.

    Args:
        out: folder for results.json, success.png, rollout.rrd, checkpoint.zip and config.json; runs/demo, or
            runs/demo-quick with --quick.
        quick: two tasks and little training, in under a minute; not a measure of anything.
    """
    folder = options.check_folder("--out", out or Path("runs/demo-quick" if quick else "runs/demo"))
    from lw_torchrl.paper.demo import QUICK, DemoConfig, run_demo

    options.use_one_thread()
    result = run_demo(folder, QUICK if quick else DemoConfig())
    return Output(json).result(result) if json else Output(json)  # as text it has printed itself


def reproduce(
    experiment: Positional[Experiment],
    /,
    schedule: Scheduled,  # which runs are done, and where
    seeds: tuple[int, ...] = (0, 1, 2),  # of the demonstrations, the initial weights and the minibatches
    methods: tuple[str, ...] | None = None,
    preset: Literal["strong", "paper", "one-network", "evaluator", "no-roles"] = "strong",
    passes: int | None = None,  # over the rows, fewer than the 500 of the preset paper
    plans: tuple[str, ...] = (),
    task_file: options.TaskFile = None,
    text_encoder: options.EncoderName = None,
    episodes: int = 20,  # evaluated for each task, on seeds that no training used, action noise 0.1
    device: options.Device = "cpu",
    out: Path = Path("runs/reproduce"),  # where everything goes; on a cluster, a folder that all its machines share
    json: options.Json = False,
) -> Output:
    """Run the paper's experiments and compare them with the published results.

    If it is stopped, the same command resumes it, even on another device.

    A run is a dataset, or the policy of one method and seed with its evaluation (in one-shot, a policy for each of the
    50 tasks). With --run any scheduler can do each by a command of its own, datasets first. The summary is written when
    the command is run without it.

    Example: lw-torchrl reproduce few-shot --seeds 0 1 2 --methods pcbc dc

    Args:
        experiment: zero-shot, 100 demonstrations of each MT10 task; few-shot, 10 of each MT50 task; one-shot, 100 of
            each MT10 task and 1 of the target; scripted, plans with scripted skills; or all of them.
        methods: pcbc, dc, one-hot, conditioned on plans, on the task's description, on the task's number; scripted,
            plans with scripted skills; or yours, of lw.modules.METHODS, POLICIES or ENCODERS. By default all of ours;
            with --plans, those that are trained.
        preset: strong, ours; paper, the published recipe, which takes hours; evaluator, in few-shot, ours with
            conditions answered by a network that is trained inside the policy; one-network, in few-shot, the policy
            that lw.load_actor("few-shot-mt50") gives; or no-roles, in zero-shot.
        plans: of all 50 tasks, instead of ours: .plan files, .json files of pairs, folders, or MT50. If several have a
            plan for a task, the last one counts.
    """
    schedule.check(out)
    options.check_encoder(text_encoder)
    options.check_condition("methods", *(name for name in methods or () if name != SCRIPTED))
    if schedule.launcher == "ray" and device != "cpu":
        raise ValueError(f"--device {device} is for the launcher local: the tasks of ray have a CPU core each")
    if passes is not None and preset != "paper":
        raise ValueError("--passes is for --preset paper; ours counts minibatches")
    tasks = options.read_tasks(task_file)
    load = cache(lambda skills: _all_plans(plans or ("MT50",), tasks, skills))
    if plans:
        load("own")
    from lw_torchrl._devices import check_device
    from lw_torchrl.paper.imitation import ImitationRun
    from lw_torchrl.paper.recipes import PRESETS, SETTINGS
    from lw_torchrl.paper.runs import execute_run

    recipes = PRESETS[preset]
    if preset in ("one-network", "evaluator", "no-roles") and experiment not in recipes:
        raise ValueError(f"--preset {preset} is for {', '.join(recipes)}, got {experiment}")
    if preset in ("evaluator", "no-roles"):
        if methods not in (None, ("pcbc",)):
            raise ValueError(f"--methods must be pcbc with --preset {preset}: others have no plans")
        methods = ("pcbc",)
    if passes is not None:
        recipes = {name: replace(recipe, passes=passes) for name, recipe in recipes.items()}
    if methods is None:
        methods = (*options.CONDITIONS, *([] if plans else [SCRIPTED]))
    if experiment == SCRIPTED:
        methods = (SCRIPTED,)
    plans_name = "+".join(map(_plans_name, plans))
    runs = [
        ImitationRun(SETTINGS[name], method, seed, recipes[name], episodes, plans_name, text_encoder or "")
        for name in (["few-shot"] if experiment == "scripted" else SETTINGS)
        if experiment in (name, "scripted", "all")
        for method in methods
        for seed in seeds
    ]
    where: dict[str, Any] = {}
    if not schedule.list:
        where = {"device": check_device("device", device), "text_encoder": options.read_encoder(text_encoder)}
    datasets: dict[str, Job] = {
        str(dataset.folder): partial(dataset.collect, out, progress=True) for one in runs for dataset in one.datasets
    }
    jobs: dict[str, Job] = {str(one.folder): partial(execute_run, one, load(one.skills), out, **where) for one in runs}
    typed: dict[str, Any] = {"preset": preset, "episodes": episodes, "seeds": seeds, "methods": methods, "plans": plans}
    typed |= {"passes": passes, "text_encoder": text_encoder, "task_file": task_file, "device": device, "out": out}
    command = command_line("reproduce", experiment, **typed)
    return schedule.execute(Output(json), [datasets], [jobs], command, lambda: _summarize(runs, load, out))


def _plans_name(source: str) -> str:
    """What plans are called in a run's folder: their file or folder, and of a format's folder the model too."""
    path = Path(source)
    return f"{path.parent.name}-{path.name}" if path.name in PLAN_FORMATS and path.parent.name else path.stem


def _all_plans(sources: Sequence[str], tasks: Mapping[str, Task], skills: Literal["own", "MT10"]) -> Plans:
    """The plans of these sources, shipped ones with these skills; each of the 50 tasks must have one."""
    found = options.read_plans(sources, tasks, skills)
    if missing := [task for task in MT50 if task not in found]:
        lack = f"{len(missing)}: {', '.join(missing[:5])}{', ...' if len(missing) > 5 else ''}"
        mend = f"--plans MT50 {' '.join(sources)} takes ours for these"
        raise ValueError(f"--plans must have a plan for each of the 50 tasks, they lack {lack}; {mend}")
    return found


def _summarize(runs: Sequence[ImitationRun], load: Callable[[str], Plans], out: Path) -> dict[str, dict[str, Any]]:
    """A summary, tables and a figure for each setting, from the results on disk; returns what each summary.json has."""
    from lw_torchrl.evaluation import plot_sorted_tasks, published_curves
    from lw_torchrl.paper.runs import compare, load_result, write_summary

    groups: dict[Path, list[ImitationRun]] = {}
    alone = all(one.method == "scripted" for one in runs)
    for one in runs:
        groups.setdefault(one.folder.parent if alone else one.group, []).append(one)
    told = {}
    for group, chosen in groups.items():
        results = [(one, result) for one in chosen if (result := load_result(one, load(one.skills), out)) is not None]
        # Task to the best rate of several evaluations, of each seed, where the method's preset has several.
        best: dict[str, dict[str, list[float]]] = {}
        for method in dict.fromkeys(one.method for one in chosen):
            configs = [result.config for one, result in results if one.method == method]
            if rated := [config["best"] for config in configs if "best" in config]:
                label = f"{method}, best of the last {min(one['of'] for one in rated)} evaluations"
                best[label] = {task: [one["rates"][task] for one in rated] for task in rated[0]["rates"]}
        means = {label: {task: sum(of) / len(of) for task, of in rates.items()} for label, rates in best.items()}
        setting = chosen[-1].setting.name
        comparison = compare(results, means | ({} if alone else published_curves(setting, ("PCBC", "DC"))))
        folder, curves = out / group, {} if alone else published_curves(setting)
        print(f"\n{group}\n{comparison.headline()}")
        told[group.as_posix()] = found = comparison.to_json()
        write_summary(folder / "summary", f"{comparison.headline()}\n\n{comparison.per_task()}\n", found)
        drawn = comparison.summaries | best
        plot_sorted_tasks(drawn, folder / "tasks.png", published=curves, title=f"{group}, last checkpoint")
        print(f"\nsummary.md, summary.json and tasks.png are in {folder}")
    return told
