"""gymnasium-robotics' Fetch tasks as a suite: an arm with a parallel gripper reaches, pushes, slides and picks up."""

from importlib.resources import files
from typing import TYPE_CHECKING, Any

from lw_torchrl._util.files import read_toml
from lw_torchrl._util.registry import ReadOnlyDict
from lw_torchrl.language import plan_files, skills
from lw_torchrl.language.layout import Layout, Slot
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import Task, TaskError, Tasks
from lw_torchrl.suites.suite import Suite

if TYPE_CHECKING:
    from lw_torchrl.suites.fetch.engine import FetchEngine

__all__ = ["FETCH", "TASKS", "FetchEngine", "load_plans", "load_skills", "make_suite"]

_DATA = files("lw_torchrl.suites.fetch") / "data"

HELD = 0.55
"""The opening below which the fingers hold the puck, whose edges are 5 cm; the pads touch it at 0.48."""
FETCH = Layout(
    "fetch",
    25,
    hand=0,
    opening=3,
    things=(Slot(4, 7),),
    goal=22,
    past=11,
    reach=0.032,
    binary_gripper=True,
    thresholds={"open": HELD, "closed": HELD},
)
"""The 25 numbers of an observation: hand, opening, puck and its quaternion, these 11 at the previous step, goal."""

TASKS: Tasks = ReadOnlyDict(
    {name: Task.from_json(name, row, FETCH) for name, row in sorted(read_toml(_DATA / "tasks.toml", TaskError).items())}
)
"""The four tasks by name, sorted."""


def load_skills() -> Skills:
    """Return Fetch's scripted skills by their text; some are Meta-World's under other texts."""
    return skills.load_skills(str(_DATA / "skills.toml"), tasks=TASKS)


def load_plans() -> Plans:
    """Return a plan for each task; every step has a scripted skill of :func:`load_skills`."""
    return plan_files.load_plans(str(_DATA / "plans"), tasks=TASKS)


def make_suite() -> Suite:
    """Return Fetch as a suite; its episodes have 50 steps, as in gymnasium-robotics."""
    step_time = 0.04  # 20 simulation steps of 2 ms
    return Suite("fetch", FETCH, TASKS, _make_engine, load_skills(), load_plans(), max_steps=50, step_time=step_time)


def _make_engine(row_tasks: list[str], **options: Any) -> Any:
    return __getattr__("FetchEngine")(row_tasks, **options)


def __getattr__(name: str) -> Any:
    if name == "FetchEngine":  # imported when it is used, because tasks and plans need no MuJoCo
        from lw_torchrl.suites.fetch.engine import FetchEngine

        return FetchEngine
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
