"""``lw-torchrl check`` and ``info``: validate your plans, skills, tasks or suite, and describe files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import counted, nearest
from lw_torchrl._util.files import read_text, read_toml
from lw_torchrl.cli import options
from lw_torchrl.cli.data import Show
from lw_torchrl.cli.options import Output
from lw_torchrl.language.nearest import nearest_skill
from lw_torchrl.language.plan_files import PLAN_LIMIT, check_plan
from lw_torchrl.language.skills import ScriptedSkill, skills_for
from lw_torchrl.language.tasks import Task

_SOURCE = "a .plan file, a folder of them, a .toml file of skills or tasks, or a suite, as its name or my_module:suite"


@dataclass(kw_only=True)
class Check:
    """Validate a file of plans, skills or tasks: report every fault with its line and the nearest allowed text.

    A suite is simulated for some steps, and its axes, units, gripper and resting objects are compared with its layout.

    Example: lw-torchrl check my-plans/push.plan

    Example: lw-torchrl check my_module:suite
    """

    source: Positional[Annotated[str, arg(metavar="FILE", help=_SOURCE)]]
    task: str | None = None  # task that a plan must be for
    skill_file: options.SkillFile = None
    task_file: options.TaskFile = None
    json: options.Json = False

    def run(self) -> Output:
        output, file = Output(self.json), Path(self.source)
        if not file.exists() and (":" in self.source or self.source in lw.suites.SUITES):
            return _check_suite(output, self.source)
        if not file.exists():
            raise FileNotFoundError(f"no file, folder or suite {self.source!r}")
        if file.suffix == ".toml":
            return _check_toml(output, file, options.read_tasks(self.task_file))
        files = sorted(file.glob("*.plan")) if file.is_dir() else [file]
        if not files:
            raise FileNotFoundError(f"the folder {self.source!r} holds no .plan files")
        known = options.tasks_of_plans(file, self.task, self.task_file)
        skills = options.read_skills(self.skill_file, known)
        rows: list[dict[str, Any]] = []
        for path in files:
            plan, faults = check_plan(read_text(path, lw.PlanError, limit=PLAN_LIMIT), self.task, path.name, known)
            steps = 0 if plan is None else len(plan.steps)
            notes = [] if plan is None else _skill_notes(plan, skills)
            rows.append({"file": path, "steps": steps, "faults": faults, "notes": notes})
            verdict = counted(len(faults), "fault") if faults else f"{counted(steps, 'step')}, valid"
            if not self.json:
                print(
                    "\n".join([*faults, *(f"{path.name}: note: {note}" for note in notes), f"{path.name}: {verdict}"])
                )
        if number := sum(len(row["faults"]) for row in rows):
            output.fault = f"{counted(number, 'fault')} in {counted(len(files), 'file')}"
        return output.show("files", rows)


def _skill_notes(plan: lw.ConditionalPlan, skills: Mapping[str, ScriptedSkill]) -> list[str]:
    """Name the steps that no scripted skill carries out."""
    notes = []
    for step in plan.steps:
        if step.skill not in skills or not skills[step.skill].suits(plan.definition):
            try:
                skill, score = nearest_skill(step.skill, plan.definition, skills_for(plan.definition, skills))
                hint = f"the nearest is {skill.text!r} ({score:.2f})"
            except ValueError:
                hint = "add yours by --skill-file"
            notes.append(f"no scripted skill {step.skill!r} for {plan.task}; {hint}. Learned policies need none")
    return notes


def _check_toml(output: Output, file: Path, known: Mapping[str, Task]) -> Output:
    """Validate a file of tasks, recognised by its keys, or of skills."""
    notes: list[str] = []
    try:
        rows = read_toml(file, ValueError)
        if any(isinstance(row, dict) and ("description" in row or "objects" in row) for row in rows.values()):
            kind = "task"
            lw.load_tasks(file)
            for name in sorted(set(rows) - set(lw.TASKS)):
                hint = "".join(f"; did you mean {close!r}?" for close in nearest(name, lw.TASKS, n=1))
                notes.append(f"task {name!r} is not a task of the simulator{hint}")
        else:
            kind = "skill"
            skills = lw.load_skills(file, tasks=known)
            for text in rows:
                if not any(skills[text].suits(task) for task in known.values()):
                    needed = f"{skills[text].target!r} and {skills[text].moved!r}"
                    notes.append(f"skill {text!r} suits no task: it needs {needed} (add your tasks by --task-file)")
    except ValueError as error:
        output.fault = str(error)
        return output.show("files", [{"file": file, "steps": 0, "faults": [str(error)], "notes": []}])
    row = {"file": file, f"{kind}s": len(rows), "faults": [], "notes": notes}
    lines = [*(f"{file.name}: note: {note}" for note in notes), f"{file.name}: {counted(len(rows), kind)}, valid"]
    return output.show("files", [row], "\n".join(lines))


def _check_suite(output: Output, name: str) -> Output:
    """Measure each task of a suite and compare with its layout."""
    suite = options.read_suite(name)
    assert suite is not None
    rows = lw.suites.check_suite(suite)
    width = [max(len(getattr(row, key)) for row in rows) for key in ("task", "what", "measured")]
    lines = [
        f"{'ok ' if row.right else 'OFF'}  {row.task:{width[0]}}  {row.what:{width[1]}}  {row.measured:{width[2]}}  "
        f"{'' if row.right else f'expected: {row.wanted}'}".rstrip()
        for row in rows
    ]
    if wrong := sum(not row.right for row in rows):
        output.fault = f"{counted(wrong, 'number')} of suite {suite.name!r} differ from its layout"
    return output.show("suite", [vars(row) for row in rows], "\n".join(lines))


@dataclass(kw_only=True)
class Info:
    """Describe a file: a policy (its model card), a dataset (as `data show` does) or a recording (its episodes).

    Example: lw-torchrl info few-shot-mt50
    """

    path: Positional[Annotated[Path, arg(metavar="PATH")]]  # policy file or name, dataset folder or .rrd file
    result: Path | None = None  # results.json of `lw-torchrl evaluate`, for the success rates of a policy's card
    json: options.Json = False

    def run(self) -> Output:
        if (self.path / "metadata.json").is_file():
            return Show(folders=(self.path,), json=self.json).run()
        output = Output(self.json)
        if self.path.suffix == ".rrd":
            return _show_recording(output, self.path)
        measured = None if self.result is None else lw.EvaluationResult.load(self.result)
        card = lw.evaluation.describe_policy(self.path, measured)
        return output.show("card", card, card)


def _show_recording(output: Output, path: Path) -> Output:
    """List the episodes of a recording with their numbers of steps."""
    from rerun.chunk import RrdReader

    steps: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        episode, _, entity = str(chunk.entity_path).strip("/").partition("/")
        if entity == "action" and not chunk.is_static:
            steps[episode] = steps.get(episode, 0) + len(chunk)
    output.show("recording", path, f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    rows = [{"episode": episode, "steps": number} for episode, number in sorted(steps.items())]
    return output.table("episodes", rows, {"episode": "episode", "steps": "steps"})
