"""``lw-torchrl check``: what is wrong with plans, skills or tasks of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from lw_torchrl.cli.sources import read_tasks

if TYPE_CHECKING:
    from lw_torchrl.language.skills import ScriptedSkill
    from lw_torchrl.language.tasks import Task


def check(
    file: Positional[Path],
    /,
    task: str | None = None,
    skill_file: Path | None = None,
    task_file: Path | None = None,
) -> None:
    """Validate a file of plans, skills or tasks of your own: what is wrong, where, and the nearest allowed text.

    Example: lw-torchrl check my-plans/push.plan

    Args:
        file: a .plan file, a folder of them, or a .toml file of skills or of tasks.
        task: the task that a plan must be for.
        skill_file: skills of yours that join ours, or replace those of the same text, for the plans.
        task_file: tasks of yours, instead of ours of the same name or beside ours, for plans and skills.
    """
    import lw_torchrl as lw
    from lw_torchrl._files import read_text

    if not file.exists():
        raise FileNotFoundError(f"file: there is no {str(file)!r}")
    known = read_tasks(task_file)
    if file.suffix == ".toml":
        print(_check_table(file, known))
        return
    paths = sorted(file.glob("*.plan")) if file.is_dir() else [file]
    if not paths:
        raise ValueError(f"file: the folder {str(file)!r} holds no .plan files")
    table = lw.load_skills(skill_file, tasks=known)
    wrong = 0
    for path in paths:
        faults, steps, notes = _check_plan(read_text(path, lw.PlanError), task, path.name, table, known)
        wrong += len(faults)
        print("\n".join([*faults, *notes, f"{path.name}: " + (_count(faults) if faults else f"{steps} steps, valid")]))
    if wrong:
        raise ValueError(f"{wrong} fault{'s' * (wrong > 1)} in {len(paths)} file{'s' * (len(paths) > 1)}")


def _count(faults: list[str]) -> str:
    return f"{len(faults)} fault" + "s" * (len(faults) > 1)


def _check_table(file: Path, known: Mapping[str, Task]) -> str:
    import lw_torchrl as lw
    from lw_torchrl._checks import nearest
    from lw_torchrl._files import read_toml

    rows = read_toml(file, ValueError)
    if any(isinstance(row, dict) and ("description" in row or "objects" in row) for row in rows.values()):
        lw.load_tasks(file)
        for name in sorted(set(rows) - set(lw.TASKS)):
            close = nearest(name, lw.TASKS, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            print(f"{file.name}: note: task {name!r} is none of the simulator's{hint}")
        return f"{file.name}: {len(rows)} tasks, valid"
    table = lw.load_skills(file, tasks=known)
    for text in rows:
        if not any(table[text].suits(task) for task in known.values()):
            print(
                f"{file.name}: skill {text!r} suits no task; it needs {table[text].target!r} and {table[text].moved!r}"
            )
    return f"{file.name}: {len(rows)} skills, valid"


def _check_plan(
    text: str, task: str | None, source: str, skills: Mapping[str, ScriptedSkill], tasks: Mapping[str, Task]
) -> tuple[list[str], int, list[str]]:
    """Every fault of a plan, the steps it has if there is none, and what the scripted skills make of it."""
    import lw_torchrl as lw
    from lw_torchrl.language.formats.chain_py import check_plan

    plan, faults = check_plan(text, task, source, tasks)
    if plan is None:
        return faults, 0, []
    notes = []
    for step in plan.steps:
        if step.skill not in skills or not skills[step.skill].suits(plan.definition):
            found, score = lw.nearest_skill(step.skill, plan.definition, skills)
            notes.append(
                f"{source}: note: no scripted skill {step.skill!r} suits {plan.task}; the nearest is {found.text!r} "
                f"({score:.2f}). A learned policy needs none"
            )
    return [], len(plan.steps), notes
