"""The paper's own numbers, per task, for tables and figures."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any, Literal

WHICH = {"last": "published, last", "best": "published, best of the last 10 evaluations"}
"""Labels in tables and legends. Headlines use only the last evaluation, not the best of ten."""


@cache
def _table(name: str = "published") -> dict[str, Any]:
    return json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text("utf-8"))


def published(setting: str, method: str = "PCBC", which: Literal["last", "best"] = "last") -> dict[str, float]:
    """Return the published success rate in [0, 1] of each task, sorted by name: the mean over 4 seeds of 20 episodes.

    The rates of single seeds were not published. For DC one-shot, the published "last" and "best" are identical.

    Args:
        setting: "zero-shot", "few-shot" or "one-shot".
        method: "PCBC" or "DC" (descriptor conditioning).
        which: "last", the last evaluation of each run, for comparisons; or "best", the best of the last ten evaluations
            for each task and seed, which the paper's figures show.

    Source: the authors' published result files; paper section 'Conditional Plan Experiments'.
    """
    return dict(zip(_table()["tasks"], _table()["rates"][setting][method][which], strict=True))


def published_curves(setting: str, *methods: str) -> dict[str, dict[str, float]]:
    """Return both published curves of each method (by default PCBC), as success rates by task, by label."""
    return {
        f"{method} {label}": published(setting, method, which)  # type: ignore[arg-type]
        for method in methods or ("PCBC",)
        for which, label in reversed(WHICH.items())
    }


def published_plans(model: str = "PaLM 2", format: str = "chain_py") -> dict[str, tuple[float, ...]]:
    """Return the published success rates in [0, 1] of a model's 5 plans with scripted skills, by task, sorted by name.

    Args:
        model: "PaLM 2", "GPT-3.5" or "GPT-3".
        format: the plans' format, a name in :data:`~lw_torchrl.PLAN_FORMATS`.

    Raises:
        KeyError: nothing was published about that model.

    Source: the authors' published result files; paper section 'LLM Experiments'.
    """
    columns = zip(*_table("published_plans")["rates"][model][format], strict=True)
    return {task: tuple(map(float, rates)) for task, rates in zip(_table()["tasks"], columns, strict=True)}
