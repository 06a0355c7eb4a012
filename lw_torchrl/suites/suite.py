"""Suite: the tasks of a simulator, their layout and words, and the engine that simulates them."""

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
    """The tasks of one simulator and robot, for every ``suite=`` argument.

    Attributes:
        name: for example "fetch", whose tasks are called "fetch/push".
        layout: the layout of observations and actions.
        tasks: full name to :class:`Task`, all of this layout.
        make_engine: ``(row_tasks, *, reward, num_threads) -> Engine``, with a row for each full name in ``row_tasks``;
            ``reward`` is "sparse" or "dense".
        skills, plans: scripted skills by their text, and plans by task; not every task needs one.
        make_expert: ``(tasks) -> actor``, a demonstrator that writes ``action`` (N, A) float32 in [-1, 1] and
            ``unclipped_action``; None if the plans with their scripted skills demonstrate.
        max_steps: default length of episodes.
        step_time: seconds between two actions.

    Raises:
        ValueError: a task has another layout, or a name that does not begin with the suite's.

    Source: ours; like gymnasium's ``EnvSpec``.
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
            if task.name != name:
                raise ValueError(f"tasks of suite {self.name!r} must map names to tasks, got {task.name!r} as {name!r}")
            if task.layout != self.layout:
                raise ValueError(f"task {name!r} must have the layout of suite {self.name!r}, got {task.layout.name!r}")
            if self.name != "metaworld" and not name.startswith(f"{self.name}/"):
                raise ValueError(f"tasks of suite {self.name!r} must be named '{self.name}/...', got {name!r}")
        if self.plans is not None and (other := set(self.plans) - set(self.tasks)):
            raise ValueError(f"plans of suite {self.name!r} are for tasks that it lacks: {', '.join(sorted(other))}")
        if not isinstance(self.tasks, ReadOnlyDict):
            object.__setattr__(self, "tasks", ReadOnlyDict(dict(sorted(self.tasks.items()))))

    def named_tasks(self, tasks: TaskList, own: Tasks | None = None) -> dict[str, Task]:
        """Return tasks by their full names, sorted. ``tasks`` is the suite's name for all of them, a name with or
        without the suite's in front, a :class:`Task`, or a list of these; names are also looked up in ``own``."""
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


def _as_suite(name: str, entry: Any) -> Suite:
    suite = entry() if callable(entry) else entry
    if not isinstance(suite, Suite):
        raise TypeError(f"suite {name!r} must be a Suite, or a function that makes one, got {shown(entry)}")
    return suite


_SHIPPED = {name: f"lw_torchrl.suites.{name}:make_suite" for name in ("metaworld", "fetch")}
SUITES = Registry("suite", "lw_torchrl.suites", _SHIPPED, _as_suite)
"""Suites by name. Add yours to use it by name; every ``suite=`` also accepts the :class:`Suite`."""


def load_suite(suite: str | Suite) -> Suite:
    """Return the suite of a name, such as "fetch"; a :class:`Suite` is returned as it is.

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
        raise TypeError(f"suite must be a suite's name or a Suite, got {shown(suite)}")
    if suite not in SUITES:
        advice = f"pass your own Suite, or add it: lw.suites.SUITES[{suite!r}] = ... (in a module for --import)"
        raise ValueError(f"{unknown_name('suite', suite, SUITES)} To use your own, {advice}")
    return SUITES[suite]


def suite_name(task: str) -> str:
    """Return the suite that a task's name begins with, or is; Meta-World's tasks have no suite in front."""
    # SUITES reads the entry points of all installed packages, which takes long: look at known names first.
    is_metaworld = task in (*TASKS, "MT10", "MT50")
    return task.partition("/")[0] if "/" in task or (not is_metaworld and task in SUITES) else "metaworld"


def listed_tasks(tasks: Any) -> Any:
    """Return an iterator as a list, which can be read twice, and anything else as it is."""
    return list(tasks) if isinstance(tasks, Iterator) else tasks


def find_suite(tasks: Any, suite: str | Suite | None = None) -> Suite:
    """Return the given suite, or else the one that the tasks' names begin with; Meta-World without a prefix.

    Raises:
        ValueError: the names are of several suites or of an unknown one.
    """
    if suite is not None:
        return load_suite(suite)
    listed = [tasks] if isinstance(tasks, (str, Task)) else list(tasks) if isinstance(tasks, Iterable) else []
    names = {task.name if isinstance(task, Task) else task for task in listed if isinstance(task, (str, Task))}
    suites = {suite_name(name) for name in names}
    if len(suites) > 1:
        raise ValueError(f"tasks must be of one suite, got tasks of {', '.join(sorted(suites))}")
    return load_suite(next(iter(suites), "metaworld"))


def known_suite(task: str) -> Suite | None:
    """Return the installed suite in :data:`SUITES` that has a task of this name; None for other tasks."""
    name = suite_name(task)
    try:
        suite = SUITES.get(name)
    except ImportError:
        return None
    return suite if suite is not None and task in suite.tasks else None
