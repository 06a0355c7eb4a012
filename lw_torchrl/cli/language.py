"""The commands ``tasks``, ``query`` and ``check``: describe tasks, answer queries, and validate custom files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import Natural, nearest
from lw_torchrl._util.files import read_text, read_toml
from lw_torchrl._util.text import counted, printable
from lw_torchrl.cli import options
from lw_torchrl.cli.options import Columns, Maybe, Output, Row
from lw_torchrl.language.nearest import nearest_skill
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plan_files import PLAN_LIMIT, check_pairs, check_plan
from lw_torchrl.language.skills import ScriptedSkill, skills_for
from lw_torchrl.language.tasks import MT10, Task

_SOURCE = (
    "a file or folder of plans (.plan, pairs in .json, or any text that `plan read` reads), a .toml file of skills or "
    "tasks, or a suite (name or my_module:suite)"
)


@dataclass(kw_only=True)
class Tasks:
    """List tasks, or show one: its description, objects, queries, plan and scripted skills.

    Example: lw-torchrl tasks drawer-open
    """

    names: Positional[Annotated[tuple[str, ...], options.OPTIONAL, arg(metavar="[NAMES]")]] = ()
    """MT10, MT50, a suite, or names of tasks (default: all 50 Meta-World tasks)"""
    plans: options.PlanSources = ("MT50",)
    skill_file: options.SkillFile = None
    task_file: options.TaskFile = None
    json: options.Json = False

    def run(self) -> Output:
        known = options.read_tasks(self.task_file, self.names)
        chosen = [known[name] for name in options.select_tasks(self.names or tuple(known), known)]
        output = Output(self.json)
        if len(chosen) != 1:
            columns: Columns = {"task": "task", "MT10": "mt10", "description": "description"}
            columns = {**columns, "objects": lambda row: ", ".join(part["name"] for part in row["objects"])}
            return output.table("tasks", list(map(_row, chosen)), columns, counted(len(chosen), "task"))
        (task,) = chosen
        plan = options.find_plans(self.plans, known).get(task.name)
        text = "no plan" if plan is None else str(plan).strip()
        published = set(lw.supported_queries(task, published_only=True))
        queries = {query: query not in published for query in lw.supported_queries(task)}
        row = _row(task) | {"plan": None if plan is None else text}
        row["queries"] = [{"query": query, "extension": extension} for query, extension in queries.items()]
        objects = [part["name"] + (" (extension)" if part["extension"] else "") for part in row["objects"]]
        output.show("task", row, f"{task.name}: {task.description}\n\nobjects: {', '.join(objects)}\n\n{text}\n")
        skills = [skill for skill in options.read_skills(self.skill_file, known).values() if skill.suits(task)]
        columns = {
            "scripted skill": "skill",
            "target": "target",
            "moved": lambda row: "" if row["moved"] == GRIPPER else row["moved"],
            "offset, m": lambda row: _numbers(row["offset"]),
            "gain": lambda row: _numbers(row["gain"][:1] if len({*row["gain"]}) == 1 else row["gain"]),
            "gripper": lambda row: f"{row['gripper']:g}",
        }
        output.table("skills", [_skill_row(skill.for_task(task)) for skill in skills], columns)
        marks = {query: "   (extension)" if extension else "" for query, extension in queries.items()}
        lines = [f"  {query}{mark}" for query, mark in marks.items() if " is not " not in query]
        print("\nqueries (each can be negated, and several can be joined by 'and' and 'or'):", *lines, sep="\n")
        print("\nextension: not part of the paper's Language-World")
        return output


def _row(task: Task) -> dict[str, Any]:
    objects = [{"name": part.name, "extension": part.ours} for part in task.objects[1:]]
    return {"task": task.name, "mt10": task.name in MT10, "description": task.description, "objects": objects}


def _skill_row(skill: ScriptedSkill) -> Row:
    numbers = {"offset": skill.offset, "gain": skill.gain, "gripper": skill.gripper}
    return {"skill": skill.text, "target": skill.target, "moved": skill.moved, **numbers}


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


@dataclass(kw_only=True)
class Ask:
    """Check whether a query holds in the state that the scripted expert reaches after --step time steps of a task.

    Example: lw-torchrl query pick-place "Is the gripper open and not above the puck?" --step 40
    """

    task: options.TaskName
    text: Positional[Annotated[Maybe[str], arg(metavar="[TEXT]")]] = None
    """the query (default: list all supported queries that hold)"""
    step: Natural = 0  # number of time steps that the expert takes first
    seed: Natural = 0  # random seed of the initial state
    episode: Natural = 0  # index of the episode
    task_file: options.TaskFile = None
    json: options.Json = False

    def run(self) -> Output:
        from torchrl.envs import EnvBase, TransformedEnv

        from lw_torchrl.data.collect import suite_expert
        from lw_torchrl.suites.suite import find_suite

        known = options.read_tasks(self.task_file, (self.task,))
        (name,) = options.select_tasks((self.task,), known)
        task, suite = known[name], find_suite(name)
        texts = lw.supported_queries(task) if self.text is None else [self.text]
        queries = [lw.parse_query(text, task) for text in texts]
        if self.step > suite.max_steps:
            raise ValueError(f"--step must be at most {suite.max_steps}, the length of an episode, got {self.step}")
        env: EnvBase = lw.LanguageWorldEnv(name, seed=self.seed)
        expert = suite_expert(suite, (name,)) if self.step else None
        if isinstance(expert, lw.ScriptedSkillActor):
            env = TransformedEnv(env, lw.modules.transform_of(expert))
        state = env.reset(episode=self.episode)
        if expert is not None:
            state = env.rollout(self.step, expert, auto_reset=False, tensordict=state)[:, -1]["next"]
        truths = lw.QueryProgram({task: queries})(state["observation"], state["task_id"])[0].tolist()
        env.close()
        output = Output(self.json)
        positions = {place: at.tolist() for place, at in task.positions(state["observation"][0]).items()}
        lines = [f"the {place:24} at {' '.join(f'{x:7.3f}' for x in at)} m" for place, at in positions.items()]
        output.show("positions", positions, "\n".join(lines))
        opening = state["observation"][0, suite.layout.opening].item()
        output.show("opening", opening, f"the gripper's opening       {opening:7.3f}\n")
        answers = [{"query": str(query), "holds": truth} for query, truth in zip(queries, truths, strict=True)]
        lines = [answer["query"] for answer in answers if answer["holds"]]
        if self.text is not None:
            lines = [f"{'yes' if answer['holds'] else 'no'}: {answer['query']}" for answer in answers]
        return output.show("queries", answers, "\n".join(lines))


@dataclass(kw_only=True)
class Check:
    """Validate a file of plans, skills or tasks: report every error with the line and the closest allowed text.

    A suite is simulated for a few time steps to compare the directions of axes, the units, the gripper and the heights
    of objects with the suite's layout. Notes do not change the exit status.

    Example: lw-torchrl check my-plans/push.plan

    Example: lw-torchrl check my_module:suite
    """

    source: Positional[Annotated[str, arg(metavar="FILE", help=_SOURCE)]]
    task: Maybe[str] = None  # task that the plans must be for
    skill_file: options.SkillFile = None
    task_file: options.TaskFile = None
    json: options.Json = False

    def run(self) -> Output:
        output, file = Output(self.json), Path(self.source)
        if not file.exists() and (":" in self.source or self.source in lw.suites.SUITES):
            return _check_suite(output, self.source)
        if not file.exists():
            raise FileNotFoundError(f"no such file, folder or suite: {self.source!r}")
        if file.suffix == ".toml":
            return _check_toml(output, file, options.read_tasks(self.task_file))
        answers = [path for ending in ("py", "md", "txt", "json", "y*ml") for path in file.glob(f"*.{ending}")]
        files = (sorted(file.glob("*.plan")) or sorted(answers)) if file.is_dir() else [file]
        if not files:
            raise FileNotFoundError(f"the folder {self.source!r} holds no plan files")
        known = options.tasks_of_plans(file, self.task, self.task_file)
        skills = options.read_skills(self.skill_file, known)
        rows: list[dict[str, Any]] = []
        for path in files:
            plans, faults, notes = self._plans(path, known)
            steps = sum(len(plan.steps) for plan in plans)
            notes += [note for plan in plans for note in _skill_notes(plan, skills)]
            rows.append({"file": path, "steps": steps, "faults": faults, "notes": notes})
            verdict = counted(len(faults), "fault") if faults else f"{counted(steps, 'step')}, valid"
            print(*faults, *(f"{path.name}: note: {note}" for note in notes), f"{path.name}: {verdict}", sep="\n")
        if number := sum(len(row["faults"]) for row in rows):
            output.fault = f"{counted(number, 'fault')} in {counted(len(files), 'file')}"
        return output.show("files", rows)

    def _plans(
        self, path: Path, known: Mapping[str, Task]
    ) -> tuple[Sequence[lw.ConditionalPlan], list[str], list[str]]:
        """Parse a file in any supported format; return its plans, the errors, and notes on how it was interpreted."""
        text = read_text(path, lw.PlanError, limit=PLAN_LIMIT)
        if path.suffix == ".plan":
            plan, faults = check_plan(text, self.task, path.name, known)
            return [] if plan is None else [plan], faults, []
        if not options.is_answer(path):
            plans, faults = check_pairs(text, path.name, known)
            if self.task is not None and self.task not in {plan.task for plan in plans}:
                faults.append(f"{path.name}: no valid plan for {self.task!r}")
            return plans, faults, []
        decoded = lw.decode_plan(text, self.task or options.task_of_answer(path, text, known), tasks=known)
        faults = [f"{path.name}, line {step.line}: {step.dropped}" for step in decoded.steps if step.dropped]
        if decoded.plan is None and not faults:
            faults = [f"{path.name}: no plan can be read: {decoded.reason}"]
        notes = [printable(str(note)) for note in decoded.notes]
        return [decoded.plan] if decoded.plan else [], faults, notes


def _skill_notes(plan: lw.ConditionalPlan, skills: Mapping[str, ScriptedSkill]) -> list[str]:
    """Return a note for each plan step that no scripted skill can execute."""
    notes = []
    for step in plan.steps:
        if step.skill not in skills or not skills[step.skill].suits(plan.definition):
            try:
                skill, score = nearest_skill(step.skill, plan.definition, skills_for(plan.definition, skills))
                hint = f"the closest is {skill.text!r} ({score:.2f})"
            except ValueError:
                hint = "add your own with --skill-file"
            notes.append(f"no scripted skill {step.skill!r} for {plan.task}; {hint}. Only scripted policies need it")
    return notes


def _check_toml(output: Output, file: Path, known: Mapping[str, Task]) -> Output:
    """Validate a .toml file; the keys determine whether the file defines tasks or skills."""
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
                    hint = "add your tasks with --task-file"
                    notes.append(f"skill {text!r} suits no task: no task has both {needed}; {hint}")
    except ValueError as error:
        output.fault = str(error)
        return output.show("files", [{"file": file, "steps": 0, "faults": [str(error)], "notes": []}])
    row = {"file": file, f"{kind}s": len(rows), "faults": [], "notes": notes}
    lines = [*(f"{file.name}: note: {note}" for note in notes), f"{file.name}: {counted(len(rows), kind)}, valid"]
    return output.show("files", [row], "\n".join(lines))


_MARKS = {True: "ok", False: "OFF", None: "note"}


def _check_suite(output: Output, name: str) -> Output:
    """Run :func:`lw_torchrl.suites.check_suite`, and print what it measured in simulation and what it expected."""
    suite = options.read_suite(name)
    assert suite is not None
    rows = lw.suites.check_suite(suite)
    width = [max(len(getattr(row, key)) for row in rows) for key in ("task", "what", "measured")]
    lines = [
        f"{_MARKS[row.right]:4} {row.task:{width[0]}}  {row.what:{width[1]}}  {row.measured:{width[2]}}  "
        f"{'' if row.right else f'expected: {row.wanted}'}".rstrip()
        for row in rows
    ]
    if wrong := sum(row.right is False for row in rows):
        output.fault = f"{counted(wrong, 'measurement')} of suite {suite.name!r} differ from the suite's layout"
    return output.show("suite", [vars(row) for row in rows], "\n".join(lines))
