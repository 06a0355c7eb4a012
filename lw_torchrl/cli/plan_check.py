"""``lw-torchrl plan check``: one plan, looked at closely."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lw_torchrl.cli.sources import read_skills, read_tasks
from lw_torchrl.cli.tables import Output
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
    json: bool = False,
) -> Output:
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
        json: print one JSON document instead, see docs/cli.md.
    """
    import lw_torchrl as lw
    from lw_torchrl._checks import check_choice
    from lw_torchrl._files import read_text
    from lw_torchrl.language.tasks import check_task

    if not file.is_file():
        raise FileNotFoundError(f"file: there is no file {str(file)!r}")
    known = read_tasks(task_file)
    if task is None:
        task = re.sub(r"-\d+$", "", file.stem)
        if task not in known:
            raise ValueError(f"--task must be given, since the file's name, {file.name!r}, names no task")
    if format is None:
        format = "basic_py" if file.suffix == ".plan" else file.absolute().parent.name
        if format not in lw.PLAN_FORMATS:
            raise ValueError(f"--format must be given, one of {', '.join(lw.PLAN_FORMATS)}: the file's folder is none")
    check_task(task, known)
    check_choice("format", format, lw.PLAN_FORMATS)
    skills = read_skills(skill_file, known) if skill_file else None
    text = read_text(file, ValueError)
    from lw_torchrl.planners.checking import check_plan

    use_one_thread()
    found = check_plan(text, task, format, episodes=episodes, seed=seed, skills=skills, tasks=known)
    output = Output(json)
    steps = [step for step in found.decoded.steps if not step.dropped]
    rows = [
        {
            "condition": str(step.condition),
            "skill": step.written_skill,
            "scripted": step.scripted,
            "expert": None if found.expert is None else found.expert.true[k],
            "own": None if found.own is None else found.own.true[k],
            "chosen": None if found.own is None else found.own.chosen[k],
            "never": k in found.never,
        }
        for k, step in enumerate(steps)
    ]
    output.show("task", found.task, str(found))
    output.show("reason", found.decoded.reason or None)
    output.show("notes", [*map(str, found.decoded.notes)])
    output.show("steps", rows)
    output.show("success", None if found.own is None else found.success)
    return output
