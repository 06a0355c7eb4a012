"""Suite: the tasks of a simulator, what their numbers mean, and what simulates them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from lw_torchrl._util.checks import check_choice, shown, typed_fields, unknown_name
from lw_torchrl._util.registry import ReadOnlyDict, Registry
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import TASKS, Task, TaskList, Tasks, named_tasks
from lw_torchrl.suites.engine import Engine


@typed_fields
@dataclass(frozen=True)
class Suite:
    """Tasks of one simulator and robot, for everything that takes ``suite=``.

    Attributes:
        name: "fetch"; its tasks are called "fetch/push".
        layout: the layout of observations and actions.
        tasks: full name to :class:`Task`, each of this layout.
        make_engine: ``(row_tasks, *, reward, num_threads) -> Engine``, with a row for each full name in ``row_tasks``;
            ``reward`` is "sparse" or "dense".
        skills, plans: scripted skills by their text, and a plan for each task that has one; None for none.
        make_expert: ``(tasks) -> actor``, a demonstrator that writes ``action`` (N, A) float32 in [-1, 1] and
            ``unclipped_action``; None for the plans with their scripted skills.
        max_steps, step_time: the default length of episodes, and seconds between two actions.

    Raises:
        ValueError: a task of another layout, or whose name does not begin with the suite's.

    Source: ours; as gymnasium's ``EnvSpec``, with words.
    """

    name: str
    layout: Layout
    tasks: Tasks
    make_engine: Callable[..., Engine]
    skills: Skills | None = None
    plans: Plans | None = None
    make_expert: Callable[..., Any] | None = None
    max_steps: int = 500
    step_time: float = 0.0125

    def __post_init__(self) -> None:
        for relation in self.layout.thresholds:
            check_choice(f"thresholds of layout {self.layout.name!r}", relation, PREDICATES)
        for name, task in self.tasks.items():
            if not isinstance(task, Task) or task.name != name:
                raise TypeError(f"tasks of suite {self.name!r} must map names to their Task, got {shown(task)}")
            if task.layout != self.layout:
                raise ValueError(f"task {name!r} must have the layout of suite {self.name!r}, got {task.layout.name!r}")
            if self.name != "metaworld" and not name.startswith(f"{self.name}/"):
                raise ValueError(f"tasks of suite {self.name!r} must be named '{self.name}/...', got {name!r}")
        if self.plans is not None and (other := set(self.plans) - set(self.tasks)):
            raise ValueError(f"plans of suite {self.name!r} are for tasks that it lacks: {', '.join(sorted(other))}")
        if not isinstance(self.tasks, ReadOnlyDict):
            object.__setattr__(self, "tasks", ReadOnlyDict(dict(sorted(self.tasks.items()))))

    def named_tasks(self, tasks: TaskList, own: Tasks | None = None) -> dict[str, Task]:
        """Full task names, sorted, to the tasks that are meant: the suite's name for all of them, a name with or
        without the suite's in front, a :class:`Task`, or a list of these. ``own`` tasks are known beside them."""
        known = {**self.tasks, **own} if own else self.tasks
        if tasks == self.name:
            return dict(self.tasks)
        if isinstance(tasks, (str, Task)) or not isinstance(tasks, Iterable):
            return named_tasks(self._full(tasks), known=known)
        return named_tasks([self._full(task) for task in tasks], known=known)

    def _full(self, task: Any) -> Any:
        if not isinstance(task, str) or task in self.tasks or f"{self.name}/{task}" not in self.tasks:
            return task
        return f"{self.name}/{task}"


def _check_suite(name: str, entry: Any) -> Suite:
    suite = entry() if callable(entry) else entry
    if not isinstance(suite, Suite):
        raise TypeError(f"suite {name!r} must be a Suite, or a function that makes one, got {shown(entry)}")
    return suite


_SHIPPED = {name: f"lw_torchrl.suites.{name}:make_suite" for name in ("metaworld", "fetch")}
SUITES = Registry("suite", "lw_torchrl.suites", _SHIPPED, _check_suite)
"""The suites by name. Add yours to use it by name; nobody has to, since every ``suite=`` takes the object too."""


def load_suite(suite: str | Suite) -> Suite:
    """Return the suite of a name, "fetch"; a :class:`Suite` is returned as it is.

    Raises:
        ValueError: the name is unknown; the message lists the nearest names.
        ImportError: the simulator is not installed; the message names the extra.

    Example:
        >>> from lw_torchrl.suites import load_suite
        >>> load_suite("metaworld").tasks["reach"].name
        'reach'
    """
    if isinstance(suite, Suite):
        return suite
    if not isinstance(suite, str):
        raise TypeError(f"suite must be a suite's name or a Suite, got {shown(suite)} ({type(suite).__name__})")
    if suite not in SUITES:
        raise ValueError(
            f"{unknown_name('suite', suite, SUITES)} (yours is given as suite=, or has a name by lw.suites.SUITES["
            f"{suite!r}] = ..., on the command line in a module that --import names)"
        )
    return SUITES[suite]


def suite_name(task: str) -> str:
    """The suite that a task's name begins with, or is; Meta-World's tasks have no suite in front."""
    known = task in (*TASKS, "MT10", "MT50")  # else installed packages are asked
    return task.partition("/")[0] if "/" in task or (not known and task in SUITES) else "metaworld"


def listed_tasks(tasks: Any) -> Any:
    """The tasks as they were given, but an iterator as a list, which can be read twice."""
    return list(tasks) if isinstance(tasks, Iterator) else tasks


def find_suite(tasks: Any, suite: str | Suite | None = None) -> Suite:
    """The suite of some tasks: the given one, or the one that their names begin with; else Meta-World's.

    Raises:
        ValueError: names of several suites, or of a suite that is not known.
    """
    if suite is not None:
        return load_suite(suite)
    listed = [tasks] if isinstance(tasks, (str, Task)) else list(tasks) if isinstance(tasks, Iterable) else []
    names = {one.name if isinstance(one, Task) else one for one in listed if isinstance(one, (str, Task))}
    prefixes = {suite_name(name) for name in names}
    if len(prefixes) > 1:
        raise ValueError(f"tasks must be of one suite, got tasks of {', '.join(sorted(prefixes))}")
    return load_suite(next(iter(prefixes), "metaworld"))


def known_suite(task: str) -> Suite | None:
    """The suite in :data:`SUITES` that has a task of this name and is installed; None for a task of one's own."""
    name = suite_name(task)
    try:
        found = load_suite(name) if name in SUITES else None
    except ImportError:
        return None
    return found if found is not None and task in found.tasks else None
