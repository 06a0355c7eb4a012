"""The paper's own numbers, per task: what our curves are drawn beside."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, Literal

from lw_torchrl._checks import check_choice, checked

#: What each choice of ``which`` is called in tables and legends; the best of ten is never the headline.
WHICH = {"last": "published, last", "best": "published, best of the last 10 evaluations"}


@cache
def _table(name: str = "published") -> dict[str, Any]:
    return json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text("utf-8"))


@checked
def published(setting: str, method: str = "PCBC", which: Literal["last", "best"] = "last") -> dict[str, float]:
    """Task, sorted by name, to its published success rate in [0, 1], a mean over 4 seeds of 20 episodes each.

    The rates of single seeds were not published. The published "last" and "best" of DC one-shot are the same numbers.

    Args:
        setting: "zero-shot", "few-shot" or "one-shot".
        method: "PCBC" or "DC" (descriptor conditioning).
        which: "last", the last evaluation of each run, to compare with; or "best", per task and seed the best of the
            last ten evaluations, which the paper's figures show.

    Example:
        >>> rates = published("few-shot")
        >>> len(rates), round(sum(rates.values()) / 50, 3), rates["coffee-pull"]
        (50, 0.393, 0.4875)

    Source: the authors' published result files; paper section 'Conditional Plan Experiments'.
    """
    rates = _table()["rates"]
    methods = rates[check_choice("setting", setting, rates)]
    choices = methods[check_choice("method", method, methods)]
    return dict(zip(_table()["tasks"], choices[check_choice("which", which, choices)], strict=True))


@checked
def published_curves(setting: str, methods: str | Iterable[str] = ("PCBC",)) -> dict[str, dict[str, float]]:
    """Both published curves of each method, label to (task to success rate): for :func:`plot_sorted_tasks` and
    :meth:`Summary.table`.

    Args:
        setting, methods: as for :func:`published`; a method, or several.

    Example:
        >>> list(published_curves("zero-shot"))
        ['PCBC published, best of the last 10 evaluations', 'PCBC published, last']
    """
    names = [methods] if isinstance(methods, str) else list(methods)
    return {
        f"{method} {label}": published(setting, method, which)  # type: ignore[arg-type]
        for method in names
        for which, label in reversed(WHICH.items())
    }


@checked
def published_plans(model: str = "PaLM 2", format: str = "chain_py") -> dict[str, tuple[float, ...]]:
    """Task, sorted by name, to the published success rates in [0, 1] of a model's 5 plans, run with scripted skills.

    Args:
        model: "PaLM 2", "GPT-3.5" or "GPT-3".
        format: of the plans, a name in :data:`~lw_torchrl.PLAN_FORMATS`.

    Example:
        >>> published_plans()["window-open"]
        (1.0, 1.0, 1.0, 1.0, 0.98)

    Source: the authors' published result files; paper section 'LLM Experiments'.
    """
    models = _table("published_plans")["rates"]
    formats = models[check_choice("model", model, models)]
    columns = zip(*formats[check_choice("format", format, formats)], strict=True)
    return {task: tuple(map(float, rates)) for task, rates in zip(_table()["tasks"], columns, strict=True)}
