"""``lw-torchrl reproduce``: the paper's experiments, run by run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from tyro.conf import Positional

from lw_torchrl.cli.sources import check_encoder, read_encoder, read_plans, read_tasks
from lw_torchrl.cli.tables import Output
from lw_torchrl.cli.units import check_asked, elsewhere, report

if TYPE_CHECKING:
    from lw_torchrl.evaluation import EvaluationResult
    from lw_torchrl.language.plans import Plans
    from lw_torchrl.language.text import TextEncoder
    from lw_torchrl.paper.runs import Run

Experiment = Literal["zero-shot", "few-shot", "one-shot", "scripted", "all"]
Method = Literal["pcbc", "dc", "one-hot", "scripted"]


def reproduce(
    experiment: Positional[Experiment],
    /,
    seeds: tuple[int, ...] = (0, 1, 2),
    methods: tuple[Method, ...] | None = None,
    preset: Literal["strong", "paper", "evaluator"] = "strong",
    passes: int | None = None,
    plans: tuple[str, ...] = (),
    task_file: Path | None = None,
    text_encoder: str | None = None,
    episodes: int = 20,
    launcher: Literal["local", "ray"] = "local",
    jobs: int = 1,
    device: str = "cpu",
    run: str | None = None,
    list: bool = False,
    out: Path = Path("runs/reproduce"),
    json: bool = False,
) -> Output:
    """Run the paper's experiments and compare them with the published results. Stopped and started again it carries on.

    A run is a dataset, or the policy of one method and seed with its evaluation (in one-shot, a policy for each of the
    50 tasks). Each can be run by a command of its own, with --run, by any scheduler; datasets first. The summary is
    written when the command is run without it.

    Example: lw-torchrl reproduce few-shot --seeds 0 1 2 --methods pcbc dc

    Args:
        experiment: zero-shot, 100 demonstrations of each MT10 task; few-shot, 10 of each MT50 task; one-shot, 100 of
            each MT10 task and 1 of the target; scripted, plans with scripted skills; or all of them.
        seeds: of the demonstrations, the initial weights and the minibatches.
        methods: conditioned on plans, on the task's description, on the task's number; plans with scripted skills. By
            default all; with --plans, those that are trained.
        preset: ours; the published recipe, which takes hours; or, in few-shot, ours with conditions answered by a
            network that is trained inside the policy.
        passes: over the rows, fewer than the 500 of the preset paper.
        plans: of all 50 tasks, instead of ours: .plan files, .json files of pairs, folders, or MT50; where several have
            a plan for a task, the last one's counts.
        task_file: tasks of yours, whose objects and points the plans may name.
        text_encoder: a function of yours that turns texts into vectors, as my_texts:encode.
        episodes: evaluated for each task, on seeds that no training used, action noise 0.1.
        launcher: local, on this machine; ray, on a Ray cluster, or on all cores of this machine.
        jobs: runs run at a time by the launcher local.
        device: where the networks work: cpu; cuda, or cuda:1 for the second of several; mps, a Mac's; or auto, the GPU
            where there is one. It is no part of what a run is: one that was begun elsewhere is
            finished here.
        run: run this one alone, such as few-shot/strong/pcbc/seed0.
        list: print the names of the runs and do nothing.
        out: where everything goes; on a cluster, a folder that all its machines share.
        json: print one JSON document instead, see docs/cli.md.
    """
    check_asked(list, run, out, jobs)
    check_encoder(text_encoder)
    if launcher == "ray" and device != "cpu":
        raise ValueError(f"--device {device} is for the launcher local: the tasks of ray have a CPU core each")
    if passes is not None and preset != "paper":
        raise ValueError("--passes is for --preset paper; ours counts minibatches")
    load = _Plans(plans, task_file)
    if plans:
        load.of("own")
    from lw_torchrl._checks import check_choice
    from lw_torchrl._devices import check_device
    from lw_torchrl.cli.threads import use_one_thread
    from lw_torchrl.modules.policy import METHODS
    from lw_torchrl.paper.execution import execute_run
    from lw_torchrl.paper.recipes import PRESETS, SETTINGS
    from lw_torchrl.paper.runs import SCRIPTED, Run

    recipes = PRESETS[preset]
    if preset == "evaluator":
        if experiment not in recipes:
            raise ValueError(f"--preset evaluator is for {', '.join(recipes)}, got {experiment}")
        if methods not in (None, ("pcbc",)):
            raise ValueError("--methods must be pcbc with --preset evaluator: others ask no conditions")
        methods = ("pcbc",)
    if passes is not None:
        recipes = {name: replace(recipe, passes=passes) for name, recipe in recipes.items()}
    if methods is None:
        methods = cast("tuple[Method, ...]", (*METHODS, *([] if plans else [SCRIPTED])))
    if experiment == SCRIPTED:
        methods = (SCRIPTED,)  # type: ignore[assignment]
    assert methods is not None
    plans_name = "+".join(map(_plans_name, plans))
    runs = [
        Run(SETTINGS[name], method, seed, recipes[name], episodes, plans_name, text_encoder or "")
        for name in (["few-shot"] if experiment == "scripted" else SETTINGS)
        if experiment in (name, "scripted", "all")
        for method in methods
        for seed in seeds
    ]
    datasets = {str(dataset.folder): dataset for one in runs for dataset in one.datasets}
    named = {str(one.folder): one for one in runs}
    for one in runs:  # before any work
        load(one)
    output = Output(json)
    if list:
        output.show("runs", [*datasets, *named], "\n".join([*datasets, *named]))
        return output
    there, encoder = check_device("device", device), read_encoder(text_encoder)
    use_one_thread()
    if run is not None:
        output.show("run", run)
    if run in datasets:
        datasets[run].collect(out, progress=True)
    elif run is not None:
        one = named[check_choice("run", run, [*datasets, *named])]
        result = execute_run(one, load(one), out, text_encoder=encoder, device=there)
        print(f"{one.folder}: mean success {result.mean_success:.3f}, {result.config['seconds']:.0f} s")
        if json:
            output.result(result)
    else:
        if launcher == "local" and jobs == 1:
            report(len(named), _here(named, load, out, encoder, device))
        else:
            given = [experiment, "--preset", preset, "--episodes", str(episodes), "--out", str(out)]
            given += ["--seeds", *map(str, seeds), "--methods", *methods]
            given += ["--device", device] if device != "cpu" else []
            given += [] if passes is None else ["--passes", str(passes)]
            given += ["--plans", *plans] if plans else []
            given += [] if text_encoder is None else ["--text-encoder", text_encoder]
            given += [] if task_file is None else ["--task-file", str(task_file)]
            for stage in (datasets, named):
                report(len(stage), elsewhere(stage, ["reproduce", *given], launcher, jobs))
        output.show("summaries", _summarize(runs, load, out))
    return output


def _plans_name(source: str) -> str:
    """What plans are called in the folder of a run: their file or folder, of a folder named after a format the model
    too."""
    from lw_torchrl.language.formats import PLAN_FORMATS

    path = Path(source)
    return f"{path.parent.name}-{path.name}" if path.name in PLAN_FORMATS and path.parent.name else path.stem


class _Plans:
    """The plans that a run uses, each set read once; :class:`ValueError` where a task of the 50 has none."""

    def __init__(self, sources: Sequence[str], task_file: Path | None) -> None:
        self.sources, self.tasks = sources, read_tasks(task_file)
        self.known: dict[str, Plans] = {}

    def __call__(self, run: Run) -> Plans:
        return self.of(run.skills)

    def of(self, skills: Literal["own", "MT10"]) -> Plans:
        """Those with these skills, where they are shipped ones."""
        from lw_torchrl.language.tasks import MT50

        if skills not in self.known:
            found = read_plans(self.sources or ["MT50"], self.tasks, skills)
            if missing := [task for task in MT50 if task not in found]:
                raise ValueError(
                    f"--plans must have a plan for each of the 50 tasks, they lack {len(missing)}: "
                    f"{', '.join(missing[:5])}{', ...' if len(missing) > 5 else ''}; --plans MT50 "
                    f"{' '.join(self.sources)} takes ours for these"
                )
            self.known[skills] = found
        return self.known[skills]


def _here(
    named: dict[str, Run], load: Callable[[Run], Plans], out: Path, encoder: TextEncoder | None, device: str
) -> Iterator[str]:
    from lw_torchrl.paper.execution import execute_run

    for name, one in named.items():
        result = execute_run(one, load(one), out, text_encoder=encoder, device=device)
        yield f"{name}: mean success {result.mean_success:.3f}, {result.config['seconds']:.0f} s"


def _best(method: str, results: Mapping[int, EvaluationResult]) -> dict[str, dict[str, list[float]]]:
    """Task to the best rate of several evaluations, of each seed, where the method's preset has several."""
    found = [result.config["best"] for result in results.values() if "best" in result.config]
    if not found:
        return {}
    rates = {task: [one["rates"][task] for one in found] for task in found[0]["rates"]}
    return {f"{method}, best of the last {min(one['of'] for one in found)} evaluations": rates}


def _summarize(runs: list[Run], load: Callable[[Run], Plans], out: Path) -> dict[str, Any]:
    """A summary, tables and a figure for each setting, from the results on disk; returns what each summary.json
    holds."""
    from lw_torchrl._files import write_json, write_text
    from lw_torchrl.evaluation import MethodComparison, plot_sorted_tasks, published_curves, summarize
    from lw_torchrl.paper.execution import load_result

    found: dict[Path, dict[str, dict[int, EvaluationResult]]] = {}
    settings = {}
    for one in runs:
        alone = all(other.method == "scripted" for other in runs)
        group = one.folder.parent if alone else one.group
        result = load_result(one, load(one), out)
        assert result is not None
        found.setdefault(group, {}).setdefault(one.method, {})[one.seed] = result
        settings[group] = None if alone else one.setting
    told = {}
    for group, methods in found.items():
        setting = settings[group]
        best = {label: rates for method, results in methods.items() for label, rates in _best(method, results).items()}
        means = {label: {task: sum(of) / len(of) for task, of in rates.items()} for label, rates in best.items()}
        published = {} if setting is None else published_curves(setting.name, ("PCBC", "DC"))
        comparison = MethodComparison(
            {method: summarize(results) for method, results in methods.items()}, means | published
        )
        folder = out / group
        print(f"\n{group}\n{comparison.headline()}")
        told[group.as_posix()] = comparison.to_json()
        write_json(folder / "summary.json", told[group.as_posix()])
        write_text(folder / "summary.md", f"{comparison.headline()}\n\n{comparison.per_task()}\n")
        curves = {} if setting is None else published_curves(setting.name)
        drawn = comparison.summaries | best
        plot_sorted_tasks(drawn, folder / "tasks.png", published=curves, title=f"{group}, last checkpoint")
        print(f"\nsummary.md, summary.json and tasks.png are in {folder}")
    return told
