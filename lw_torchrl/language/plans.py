"""Conditional plans: (condition, skill) pairs in English. :mod:`lw_torchrl.language.formats` writes and reads them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from hashlib import sha256
from types import NoneType
from typing import Any, NoReturn

from lw_torchrl._util.checks import Probability, shown, typed, typed_fields
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plan_text import MOST_STEPS, function_head, one_line, quote, read_plan_text, too_many_steps
from lw_torchrl.language.queries import Query, check_query, read_query
from lw_torchrl.language.relations import comparisons
from lw_torchrl.language.roles import StepRole
from lw_torchrl.language.skills import canonical_skill, load_skills
from lw_torchrl.language.tasks import TASKS, Task, Tasks, check_task, get_task, one_layout, role_object, task_ids


class PlanError(ValueError):
    """A text or a list of steps that is no conditional plan."""


@lru_cache(maxsize=1024)
def usual_goal(skill: str, task: Task) -> Query | None:
    """The state that the scripted skill of this text steers to, if it has one that the task's queries can say."""
    found = load_skills().get(skill)
    return None if found is None else read_query(found.variants.get(task.name, found).goal, task)


@typed_fields
@dataclass(frozen=True)
class PlanStep:
    """One step: while ``condition`` holds, do ``skill``. Its queries are of the plan's task."""

    condition: Query
    skill: str  # plain English, "place the gripper above the puck"
    reason: str = field(default="", compare=False)  # a comment for the reader; it does not change what the plan does
    goal: Query | None = None  # the state to reach, if not the skill's usual one; :attr:`ConditionalPlan.goals` has all
    role: StepRole | None = None  # what the step does to which object, in plans of :func:`~lw_torchrl.canonical_plan`

    def mentions(self, task: Task) -> set[str]:
        """The names of the objects that the condition or the skill mentions; "target location" may stand for the goal.

        A role says which objects the skill mentions; without one they are found in the skill's text.
        """
        clauses = self.condition.clauses
        names = {name for clause in clauses for name in (clause.subject, clause.object) if name is not None}
        if self.role is not None:
            return names.union(self.role.objects)
        longest = sorted(task.object_names, key=len, reverse=True)  # "drawer handle" is not "drawer"
        return names.union(re.findall(rf"(?<![\w-])(?:{'|'.join(map(re.escape, longest))})(?![\w-])", self.skill))


@typed_fields
@dataclass(frozen=True)
class ConditionalPlan:
    """The steps that carry out one task, as in the paper's section 'Conditional Plan Generation'.

    It has 1 to 1,000 steps, in canonical spelling, so that its text reads back as the same plan: conditions as
    ``str(query)``, "the" before nouns. Equal conditions, skills and goals make equal plans. A plan of
    :func:`~lw_torchrl.canonical_plan` has as its confidence the fraction of typical states in which the plan, as
    written, does what its motion needs.

    Example:
        >>> plan = ConditionalPlan.from_pairs("reach", [("gripper is open", "move the gripper to the target")])
        >>> plan.steps[0].skill
        'move the gripper to the target'
    """

    task: str
    steps: tuple[PlanStep, ...]
    # The task whose objects the conditions name; None for the shipped task of that name.
    definition: Task = field(default=None, compare=False, repr=False)  # type: ignore[assignment]
    confidence: Probability | None = None

    def __post_init__(self) -> None:
        if isinstance(self.steps, str) or not isinstance(self.steps, Iterable):
            raise TypeError(f"steps must be a tuple of PlanStep, got {shown(self.steps)}")
        if not isinstance(self.definition, (Task, NoneType)):
            raise TypeError(f"definition must be a Task, got {shown(self.definition)}")
        listed, definition = tuple(self.steps), self.definition or TASKS[check_task(self.task)]
        if len(listed) > MOST_STEPS:
            raise PlanError(too_many_steps(f"plan of task {self.task!r}", len(listed)))
        if definition.name != self.task:
            raise PlanError(f"definition of plan {self.task!r} is of another task, {definition.name!r}")
        object.__setattr__(self, "definition", definition)
        steps = []
        for number, step in enumerate(listed, 1):
            where = f"step {number} of plan {self.task!r}"
            if not isinstance(step, PlanStep):
                raise TypeError(f"{where} must be a PlanStep with a skill in words, got {step!r}")
            try:
                condition, skill = check_query(step.condition, definition), canonical_skill(step.skill, definition)
                goal = None if step.goal is None else check_query(step.goal, definition)
                for name in () if step.role is None else step.role.objects:
                    role_object(definition, name)
            except ValueError as error:
                raise PlanError(f"{where}: {error}") from error
            goal = None if goal == usual_goal(skill, definition) else goal
            steps.append(replace(step, condition=condition, skill=skill, goal=goal))
        if not steps:
            raise PlanError(f"plan of task {self.task!r} must have at least one step, got none")
        object.__setattr__(self, "steps", tuple(steps))

    @classmethod
    def from_pairs(cls, task: str | Task, pairs: Iterable[tuple[str | Query, str]]) -> ConditionalPlan:
        """A plan from (condition, skill) pairs, the conditions in any accepted spelling."""
        definition = get_task(task)
        steps = tuple(PlanStep(check_query(query, definition), skill) for query, skill in pairs)
        return cls(definition.name, steps, definition)

    @property
    def goals(self) -> tuple[Query | None, ...]:
        """The state that each step's skill is to reach: its own goal, else the skill's usual one; None without both."""
        return tuple(step.goal or usual_goal(step.skill, self.definition) for step in self.steps)

    def __str__(self) -> str:
        """The plan as text in the chain_py format; :func:`parse_plan` reads it back."""
        lines = []
        for step in self.steps:
            if reason := one_line(step.reason).lstrip("# "):
                lines.append(f"    # {reason}")
            verb, _, details = step.skill.partition(" ")
            said = [quote(details)]
            if step.goal is not None:
                said.append(f"goal={quote(str(step.goal))}")
            lines += [f"    if check({quote(str(step.condition))}):", f"        robot.{verb}({', '.join(said)})"]
        return function_head(self.definition) + "".join(f"{line}\n" for line in lines)

    def to_json(self) -> dict[str, Any]:
        """The plan as chain_py text, its task unless this is a shipped one, and the roles and confidence if any."""
        row: dict[str, Any] = {"plan": str(self)}
        if self.definition != TASKS.get(self.task):
            row["task"] = self.definition.to_json()
        if any(step.role for step in self.steps):
            row["roles"] = [step.role and step.role.to_json() for step in self.steps]
        return row if self.confidence is None else {**row, "confidence": self.confidence}

    @classmethod
    def from_json(cls, name: str, row: Any) -> ConditionalPlan:
        """Rebuild the plan of the task ``name`` from :meth:`to_json`; raise :class:`PlanError` for any other value."""
        where, keys = f"plan of {shown(name)}", ("plan", "task", "roles", "confidence")
        if not isinstance(row, dict) or not isinstance(row.get("plan"), str) or set(row) - {*keys}:
            raise PlanError(f'{where} must be like {{"plan": text, "task": table}}, got {shown(row)}')
        try:
            task = Task.from_json(name, row["task"]) if "task" in row else TASKS[check_task(name)]
            plan = parse_plan(row["plan"], name, where, {name: task})
            roles = row.get("roles", [None] * len(plan.steps))
            if not isinstance(roles, list) or len(roles) != len(plan.steps):
                raise ValueError(f"roles must be a list with one entry for each of its {len(plan.steps)} steps")
            steps = [
                replace(step, role=None if role is None else StepRole.from_json(role))
                for step, role in zip(plan.steps, roles, strict=True)
            ]
            return replace(plan, steps=tuple(steps), confidence=row.get("confidence"))
        except PlanError:
            raise
        except (ValueError, TypeError) as error:
            raise PlanError(f"{where}: {error}") from error


def check_plan(
    text: str, task: str | None = None, source: str = "plan", tasks: Tasks = TASKS
) -> tuple[ConditionalPlan | None, list[str]]:
    """As :func:`parse_plan`, but the plan, None if it has faults, and all its faults in the order of the lines."""
    faults: list[str] = []
    return _read(text, task, source, tasks, faults.append), faults


def parse_plan(text: str, task: str | None = None, source: str = "plan", tasks: Tasks = TASKS) -> ConditionalPlan:
    """Read one plan in the chain_py format. It is not executed: every line is matched against a few forms::

        def drawer_open(robot):
            # The gripper has to come from above.
            if check("the robot's gripper is not vertically aligned with the drawer handle"):
                robot.place("the gripper above the drawer handle")

    A goal that is not the skill's usual one stands behind it: ``robot.place("...", goal="the gripper is open")``.

    Args:
        text: the plan; its first fault is a :class:`PlanError` with the line.
        task: the task it must be for; None for the one that its ``def`` line names.
        source: the text's name in errors.
        tasks: whose objects the conditions name, by task name, as from :func:`~lw_torchrl.load_tasks`.

    Source: paper section 'Conditional Plan Generation' and its figure of a chain_py plan.
    """

    def refuse(fault: str) -> NoReturn:
        raise PlanError(fault)

    plan = _read(text, task, source, tasks, refuse)
    assert plan is not None  # or a fault was refused
    return plan


def _read(text: str, task: str | None, source: str, tasks: Tasks, report: Callable[..., Any]) -> ConditionalPlan | None:
    if (found := read_plan_text(text, task, source, tasks, report)) is None:
        return None
    name, steps = found
    try:
        return ConditionalPlan(name, tuple(PlanStep(*step) for step in steps), tasks[name])
    except PlanError as error:
        return report(str(error))


class Plans(Mapping[str, ConditionalPlan]):
    """An immutable mapping from task names, sorted, to their plans. ``layout`` is that of the tasks."""

    @typed
    def __init__(self, plans: Mapping[str, ConditionalPlan] | Iterable[ConditionalPlan]) -> None:
        listed = list(plans.values() if isinstance(plans, Mapping) else plans)
        for plan in listed:
            if not isinstance(plan, ConditionalPlan):
                made = "from_pairs makes one of conditions and skills, QueryProgram takes queries alone"
                raise TypeError(f"plans must hold ConditionalPlan, got {plan!r} ({type(plan).__name__}); {made}")
        for name, plan in plans.items() if isinstance(plans, Mapping) else ():
            if name != plan.task:
                raise PlanError(f"plans[{name!r}] is a plan for another task, {plan.task!r}")
        if len({plan.task for plan in listed}) != len(listed):
            raise PlanError("plans must hold one plan for each task")
        if not listed:
            raise PlanError("plans must hold at least one plan, got none")
        self._plans = {plan.task: plan for plan in sorted(listed, key=lambda p: p.task)}
        try:
            self.layout: Layout = one_layout(plan.definition for plan in listed)
        except ValueError as error:
            raise PlanError(str(error)) from None

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
        """S, the steps of the longest plan."""
        return max(len(plan.steps) for plan in self.values())

    @cached_property
    def skills(self) -> tuple[str, ...]:
        """Every skill text once, sorted."""
        return tuple(sorted({step.skill for plan in self.values() for step in plan.steps}))

    @property
    def task_ids(self) -> dict[str, int]:
        """The id of each task, see :func:`~lw_torchrl.task_id`."""
        return task_ids(self)

    @cached_property
    def has_roles(self) -> bool:
        """Whether every step has a role, as in the plans of :func:`~lw_torchrl.canonical_plans`."""
        return all(step.role is not None for plan in self.values() for step in plan.steps)

    @property
    def numbers(self) -> dict[str, int]:
        """A number for each task's plan, below 2**60: plans with another :attr:`fingerprint` have another number."""
        return {task: int(Plans([plan]).fingerprint[:15], 16) for task, plan in self.items()}

    @property
    def fingerprint(self) -> str:
        """32 hex digits of all that queries and attention depend on: each step's condition and skill, the number of
        steps, the objects of each task with their positions and offsets, and what each used relation means now.

        Plans with the same fingerprint give the same ``qaf``. Reasons and descriptions do not count.
        """
        used = {clause.predicate for plan in self.values() for step in plan.steps for clause in step.condition.clauses}

        def facts(plan: ConditionalPlan) -> dict[str, Any]:
            objects = [(one.name, one.position, list(map(float, one.offset))) for one in plan.definition.objects]
            return {"steps": [(str(step.condition), step.skill) for step in plan.steps], "objects": objects}

        told = {
            "steps": self.num_steps,
            "predicates": {name: [asdict(part) for part in comparisons(name, self.layout)] for name in sorted(used)},
            "plans": {task: facts(plan) for task, plan in self.items()},
        }
        if self.layout != METAWORLD:
            told["layout"] = self.layout.to_json()
        return sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:32]

    def to_json(self) -> dict[str, Any]:
        """Return each task's plan as :meth:`ConditionalPlan.to_json` has it."""
        return {task: plan.to_json() for task, plan in self.items()}

    @classmethod
    def from_json(cls, found: Any) -> Plans:
        """The plans of :meth:`to_json`; any other value is a :class:`PlanError`."""
        if not isinstance(found, dict):
            raise PlanError(f"plans must be an object of task names and plans, got {shown(found)}")
        return cls([ConditionalPlan.from_json(name, row) for name, row in found.items()])

    def differences(self, other: Plans) -> list[str]:
        """The common tasks whose plans have other fingerprints."""
        theirs = other.numbers
        return [task for task, number in self.numbers.items() if number != theirs.get(task, number)]

    def require(self, tasks: Iterable[str]) -> None:
        """Raise :class:`PlanError` if one of ``tasks`` has no plan here."""
        if missing := [task for task in tasks if task not in self]:
            what = f"plans lack {', '.join(missing)}; they cover {', '.join(self)}"
            raise PlanError(f"{what}. Load or write a plan for each task, or leave the task out.")


AnyPlans = Plans | Mapping[str, ConditionalPlan]
"""What an argument ``plans`` takes: :class:`Plans`, or a mapping from task names that they are made of."""


def as_plans(plans: AnyPlans, argument: str = "plans") -> Plans:
    """``plans`` as :class:`Plans`; a mapping is checked and copied. Errors name the argument."""
    if isinstance(plans, Plans):
        return plans
    if isinstance(plans, ConditionalPlan) or not isinstance(plans, Mapping):
        raise TypeError(f"{argument} must map task names to ConditionalPlan, got {type(plans).__name__}")
    try:
        return Plans(plans)
    except (TypeError, PlanError) as error:
        raise (error if argument == "plans" else type(error)(f"{argument}: {error}")) from None
