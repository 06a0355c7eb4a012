"""``lw-torchrl tasks`` and ``query``: describe tasks, and answer queries in a state."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import Natural, check_value, counted
from lw_torchrl.cli import options
from lw_torchrl.cli.options import Columns, Output, Row
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.tasks import MT10, Task


@dataclass(kw_only=True)
class Tasks:
    """List tasks, or show one: its description, objects, queries, plan and scripted skills.

    Example: lw-torchrl tasks drawer-open
    """

    names: Positional[Annotated[tuple[str, ...], options.OPTIONAL, arg(metavar="[NAMES]")]] = ()
    """MT10, MT50, a suite, or names of tasks (without any, all 50)"""
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
            columns = {**columns, "objects": lambda row: ", ".join(one["name"] for one in row["objects"])}
            return output.table("tasks", list(map(_row, chosen)), columns, counted(len(chosen), "task"))
        (task,) = chosen
        plan = options.find_plans(self.plans, known).get(task.name)
        text = "no plan" if plan is None else str(plan).strip()
        published = set(lw.supported_queries(task, published_only=True))
        queries = {query: query not in published for query in lw.supported_queries(task)}
        row = _row(task) | {"plan": None if plan is None else text}
        row["queries"] = [{"query": query, "extension": extension} for query, extension in queries.items()]
        objects = [one["name"] + (" (extension)" if one["extension"] else "") for one in row["objects"]]
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
        print("\nqueries (each may be negated, and joined to others by 'and'):", *lines, sep="\n")
        print("\nextension: not part of the paper's Language-World")
        return output


def _row(task: Task) -> dict[str, Any]:
    objects = [{"name": one.name, "extension": one.ours} for one in task.objects[1:]]
    return {"task": task.name, "mt10": task.name in MT10, "description": task.description, "objects": objects}


def _skill_row(skill: ScriptedSkill) -> Row:
    numbers = {"offset": skill.offset, "gain": skill.gain, "gripper": skill.gripper}
    return {"skill": skill.text, "target": skill.target, "moved": skill.moved, **numbers}


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


@dataclass(kw_only=True)
class Ask:
    """Answer a query in a state of a task: the state after N steps of the scripted expert.

    Example: lw-torchrl query pick-place "Is the gripper open and not above the puck?" --step 40
    """

    task: options.TaskName
    text: Positional[Annotated[str | None, arg(metavar="[TEXT]")]] = None
    """the query (without it, all supported queries that hold are listed)"""
    step: int = 0  # number of steps that the expert does first
    seed: int = 0  # random seed of the initial state
    episode: int = 0  # index of the episode
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
        if check_value("--step", self.step, Natural) > suite.max_steps:
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
        lines = [one["query"] for one in answers if one["holds"]]
        if self.text is not None:
            lines = [f"{'yes' if one['holds'] else 'no'}: {one['query']}" for one in answers]
        return output.show("queries", answers, "\n".join(lines))
