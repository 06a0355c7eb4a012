"""Prompts that request plans, plans as JSON, and JSON Schemas that restrict a model's output to plans for one task."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

from rapidfuzz.distance import Levenshtein

from lw_torchrl._util.checks import check_choice, shown, typed
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.base import Clause, Reading, Style
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, Plans, as_plans, one_line
from lw_torchrl.language.queries import Query, base_clauses
from lw_torchrl.language.relations import PREDICATES, RELATIONS, STATES
from lw_torchrl.language.skills import SkillError, Skills, skills_for
from lw_torchrl.language.tasks import TASKS, Task, Tasks, get_task

_ALWAYS = "pick-place"  # always an example, since many tasks need its skills
_EXAMPLES = 3


def prompt_examples(task: str | Task, plans: AnyPlans | None = None) -> tuple[ConditionalPlan, ...]:
    """Return the example plans for a prompt: the pick-place plan, and plans for tasks with similar descriptions.

    Up to three plans are returned, excluding the task's own. The task whose description is nearest by edit distance
    comes last, right before the request.

    Args:
        plans: the plans to choose from; None for the hand-written MT10 plans.

    Example:
        >>> [plan.task for plan in prompt_examples("coffee-push")]
        ['pick-place', 'reach', 'push']

    Source: paper section 'Conditional Plan Generation'.
    """
    owner = get_task(task)
    others = [plan for name, plan in example_plans(plans).items() if name != owner.name]
    if not others:
        raise ValueError(f"plans must hold a plan for a task other than {owner.name!r}, got only a plan for this task")

    def distance(plan: ConditionalPlan) -> tuple[bool, int]:
        return plan.task != _ALWAYS, Levenshtein.distance(plan.definition.description, owner.description)

    first, *nearest = sorted(others, key=distance)[:_EXAMPLES]
    return (first, *reversed(nearest)) if first.task == _ALWAYS else (*reversed(nearest), first)


@cache
def _shipped() -> Plans:
    return load_plans("MT10")


def example_plans(plans: AnyPlans | None) -> Plans:
    """Return the plans from which examples are chosen; ``plans=None`` selects the shipped MT10 plans."""
    return _shipped() if plans is None else as_plans(plans)


@typed
def plan_prompt(
    task: str | Task, format: str, *, plans: AnyPlans | None = None, vocabulary: bool = False, tasks: Tasks = TASKS
) -> str:
    """Build the prompt that requests a plan from a language model; :func:`~lw_torchrl.decode_plan` parses the answer.

    The prompt shows the plans from :func:`prompt_examples` in the requested format, then the task's name and
    description.

    Args:
        format: a name in :data:`~lw_torchrl.PLAN_FORMATS`.
        plans: see :func:`prompt_examples`.
        vocabulary: also list the task's objects and the relations between them.
        tasks: the known tasks by name, as from :func:`~lw_torchrl.load_tasks`.

    Example:
        >>> print(plan_prompt("drawer-open", "chain_py").splitlines()[-2])
        # drawer-open: Take hold of the drawer handle and pull the drawer open.
    """
    task = get_task(task, tasks)
    prompt = PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].prompt
    hints = (
        f"The things in {task.name} are: {', '.join(f'the {name}' for name in task.object_names)}.",
        f"A condition says that one of them is, or is not, {', '.join(RELATIONS)} another one, or touching the table;",
        f"or that the {' or '.join(task.openings)} is {' or '.join(STATES)}. "
        "Several conditions are joined by 'and'; there is no 'or'.",
    )
    return prompt(prompt_examples(task, plans), task, hints if vocabulary else ())


class Question(NamedTuple):
    """A request for a plan, with the task and the attempt."""

    task: Task
    attempt: int  # the index of the answer among the answers to the same request
    request: dict[str, Any]  # see OpenAIPlanner.request

    def __str__(self) -> str:
        return f"{self.task.name}, attempt {self.attempt}"


def chat_messages(
    task: Task, format: str, plans: AnyPlans | None, vocabulary: bool, constrain: bool
) -> list[dict[str, str]]:
    """Build a system message that requests only the plan, and a user message with the prompt.

    If the model's output is constrained, the system message also shows the last example as JSON.
    """
    how = (
        "the whole of it, in the form of the plans that you are shown: no other tasks, and nothing before or after it."
    )
    if constrain:
        example = prompt_examples(task, plans)[-1]
        how = "as JSON. The plans that you are shown are in another form; "
        how += f"this is the one for `{example.task}` as JSON:\n{write_structured(example, PLAN_FORMATS[format].style)}"
    system = f"You write plans for a robot arm. Answer with the plan for `{task.name}` alone, {how}"
    prompt = plan_prompt(task, format, plans=plans, vocabulary=vocabulary)
    return [{"role": "system", "content": system}, {"role": "user", "content": prompt}]


_STEPS = re.compile(r'"steps"\s*:\s*\[')
_BETWEEN = re.compile(r"\s*,?\s*")


def write_structured(plan: ConditionalPlan, style: Style) -> str:
    """Convert a plan to one line of JSON, which :func:`read_structured` parses::

        {"steps": [{"because": "It has to come from above.",
                    "condition": [{"first": "the robot's gripper", "is": "not above", "second": "the puck"}],
                    "goal": [{"first": "the robot's gripper", "is": "above", "second": "the puck"}],
                    "skill": "place the gripper above the puck"}]}

    Only styles with reasons have the key "because", and only the goal style has "goal". The keys are in alphabetical
    order, since some servers sort keys.
    """
    steps = []
    for step, goal in zip(plan.steps, plan.goals, strict=True):
        row: dict[str, Any] = {"because": one_line(step.reason) or "It comes next"} if style.explains else {}
        row["condition"] = _write_query(step.condition)
        if style.goals:
            row["goal"] = _write_query(goal) if goal else []
        steps.append({**row, "skill": step.skill})
    return json.dumps({"steps": steps})


def _write_query(query: Query) -> list[dict[str, str]] | str:
    """Convert a query to JSON: one object per clause of a conjunction, or a sentence for any other query."""
    if not query.is_conjunction or not query.clauses:
        return str(query)
    rows = []
    for clause in query.clauses:
        row = {"first": f"the {clause.subject}", "is": f"{'not ' if clause.negated else ''}{clause.predicate}"}
        rows.append(row if clause.object is None else {**row, "second": f"the {clause.object}"})
    return rows


def read_structured(text: str) -> Reading:
    """Parse the steps of a JSON plan up to the first error, without raising. Conditions may also be sentences."""
    reading = Reading()
    match = _STEPS.search(text)
    if match is None:
        return reading
    decoder, at, line, counted = json.JSONDecoder(), match.end(), 1, 0
    while True:
        at = _BETWEEN.match(text, at).end()  # type: ignore[union-attr]
        line, counted = line + text.count("\n", counted, at), at
        if text.startswith("]", at):
            return reading
        try:
            step, at = decoder.raw_decode(text, at)
        except (ValueError, RecursionError):
            reading.note(line, f"the answer ends or is not JSON from here: {shown(text[at : at + 60])}")
            return reading
        row = step if isinstance(step, dict) else {}
        condition, skill, reason = _read_query(row.get("condition")), row.get("skill"), row.get("because")
        if condition and isinstance(skill, str) and skill.strip():
            reason = one_line(reason) if isinstance(reason, str) else ""
            clause = Clause(line, condition, one_line(skill), _read_query(row.get("goal")), reason)
            reading.section.clauses.append(clause)
        else:
            reading.note(line, f"a step without a condition or without a skill is left out: {shown(step)}")


def _read_query(value: Any) -> str:
    """Convert the JSON of a query to text; "" if there is no clause."""
    texts = []
    for row in value if isinstance(value, list) else [value]:
        if isinstance(row, dict):
            words = [row.get("first"), "is", row.get("is"), row.get("second")]
            texts.append(" ".join(word for word in words if isinstance(word, str)))
        elif isinstance(row, str):
            texts.append(row)
    texts = [one_line(text) for text in texts if text.strip()]
    return " and ".join(f"({text})" if len(texts) > 1 and " or " in text else text for text in texts)


# Limits that cut off a model that repeats itself. Shipped plans have at most 6 steps with at most 5 clauses each.
MOST_STEPS, MOST_CLAUSES = 8, 5
_SKILL = "^[a-z]+( [a-z'-]+){1,12}$"
_BECAUSE = "^[A-Za-z0-9,.:;'-]+( [A-Za-z0-9,.:;'-]+){1,29}$"


@typed
def plan_schema(
    task: str | Task, format: str = "basic_py", *, skills: Skills | None = None, free_skills: bool = False
) -> dict[str, Any]:
    """Build the JSON Schema for a task's plans, in the form that :func:`write_structured` writes.

    The schema uses only features that the strict modes of OpenAI, vLLM, Ollama, llama.cpp and llama-cpp-python share.
    OpenAI allows 1,000 enum values in total. Therefore a clause has three fields with few values each, instead of one
    field with hundreds of values. The schema of the largest task has 320 values.

    Args:
        format: the format, whose style determines whether each step has a reason and a goal.
        skills: the scripted skills to choose from; None for the shipped skills.
        free_skills: allow free-form skills.

    Raises:
        SkillError: (a ValueError) the task can use no scripted skill.

    Example:
        >>> plan_schema("reach")["properties"]["steps"]["items"]["properties"]["skill"]["enum"][0]
        'hold the gripper at the reach target'
    """
    task = get_task(task)
    style = PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].style
    scripted = list(skills_for(task, skills))
    if not scripted and not free_skills:
        raise SkillError(f"task {task.name!r} can use no scripted skill; pass free_skills=True to allow any text")
    step: dict[str, Any] = {"because": {"type": "string", "pattern": _BECAUSE}} if style.explains else {}
    step["condition"] = _list({"anyOf": _clauses(task)}, MOST_CLAUSES)
    if style.goals:
        step["goal"] = {**step["condition"], "minItems": 0}  # the query language cannot express some goals
    step["skill"] = {"type": "string", "pattern": _SKILL} if free_skills else _choice(scripted)
    return _object({"steps": _list(_object(step), MOST_STEPS)})


def passes(value: Any, schema: Mapping[str, Any]) -> bool:
    """Return whether a JSON value follows a schema from :func:`plan_schema`."""
    if "anyOf" in schema:
        return any(passes(value, choice) for choice in schema["anyOf"])
    if "enum" in schema:
        return value in schema["enum"]
    if properties := schema.get("properties"):
        complete = isinstance(value, dict) and {*value} == {*properties}
        return complete and all(passes(value[name], properties[name]) for name in properties)
    if schema["type"] == "array":
        fits = isinstance(value, list) and schema["minItems"] <= len(value) <= schema["maxItems"]
        return fits and all(passes(item, schema["items"]) for item in value)
    return isinstance(value, str) and re.search(schema["pattern"], value) is not None


def _clauses(task: Task) -> list[dict[str, Any]]:
    """Build schemas for clauses that allow, for each subject and predicate, only the objects of supported queries."""
    seconds = defaultdict[tuple[str, str], list[str | None]](list)
    for clause in base_clauses(task, tuple(PREDICATES)):
        predicate = f"not {clause.predicate}" if clause.negated else clause.predicate
        seconds[clause.subject, predicate].append(clause.object)
    groups = defaultdict[tuple[str, tuple[str | None, ...]], list[str]](list)
    for (subject, predicate), objects in seconds.items():
        groups[subject, tuple(objects)].append(predicate)
    schemas = []
    for (subject, others), predicates in groups.items():
        second = {} if others == (None,) else {"second": _choice([f"the {name}" for name in others])}
        schemas.append(_object({"first": _choice([f"the {subject}"]), "is": _choice(predicates), **second}))
    return schemas


def _choice(words: list[str]) -> dict[str, Any]:
    """Build the schema of a string that is one of ``words``."""
    return {"type": "string", "enum": words}


def _list(items: dict[str, Any], most: int) -> dict[str, Any]:
    """Build the schema of a list of 1 to ``most`` items."""
    return {"type": "array", "items": items, "minItems": 1, "maxItems": most}


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    """Build the JSON schema of an object that requires these properties and allows no others."""
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}
