"""Plan files: loading and saving .plan files in the chain_py format, and loading (condition, skill) pairs from JSON.

This parser is strict. :func:`~lw_torchrl.decode_plan` is the tolerant parser for text from language models.
"""

from __future__ import annotations

import re
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Literal

from lw_torchrl._util.checks import did_you_mean, shown, typed
from lw_torchrl._util.files import AnyPath, parse_json, read_text, write_text
from lw_torchrl.language.nearest import LIMIT, nearest_query
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, PlanError, Plans, PlanStep, as_plans
from lw_torchrl.language.queries import Query, QueryError, check_query
from lw_torchrl.language.tasks import MT10, TASKS, Tasks

PLAN_LIMIT = 2**18  # characters of a plan's text, and bytes of a plan file; this bounds the parsing time
_TEXT = r'"((?:[^"\\]|\\.)*)"|\'((?:[^\'\\]|\\.)*)\''
_DEF = re.compile(r"def\s+([A-Za-z]\w*)\s*\(\s*robot\s*\)\s*:")
_CHECK = re.compile(rf"if\s+check\s*\(\s*(?:{_TEXT})\s*\)\s*:")
_SKILL = re.compile(rf"robot\.([A-Za-z]\w*)\s*\(\s*+(?:{_TEXT})?\s*+(?:,?\s*+goal\s*=\s*(?:{_TEXT}))?\s*+\)")


def parse_plan(text: str, task: str | None = None, source: str = "plan", tasks: Tasks = TASKS) -> ConditionalPlan:
    """Parse a plan in the chain_py format. The text is never executed; each line must have one of these forms::

        def drawer_open(robot):
            # The gripper has to come from above.
            if check("the robot's gripper is not vertically aligned with the drawer handle"):
                robot.place("the gripper above the drawer handle")

    A goal other than the skill's usual goal follows the skill: ``robot.place("...", goal="the gripper is open")``.

    Args:
        text: the plan.
        task: the name of the expected task; None accepts the task that the ``def`` line names.
        source: the name of the text in error messages, such as a file name.
        tasks: the known tasks by name, as from :func:`~lw_torchrl.load_tasks`.

    Raises:
        PlanError: the text is not a plan; the message names the first faulty line.

    Source: paper section 'Conditional Plan Generation' and its figure of a chain_py plan.
    """
    plan, faults = check_plan(text, task, source, tasks)
    if plan is None:
        raise PlanError(faults[0])
    return plan


@typed
def check_plan(
    text: str, task: str | None = None, source: str = "plan", tasks: Tasks = TASKS
) -> tuple[ConditionalPlan | None, list[str]]:
    """Parse a plan as :func:`parse_plan` does, but return (plan, []) or (None, all errors in line order) instead of
    raising.
    """
    if len(text) > PLAN_LIMIT:
        return None, [f"{source}: a plan's text must have at most {PLAN_LIMIT} characters, got {len(text)}"]
    name: str | None = None
    condition: Query | None = None
    is_open = False  # whether the last condition, valid or not, still has no skill
    faults: list[str] = []
    steps: list[PlanStep] = []
    reason: list[str] = []
    for number, raw in enumerate(text.splitlines(), 1):
        line, where, fault = raw.strip(), f"{source}, line {number}", ""
        if not line:
            continue
        if line.startswith("#"):
            if name is not None:
                reason.append(line.lstrip("# "))
        elif match := _DEF.fullmatch(line):
            if name is not None:
                return None, [*faults, f"{where}: a second plan begins, but a plan file holds one plan"]
            name = match[1].replace("__", "/").replace("_", "-")
            if name not in tasks:
                return None, [*faults, f"{where}: {shown(name)} is not a task{did_you_mean(name, tasks)}"]
            if task is not None and name != task:
                return None, [*faults, f"{where}: expected a plan for {task!r}, got a plan for {name!r}"]
        elif name is None:
            fault = f"expected 'def task_name(robot):' before {shown(line)}"
        elif match := _CHECK.fullmatch(line):
            if is_open:
                fault = 'expected robot.verb("details") for the condition above, got a second condition'
            is_open, condition = True, None
            try:
                condition = check_query(_unquote(match, 1), tasks[name])
            except ValueError as error:
                fault = fault or str(error)
        elif match := _SKILL.fullmatch(line):
            if not is_open:
                fault = 'the skill has no condition; expected if check("condition"): above the skill'
            elif condition is not None:
                goal = _unquote(match, 4)
                try:
                    reached = check_query(goal, tasks[name]) if goal else None
                    skill = f"{match[1]} {_unquote(match, 2)}"
                    steps.append(PlanStep(condition, skill, " ".join(reason), reached))
                except ValueError as error:
                    fault = f"goal: {error}"
            is_open, condition, reason = False, None, []
        else:
            fault = f'expected a comment, if check("condition"): or robot.verb("details"), got {shown(line)}'
            if line.startswith("if"):
                is_open, condition = True, None
        if fault:
            faults.append(f"{where}: {fault}")
    if not faults and name is None:
        faults.append(f"{source}: no plan found; a plan begins with 'def task_name(robot):'")
    elif not faults and is_open:
        faults.append(f"{source}: the last condition has no skill")
    if faults or name is None:
        return None, faults
    try:
        return ConditionalPlan(name, tuple(steps), tasks[name]), []
    except PlanError as error:
        return None, [str(error)]


def _unquote(match: re.Match[str], group: int) -> str:
    return re.sub(r"\\(.)", r"\1", match[group] or match[group + 1] or "").strip()


@typed
def load_plans(source: AnyPath, *, skills: Literal["own", "MT10"] = "own", tasks: Tasks = TASKS) -> Plans:
    """Load the shipped plans, or plans from files.

    A .json file maps task names to lists of (condition, skill) pairs, at the top level or under the key "plans". A
    condition outside the query language is replaced by the nearest query (:func:`nearest_query`) if each clause is
    within a distance of 0.4; the step's ``reason`` then quotes the original condition.

    Args:
        source: "MT10" or "MT50" for the shipped plans; or the path of a .plan or .json file, or of a folder of .plan
            files. A .plan file must not have the name of another task.
        skills: the wording of the shipped plans. With "own" every step has a scripted skill; with "MT10" every step is
            worded as in the MT10 plans, for policies that were trained on those plans only.
        tasks: the known tasks by name, as from :func:`~lw_torchrl.load_tasks`.

    Raises:
        FileNotFoundError: the path does not exist, or the folder has no .plan files.
        PlanError: (a ValueError) a file is not a valid plan, or its name is the name of another task.

    Example:
        >>> load_plans("MT10")["reach"].task
        'reach'
    """
    if source in ("MT10", "MT50"):
        data = files("lw_torchrl.language") / "data"
        folder = "plans_mt10_skills" if skills == "MT10" else "plans"
        names = MT10 if source == "MT10" else tuple(TASKS)
        return _read_all([data / ("plans" if task in MT10 else folder) / f"{task}.plan" for task in names], tasks)
    if skills != "own":
        raise ValueError(f"skills={skills!r} only applies to source 'MT10' or 'MT50', got source {str(source)!r}")
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"no plan file or folder {str(path)!r}; 'MT10' and 'MT50' load the shipped plans")
    if path.suffix == ".json":
        return _read_pairs(path, tasks)
    # Skip the temporary files of an interrupted save_plans, whose names start with a dot.
    paths = [path] if path.is_file() else sorted(p for p in path.glob("*.plan") if p.name[0] != ".")
    if not paths:
        hint = "use lw.decode_plan for a language model's answer, and lw.save_plans to write .plan files"
        raise FileNotFoundError(f"the folder {str(path)!r} contains no .plan files; {hint}")
    return _read_all(list[Traversable](paths), tasks)


def _read_all(paths: list[Traversable], tasks: Tasks) -> Plans:
    plans: dict[str, ConditionalPlan] = {}
    names: dict[str, str] = {}
    for path in paths:
        stem = path.name.removesuffix(".plan").replace("__", "/")
        text = read_text(path, PlanError, limit=PLAN_LIMIT)
        plan = parse_plan(text, stem if stem in tasks else None, path.name, tasks)
        if plan.task in plans:
            raise PlanError(f"{path.name}: {plan.task!r} already has a plan in {names[plan.task]}; remove one file")
        plans[plan.task], names[plan.task] = plan, path.name
    return Plans(plans)


def _read_pairs(path: Path, tasks: Tasks) -> Plans:
    plans, faults = check_pairs(read_text(path, PlanError, limit=PLAN_LIMIT), path.name, tasks)
    if faults:
        raise PlanError("; ".join(faults[:5]) + (f"; and {len(faults) - 5} more" if faults[5:] else ""))
    return Plans(plans)


def is_pairs(text: str) -> bool:
    """Return whether a text is JSON that maps names to lists of pairs, rather than a program in JSON."""
    try:
        content = parse_json(text.encode())
    except ValueError:
        return False
    rows = content.get("plans", content)
    return (
        isinstance(rows, dict)
        and bool(rows)
        and all(isinstance(pairs, list) and all(isinstance(pair, list) for pair in pairs) for pairs in rows.values())
    )


def check_pairs(text: str, source: str, tasks: Tasks = TASKS) -> tuple[list[ConditionalPlan], list[str]]:
    """Parse JSON of (condition, skill) pairs, and return the plans and all errors.

    A condition with a clause that is further than :data:`~lw_torchrl.language.nearest.LIMIT` from every query is an
    error.
    """
    try:
        content = parse_json(text.encode())
    except ValueError as error:
        return [], [f"{source}: expected JSON that maps task names to lists of pairs: {error}"]
    rows = content.get("plans", content)
    if not isinstance(rows, dict):
        return [], [f"{source}: expected task names mapped to (condition, skill) pairs, got {shown(rows)}"]
    plans, faults = list[ConditionalPlan](), list[str]()
    for name, pairs in rows.items():
        if name not in tasks:
            faults.append(f"{source}: {shown(name)} is not a task{did_you_mean(name, tasks)}")
            continue
        steps, before = list[PlanStep](), len(faults)
        for number, pair in enumerate(pairs if isinstance(pairs, list) else [pairs], 1):
            where = f"{source}, {name}, step {number}"
            if not (isinstance(pair, list) and len(pair) == 2 and all(isinstance(text, str) for text in pair)):
                faults.append(f"{where}: expected a pair of strings (condition, skill), got {shown(pair)}")
                continue
            try:
                match = nearest_query(pair[0], tasks[name])
            except QueryError as error:
                faults.append(f"{where}: {error}")
                continue
            if match.least_score < 1.0 - LIMIT:
                distance = f"the distance of the nearest, {str(match.query)!r}, is {1.0 - match.least_score:.2f}"
                faults.append(f"{where}: no query is near enough to the condition {shown(pair[0])} ({distance})")
            steps.append(PlanStep(match.query, pair[1], "" if match.score == 1.0 else f"nearest to: {pair[0]}"))
        if len(faults) == before:
            try:
                plans.append(ConditionalPlan(name, tuple(steps), tasks[name]))
            except PlanError as error:
                faults.append(f"{source}: {error}")
    return plans, faults


@typed
def save_plans(plans: AnyPlans, folder: AnyPath) -> list[Path]:
    """Write each plan atomically to ``folder``/<task>.plan, with "__" for a slash; return the paths."""
    texts = {Path(folder) / f"{task.replace('/', '__')}.plan": str(plan) for task, plan in as_plans(plans).items()}
    Path(folder).mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        write_text(path, text)
    return list(texts)
