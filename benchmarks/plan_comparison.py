"""python -m benchmarks.plan_comparison DIR: compare language models by the success of their plans.

Every answer is decoded, and scripted skills execute all plans in one simulation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from time import monotonic
from typing import Any, Literal

import torch
import tyro

from benchmarks.figures import markdown_table, plot_sorted_tasks
from benchmarks.many_plans import evaluate_plans
from benchmarks.paper.published import published_plans
from benchmarks.statistics import mean_rate
from lw_torchrl._util.files import read_json, write_json, write_text
from lw_torchrl._util.progress import Progress
from lw_torchrl._util.reproducibility import differences
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plan_decoding import decode_plan
from lw_torchrl.language.plan_files import save_plans
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.planners.answer_files import answer_text, recorded_answers

_SAVE_SECONDS = 5.0
Group = tuple[str, str]  # model, format


@dataclass(frozen=True)
class ComparedAnswer:
    """A decoded answer and the success of its plan."""

    model: str
    format: str
    task: str
    attempt: int
    steps: int  # number of plan steps that scripted skills can execute
    dropped: int  # number of clauses for the task that were left out
    reason: str  # why the text has no plan; "" if it has one
    success: tuple[bool, ...]  # whether each episode succeeded; all False without a plan
    plan: ConditionalPlan | None = field(default=None, repr=False)  # the executed plan

    @property
    def rate(self) -> float:
        """The fraction of the episodes that succeeded."""
        return sum(self.success) / len(self.success)


class PlanComparison:
    """Answers of models, sorted by model, format, task and attempt, with the settings of the episodes."""

    def __init__(self, answers: Sequence[ComparedAnswer], settings: Mapping[str, Any]) -> None:
        self.answers = tuple(sorted(answers, key=lambda one: (one.model, one.format, one.task, one.attempt)))
        self.settings = dict(settings)
        self._found: dict[Group, dict[str, list[ComparedAnswer]]] = {}
        for one in self.answers:
            self._found.setdefault((one.model, one.format), {}).setdefault(one.task, []).append(one)

    @property
    def groups(self) -> tuple[Group, ...]:
        """The distinct (model, format) pairs of the answers."""
        return tuple(self._found)

    @property
    def models(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(model for model, _ in self.groups))

    def rates(self, model: str, format: str) -> dict[str, list[float]]:
        """Return the success rates of a model's answers in a format, by task."""
        return {task: [one.rate for one in found] for task, found in self._found.get((model, format), {}).items()}

    def mean(self, model: str, format: str) -> float:
        """Return the mean success rate over tasks, where each task's rate is the mean over its answers."""
        return _mean([_mean(rates) for rates in self.rates(model, format).values()])

    def best_format(self, model: str) -> str:
        """Return the format in which the model has the highest mean success rate."""
        return max((format for name, format in self.groups if name == model), key=lambda one: self.mean(model, one))

    def best_of(self, model: str, format: str) -> float:
        """Return the mean success over tasks of the best answer of each task; NaN if there is only one episode.

        The answer is selected by the even episodes, and its success is measured in the odd episodes.
        """
        listed = self._found[model, format].values()
        chosen = [max(found, key=lambda one: _mean(one.success[::2])) for found in listed]
        return _mean([_mean(one.success[1::2]) for one in chosen])

    def best_plans(self, model: str, format: str) -> dict[str, ConditionalPlan]:
        """Return the plan of each task that succeeded most often; the first of several equal ones."""
        listed = self._found[model, format].values()
        best = [max(found, key=lambda one: (one.plan is not None, one.rate)) for found in listed]
        return {one.task: one.plan for one in best if one.plan is not None}

    def table(self) -> str:
        """Return a Markdown table with a row for each model and format."""
        rows = []
        for model, format in self.groups:
            rates = self.rates(model, format)
            success = str(mean_rate([[_mean(one)] for one in rates.values()]))
            found = [one for one in self.answers if (one.model, one.format) == (model, format)]
            counts = map(str, (len(rates), len(found), sum(bool(one.steps) for one in found)))
            rows.append([model, format, *counts, success, f"{self.best_of(model, format):.3f}"])
        head = ["model", "format", "tasks", "answers", "with a plan that runs", "success"]
        head.append("best answer of a task")
        return markdown_table(head, rows)

    def task_table(self) -> str:
        """Return a Markdown table of mean success with a row for each task and a column for each model."""
        rows = []
        for task in sorted({one.task for one in self.answers}):
            cells = []
            for model in self.models:
                rates = [one.rate for one in self.answers if (one.model, one.task) == (model, task)]
                cells.append(f"{_mean(rates):.2f}" if rates else "")
            rows.append([task, *cells])
        return markdown_table(["task", *self.models], rows)

    def to_json(self) -> dict[str, Any]:
        """Return the settings and answers as JSON, with the success of each episode as 0 or 1."""
        names = [one.name for one in fields(ComparedAnswer) if one.name not in ("success", "plan")]
        rows = [{name: getattr(one, name) for name in names} | {"success": _bits(one.success)} for one in self.answers]
        return {"format_version": 1, "settings": self.settings, "answers": rows}


def compare_plans(
    source: Path,
    *,
    episodes: int = 20,
    seed: int = 1000,
    choose: Literal["random", "first"] = "random",
    noise_scale: float = 0.0,
    max_steps: int = 500,
    resume: Path | None = None,
    progress: bool = True,
) -> PlanComparison:
    """Decode recorded answers, and execute all plans with scripted skills in one simulation.

    Args:
        source: a folder or a .jsonl file, as for :class:`~lw_torchrl.planners.FilePlanner`.
        episodes, seed, choose, noise_scale, max_steps: as for :func:`~benchmarks.many_plans.evaluate_plans`.
        resume: a file for intermediate results, written every few seconds. Plans in this file are not executed again.
        progress: show progress bars.

    Source: paper section 'LLM Experiments'.
    """
    found = recorded_answers(source)
    settings = dict(episodes=episodes, seed=seed, choose=choose, noise_scale=noise_scale, max_steps=max_steps)
    successes = _read(resume, settings)
    listed = [(model, *place, text) for model, answers in found.items() for place, text in answers.items()]
    decoded = []
    with Progress("decoding", len(listed), "answer", show=progress) as bar:
        for _, format, task, _, text in listed:
            decoded.append(decode_plan(answer_text(text), task, format))
            bar.update(1)
    plans = {_key(one.scripted): one.scripted for one in decoded if one.scripted is not None}
    to_do = {key: plan for key, plan in plans.items() if key not in successes}
    if to_do:
        keys, saved = list(to_do), [monotonic()]

        def note(index: int, success: tuple[bool, ...]) -> None:
            successes[keys[index]] = success
            if resume is not None and monotonic() - saved[0] > _SAVE_SECONDS:
                _write(resume, settings, successes)
                saved[0] = monotonic()

        options: dict[str, Any] = {**settings, "progress": progress}
        evaluate_plans(list(to_do.values()), on_plan=note, **options)
        if resume is not None:
            _write(resume, settings, successes)
    answers = []
    for (model, format, task, attempt, _), one in zip(listed, decoded, strict=True):
        reason = one.reason or ("" if one.scripted is not None else "no step has a skill near a scripted one")
        steps = 0 if one.scripted is None else len(one.scripted.steps)
        success = (False,) * episodes if one.scripted is None else successes[_key(one.scripted)]
        dropped = len(one.steps) - steps
        said = (model, format, task, attempt, steps, dropped, reason, success)
        answers.append(ComparedAnswer(*said, one.scripted))
    return PlanComparison(answers, settings)


def _key(plan: ConditionalPlan) -> str:
    return f"{plan.task} {Plans([plan]).fingerprint}"


def _mean(numbers: Sequence[float]) -> float:
    return sum(numbers) / len(numbers) if numbers else float("nan")


def _read(file: Path | None, settings: Mapping[str, Any]) -> dict[str, tuple[bool, ...]]:
    if file is None or not file.exists():
        return {}
    kept = read_json(file, "resume: the intermediate results")
    if kept["settings"] != settings:
        differ = ", ".join(differences(kept["settings"], settings))
        raise ValueError(f"resume: {str(file)!r} has other settings: {differ}; choose another folder, or delete it")
    return {key: tuple(bit == "1" for bit in bits) for key, bits in kept["success"].items()}


def _write(file: Path, settings: Mapping[str, Any], successes: Mapping[str, Sequence[bool]]) -> None:
    bits = {key: _bits(success) for key, success in successes.items()}
    write_json(file, {"settings": dict(settings), "success": bits})


def _bits(success: Sequence[bool]) -> str:
    return "".join(map(str, map(int, success)))


def write_report(comparison: PlanComparison, folder: Path) -> list[Path]:
    """Write a report to a folder, and return the paths of the files.

    The files are results.json, summary.md, models.png (each model in its best format), formats.png (all formats of the
    best model), and the best plan of each task, best/<model>/<format>/<task>.plan. A figure omits tasks that one of its
    curves lacks.

    Source: the paper's figures of section 'LLM Experiments'.
    """
    best = {model: comparison.best_format(model) for model in comparison.models}
    first = max(best, key=lambda model: comparison.mean(model, best[model]))
    formats = [group for group in comparison.groups if group[0] == first]
    settings = ", ".join(f"{name} {value}" for name, value in comparison.settings.items())
    words = f"""# Plans of {", ".join(comparison.models)}, by scripted skills

{comparison.table()}

Success is the mean over tasks, each over its answers; an answer without a plan that runs fails. Brackets
are 95 % intervals over tasks. The best answer of a task is chosen by the even episodes, and counted in the odd ones.

{comparison.task_table()}

{settings}
"""
    written = [folder / name for name in ("results.json", "summary.md", "models.png", "formats.png")]
    write_json(written[0], comparison.to_json())
    write_text(written[1], words)
    title = "each model in its best format"
    _draw(comparison, list(best.items()), written[2], title, lambda model, format: f"{model}, {format}")
    _draw(comparison, formats, written[3], f"formats of {first}", lambda _, format: format)
    _write_best(comparison, folder / "best")
    return [*(file for file in written if file.is_file()), folder / "best"]


def no_plans(comparison: PlanComparison, most: int = 3) -> list[str]:
    """Return lines with the number of answers that have no plan, and the most frequent reasons."""
    reasons = [one.reason.replace(f" for {one.task}", " for the task") for one in comparison.answers if one.reason]
    if not reasons:
        return []
    return [
        f"answers without a plan: {len(reasons)}",
        *(f"{times}: {why}" for why, times in Counter(reasons).most_common(most)),
    ]


def _write_best(comparison: PlanComparison, folder: Path) -> None:
    """Write the best plans, and delete .plan files of an earlier report."""
    for format in PLAN_FORMATS:
        for path in folder.glob(f"*/{format}/*.plan"):
            path.unlink()
    for model, format in comparison.groups:
        if plans := comparison.best_plans(model, format):
            save_plans(plans, folder / model / format)


def _draw(
    comparison: PlanComparison, groups: Sequence[Group], file: Path, title: str, label: Callable[[str, str], str]
) -> None:
    rates = {label(*group): comparison.rates(*group) for group in groups}
    common = set.intersection(*(set(found) for found in rates.values()))
    if not common:
        file.unlink(missing_ok=True)
        return
    least = min(len(found[task]) for found in rates.values() for task in common)
    even = {name: {task: found[task][:least] for task in sorted(common)} for name, found in rates.items()}
    published = {}
    for model, format in groups:
        with suppress(KeyError):  # the paper has no results for this model
            means = {task: sum(one) / len(one) for task, one in published_plans(model, format).items()}
            if common <= set(means):
                published[f"{model}, {format}, published"] = {task: means[task] for task in common}
    plot_sorted_tasks(even, file, published=published, order="own", of="answer", title=title)


@dataclass(frozen=True)
class Arguments:
    """Compare models by the success of their plans. If the command is stopped, run it again to resume.

    Writes results.json, summary.md, models.png and formats.png, and the most successful plan of each task to
    best/MODEL/FORMAT, which other commands accept as --plans.
    """

    source: tyro.conf.Positional[Path]
    """Folder with files MODEL/FORMAT/TASK-ATTEMPT.EXT, as written by `lw-torchrl plan generate`, or a .jsonl file of
    answers."""
    episodes: int = 20
    """Number of episodes per plan; all plans of a task get the same initial states."""
    seed: int = 1000
    """Random seed of initial states, goals and the choice among true steps."""
    choose: Literal["random", "first"] = "random"
    """Step that acts if several are true: a random one, as in the paper, or the first."""
    noise: float = 0.0
    """Standard deviation of the noise on the executed action."""
    max_steps: int = 500
    """Number of steps per episode."""
    out: Path = Path("runs/compare")
    """Folder for the results."""


def main(args: Arguments) -> None:
    settings: dict[str, Any] = {"episodes": args.episodes, "seed": args.seed, "choose": args.choose}
    settings |= {"noise_scale": args.noise, "max_steps": args.max_steps}
    comparison = compare_plans(args.source, resume=args.out / "success.json", **settings)
    print(f"{comparison.table()}\n\n{comparison.task_table()}\n")
    print("\n".join(no_plans(comparison)))
    for path in write_report(comparison, args.out):
        print(f"written to {path}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
