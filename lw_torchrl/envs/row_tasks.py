"""The tasks that an environment is given: names, sets of names, and tasks of one's own."""

from __future__ import annotations

from collections.abc import Iterable

from lw_torchrl.language.tasks import TASKS, Task, resolve_tasks


def named_tasks(tasks: str | Task | Iterable[str | Task]) -> dict[str, Task]:
    """Task names, sorted, to the tasks of a set, a name, a Task, or a list of names and Tasks."""
    if isinstance(tasks, str) or not isinstance(tasks, (Task, Iterable)):
        return {name: TASKS[name] for name in resolve_tasks(tasks)}  # which names what is wrong
    listed = [tasks] if isinstance(tasks, Task) else list(tasks)
    own = [task for task in listed if isinstance(task, Task)]
    names = [task for task in listed if not isinstance(task, Task)]
    found = {name: TASKS[name] for name in (resolve_tasks(names) if names or not own else ())}
    for task in own:
        if task.name in found:
            raise ValueError(f"tasks must name each task once, got {task.name} more than once")
        found[task.name] = task
    return dict(sorted(found.items()))
