"""Meta-World's 50 tasks: the engines that simulate them, and the scripted experts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from lw_torchrl._util.checks import check_choice
from lw_torchrl._util.registry import Registry, is_function
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.skills import load_skills
from lw_torchrl.language.tasks import TASKS
from lw_torchrl.suites.engine import Engine
from lw_torchrl.suites.metaworld.plain_engine import MetaWorldEngine
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine
from lw_torchrl.suites.suite import Suite

if TYPE_CHECKING:
    from lw_torchrl.suites.metaworld.experts import ExpertActor


_SHIPPED = {"vectorized": VectorizedEngine, "metaworld": MetaWorldEngine}
ENGINES = Registry("engine", "lw_torchrl.engines", _SHIPPED, is_function)
"""Name to ``(row_tasks, *, reward, num_threads) -> Engine``."""


def make_engine(engine: str | Callable[..., Engine], row_tasks: Sequence[str], **options: Any) -> Engine:
    """The engine of that name, or what a callable of one's own gives, for rows of these tasks."""
    make: Callable[..., Engine] = engine if callable(engine) else ENGINES[check_choice("engine", engine, ENGINES)]
    return make(list(row_tasks), **options)


def make_suite() -> Suite:
    """Meta-World, whose tasks need no prefix."""
    plans = load_plans("MT50")
    return Suite("metaworld", METAWORLD, TASKS, _make_engine, load_skills(), plans, make_expert=_make_expert)


def _make_engine(row_tasks: Sequence[str], **options: object) -> Engine:
    from lw_torchrl.suites.metaworld import make_engine  # Meta-World takes a second to import

    return make_engine("vectorized", row_tasks, **options)


def _make_expert(tasks: Sequence[str]) -> ExpertActor:
    from lw_torchrl.suites.metaworld.experts import ExpertActor

    return ExpertActor(tasks)
