"""Conditional plans: (condition, skill) pairs in English. :mod:`lw_torchrl.language.formats` defines their text
formats."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from hashlib import sha256
from typing import TYPE_CHECKING, Any

from lw_torchrl._util.checks import check_value, shown, typed, typed_fields
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.queries import Query, check_query, read_query
from lw_torchrl.language.relations import comparisons
from lw_torchrl.language.roles import StepRole
from lw_torchrl.language.skills import canonical_skill, load_skills
from lw_torchrl.language.tasks import TASKS, Task, check_task, get_task, one_layout, role_object, task_ids

if TYPE_CHECKING:
    from lw_torchrl.language.programs import Node

MOST_STEPS = 1_000  # maximum number of steps of a plan; the longest shipped plan has 6


class PlanError(ValueError):
    """The error for a text or a list of steps that is not a valid conditional plan."""


def one_line(text: str) -> str:
    """Join the lines of a text with spaces."""
    return " ".join(text.split())


def quote(text: str) -> str:
    """Put a text in double quotes, with its quotes and backslashes escaped."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def function_head(task: Task) -> str:
    """Return the first lines of a task's function: a comment with the task's description, and the ``def`` line."""
    name = task.name.replace("/", "__").replace("-", "_")
    return f"# {task.name}: {one_line(task.description)}\ndef {name}(robot):\n"


@lru_cache(maxsize=1024)
def usual_goal(skill: str, task: Task) -> Query | None:
    """Return the state that a scripted skill steers to; None for other skills, or if no query expresses that state."""
    scripted = load_skills().get(skill)
    return None if scripted is None else read_query(scripted.variants.get(task.name, scripted).goal, task)


@typed_fields
@dataclass(frozen=True)
class PlanStep:
    """A step of a plan: while ``condition`` is true, carry out ``skill``. Queries name objects of the plan's task."""

    condition: Query
    skill: str  # plain English, "place the gripper above the puck"
    reason: str = field(default="", compare=False)  # a comment for human readers, without effect on policies
    goal: Query | None = None  # the state to reach; None for the skill's usual goal, see ConditionalPlan.goals
    role: StepRole | None = None  # the action and its objects, in plans of :func:`~lw_torchrl.canonical_plan`

    def mentions(self, task: Task) -> set[str]:
        """Return the names of the objects that the condition or the skill mentions.

        The skill's objects come from the step's role, which calls the goal "target location". Without a role, they are
        found by name in the skill's text.
        """
        clauses = self.condition.clauses
        names = {name for clause in clauses for name in (clause.subject, clause.object) if name is not None}
        if self.role is not None:
            return names.union(self.role.objects)
        longest = sorted(task.object_names, key=len, reverse=True)  # "drawer handle" before "drawer"
        return names.union(re.findall(rf"(?<![\w-])(?:{'|'.join(map(re.escape, longest))})(?![\w-])", self.skill))


@typed_fields
@dataclass(frozen=True)
class ConditionalPlan:
    """A plan of 1 to 1,000 steps for one task; see the paper's section 'Conditional Plan Generation'.

    Conditions and skills are stored in canonical spelling (``str(query)``, "the" before nouns), so that parsing the
    plan's text returns an equal plan. Two plans are equal if their conditions, skills and goals are equal.

    Raises:
        PlanError: a condition, a skill or a role is not valid for the task; the message names the step.

    Example:
        >>> plan = ConditionalPlan.from_pairs("reach", [("gripper is open", "move the gripper to the target")])
        >>> plan.steps[0].skill
        'move the gripper to the target'
    """

    task: str
    steps: tuple[PlanStep, ...]
    # The task whose objects the conditions name; None for the shipped task called ``task``.
    definition: Task = field(default=None, compare=False, repr=False)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        task, plan = self.definition or TASKS[check_task(self.task)], f"plan {self.task!r}"
        if not 1 <= len(self.steps) <= MOST_STEPS:
            raise PlanError(f"{plan} must have 1 to {MOST_STEPS} steps, got {len(self.steps)}")
        if task.name != self.task:
            raise PlanError(f"definition of {plan} must define the task {self.task!r}, but it defines {task.name!r}")
        steps = []
        for number, step in enumerate(self.steps, 1):
            try:
                condition, skill = check_query(step.condition, task), canonical_skill(step.skill, task)
                goal = None if step.goal is None else check_query(step.goal, task)
                if goal is not None and goal.has_latch:
                    raise PlanError(f"a goal must not contain 'has been' or 'once'; use {str(goal.present)!r}")
                for name in () if step.role is None else step.role.objects:
                    role_object(task, name)
            except ValueError as error:
                raise PlanError(f"step {number} of {plan}: {error}") from error
            # Store the usual goal as None, so that a plan that states this goal equals a plan that omits it.
            goal = None if goal == usual_goal(skill, task) else goal
            steps.append(replace(step, condition=condition, skill=skill, goal=goal))
        object.__setattr__(self, "definition", task)
        object.__setattr__(self, "steps", tuple(steps))

    @classmethod
    def from_pairs(cls, task: str | Task, pairs: Iterable[tuple[str | Query, str]]) -> ConditionalPlan:
        """Build a plan from (condition, skill) pairs; a condition may be a text that :func:`parse_query` accepts."""
        definition = get_task(task)
        steps = tuple(PlanStep(check_query(query, definition), skill) for query, skill in pairs)
        return cls(definition.name, steps, definition)

    @classmethod
    def from_program(
        cls, program: str | Node, task: str | Task, library: Mapping[str, str] | None = None
    ) -> ConditionalPlan:
        """Build a plan from a program with control flow; the text is parsed, never executed.

        Each action becomes a step, guarded by all conditions on the path to it, as in :func:`~lw_torchrl.decode_plan`.
        That function also reports which parts of the text were left out.

        Args:
            program: Python, JSON, YAML or prose; or a tree of :mod:`lw_torchrl.language.programs`.
            library: programs that ``program`` may call, by name: {"grasp {object}": text}, or the shipped
                :data:`lw_torchrl.language.library.LIBRARY`; None for no library.

        Raises:
            PlanError: no action for the task can be parsed, the program nests too deeply, or a program of the library
                calls itself.

        Example:
            >>> program = '''
            ... def push(robot):
            ...     held = check("the gripper is around the puck") and check("the gripper is closed")
            ...     if held:
            ...         robot.slide("the puck to the target location")
            ...     elif check("the gripper is around the puck"):
            ...         robot.close("the gripper")
            ...     else:
            ...         robot.move("to the puck")
            ... '''
            >>> for step in ConditionalPlan.from_program(program, "push").steps[1:]:
            ...     print(step.condition, "->", step.skill)
            the robot's gripper is not closed and the robot's gripper is around the puck -> close the gripper
            the robot's gripper is not around the puck -> move to the puck
        """
        from lw_torchrl.language.plan_decoding import decode_program  # here, because it imports this module

        decoded = decode_program(program, get_task(task), library)
        if decoded.plan is None:
            raise PlanError("; ".join([decoded.reason, *(str(note) for note in decoded.notes[:3])]))
        return decoded.plan

    @property
    def goals(self) -> tuple[Query | None, ...]:
        """The state to reach in each step: the step's goal, else the skill's usual goal, else None."""
        return tuple(step.goal or usual_goal(step.skill, self.definition) for step in self.steps)

    def __str__(self) -> str:
        """Convert the plan to text in the chain_py format, which :func:`parse_plan` parses."""
        lines = []
        for step in self.steps:
            if reason := one_line(step.reason).lstrip("# "):
                lines.append(f"    # {reason}")
            verb, _, details = step.skill.partition(" ")
            goal = "" if step.goal is None else f", goal={quote(str(step.goal))}"
            lines += [f"    if check({quote(str(step.condition))}):", f"        robot.{verb}({quote(details)}{goal})"]
        return function_head(self.definition) + "".join(f"{line}\n" for line in lines)

    def to_json(self) -> dict[str, Any]:
        """Convert the plan to JSON: its text, its roles (if any), and its task (unless shipped)."""
        row: dict[str, Any] = {"plan": str(self)}
        if self.definition != TASKS.get(self.task):
            row["task"] = self.definition.to_json()
        if any(step.role for step in self.steps):
            row["roles"] = [step.role and step.role.to_json() for step in self.steps]
        return row

    @classmethod
    def from_json(cls, name: str, row: Any) -> ConditionalPlan:
        """Rebuild the plan for task ``name`` from :meth:`to_json`; raise a PlanError if ``row`` is not such JSON."""
        from lw_torchrl.language.plan_files import parse_plan  # here, because plan_files imports this module

        where = f"plan of {shown(name)}"
        keys = ("plan", "task", "roles", "confidence")  # earlier versions wrote a confidence; it is ignored
        if not isinstance(row, dict) or not isinstance(row.get("plan"), str) or set(row) - {*keys}:
            raise PlanError(f'{where} must be an object {{"plan": text, "task": object}}, got {shown(row)}')
        try:
            task = Task.from_json(name, row["task"]) if "task" in row else TASKS[check_task(name)]
            plan = parse_plan(row["plan"], name, where, {name: task})
            roles = row.get("roles", [None] * len(plan.steps))
            if not isinstance(roles, list) or len(roles) != len(plan.steps):
                raise ValueError(f"roles must be a list with one entry per step ({len(plan.steps)})")
            steps = [
                replace(step, role=None if role is None else StepRole.from_json(role))
                for step, role in zip(plan.steps, roles, strict=True)
            ]
            return replace(plan, steps=tuple(steps))
        except PlanError:
            raise
        except (ValueError, TypeError) as error:
            raise PlanError(f"{where}: {error}") from error


class Plans(Mapping[str, ConditionalPlan]):
    """An immutable mapping from sorted task names to plans. ``layout`` is the layout that all the tasks share."""

    @typed
    def __init__(self, plans: Mapping[str, ConditionalPlan] | Iterable[ConditionalPlan]) -> None:
        listed = list(plans.values() if isinstance(plans, Mapping) else plans)
        for name, plan in plans.items() if isinstance(plans, Mapping) else ():
            if name != plan.task:
                raise PlanError(f"plans[{name!r}] must be a plan for {name!r}, got a plan for {plan.task!r}")
        if not listed or len({plan.task for plan in listed}) != len(listed):
            raise PlanError(f"plans must hold at least one plan, and at most one per task, got {len(listed)} plans")
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
        """The number of steps S in the longest plan."""
        return max(len(plan.steps) for plan in self.values())

    @cached_property
    def skills(self) -> tuple[str, ...]:
        """The distinct skill texts of all plans, sorted."""
        return tuple(sorted({step.skill for plan in self.values() for step in plan.steps}))

    @property
    def task_ids(self) -> dict[str, int]:
        """The id of each task by name; see :func:`~lw_torchrl.task_id`."""
        return task_ids(self)

    @cached_property
    def has_roles(self) -> bool:
        """True if every step has a role, as in the plans that :func:`~lw_torchrl.canonical_plans` returns."""
        return all(step.role is not None for plan in self.values() for step in plan.steps)

    @property
    def numbers(self) -> dict[str, int]:
        """An integer below 2**60 for each task, derived from the :attr:`fingerprint` of the task's plan."""
        return {task: int(Plans([plan]).fingerprint[:15], 16) for task, plan in self.items()}

    @property
    def fingerprint(self) -> str:
        """A hash (32 hex digits) of everything that queries and attention depend on.

        The hash covers each step's condition and skill, the number of steps, the objects of each task with their
        positions and offsets, and the current definitions of the relations that the conditions use. Reasons and
        descriptions do not affect the hash. Plans with the same fingerprint give the same ``qaf``.
        """
        used = {clause.predicate for plan in self.values() for step in plan.steps for clause in step.condition.clauses}

        def facts(plan: ConditionalPlan) -> dict[str, Any]:
            objects = [
                (named.name, named.position, list(map(float, named.offset))) for named in plan.definition.objects
            ]
            return {"steps": [(str(step.condition), step.skill) for step in plan.steps], "objects": objects}

        content = {
            "steps": self.num_steps,
            "predicates": {name: [asdict(part) for part in comparisons(name, self.layout)] for name in sorted(used)},
            "plans": {task: facts(plan) for task, plan in self.items()},
        }
        if self.layout != METAWORLD:
            content["layout"] = self.layout.to_json()
        return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]

    def to_json(self) -> dict[str, Any]:
        """Convert the plans to JSON: task name to :meth:`ConditionalPlan.to_json`."""
        return {task: plan.to_json() for task, plan in self.items()}

    @classmethod
    def from_json(cls, row: Any) -> Plans:
        """Rebuild plans from the result of :meth:`to_json`; raise a PlanError if ``row`` has another form."""
        if not isinstance(row, dict):
            raise PlanError(f"plans must be an object that maps task names to plans, got {shown(row)}")
        return cls([ConditionalPlan.from_json(name, plan) for name, plan in row.items()])

    def differences(self, other: Plans) -> list[str]:
        """Return the tasks whose plans in the two collections have different fingerprints."""
        theirs = other.numbers
        return [task for task, number in self.numbers.items() if number != theirs.get(task, number)]

    def require(self, tasks: Iterable[str]) -> None:
        """Raise a PlanError if a task in ``tasks`` has no plan in this collection."""
        if missing := [task for task in tasks if task not in self]:
            raise PlanError(f"plans have no plan for {', '.join(missing)}; they cover {', '.join(self)}")


AnyPlans = Plans | Mapping[str, ConditionalPlan] | Sequence[ConditionalPlan]
"""The type of a ``plans`` argument: :class:`Plans`, a mapping from task names to plans, or a list of plans."""


def as_plans(plans: AnyPlans, argument: str = "plans") -> Plans:
    """Convert a mapping or a list of plans to :class:`Plans`; return Plans unchanged. Errors name the ``argument``."""
    if isinstance(plans, Plans):
        return plans
    check_value(argument, plans, Mapping | list | tuple)
    try:
        return Plans(plans)
    except (TypeError, PlanError) as error:
        raise (error if argument == "plans" else type(error)(f"{argument}: {error}")) from None
