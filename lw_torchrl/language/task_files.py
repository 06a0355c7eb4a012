"""Files of tasks of one's own, in the format of data/tasks.toml."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from lw_torchrl._checks import checked, nearest
from lw_torchrl._files import read_toml
from lw_torchrl.language.tasks import TASKS, Task, TaskError


@checked
def load_tasks(path: str | os.PathLike[str]) -> Mapping[str, Task]:
    """All 50 tasks and those of a file of one's own: some of the 50 with other objects, points or words, or tasks that
    the simulator does not have.

    Args:
        path: a file in the format of data/tasks.toml. A task with a new name must name its objects.

    Returns:
        Task name to :class:`Task`, sorted; pass one wherever a task is asked for, or all of them to
        :func:`~lw_torchrl.load_plans` and :func:`~lw_torchrl.resolve_tasks`.

    Raises:
        FileNotFoundError: there is no such file.
        TaskError: (a ValueError) it is no TOML, or a task in it is malformed.

    Example:
        >>> import os, tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> path = os.path.join(folder.name, "mine.toml")
        >>> lines = ["[push]", "description = 'Push the disc.'", "objects.disc = 'obs[4:7]'"]
        >>> with open(path, "w") as file:
        ...     print(*lines, sep=os.linesep, file=file)
        >>> load_tasks(path)["push"].object_names
        ("robot's gripper", 'disc')
        >>> folder.cleanup()
    """
    file = Path(path)
    found = dict(TASKS)
    for name, row in read_toml(file, TaskError).items():
        try:
            found[name] = Task.from_json(name, row)
            if name not in TASKS and len(found[name].objects) == 1:
                close = nearest(name, TASKS, n=1)
                raise TaskError(
                    f"task {name!r}: is none of the 50, so it must name its objects"
                    + (f"; did you mean {close[0]!r}?" if close else "")
                )
        except TaskError as error:
            raise TaskError(f"{file}, {error}") from error
    return MappingProxyType(dict(sorted(found.items())))
