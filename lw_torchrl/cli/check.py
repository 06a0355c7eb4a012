"""``lw-torchrl check``: what is wrong with plans, skills, tasks or a suite of one's own."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from tyro.conf import Positional

import lw_torchrl as lw
from lw_torchrl._checks import counted, nearest
from lw_torchrl._files import read_text, read_toml
from lw_torchrl.cli.options import (
    File,
    Json,
    SkillFile,
    TaskFile,
    is_suite,
    read_skills,
    read_suite,
    read_tasks,
    tasks_of,
)
from lw_torchrl.cli.output import Output
from lw_torchrl.language.nearest import nearest_skill
from lw_torchrl.language.plan_text import PLAN_LIMIT
from lw_torchrl.language.plans import check_plan
from lw_torchrl.language.skills import ScriptedSkill, skills_for
from lw_torchrl.language.tasks import Task


def check(
    file: Positional[File],  # a .plan file, a folder of them, a .toml file of skills or of tasks, or a suite
    /,
    task: str | None = None,  # the task that a plan must be for
    skill_file: SkillFile = None,
    task_file: TaskFile = None,
    json: Json = False,
) -> Output:
    """Validate a file of plans, skills or tasks of your own: what is wrong, where, and the nearest allowed text.

    A suite, by name or as my_module:suite, is simulated for a few steps: axes, units, gripper, and how things rest.

    Example: lw-torchrl check my-plans/push.plan
    Example: lw-torchrl check my_module:suite
    """
    if not file.exists() and is_suite(str(file)):
        return _check_suite(str(file), json)
    if not file.exists():
        raise FileNotFoundError(f"file: there is no {str(file)!r}")
    paths = sorted(file.glob("*.plan")) if file.is_dir() else [file]
    known = read_tasks(task_file) if file.suffix == ".toml" else tasks_of(paths, task_file)
    output = Output(json)
    if file.suffix == ".toml":
        try:
            kind, number, notes = _check_table(file, known, "" if task_file else "; tasks of yours come by --task-file")
        except ValueError as error:
            output.fault = str(error)
            return output.show("files", [{"file": file, "steps": 0, "faults": [str(error)], "notes": []}])
        lines = [*(f"{file.name}: note: {note}" for note in notes), f"{file.name}: {counted(number, kind)}, valid"]
        row = {"file": file, f"{kind}s": number, "faults": [], "notes": notes}
        return output.show("files", [row], "\n".join(lines))
    if not paths:
        raise ValueError(f"file: the folder {str(file)!r} holds no .plan files")
    table = read_skills(skill_file, known)
    read = partial(read_text, error=lw.PlanError, limit=PLAN_LIMIT)
    rows: list[dict[str, Any]] = []
    for path in paths:
        faults, steps, notes = _check_plan(read(path), task, path.name, table, known)
        rows.append({"file": path, "steps": steps, "faults": faults, "notes": notes})
        found = counted(len(faults), "fault") if faults else f"{counted(steps, 'step')}, valid"
        if not json:
            print("\n".join([*faults, *(f"{path.name}: note: {note}" for note in notes), f"{path.name}: {found}"]))
    if faults := [fault for row in rows for fault in row["faults"]]:
        unknown = any(" is no task" in fault for fault in faults)
        hint = "; tasks of yours come by --task-file, those of a suite by --import" if unknown and not task_file else ""
        output.fault = f"{counted(len(faults), 'fault')} in {counted(len(paths), 'file')}{hint}"
    return output.show("files", rows)


def _check_suite(name: str, json: bool) -> Output:
    """What was measured in each task of a suite, beside what its layout says."""
    from lw_torchrl.suites import check_suite

    suite = read_suite(name)
    assert suite is not None
    rows, output = check_suite(suite), Output(json)
    width = [max(len(getattr(row, key)) for row in rows) for key in ("task", "what", "measured")]
    lines = [
        f"{'ok ' if row.right else 'OFF'}  {row.task:{width[0]}}  {row.what:{width[1]}}  {row.measured:{width[2]}}  "
        f"{'' if row.right else f'wanted: {row.wanted}'}".rstrip()
        for row in rows
    ]
    if off := sum(not row.right for row in rows):
        output.fault = f"{counted(off, 'number')} of suite {suite.name!r} {'is' if off == 1 else 'are'} off"
    return output.show("suite", [vars(row) for row in rows], "\n".join(lines))


def _check_table(file: Path, known: Mapping[str, Task], hint: str) -> tuple[str, int, list[str]]:
    """What a file is a table of, of how many, and what is noted of them."""
    rows = read_toml(file, ValueError)
    notes = []
    if any(isinstance(row, dict) and ("description" in row or "objects" in row) for row in rows.values()):
        lw.load_tasks(file)
        for name in sorted(set(rows) - set(lw.TASKS)):
            hint = "".join(f"; did you mean {close!r}?" for close in nearest(name, lw.TASKS, n=1))
            notes.append(f"task {name!r} is none of the simulator's{hint}")
        return "task", len(rows), notes
    table = lw.load_skills(file, tasks=known)
    for text in rows:
        if not any(table[text].suits(task) for task in known.values()):
            needed = f"{table[text].target!r} and {table[text].moved!r}"
            notes.append(f"skill {text!r} suits no task; it needs {needed}{hint}")
    return "skill", len(rows), notes


def _check_plan(
    text: str, task: str | None, source: str, skills: Mapping[str, ScriptedSkill], tasks: Mapping[str, Task]
) -> tuple[list[str], int, list[str]]:
    """Every fault of a plan, the steps it has if there is none, and what the scripted skills make of it."""
    plan, faults = check_plan(text, task, source, tasks)
    if plan is None:
        return faults, 0, []
    notes = []
    offered = skills_for(plan.definition, skills)
    for step in plan.steps:
        if step.skill not in skills or not skills[step.skill].suits(plan.definition):
            try:
                found, score = nearest_skill(step.skill, plan.definition, offered)
                hint = f"the nearest is {found.text!r} ({score:.2f})"
            except ValueError:
                hint = "nor does another; yours come by --skill-file"
            notes.append(f"no scripted skill {step.skill!r} suits {plan.task}; {hint}. A learned policy needs none")
    return [], len(plan.steps), notes
