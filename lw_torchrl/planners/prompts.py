"""Prompts for plans, plans as JSON, and the JSON Schema that constrains a model to plans of one task."""

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

_ALWAYS = "pick-place"  # it has skills that many tasks need
_EXAMPLES = 3


@typed
def prompt_examples(task: str | Task, plans: AnyPlans | None = None) -> tuple[ConditionalPlan, ...]:
    """Return the plans that a prompt shows: pick-place's, and those of the tasks with the most similar descriptions.

    They are up to three, without the task's own. The nearest by edit distance comes last, next to the question.

    Args:
        plans: the plans to choose from; None for the hand-written ones of MT10.

    Example:
        >>> [plan.task for plan in prompt_examples("coffee-push")]
        ['pick-place', 'reach', 'push']

    Source: paper section 'Conditional Plan Generation'.
    """
    owner = get_task(task)
    others = [plan for name, plan in example_plans(plans).items() if name != owner.name]
    if not others:
        raise ValueError(f"plans must hold one of another task than {owner.name!r}, got none")

    def distance(plan: ConditionalPlan) -> tuple[bool, int]:
        return plan.task != _ALWAYS, Levenshtein.distance(plan.definition.description, owner.description)

    first, *nearest = sorted(others, key=distance)[:_EXAMPLES]
    return (first, *reversed(nearest)) if first.task == _ALWAYS else (*reversed(nearest), first)


@cache
def _shipped() -> Plans:
    return load_plans("MT10")


def example_plans(plans: AnyPlans | None) -> Plans:
    """Return the plans that examples are chosen from."""
    return _shipped() if plans is None else as_plans(plans)


@typed
def plan_prompt(
    task: str | Task, format: str, *, plans: AnyPlans | None = None, vocabulary: bool = False, tasks: Tasks = TASKS
) -> str:
    """Return the text that asks a language model for a plan, whose answer :func:`~lw_torchrl.decode_plan` reads.

    It shows the plans of :func:`prompt_examples`, and ends with the task's name and description, in the format.

    Args:
        plans: see :func:`prompt_examples`.
        vocabulary: also list the task's objects and the relations between them.
        tasks: the known tasks by name, as from :func:`~lw_torchrl.load_tasks`.

    Example:
        >>> print(plan_prompt("drawer-open", "chain_py").splitlines()[-2])
        # drawer-open: Take hold of the drawer handle and pull the drawer open.
    """
    task = get_task(task, tasks)
    check_choice("format", format, PLAN_FORMATS)
    hints = (
        f"The things in {task.name} are: {', '.join(f'the {name}' for name in task.object_names)}.",
        f"A condition says that one of them is, or is not, {', '.join(RELATIONS)} another one, or touching the table;",
        f"or that the {' or '.join(task.openings)} is {' or '.join(STATES)}. "
        "Several conditions are joined by 'and'; there is no 'or'.",
    )
    return PLAN_FORMATS[format].prompt(prompt_examples(task, plans), task, hints if vocabulary else ())


class Question(NamedTuple):
    """A question to a model."""

    task: Task
    attempt: int  # the index of this answer among several to the same question
    request: dict[str, Any]  # everything that determines the answer

    def __str__(self) -> str:
        return f"{self.task.name}, attempt {self.attempt}"


def chat_messages(
    task: Task, format: str, plans: AnyPlans | None, vocabulary: bool, constrain: bool
) -> list[dict[str, str]]:
    """Return a system message that asks for nothing but the plan, and the prompt as the user's message.

    For a model that is constrained to a schema, the system message shows the last example as JSON.
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
    """Write a plan as JSON in one line, which :func:`read_structured` reads back::

        {"steps": [{"because": "It has to come from above.",
                    "condition": [{"first": "the robot's gripper", "is": "not above", "second": "the puck"}],
                    "goal": [{"first": "the robot's gripper", "is": "above", "second": "the puck"}],
                    "skill": "place the gripper above the puck"}]}

    Styles that explain have "because", the goal style has "goal". The keys are in alphabetical order, in which some
    servers write them.
    """
    steps = []
    for step, goal in zip(plan.steps, plan.goals, strict=True):
        row: dict[str, Any] = {"because": one_line(step.reason) or "It comes next"} if style.explains else {}
        row["condition"] = _write_query(step.condition)
        if style.goals:
            row["goal"] = _write_query(goal) if goal else []
        steps.append({**row, "skill": step.skill})
    return json.dumps({"steps": steps})


def _write_query(query: Query) -> list[dict[str, str]]:
    rows = []
    for clause in query.clauses:
        row = {"first": f"the {clause.subject}", "is": f"{'not ' if clause.negated else ''}{clause.predicate}"}
        rows.append(row if clause.object is None else {**row, "second": f"the {clause.object}"})
    return rows


def read_structured(text: str) -> Reading:
    """Read the steps of a plan as JSON, up to the first fault; it never raises. Conditions may also be sentences."""
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
            reading.note(line, f"a step without a condition or a skill is left out: {shown(step)}")


def _read_query(value: Any) -> str:
    texts = []
    for row in value if isinstance(value, list) else [value]:
        if isinstance(row, dict):
            words = [row.get("first"), "is", row.get("is"), row.get("second")]
            texts.append(" ".join(word for word in words if isinstance(word, str)))
        elif isinstance(row, str):
            texts.append(row)
    return " and ".join(one_line(text) for text in texts if text.strip())


# Limits end the answer of a model that repeats itself; the longest shipped plan has 6 steps, of up to 5 clauses.
MOST_STEPS, MOST_CLAUSES = 8, 5
_SKILL = "^[a-z]+( [a-z'-]+){1,12}$"
_BECAUSE = "^[A-Za-z0-9,.:;'-]+( [A-Za-z0-9,.:;'-]+){1,29}$"


@typed
def plan_schema(
    task: str | Task, format: str = "basic_py", *, skills: Skills | None = None, free_skills: bool = False
) -> dict[str, Any]:
    """Return the JSON Schema of plans of a task, as :func:`write_structured` writes them.

    It uses only what the strict modes of OpenAI, vLLM, Ollama, llama.cpp and llama-cpp-python have in common. A clause
    is three choices, not one of hundreds: OpenAI allows 1,000 words to choose from; the largest task has 320.

    Args:
        format: determines the style: a reason before each clause if it explains, a goal in a goal format.
        skills: the scripted skills to choose from; None for the shipped ones.
        free_skills: allow skills in any words.

    Raises:
        SkillError: (a ValueError) no scripted skill suits the task.

    Example:
        >>> plan_schema("reach")["properties"]["steps"]["items"]["properties"]["skill"]["enum"][0]
        'hold the gripper at the reach target'
    """
    task = get_task(task)
    style = PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].style
    scripted = list(skills_for(task, skills))
    if not scripted and not free_skills:
        raise SkillError(f"no scripted skill suits task {task.name!r}; free_skills=True takes any words")
    step: dict[str, Any] = {"because": {"type": "string", "pattern": _BECAUSE}} if style.explains else {}
    step["condition"] = _list({"anyOf": _clauses(task)}, MOST_CLAUSES)
    if style.goals:
        step["goal"] = {**step["condition"], "minItems": 0}  # the query language cannot express some goals
    step["skill"] = {"type": "string", "pattern": _SKILL} if free_skills else _choice(scripted)
    return _object({"steps": _list(_object(step), MOST_STEPS)})


def passes(value: Any, schema: Mapping[str, Any]) -> bool:
    """Check JSON against a schema of :func:`plan_schema`."""
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
    """Return schemas for the base queries: for each subject and predicate, only the objects that complete a query."""
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
    return {"type": "string", "enum": words}


def _list(items: dict[str, Any], most: int) -> dict[str, Any]:
    return {"type": "array", "items": items, "minItems": 1, "maxItems": most}


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}
