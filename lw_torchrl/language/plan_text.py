"""Plans as text: what chain_py, the format of .plan files, is written with, and how it is read, strictly."""

import re
from collections.abc import Callable
from typing import Any

from lw_torchrl._util.checks import check_value, did_you_mean, shown
from lw_torchrl.language.queries import Query, check_query
from lw_torchrl.language.tasks import Task, Tasks

MOST_STEPS = 1_000  # steps of a plan, at most; the longest of ours has 6
PLAN_LIMIT = 2**18  # characters of a plan's text, and bytes of a file of plans, which takes a second to read
StepFields = tuple[Query, str, str, Query | None]  # the fields of a :class:`~lw_torchrl.language.plans.PlanStep`

_TEXT = r'"((?:[^"\\]|\\.)*)"|\'((?:[^\'\\]|\\.)*)\''
_DEF = re.compile(r"def\s+([A-Za-z]\w*)\s*\(\s*robot\s*\)\s*:")
_CHECK = re.compile(rf"if\s+check\s*\(\s*(?:{_TEXT})\s*\)\s*:")
_ASKS = re.compile(r"^[ \t]*+if[ \t]+check\b", re.MULTILINE)
_SKILL = re.compile(rf"robot\.([A-Za-z]\w*)\s*\(\s*+(?:{_TEXT})?\s*+(?:,?\s*+goal\s*=\s*(?:{_TEXT}))?\s*+\)")


def one_line(text: str) -> str:
    """A description or a reason with its line ends as spaces."""
    return " ".join(text.split())


def quote(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def function_head(task: Task) -> str:
    """The lines with which the function of a task begins."""
    name = task.name.replace("/", "__").replace("-", "_")
    return f"# {task.name}: {one_line(task.description)}\ndef {name}(robot):\n"


def too_many_steps(what: str, number: int) -> str:
    """What is wrong with a plan of more than :data:`MOST_STEPS`."""
    return f"{what} must have at most {MOST_STEPS} steps, got {number}"


def no_task(where: str, name: str, tasks: Tasks) -> str:
    """What is wrong with a name that is none of ``tasks``."""
    return f"{where}: {shown(name)} is not a task{did_you_mean(name, tasks)}"


def read_plan_text(
    text: str, task: str | None, source: str, tasks: Tasks, report: Callable[[str], Any]
) -> tuple[str, list[StepFields]] | None:
    """Report every fault, line by line, and return the task's name and the steps if there is none."""
    check_value("text", text, str)
    if (asked := len(_ASKS.findall(text))) > MOST_STEPS:
        return report(too_many_steps(source, asked))
    if len(text) > PLAN_LIMIT:
        return report(f"{source}: a plan's text must have at most {PLAN_LIMIT} characters, got {len(text)}")
    found: str | None = None
    condition: Query | None = None
    opened, sound = False, True  # opened: a condition, sound or not, waits for its skill
    steps: list[StepFields] = []
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
            found = match[1].replace("__", "/").replace("_", "-")
            if found not in tasks:
                return report(no_task(where, found, tasks))
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
                fault = 'the skill has no condition; expected if check_value("condition"): above it'
            elif condition is not None:
                goal = _unquote(match, 4)
                try:
                    reached = check_query(goal, tasks[found]) if goal else None
                    steps.append((condition, f"{match[1]} {_unquote(match, 2)}", " ".join(reason), reached))
                except ValueError as error:
                    fault = f"goal: {error}"
            opened, condition, reason = False, None, []
        else:
            fault = f'expected a comment, if check_value("condition"): or robot.verb("details"), got {shown(line)}'
            if line.startswith("if"):
                opened, condition = True, None
        if fault:
            sound = False
            report(f"{where}: {fault}")
    if not sound:
        return None
    if found is None:
        return report(f"{source}: no plan found; a plan begins with 'def task_name(robot):'")
    return report(f"{source}: the last condition has no skill") if opened else (found, steps)


def _unquote(match: re.Match[str], group: int) -> str:
    return re.sub(r"\\(.)", r"\1", match[group] or match[group + 1] or "").strip()
