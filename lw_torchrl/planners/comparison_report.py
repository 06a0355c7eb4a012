"""What a comparison of models is shown as: the paper's two figures, and a page of tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from lw_torchrl._checks import counted
from lw_torchrl._files import write_json, write_text
from lw_torchrl.evaluation.figures import plot_sorted_tasks
from lw_torchrl.evaluation.published import published_plans
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plan_files import save_plans
from lw_torchrl.planners.comparing import Group, PlanComparison

_REASONS = 3  # the commonest are told of


def write_report(comparison: PlanComparison, folder: Path) -> list[Path]:
    """Write results.json, summary.md, models.png (each model in its best format) and formats.png (of the best model)
    to a folder, and the best plan of each task to best/<model>/<format>/<task>.plan; returns what was written.

    The figures leave out tasks that some of their curves lack.

    Source: the paper's figures of section 'LLM Experiments'.
    """
    best = {model: comparison.best_format(model) for model in comparison.models}
    first = max(best, key=lambda model: comparison.mean(model, best[model]))
    formats = [group for group in comparison.groups if group[0] == first]
    settings = ", ".join(f"{name} {value}" for name, value in comparison.settings.items())
    words = f"""# Plans of {", ".join(comparison.models)}, by scripted skills

{comparison.table()}

Success is the mean over tasks, each over its answers; an answer without a plan that runs fails. Brackets
are 95 % intervals over tasks. The most trusted answer of a task is chosen by its words and conditions, without trying
any; the best by the even episodes, and counted in the odd ones.

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


def no_plans(comparison: PlanComparison) -> list[str]:
    """Lines that say how many answers have no plan, and the commonest reasons."""
    reasons = [one.reason.replace(f" for {one.task}", " for the task") for one in comparison.answers if one.reason]
    if not reasons:
        return []
    head = f"{counted(len(reasons), 'answer')} {'has' if len(reasons) == 1 else 'have'} no plan:"
    return [head, *(f"{times}: {reason}" for reason, times in Counter(reasons).most_common(_REASONS))]


def _write_best(comparison: PlanComparison, folder: Path) -> None:
    """The best plans in place of those of an earlier report; files of other kinds stay."""
    written: list[Path] = []
    for model, format in comparison.groups:
        if plans := comparison.best_plans(model, format):
            written += save_plans(plans, folder / model / format)
    old = [path for format in PLAN_FORMATS for path in folder.glob(f"*/{format}/*.plan")]
    for path in set(old).difference(written):
        path.unlink()
        for empty in (path.parent, path.parent.parent):
            with suppress(OSError):  # it is not empty, or gone
                empty.rmdir()


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
        with suppress(ValueError):  # the paper has no such group
            means = {task: sum(one) / len(one) for task, one in published_plans(model, format).items()}
            if common <= set(means):
                published[f"{model}, {format}, published"] = {task: means[task] for task in common}
    plot_sorted_tasks(even, file, published=published, order="own", of="answer", title=title)
