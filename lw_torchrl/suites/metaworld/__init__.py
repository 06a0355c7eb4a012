"""The Meta-World suite: the engines that simulate the 50 tasks, and the scripted experts."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from lw_torchrl._util.checks import check_choice
from lw_torchrl._util.registry import Registry, is_function
from lw_torchrl._util.reproducibility import version_changes
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.skills import load_skills
from lw_torchrl.language.tasks import TASKS
from lw_torchrl.suites.engine import Engine
from lw_torchrl.suites.metaworld.environments import COMPARED_VERSIONS, MetaWorldEngine
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine
from lw_torchrl.suites.suite import Suite

if TYPE_CHECKING:
    from lw_torchrl.suites.metaworld.experts import ExpertActor


_SHIPPED = {"vectorized": VectorizedEngine, "metaworld": MetaWorldEngine}
ENGINES = Registry("engine", "lw_torchrl.engines", _SHIPPED, is_function)
"""A registry of engines: name -> ``(row_tasks, *, reward, num_threads) -> Engine``."""


def make_engine(engine: str | Callable[..., Engine], row_tasks: Sequence[str], **options: Any) -> Engine:
    """Return an engine with a row for each task; ``engine`` is a name in :data:`ENGINES` or a custom function."""
    make: Callable[..., Engine] = engine if callable(engine) else ENGINES[check_choice("engine", engine, ENGINES)]
    return make(list(row_tasks), **options)


def make_suite() -> Suite:
    """Return the Meta-World suite, whose task names have no prefix."""
    plans = load_plans("MT50")
    return Suite("metaworld", METAWORLD, TASKS, _make_engine, load_skills(), plans, make_expert=_make_expert)


def _make_engine(row_tasks: Sequence[str], **options: Any) -> Engine:
    """Return the vectorized engine, or the plain engine if the installed versions were not verified."""
    if not (changes := version_changes(COMPARED_VERSIONS, COMPARED_VERSIONS)):
        return VectorizedEngine(row_tasks, **options)
    _warn_once(", ".join(changes))
    return MetaWorldEngine(row_tasks, **options)


@cache
def _warn_once(changes: str) -> None:
    installation = " ".join(f"{package}=={version}" for package, version in COMPARED_VERSIONS.items())
    warnings.warn(
        f"engine: the vectorized engine was verified against other versions ({changes}), so Meta-World's own "
        "environments are used instead (4 times slower on one thread, 6 times on two). To use the vectorized engine, "
        f"pip install {installation}",
        stacklevel=6,  # reports the line that called LanguageWorldEnv(...)
    )


def _make_expert(tasks: Sequence[str]) -> ExpertActor:
    # This module imports TensorDict, which tasks and engines do not need.
    from lw_torchrl.suites.metaworld.experts import ExpertActor

    return ExpertActor(tasks)
