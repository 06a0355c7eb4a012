"""gymnasium-robotics' Fetch tasks: an arm with a parallel gripper reaches, pushes, slides and picks up."""

from lw_torchrl.suites.fetch.engine import FetchEngine
from lw_torchrl.suites.fetch.words import FETCH, TASKS, load_plans, load_skills

__all__ = ["FETCH", "TASKS", "FetchEngine", "load_plans", "load_skills"]
