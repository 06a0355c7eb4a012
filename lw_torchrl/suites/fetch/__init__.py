"""The Fetch suite: gymnasium-robotics tasks for an arm with a parallel gripper (reach, push, slide, pick and place)."""

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
"""The gripper opening (0 to 1) below which the fingers hold the puck (5 cm edges); the pads touch the puck at 0.48."""
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
"""The layout of the 25 values of an observation: hand (3), gripper opening (1), puck (3), puck quaternion (4), the same
11 values at the previous time step, and goal (3)."""

TASKS: Tasks = ReadOnlyDict(
    {name: Task.from_json(name, row, FETCH) for name, row in sorted(read_toml(_DATA / "tasks.toml", TaskError).items())}
)
"""The four tasks, sorted by name."""


def load_skills() -> Skills:
    """Load Fetch's scripted skills by text; some are Meta-World skills under a different text."""
    return skills.load_skills(str(_DATA / "skills.toml"), tasks=TASKS)


def load_plans() -> Plans:
    """Load a plan for each task; :func:`load_skills` returns a scripted skill for every plan step."""
    return plan_files.load_plans(str(_DATA / "plans"), tasks=TASKS)


def make_suite() -> Suite:
    """Return the Fetch suite; episodes have 50 time steps, as in gymnasium-robotics."""
    step_time = 0.04  # 20 simulation steps of 2 ms
    return Suite("fetch", FETCH, TASKS, _make_engine, load_skills(), load_plans(), max_steps=50, step_time=step_time)


def _make_engine(row_tasks: list[str], **options: Any) -> Any:
    return __getattr__("FetchEngine")(row_tasks, **options)


def __getattr__(name: str) -> Any:
    if name == "FetchEngine":  # imported on first use, because tasks and plans do not need MuJoCo
        from lw_torchrl.suites.fetch.engine import FetchEngine

        return FetchEngine
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
