"""``lw-torchrl plan``: plans from language models, one command for each thing to do with them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lw_torchrl._checks import check_choice, counted
from lw_torchrl._files import read_text
from lw_torchrl.cli import options
from lw_torchrl.cli.output import Columns, Output
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Task, check_task


def prompt(
    task: Positional[Annotated[str, arg(metavar="TASK")]],  # the task that a plan is wanted for
    /,
    format: str = "chain_py",  # how plans are written: basic, chain or goal, then _py, _py_md or _md
    vocabulary: bool = False,  # also say which things the task has, and what can be asked of them
    plans: options.PlanSources = ("MT10",),  # of the examples
    task_file: options.TaskFile = None,
) -> None:
    """Print the text that asks a language model for a plan: plans of three other tasks, then the task.

    Example: lw-torchrl plan prompt drawer-open --format chain_py
    """
    from lw_torchrl.planners.prompts import plan_prompt

    known = options.read_tasks(task_file, (task,))
    found = plan_prompt(task, format, plans=options.read_plans(plans, known), vocabulary=vocabulary, tasks=known)
    print(found, end="")


def _answer(
    file: Path, task: str | None, format: str | None, task_file: Path | None
) -> tuple[str, str, str, Mapping[str, Task]]:
    """The text of an answer, the task that it is for, how it is written, and the tasks that are known."""
    if not file.is_file():
        raise FileNotFoundError(f"file: there is no file {str(file)!r}")
    known = options.read_tasks(task_file, () if task is None else (task,))
    if task is None:
        task = re.sub(r"-\d+$", "", file.stem)
        if task not in known:
            raise ValueError(f"--task must be given, since the file's name, {file.name!r}, names no task")
    if format is None:
        format = "basic_py" if file.suffix == ".plan" else file.absolute().parent.name
        if format not in PLAN_FORMATS:
            raise ValueError(f"--format must be given, one of {', '.join(PLAN_FORMATS)}: the file's folder is none")
    check_task(task, known)
    check_choice("format", format, PLAN_FORMATS)
    return read_text(file, ValueError), task, format, known


def read(
    source: Positional[Annotated[str, arg(metavar="FILE")]],
    /,
    task: str | None = None,  # of an answer; by default as the file's name says
    format: str | None = None,  # of an answer; by default as the file's folder says
    task_file: options.TaskFile = None,
    json: options.Json = False,
) -> Output:
    """Show what policies with roles see of a plan: what became of each step, and how far the plan is trusted.

    Trust is the share of usual states of the plan's motion in which the plan, as written, does what the motion needs.
    Below 0.75, or if it moves a thing without closing the gripper around it, or pulls what is no handle, the plan is
    completed: its motion, things and directions stay, and its conditions are ours. A plan that
    says no motion becomes the default plan: grasp the first thing and move it to the goal.

    Example: lw-torchrl plan read my-plans/coffee-pull.plan

    Args:
        source: a .plan file, a folder of them, a .json file of pairs, "MT10", "MT50" or a suite; or a language model's
            answer, FORMAT/TASK-ATTEMPT.EXT, as plan generate writes it.
    """
    from lw_torchrl.language.canonical import canonical_plan

    file = Path(source)
    if file.is_file() and file.suffix not in (".plan", ".json"):
        from lw_torchrl.language.plan_decoding import decode_plan

        text, task, format, known = _answer(file, task, format, task_file)
        decoded = decode_plan(text, task, format, tasks=known)
        if decoded.plan is None:
            raise ValueError(f"{source}: no plan can be read, {decoded.reason}")
        plans = [decoded.plan]
    else:
        named = not file.exists() and source not in options.SETS and options.is_suite(source)
        suite = options.read_suite(source) if named else None
        files = sorted(file.glob("*.plan")) if file.is_dir() else [file]
        known = options.tasks_of(files, task_file) if task is None else options.read_tasks(task_file, (task,))
        if task is not None:
            check_task(task, known if suite is None else suite.tasks)
        found = options.read_plans([source], known, option="FILE") if suite is None else Plans(suite.plans or {})
        plans = [plan for plan in found.values() if task in (None, plan.task)]
        if not plans:
            raise ValueError(f"--task {task}: {source} has no plan for it")
    output, rows, steps = Output(json), [], []
    for one in map(canonical_plan, plans):
        name, notes = one.written.task, one.notes()
        rows.append({"task": name, "source": one.source, "trust": one.trust})
        steps += [{"task": name, "source": f"{one.source}, trust {one.trust:.2f}", **note} for note in notes]
    columns: Columns = {
        "task": "task",
        "plan": "source",
        "as written": lambda row: row["written"] or "(lacking)",
        "read as": lambda row: row["skill"] or "(left out: it cannot be read)",
        "if": lambda row: row["condition"] or "",
        "sure": lambda row: f"{row['sure']:.1f}" if row["written"] else "",
        "seen": "seen",
    }
    output.table("read", steps, columns, counted(len(rows), "plan"))
    return output.show("plans", rows)


def check(
    file: Positional[options.File],
    /,
    task: str | None = None,  # the task it is for; by default as the file's name says
    format: str | None = None,  # how it is written; by default as the file's folder says, or basic_py for a .plan file
    episodes: int = 5,  # of the expert, and of the plan by scripted skills; conditions are answered in their states
    seed: int = 0,  # of these
    skill_file: options.SkillFile = None,
    task_file: options.TaskFile = None,
    json: options.Json = False,
) -> Output:
    """Say how a plan was read, where its conditions hold, and which steps never fire.

    Example: lw-torchrl plan check runs/plans/llama3.1/chain_py/push-0.py

    Args:
        file: an answer FORMAT/TASK-ATTEMPT.EXT, as plan generate writes it, or a .plan file TASK.plan; any text with
            --task and --format.
    """
    text, task, format, known = _answer(file, task, format, task_file)
    skills = options.read_skills(skill_file, known) if skill_file else None
    from lw_torchrl.planners.repairing import check_plan

    options.use_one_thread()
    found = check_plan(text, task, format, episodes=episodes, seed=seed, skills=skills, tasks=known)
    steps = [step for step in found.decoded.steps if not step.dropped]
    rows = [
        {"condition": str(step.condition), "skill": step.written_skill, "scripted": step.scripted}
        | {"expert": None if found.expert is None else found.expert.true[k]}
        | {"own": None if found.own is None else found.own.true[k]}
        | {"chosen": None if found.own is None else found.own.chosen[k], "never": k in found.never}
        for k, step in enumerate(steps)
    ]
    output = Output(json).show("task", found.task, str(found)).show("reason", found.decoded.reason or None)
    output.show("notes", [*map(str, found.decoded.notes)]).show("steps", rows)
    return output.show("success", None if found.own is None else found.success)


def plan() -> None:
    """Plans from language models: the prompt, asking a model, and checking and repairing what it wrote."""
