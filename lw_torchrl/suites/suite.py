"""The Suite class (a simulator's tasks, layout, skills, plans and engine) and the registry of suites."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from lw_torchrl._util.checks import check_choice, check_value, typed_fields, unknown_name
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
    """A set of tasks for one simulator and robot. Functions accept a suite as the argument ``suite``.

    Attributes:
        name: the suite's name, for example "fetch"; the tasks are then called "fetch/push" etc.
        layout: the layout of observations and actions.
        tasks: a mapping from full names to :class:`Task` objects with this layout.
        make_engine: ``(row_tasks, *, reward, num_threads) -> Engine``, with a row for each full name in ``row_tasks``;
            ``reward`` is "sparse" or "dense".
        skills, plans: scripted skills by text, and plans by task; tasks may lack a plan.
        make_expert: ``(tasks) -> actor``, a demonstrator that writes ``action`` (N, A) float32 in [-1, 1] and
            ``unclipped_action``; None if scripted skills demonstrate the plans.
        max_steps: default episode length, in time steps.
        step_time: seconds between two actions.

    Raises:
        ValueError: a task has a different layout, or its name does not begin with the suite's name.

    Source: specific to this library; similar to gymnasium's ``EnvSpec``.
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
        prefix = "" if self.name == "metaworld" else f"{self.name}/"
        for name, task in self.tasks.items():
            if task.name != name or task.layout != self.layout or not name.startswith(prefix):
                wanted = f"names '{prefix}...' to tasks with the layout {self.layout.name!r}"
                raise ValueError(f"tasks must map {wanted}, got {name!r}: {task.name!r} with {task.layout.name!r}")
        if self.plans is not None and (other := set(self.plans) - set(self.tasks)):
            raise ValueError(f"plans of suite {self.name!r} must be for its tasks, got {', '.join(sorted(other))}")
        if not isinstance(self.tasks, ReadOnlyDict):
            object.__setattr__(self, "tasks", ReadOnlyDict(dict(sorted(self.tasks.items()))))

    def named_tasks(self, tasks: TaskList, own: Tasks | None = None) -> dict[str, Task]:
        """Return a dict from full task name to task, sorted by name. ``tasks`` is the suite's name (for all tasks), a
        task's name with or without the suite's prefix, a :class:`Task`, or a list of these; names are also looked up
        in ``own``."""
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
    suite: Suite = check_value(f"suite {name!r}", entry() if callable(entry) else entry, Suite)
    return suite


_SHIPPED = {name: f"lw_torchrl.suites.{name}:make_suite" for name in ("metaworld", "fetch")}
SUITES = Registry("suite", "lw_torchrl.suites", _SHIPPED, _as_suite)
"""A registry of suites by name. Add your own suite to use it by name, or pass the :class:`Suite` as ``suite=``."""


def load_suite(suite: str | Suite) -> Suite:
    """Return the suite with a given name, such as "fetch"; a :class:`Suite` is returned unchanged.

    Raises:
        ValueError: the name is unknown; the message suggests the closest names.
        ImportError: the simulator is not installed; the message names the extra.

    Example:
        >>> from lw_torchrl.suites import load_suite
        >>> load_suite("metaworld").tasks["reach"].name
        'reach'
    """
    if isinstance(suite, Suite):
        return suite
    if suite not in SUITES:
        advice = f"pass a Suite object, or register the suite: lw.suites.SUITES[{suite!r}] = ... (see also --import)"
        raise ValueError(f"{unknown_name('suite', suite, SUITES)} For a custom suite, {advice}")
    return SUITES[suite]


def suite_name(task: str) -> str:
    """Return the name of a task's suite: the prefix of the task's name, or "metaworld" for a name without a prefix. The
    name of a suite is returned unchanged."""
    # SUITES reads the entry points of all installed packages, which is slow, so check known names first.
    is_metaworld = task in (*TASKS, "MT10", "MT50")
    return task.partition("/")[0] if "/" in task or (not is_metaworld and task in SUITES) else "metaworld"


def listed_tasks(tasks: Any) -> Any:
    """Convert an iterator to a list, which can be read twice; return any other object unchanged."""
    return list(tasks) if isinstance(tasks, Iterator) else tasks


def find_suite(tasks: Any, suite: str | Suite | None = None) -> Suite:
    """Return ``suite`` unless it is None; otherwise infer the suite from the tasks' names (see :func:`suite_name`).

    Raises:
        ValueError: the tasks belong to several suites or to an unknown suite.
    """
    if suite is not None:
        return load_suite(suite)
    listed = [tasks] if isinstance(tasks, (str, Task)) else list(tasks) if isinstance(tasks, Iterable) else []
    names = {task.name if isinstance(task, Task) else task for task in listed if isinstance(task, (str, Task))}
    suites = {suite_name(name) for name in names}
    if len(suites) > 1:
        raise ValueError(f"tasks must belong to one suite, got tasks of {', '.join(sorted(suites))}")
    return load_suite(next(iter(suites), "metaworld"))


def known_suite(task: str) -> Suite | None:
    """Return the installed suite in :data:`SUITES` that has a task with this name, or None if there is none."""
    name = suite_name(task)
    try:
        suite = SUITES.get(name)
    except ImportError:
        return None
    return suite if suite is not None and task in suite.tasks else None
