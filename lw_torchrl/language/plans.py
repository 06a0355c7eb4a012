"""Conditional plans: (condition, skill) pairs in English, written as text in the chain_py format.

    # drawer-open: Take hold of the drawer handle and pull the drawer open.
    def drawer_open(robot):
        # The gripper has to come from above.
        if check("the robot's gripper is not vertically aligned with the drawer handle"):
            robot.place("the gripper above the drawer handle")

The text looks like Python and is never executed: every line is matched against the few forms above.
Source: paper section 'Conditional Plan Generation' and its figure of a chain_py plan.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

from lw_torchrl._checks import nearest
from lw_torchrl.language.queries import Query, check_query
from lw_torchrl.language.tasks import TASKS, Task, check_task, get_task

_TEXT = r'"((?:[^"\\]|\\.)*)"|\'((?:[^\'\\]|\\.)*)\''
_DEF = re.compile(r"def\s+([A-Za-z]\w*)\s*\(\s*robot\s*\)\s*:")
_CHECK = re.compile(rf"if\s+check\s*\(\s*(?:{_TEXT})\s*\)\s*:")
_SKILL = re.compile(rf"robot\.([A-Za-z]\w*)\s*\(\s*(?:{_TEXT})?\s*\)")
# fmt: off
_BEFORE_NOUN = {
    "above", "across", "against", "along", "and", "around", "at", "away", "back", "behind", "below", "beside",
    "between", "by", "down", "from", "in", "inside", "into", "near", "of", "off", "on", "onto", "or", "out", "over",
    "past", "through", "to", "toward", "towards", "under", "up", "with",
}
# fmt: on


class PlanError(ValueError):
    """A text or a list of steps that is no conditional plan."""


@dataclass(frozen=True)
class PlanStep:
    """One step: while ``condition`` holds, do ``skill``.

    Attributes:
        condition: a query of the plan's task.
        skill: plain English, "place the gripper above the puck".
        reason: why, a comment for the reader; it plays no part in what the plan does.
    """

    condition: Query
    skill: str
    reason: str = field(default="", compare=False)


@dataclass(frozen=True)
class ConditionalPlan:
    """The steps that carry out one task.

    Attributes:
        task: the task's name.
        steps: at least one :class:`PlanStep`, in canonical spelling, so that the plan's text reads back as
            the same plan: conditions as ``str(query)`` gives them, skills with "the" before the task's nouns.
        definition: the :class:`Task` whose objects the conditions name; None for ours of that name.

    Raises:
        PlanError: (a ValueError) the plan has no steps, a skill does not begin with a plain word, or a
            condition names objects of another task.
        TypeError: a step is no PlanStep, or its skill no string.

    Example:
        >>> plan = ConditionalPlan.from_pairs("reach", [("gripper is open", "move the gripper to the target")])
        >>> plan.steps[0].skill
        'move the gripper to the target'
    """

    task: str
    steps: tuple[PlanStep, ...]
    definition: Task = field(default=None, compare=False, repr=False)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        definition = TASKS[check_task(self.task)] if self.definition is None else self.definition
        if definition.name != self.task:
            raise PlanError(f"definition of plan {self.task!r} is of another task, {definition.name!r}")
        object.__setattr__(self, "definition", definition)
        steps = []
        for number, step in enumerate(self.steps, 1):
            where = f"step {number} of plan {self.task!r}"
            if not isinstance(step, PlanStep) or not isinstance(step.skill, str):
                raise TypeError(f"{where} must be a PlanStep with a skill in words, got {step!r}")
            try:
                condition, skill = check_query(step.condition, definition), _skill_text(step.skill, definition)
            except ValueError as error:
                raise PlanError(f"{where}: {error}") from error
            steps.append(replace(step, condition=condition, skill=skill))
        if not steps:
            raise PlanError(f"plan of task {self.task!r} must have at least one step, got none")
        object.__setattr__(self, "steps", tuple(steps))

    @classmethod
    def from_pairs(cls, task: str | Task, pairs: Iterable[tuple[str | Query, str]]) -> ConditionalPlan:
        """A plan from (condition, skill) pairs, the conditions in any accepted spelling."""
        definition = get_task(task)
        steps = tuple(PlanStep(check_query(query, definition), skill) for query, skill in pairs)
        return cls(definition.name, steps, definition)

    def __str__(self) -> str:
        return format_plan(self)


class Plans(Mapping[str, ConditionalPlan]):
    """An immutable mapping from task names, sorted, to their plans.

    Attributes:
        num_steps: S, the steps of the longest plan.
        skills: every skill text once, sorted.
    """

    def __init__(self, plans: Mapping[str, ConditionalPlan] | Iterable[ConditionalPlan]) -> None:
        listed = list(plans.values() if isinstance(plans, Mapping) else plans)
        for plan in listed:
            if not isinstance(plan, ConditionalPlan):
                raise TypeError(f"plans must hold ConditionalPlan, got {plan!r} ({type(plan).__name__})")
        if isinstance(plans, Mapping):
            for name, plan in plans.items():
                if name != plan.task:
                    raise PlanError(f"plans[{name!r}] is a plan for another task, {plan.task!r}")
        if len({plan.task for plan in listed}) != len(listed):
            raise PlanError("plans must hold one plan for each task")
        if not listed:
            raise PlanError("plans must hold at least one plan, got none")
        self._plans = MappingProxyType({plan.task: plan for plan in sorted(listed, key=lambda p: p.task)})

    def __getitem__(self, task: str) -> ConditionalPlan:
        return self._plans[task]

    def __iter__(self) -> Iterator[str]:
        return iter(self._plans)

    def __len__(self) -> int:
        return len(self._plans)

    def __repr__(self) -> str:
        return f"Plans({len(self)} tasks, num_steps={self.num_steps}, {len(self.skills)} skills)"

    @cached_property
    def num_steps(self) -> int:
        return max(len(plan.steps) for plan in self.values())

    @cached_property
    def skills(self) -> tuple[str, ...]:
        return tuple(sorted({step.skill for plan in self.values() for step in plan.steps}))

    @property
    def fingerprint(self) -> str:
        return repr([(t, [(str(s.condition), s.skill) for s in p.steps], p.definition) for t, p in self.items()])

    def to_json(self) -> dict:
        return {task: format_plan(plan) for task, plan in self.items()}

    @classmethod
    def from_json(cls, found: dict) -> Plans:
        return cls([parse_plan(text, task) for task, text in found.items()])

    def differences(self, other: Plans) -> list[str]:
        """The tasks of both whose plans, or the tasks' definitions, differ."""
        return [t for t in self if t in other and (self[t], self[t].definition) != (other[t], other[t].definition)]

    def require(self, tasks: Iterable[str]) -> None:
        """Raise :class:`PlanError` if one of ``tasks`` has no plan here."""
        if missing := [task for task in tasks if task not in self]:
            raise PlanError(
                f"plans lack {', '.join(missing)}; they cover {', '.join(self)}. Load or write a plan for "
                "each task, or leave the task out."
            )


def as_plans(plans: Plans | Mapping[str, ConditionalPlan]) -> Plans:
    """``plans`` as :class:`Plans`; a mapping is checked and copied."""
    if isinstance(plans, Plans):
        return plans
    if isinstance(plans, ConditionalPlan) or not isinstance(plans, Mapping):
        raise TypeError(f"plans must map task names to ConditionalPlan, got {type(plans).__name__}")
    return Plans(plans)


def _unquote(match: re.Match[str], group: int) -> str:
    return re.sub(r"\\(.)", r"\1", match[group] or match[group + 1] or "").strip()


def _with_articles(details: str, task: Task) -> str:
    def article(match: re.Match[str]) -> str:
        before = details[: match.start()].removesuffix(" ").rpartition(" ")[2]
        return f"the {match[0]}" if not before or before in _BEFORE_NOUN else match[0]

    nouns = sorted({*task.object_names, "gripper"}, key=len, reverse=True)
    pattern = "|".join(re.escape(noun) for noun in nouns)
    return re.sub(rf"(?<![\w'-])(?:{pattern})(?![\w'-])", article, details)


def _skill_text(skill: str, task: Task) -> str:
    """The skill in plain English: articles go before the nouns that lack one, as in the paper.

    A noun lacks one at the beginning and after a word like "above"; after any other word ("the coffee mug") it
    is part of something longer and is left alone.
    """
    first, _, details = " ".join(skill.split()).partition(" ")
    verb, *rest = first.replace("_", " ").split() or [""]
    if not re.fullmatch(r"[A-Za-z]\w*", verb):
        raise PlanError(f"skill must begin with a plain word like 'place', got {skill!r}")
    details = " ".join([*rest, _with_articles(details, task)]).strip()
    return f"{verb} {_with_articles(details, task)}".strip()


def parse_plan(
    text: str, task: str | None = None, source: str = "plan", tasks: Mapping[str, Task] = TASKS
) -> ConditionalPlan:
    """Read one plan in the chain_py format.

    Args:
        text: the plan.
        task: the task it must be for; None takes the one its ``def`` line names.
        source: what to call the text in errors, a file's name.
        tasks: whose objects the conditions name, by task name, as from :func:`load_tasks`.

    Raises:
        PlanError: (a ValueError) with the line: a line of another form, a condition outside the query language,
            a plan without steps, or one for another task.
        TypeError: ``text`` is no string.
    """
    if not isinstance(text, str):
        raise TypeError(f"text must be a string, got {type(text).__name__}")
    found: str | None = None
    condition: Query | None = None
    steps: list[PlanStep] = []
    reason: list[str] = []
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.strip()
        where = f"{source}, line {number}"
        if not line:
            continue
        if line.startswith("#"):
            if found is not None:
                reason.append(line.lstrip("# "))
        elif match := _DEF.fullmatch(line):
            if found is not None:
                raise PlanError(f"{where}: a second plan begins; a plan file holds one")
            found = match[1].replace("_", "-")
            if found not in tasks:
                near = nearest(found, tasks)
                raise PlanError(f"{where}: {found!r} is no task" + (f"; did you mean {near[0]!r}?" if near else ""))
            if task is not None and found != task:
                raise PlanError(f"{where}: this is a plan for {found!r}, expected one for {task!r}")
        elif found is None:
            raise PlanError(f"{where}: expected 'def task_name(robot):' before {line!r}")
        elif match := _CHECK.fullmatch(line):
            if condition is not None:
                raise PlanError(f'{where}: the condition above has no skill; expected robot.verb("details")')
            try:
                condition = check_query(_unquote(match, 1), tasks[found])
            except ValueError as error:
                raise PlanError(f"{where}: {error}") from error
        elif match := _SKILL.fullmatch(line):
            if condition is None:
                raise PlanError(f'{where}: the skill has no condition; expected if check("condition"): above it')
            steps.append(PlanStep(condition, f"{match[1]} {_unquote(match, 2)}", " ".join(reason)))
            condition, reason = None, []
        else:
            raise PlanError(
                f'{where}: expected a comment, if check("condition"): or robot.verb("details"), got {line!r}'
            )
    if found is None:
        raise PlanError(f"{source}: no plan found; a plan begins with 'def task_name(robot):'")
    if condition is not None:
        raise PlanError(f"{source}: the last condition has no skill")
    return ConditionalPlan(found, tuple(steps), tasks[found])


def format_plan(plan: ConditionalPlan) -> str:
    """The plan as text in the chain_py format; :func:`parse_plan` reads it back."""

    def quote(text: str) -> str:
        return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'

    lines = [f"# {plan.task}: {plan.definition.description}", f"def {plan.task.replace('-', '_')}(robot):"]
    for step in plan.steps:
        if reason := " ".join(step.reason.split()).lstrip("# "):
            lines.append(f"    # {reason}")
        verb, _, details = step.skill.partition(" ")
        lines += [f"    if check({quote(str(step.condition))}):", f"        robot.{verb}({quote(details)})"]
    return "\n".join(lines) + "\n"
