"""Plan files: loading and saving .plan files in the chain_py format, and loading (condition, skill) pairs from JSON.

This parser is strict. :func:`~lw_torchrl.decode_plan` is the tolerant parser for text from language models.
"""

from __future__ import annotations

import re
from contextlib import suppress
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal

from lw_torchrl._util.checks import check_value, did_you_mean, shown, typed
from lw_torchrl._util.files import AnyPath, parse_json, read_text, write_text
from lw_torchrl.language.nearest import LIMIT, nearest_query
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, PlanError, Plans, PlanStep, as_plans
from lw_torchrl.language.queries import QueryError, check_query
from lw_torchrl.language.tasks import MT10, TASKS, Task, Tasks

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
    """Parse a plan like :func:`parse_plan`, but return (plan, []) or (None, all errors in line order)."""
    if len(text) > PLAN_LIMIT:
        return None, [f"{source}: a plan's text must have at most {PLAN_LIMIT} characters, got {len(text)}"]
    name, condition, is_open = "", None, False  # is_open: the last condition, valid or not, has no skill yet
    faults, steps, reason = list[str](), list[PlanStep](), list[str]()
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        where, fault = f"{source}, line {number}", ""
        if not line:
            continue
        if line.startswith("#"):
            reason += [line.lstrip("# ")] if name else []
        elif match := _DEF.fullmatch(line):
            second, name = bool(name), match[1].replace("__", "/").replace("_", "-")
            if second or name not in tasks or task not in (None, name):
                unknown = f"{shown(name)} is not a task{did_you_mean(name, tasks)}"
                other = unknown if name not in tasks else f"expected a plan for {task!r}, got a plan for {name!r}"
                fault = "a second plan begins, but a plan file holds one plan" if second else other
                return None, [*faults, f"{where}: {fault}"]
        elif not name:
            fault = f"expected 'def task_name(robot):' before {shown(line)}"
        elif match := _CHECK.fullmatch(line):
            fault = 'expected robot.verb("details") for the condition above, got a second condition' if is_open else ""
            is_open, condition = True, None
            try:
                condition = check_query(_unquote(match, 1), tasks[name])
            except ValueError as error:
                fault = fault or str(error)
        elif match := _SKILL.fullmatch(line):
            if not is_open:
                fault = 'the skill has no condition; expected if check("condition"): above the skill'
            elif condition is not None:
                try:
                    reached = check_query(goal, tasks[name]) if (goal := _unquote(match, 4)) else None
                    steps.append(PlanStep(condition, f"{match[1]} {_unquote(match, 2)}", " ".join(reason), reached))
                except ValueError as error:
                    fault = f"goal: {error}"
            is_open, condition, reason = False, None, []
        else:
            fault = f'expected a comment, if check("condition"): or robot.verb("details"), got {shown(line)}'
            if line.startswith("if"):
                is_open, condition = True, None
        faults += [f"{where}: {fault}"] if fault else []
    if not faults and (not name or is_open):
        absent = "the last condition has no skill" if name else "no plan found; it begins with 'def task_name(robot):'"
        faults.append(f"{source}: {absent}")
    try:
        return (None, faults) if faults else (ConditionalPlan(name, tuple(steps), tasks[name]), [])
    except PlanError as error:
        return None, [str(error)]


def _unquote(match: re.Match[str], group: int) -> str:
    return re.sub(r"\\(.)", r"\1", match[group] or match[group + 1] or "").strip()


@typed
def load_plans(source: AnyPath, *, skills: Literal["own", "MT10"] = "own", tasks: Tasks = TASKS) -> Plans:
    """Load the shipped plans, or plans from files.

    A .json file maps task names to lists of (condition, skill) pairs, at the top level or under the key "plans". A
    condition outside the query language is replaced by the nearest query (:func:`nearest_query`) if the distance of
    each clause is at most 0.4. The step's ``reason`` then quotes the original condition.

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
    if path.suffix == ".json" and path.exists():
        return _read_pairs(path, tasks)
    # Skip the temporary files of an interrupted save_plans, whose names start with a dot.
    paths = [path] if path.is_file() else sorted(p for p in path.glob("*.plan") if p.name[0] != ".")
    if not paths:
        hint = "'MT10' and 'MT50' load the shipped plans, and lw.decode_plan reads a language model's answer"
        raise FileNotFoundError(f"no plan file, or folder with .plan files, {str(path)!r}; {hint}")
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
    with suppress(ValueError):
        rows = _rows(text)
        listed = [*rows.values()] if isinstance(rows, dict) else []
        return bool(listed) and all(
            isinstance(pairs, list) and all(isinstance(x, list) for x in pairs) for pairs in listed
        )
    return False


def _rows(text: str) -> Any:
    content = parse_json(text.encode())
    return content.get("plans", content)


def check_pairs(text: str, source: str, tasks: Tasks = TASKS) -> tuple[list[ConditionalPlan], list[str]]:
    """Parse JSON of (condition, skill) pairs; return the plans and all errors (such as conditions not near a query)."""
    try:
        rows = check_value("plans", _rows(text), dict)
    except ValueError as error:
        return [], [f"{source}: expected JSON that maps task names to lists of pairs: {error}"]
    plans, faults = list[ConditionalPlan](), list[str]()
    for name, pairs in rows.items():
        steps, before = list[PlanStep](), len(faults)
        if name not in tasks:
            faults.append(f"{source}: {shown(name)} is not a task{did_you_mean(name, tasks)}")
            continue
        for number, pair in enumerate(pairs if isinstance(pairs, list) else [pairs], 1):
            try:
                steps.append(_step_of(pair, tasks[name]))
            except ValueError as error:
                faults.append(f"{source}, {name}, step {number}: {error}")
        try:
            plans += [ConditionalPlan(name, tuple(steps), tasks[name])] if len(faults) == before else []
        except PlanError as error:
            faults.append(f"{source}: {error}")
    return plans, faults


def _step_of(pair: Any, task: Task) -> PlanStep:
    """Convert a (condition, skill) pair to a step whose condition is the nearest query."""
    if not (isinstance(pair, list) and [*map(type, pair)] == [str, str]):
        raise QueryError(f"expected a pair of strings (condition, skill), got {shown(pair)}")
    condition, skill = pair
    match = nearest_query(condition, task)
    if match.least_score < 1.0 - LIMIT:
        distance = f"the distance of the nearest, {str(match.query)!r}, is {1.0 - match.least_score:.2f}"
        raise QueryError(f"no query is near enough to the condition {shown(condition)} ({distance})")
    return PlanStep(match.query, skill, "" if match.score == 1.0 else f"nearest to: {condition}")


@typed
def save_plans(plans: AnyPlans, folder: AnyPath) -> list[Path]:
    """Write each plan atomically to ``folder``/<task>.plan, with "__" for a slash in the name; return the paths."""
    texts = {Path(folder) / f"{task.replace('/', '__')}.plan": str(plan) for task, plan in as_plans(plans).items()}
    Path(folder).mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        write_text(path, text)
    return list(texts)
