"""``lw-torchrl plan check``: one plan, looked at closely."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lw_torchrl.cli.sources import read_tasks
from lw_torchrl.cli.threads import use_one_thread


def check(
    file: Positional[Annotated[Path, arg(metavar="FILE")]],
    /,
    task: str | None = None,
    format: str | None = None,
    episodes: int = 5,
    seed: int = 0,
    skill_file: Path | None = None,
    task_file: Path | None = None,
) -> None:
    """Say of a plan how it was read, where its conditions hold, and which steps never fire.

    Example: lw-torchrl plan check runs/plans/llama3.1/chain_py/push-0.py

    Args:
        file: an answer FORMAT/TASK-ATTEMPT.EXT, as plan generate writes it, or a .plan file TASK.plan; any text with
            --task and --format.
        task: the task it is for; as the file's name says if none is given.
        format: how it is written; as the file's folder says, or of a .plan file basic_py, if none is given.
        episodes: of the expert, and of the plan by scripted skills, in whose states it is looked where conditions hold.
        seed: of these.
        skill_file: skills of yours that join ours, or replace those of the same text.
        task_file: tasks of yours, instead of ours of the same name or beside ours.
    """
    import lw_torchrl as lw
    from lw_torchrl._files import read_text
    from lw_torchrl.planners.checking import check_plan

    known = read_tasks(task_file)
    if task is None:
        task = re.sub(r"-\d+$", "", file.stem)
        if task not in known:
            raise ValueError(f"--task must be given, since the file's name, {file.name!r}, names no task")
    if format is None:
        format = "basic_py" if file.suffix == ".plan" else file.absolute().parent.name
        if format not in lw.PLAN_FORMATS:
            raise ValueError(f"--format must be given, one of {', '.join(lw.PLAN_FORMATS)}: the file's folder is none")
    use_one_thread()
    skills = lw.load_skills(skill_file, tasks=known) if skill_file else None
    text = read_text(file, ValueError)
    print(check_plan(text, task, format, episodes=episodes, seed=seed, skills=skills, tasks=known))
