"""gymnasium-robotics' Fetch tasks: an arm with a parallel gripper reaches, pushes, slides and picks up."""

from typing import TYPE_CHECKING, Any

from lw_torchrl.suites.fetch.words import FETCH, TASKS, load_plans, load_skills

if TYPE_CHECKING:
    from lw_torchrl.suites.fetch.engine import FetchEngine

__all__ = ["FETCH", "TASKS", "FetchEngine", "load_plans", "load_skills"]


def __getattr__(name: str) -> Any:
    if name == "FetchEngine":  # words alone load neither MuJoCo nor TorchRL
        from lw_torchrl.suites.fetch.engine import FetchEngine

        return FetchEngine
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
