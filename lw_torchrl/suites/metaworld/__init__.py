"""Meta-World's 50 tasks: the engines that simulate them, and the scripted experts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.skills import load_skills
from lw_torchrl.language.tasks import TASKS
from lw_torchrl.suites.engine import Engine
from lw_torchrl.suites.suite import Suite

if TYPE_CHECKING:
    from lw_torchrl.suites.metaworld.experts import ExpertActor


def make_suite() -> Suite:
    """Meta-World, whose tasks need no prefix."""
    plans = load_plans("MT50")
    return Suite("metaworld", METAWORLD, TASKS, _make_engine, load_skills(), plans, make_expert=_make_expert)


def _make_engine(row_tasks: Sequence[str], **options: object) -> Engine:
    from lw_torchrl.suites.metaworld.engines import make_engine  # Meta-World takes a second to import

    return make_engine("vectorized", row_tasks, **options)


def _make_expert(tasks: Sequence[str]) -> ExpertActor:
    from lw_torchrl.suites.metaworld.experts import ExpertActor

    return ExpertActor(tasks)
