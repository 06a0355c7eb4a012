"""Plans as text and on disk: .plan files (chain_py, read strictly), folders of them, JSON of language models' pairs."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal, NoReturn

from lw_torchrl._checks import check_text, checked, nearest, shown
from lw_torchrl._files import parse_json, read_text, write_text
from lw_torchrl.language.nearest import nearest_query
from lw_torchrl.language.plans import (
    MOST_STEPS,
    PLAN_LIMIT,
    ConditionalPlan,
    PlanError,
    Plans,
    PlanStep,
    as_plans,
    format_plan,
    too_many_steps,
)
from lw_torchrl.language.queries import Query, QueryError, check_query
from lw_torchrl.language.tasks import MT10, TASKS, Task

_TEXT = r'"((?:[^"\\]|\\.)*)"|\'((?:[^\'\\]|\\.)*)\''
_DEF = re.compile(r"def\s+([A-Za-z]\w*)\s*\(\s*robot\s*\)\s*:")
_CHECK = re.compile(rf"if\s+check\s*\(\s*(?:{_TEXT})\s*\)\s*:")
_ASKS = re.compile(r"^[ \t]*+if[ \t]+check\b", re.MULTILINE)
_SKILL = re.compile(rf"robot\.([A-Za-z]\w*)\s*\(\s*+(?:{_TEXT})?\s*+(?:,?\s*+goal\s*=\s*(?:{_TEXT}))?\s*+\)")


def _read(
    text: str, task: str | None, source: str, tasks: Mapping[str, Task], report: Callable[[str], Any]
) -> ConditionalPlan | None:
    """Report every fault, line by line, and return the plan if there is none."""
    check_text("text", text)
    if (asked := len(_ASKS.findall(text))) > MOST_STEPS:
        return report(str(too_many_steps(source, asked)))
    if len(text) > PLAN_LIMIT:
        return report(f"{source}: a plan's text must have at most {PLAN_LIMIT} characters, got {len(text)}")
    found: str | None = None
    condition: Query | None = None
    opened, sound = False, True  # opened: a condition, sound or not, waits for its skill
    steps: list[PlanStep] = []
    reason: list[str] = []
    for number, raw in enumerate(text.splitlines(), 1):
        line, where, fault = raw.strip(), f"{source}, line {number}", ""
        if not line:
            continue
        if line.startswith("#"):
            if found is not None:
                reason.append(line.lstrip("# "))
        elif match := _DEF.fullmatch(line):
            if found is not None:
                return report(f"{where}: a second plan begins; a plan file holds one")
            found = match[1].replace("_", "-")
            if found not in tasks:
                return report(_no_task(where, found, tasks))
            if task is not None and found != task:
                return report(f"{where}: this is a plan for {found!r}, expected one for {task!r}")
        elif found is None:
            fault = f"expected 'def task_name(robot):' before {shown(line)}"
        elif match := _CHECK.fullmatch(line):
            if opened:
                fault = 'the condition above has no skill; expected robot.verb("details")'
            opened, condition = True, None
            try:
                condition = check_query(_unquote(match, 1), tasks[found])
            except ValueError as error:
                fault = fault or str(error)
        elif match := _SKILL.fullmatch(line):
            if not opened:
                fault = 'the skill has no condition; expected if check("condition"): above it'
            elif condition is not None:
                goal = _unquote(match, 4)
                try:
                    reached = check_query(goal, tasks[found]) if goal else None
                    steps.append(PlanStep(condition, f"{match[1]} {_unquote(match, 2)}", " ".join(reason), reached))
                except ValueError as error:
                    fault = f"goal: {error}"
            opened, condition, reason = False, None, []
        else:
            fault = f'expected a comment, if check("condition"): or robot.verb("details"), got {shown(line)}'
            if line.startswith("if"):
                opened, condition = True, None
        if fault:
            sound = False
            report(f"{where}: {fault}")
    if not sound:
        return None
    if found is None:
        return report(f"{source}: no plan found; a plan begins with 'def task_name(robot):'")
    if opened:
        return report(f"{source}: the last condition has no skill")
    try:
        return ConditionalPlan(found, tuple(steps), tasks[found])
    except PlanError as error:
        return report(str(error))


def _unquote(match: re.Match[str], group: int) -> str:
    return re.sub(r"\\(.)", r"\1", match[group] or match[group + 1] or "").strip()


def _no_task(where: str, name: str, tasks: Mapping[str, Task]) -> str:
    near = nearest(name, tasks)
    return f"{where}: {shown(name)} is no task" + (f"; did you mean {near[0]!r}?" if near else "")


def check_plan(
    text: str, task: str | None = None, source: str = "plan", tasks: Mapping[str, Task] = TASKS
) -> tuple[ConditionalPlan | None, list[str]]:
    """As :func:`parse_plan`, but the plan, None if it has faults, and all its faults in the order of the lines."""
    faults: list[str] = []
    return _read(text, task, source, tasks, faults.append), faults


def parse_plan(
    text: str, task: str | None = None, source: str = "plan", tasks: Mapping[str, Task] = TASKS
) -> ConditionalPlan:
    """Read one plan in the chain_py format. It is not executed: every line is matched against a few forms::

        def drawer_open(robot):
            # The gripper has to come from above.
            if check("the robot's gripper is not vertically aligned with the drawer handle"):
                robot.place("the gripper above the drawer handle")

    A goal that is not the skill's usual one stands behind it: ``robot.place("...", goal="the gripper is open")``.

    Args:
        text: the plan; its first fault is a :class:`PlanError` with the line.
        task: the task it must be for; None takes the one its ``def`` line names.
        source: what to call the text in errors, a file's name.
        tasks: whose objects the conditions name, by task name, as from :func:`~lw_torchrl.load_tasks`.

    Source: paper section 'Conditional Plan Generation' and its figure of a chain_py plan.
    """

    def refuse(fault: str) -> NoReturn:
        raise PlanError(fault)

    plan = _read(text, task, source, tasks, refuse)
    assert plan is not None  # or a fault was refused
    return plan


_MOST_PAIRS = 2_000  # of a file, each compared with all queries of its task


@checked
def load_plans(
    source: str | os.PathLike[str], *, skills: Literal["own", "MT10"] = "own", tasks: Mapping[str, Task] = TASKS
) -> Plans:
    """Load plans.

    A .json file maps task names to lists of (condition, skill) pairs, at its top or under the key "plans", as language
    models wrote them. A condition outside the query language is replaced by the nearest query (:func:`nearest_query`),
    and the step's ``reason`` keeps its words.

    Args:
        source: "MT10" or "MT50" for the shipped plans of a set; otherwise the path of a .plan or .json file, or of a
            folder of .plan files. A .plan file may have any name but that of another task.
        skills: which of the shipped plans: "own", where every step has a scripted skill; "MT10", where every step is
            worded as in the plans of MT10, for policies that have only seen these.
        tasks: whose objects the conditions name, by task name, as from :func:`~lw_torchrl.load_tasks`.

    Raises:
        FileNotFoundError: there is no such file or folder, or the folder holds no plans.
        PlanError: (a ValueError) a file holds no valid plan, or one for another task than the one it is named after.

    Example:
        >>> load_plans("MT10")["reach"].task
        'reach'
    """
    if source in ("MT10", "MT50"):
        data = files("lw_torchrl.language") / "data"
        other = "plans_mt10_skills" if skills == "MT10" else "plans"
        names = MT10 if source == "MT10" else tuple(TASKS)
        return _read_all([data / ("plans" if task in MT10 else other) / f"{task}.plan" for task in names], tasks)
    if skills != "own":
        raise ValueError(f"skills={skills!r} is for the shipped plans, 'MT10' and 'MT50', got source {str(source)!r}")
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"no plan file or folder {str(path)!r}; 'MT10' and 'MT50' name the shipped plans")
    if path.suffix == ".json":
        return _read_pairs(path, tasks)
    # A name with a dot in front is what a killed save_plans leaves.
    listed = [path] if path.is_file() else sorted(p for p in path.glob("*.plan") if p.name[0] != ".")
    if not listed:
        how = "of a folder of models' answers `lw-torchrl plan compare` makes them"
        raise FileNotFoundError(f"the folder {str(path)!r} holds no .plan files; {how}")
    return _read_all(list[Traversable](listed), tasks)


def _read_all(found: list[Traversable], tasks: Mapping[str, Task]) -> Plans:
    plans: dict[str, ConditionalPlan] = {}
    source: dict[str, str] = {}
    for file in found:
        stem = file.name.removesuffix(".plan")
        text = read_text(file, PlanError, limit=PLAN_LIMIT)
        plan = parse_plan(text, stem if stem in tasks else None, file.name, tasks)
        if plan.task in plans:
            raise PlanError(f"{file.name}: a second plan for {plan.task!r}; {source[plan.task]} holds one, too")
        plans[plan.task], source[plan.task] = plan, file.name
    return Plans(plans)


def _read_pairs(path: Path, tasks: Mapping[str, Task]) -> Plans:
    try:
        whole = parse_json(read_text(path, PlanError, limit=PLAN_LIMIT).encode())
    except ValueError as error:
        raise PlanError(f"{path.name}: expected JSON, task names with lists of pairs: {error}") from error
    found = whole.get("plans", whole)
    if not isinstance(found, dict):
        raise PlanError(f"{path.name}: expected task names with lists of (condition, skill) pairs, got {shown(found)}")
    if (number := sum(len(pairs) for pairs in found.values() if isinstance(pairs, list))) > _MOST_PAIRS:
        raise PlanError(f"{path.name}: its plans must have at most {_MOST_PAIRS} pairs in all, got {number}")
    plans = []
    for name, pairs in found.items():
        if name not in tasks:
            raise PlanError(_no_task(path.name, name, tasks))
        if not isinstance(pairs, list):
            raise PlanError(f"{path.name}, {name}: expected a list of (condition, skill) pairs, got {shown(pairs)}")
        if len(pairs) > MOST_STEPS:
            raise too_many_steps(f"{path.name}, {name}", len(pairs))
        steps = [_step(pair, tasks[name], f"{path.name}, {name}, step {n}") for n, pair in enumerate(pairs, 1)]
        plans.append(ConditionalPlan(name, tuple(steps), tasks[name]))
    return Plans(plans)


def _step(pair: Any, task: Task, where: str) -> PlanStep:
    if not (isinstance(pair, list) and len(pair) == 2 and all(isinstance(text, str) for text in pair)):
        raise PlanError(f"{where}: expected a condition and a skill, two strings, got {shown(pair)}")
    condition, skill = pair
    try:
        match = nearest_query(condition, task)
    except QueryError as error:
        raise PlanError(f"{where}: {error}") from error
    return PlanStep(match.query, skill, "" if match.score == 1.0 else f"nearest to: {condition}")


@checked
def save_plans(plans: Plans | Mapping[str, ConditionalPlan], folder: str | os.PathLike[str]) -> list[Path]:
    """Write each plan to ``folder``/<task>.plan; a file is replaced whole or not at all."""
    texts = {Path(folder) / f"{task}.plan": format_plan(plan) for task, plan in as_plans(plans).items()}
    Path(folder).mkdir(parents=True, exist_ok=True)
    for file, text in texts.items():
        write_text(file, text)
    return list(texts)


def shipped_texts() -> list[str]:
    """The task descriptions and the skills of the shipped plans, sorted."""
    skills = {*load_plans("MT50").skills, *load_plans("MT50", skills="MT10").skills}
    return sorted({task.description for task in TASKS.values()} | skills)
