"""Plan files: chain_py, read strictly. A plan is a function that looks like Python.

    # drawer-open: Take hold of the drawer handle and pull the drawer open.
    def drawer_open(robot):
        # The gripper has to come from above.
        if check("the robot's gripper is not vertically aligned with the drawer handle"):
            robot.place("the gripper above the drawer handle")

It is never executed: every line is matched against the few forms above. Where a step's goal is not the usual one of its
skill, the skill ends with it: ``robot.place("the gripper above the puck", goal="the puck is near the gripper")``.
What models write is read with patience instead, by :func:`~lw_torchrl.language.decoding.decode_plan`.
Source: paper section 'Conditional Plan Generation' and its figure of a chain_py plan.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Mapping

from lw_torchrl._checks import nearest, shown
from lw_torchrl.language.plans import MOST_STEPS, PLAN_LIMIT, ConditionalPlan, PlanError, PlanStep, too_many_steps
from lw_torchrl.language.queries import Query, check_query
from lw_torchrl.language.tasks import TASKS, Task

_TEXT = r'"((?:[^"\\]|\\.)*)"|\'((?:[^\'\\]|\\.)*)\''
_DEF = re.compile(r"def\s+([A-Za-z]\w*)\s*\(\s*robot\s*\)\s*:")
_CHECK = re.compile(rf"if\s+check\s*\(\s*(?:{_TEXT})\s*\)\s*:")
_ASKS = re.compile(r"^[ \t]*+if[ \t]+check\b", re.MULTILINE)
_SKILL = re.compile(rf"robot\.([A-Za-z]\w*)\s*\(\s*+(?:{_TEXT})?\s*+(?:,?\s*+goal\s*=\s*(?:{_TEXT}))?\s*+\)")


def _unquote(match: re.Match[str], group: int) -> str:
    return re.sub(r"\\(.)", r"\1", match[group] or match[group + 1] or "").strip()


def _read(
    text: str, task: str | None, source: str, tasks: Mapping[str, Task]
) -> Generator[PlanError, None, ConditionalPlan | None]:
    """Yields every fault, line by line, and returns the plan where there is none."""
    if not isinstance(text, str):
        raise TypeError(f"text must be a string, got {type(text).__name__}")
    if (asked := len(_ASKS.findall(text))) > MOST_STEPS:
        yield too_many_steps(source, asked)
        return None
    if len(text) > PLAN_LIMIT:
        yield PlanError(f"{source}: a plan's text must have at most {PLAN_LIMIT} characters, got {len(text)}")
        return None
    found: str | None = None
    condition: Query | None = None
    opened, sound = False, True  # opened: a condition, sound or not, waits for its skill
    steps: list[PlanStep] = []
    reason: list[str] = []
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.strip()
        where = f"{source}, line {number}"
        fault = ""
        if not line:
            continue
        if line.startswith("#"):
            if found is not None:
                reason.append(line.lstrip("# "))
        elif match := _DEF.fullmatch(line):
            if found is not None:
                yield PlanError(f"{where}: a second plan begins; a plan file holds one")
                return None
            found = match[1].replace("_", "-")
            if found not in tasks:
                near = nearest(found, tasks)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                yield PlanError(f"{where}: {shown(found)} is no task{hint}")
                return None
            if task is not None and found != task:
                yield PlanError(f"{where}: this is a plan for {found!r}, expected one for {task!r}")
                return None
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
            yield PlanError(f"{where}: {fault}")
    if not sound:
        return None
    if found is None:
        yield PlanError(f"{source}: no plan found; a plan begins with 'def task_name(robot):'")
        return None
    if opened:
        yield PlanError(f"{source}: the last condition has no skill")
        return None
    try:
        return ConditionalPlan(found, tuple(steps), tasks[found])
    except PlanError as error:
        yield error
        return None


def check_plan(
    text: str, task: str | None = None, source: str = "plan", tasks: Mapping[str, Task] = TASKS
) -> tuple[ConditionalPlan | None, list[str]]:
    """Read a plan as :func:`parse_plan` does, and tell all its faults instead of raising the first.

    Returns:
        The plan, None if it has faults; and the faults, in the order of the lines.

    Example:
        >>> check_plan("nonsense")
        (None, ["plan, line 1: expected 'def task_name(robot):' before 'nonsense'"])
    """
    faults, reading = [], _read(text, task, source, tasks)
    while True:
        try:
            faults.append(str(next(reading)))
        except StopIteration as done:
            return done.value, faults


def parse_plan(
    text: str, task: str | None = None, source: str = "plan", tasks: Mapping[str, Task] = TASKS
) -> ConditionalPlan:
    """Read one plan in the chain_py format.

    Args:
        text: the plan.
        task: the task it must be for; None takes the one its ``def`` line names.
        source: what to call the text in errors, a file's name.
        tasks: whose objects the conditions name, by task name, as from :func:`~lw_torchrl.load_tasks`.

    Raises:
        PlanError: (a ValueError) with the line: a line of another form, a condition outside the query language,
            a plan without steps, or one for another task.
        TypeError: ``text`` is no string.
    """
    try:
        fault = next(_read(text, task, source, tasks))
    except StopIteration as done:
        return done.value
    raise fault


def quote(text: str) -> str:
    """A text in quotes, as :func:`parse_plan` and Python read it."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def format_plan(plan: ConditionalPlan) -> str:
    """The plan as text in the chain_py format; :func:`parse_plan` reads it back."""

    description = " ".join(plan.definition.description.split())  # a comment is one line
    lines = [f"# {plan.task}: {description}", f"def {plan.task.replace('-', '_')}(robot):"]
    for step in plan.steps:
        if reason := " ".join(step.reason.split()).lstrip("# "):
            lines.append(f"    # {reason}")
        verb, _, details = step.skill.partition(" ")
        said = [quote(details)]
        if step.goal is not None:
            said.append(f"goal={quote(str(step.goal))}")
        lines += [f"    if check({quote(str(step.condition))}):", f"        robot.{verb}({', '.join(said)})"]
    return "\n".join(lines) + "\n"
