"""gymnasium-robotics' Fetch tasks: an arm with a parallel gripper reaches, pushes, slides and picks up."""

from typing import TYPE_CHECKING, Any

from lw_torchrl.suites.fetch.words import FETCH, TASKS, load_plans, load_skills
from lw_torchrl.suites.suite import Suite

if TYPE_CHECKING:
    from lw_torchrl.suites.fetch.engine import FetchEngine

__all__ = ["FETCH", "TASKS", "FetchEngine", "load_plans", "load_skills", "make_suite"]


def make_suite() -> Suite:
    """The four tasks, with their scripted skills and plans. Episodes have 50 steps, as gymnasium-robotics has it."""
    return Suite("fetch", FETCH, TASKS, _make_engine, skills=load_skills(), plans=load_plans(), max_steps=50)


def _make_engine(row_tasks: list[str], **options: Any) -> Any:
    return __getattr__("FetchEngine")(row_tasks, **options)


def __getattr__(name: str) -> Any:
    if name == "FetchEngine":  # words alone load neither MuJoCo nor TorchRL
        from lw_torchrl.suites.fetch.engine import FetchEngine

        return FetchEngine
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
