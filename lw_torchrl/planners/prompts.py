"""Prompts for plans, the messages around them, and the JSON Schema that only plans of one task satisfy."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

from rapidfuzz.distance import Levenshtein

from lw_torchrl._util.checks import check_choice, typed
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.structured import write_structured
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, Plans, as_plans
from lw_torchrl.language.queries import base_clauses
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
    """Return a system message that asks a chat model only for the plan, with the last example as JSON if the model is
    constrained to a schema, and the prompt."""
    how = (
        "the whole of it, in the form of the plans that you are shown: no other tasks, and nothing before or after it."
    )
    if constrain:
        example = prompt_examples(task, plans)[-1]
        json = write_structured(example, PLAN_FORMATS[format].style)
        how = "as JSON. The plans that you are shown are in another form; "
        how += f"this is the one for `{example.task}` as JSON:\n{json}"
    system = f"You write plans for a robot arm. Answer with the plan for `{task.name}` alone, {how}"
    prompt = plan_prompt(task, format, plans=plans, vocabulary=vocabulary)
    return [{"role": "system", "content": system}, {"role": "user", "content": prompt}]


# So that a model that repeats itself ends; the longest shipped plan has 6 steps, with conditions of up to 5 clauses.
MOST_STEPS, MOST_CLAUSES = 8, 5
_SKILL = "^[a-z]+( [a-z'-]+){1,12}$"
_BECAUSE = "^[A-Za-z0-9,.:;'-]+( [A-Za-z0-9,.:;'-]+){1,29}$"


@typed
def plan_schema(
    task: str | Task, format: str = "basic_py", *, skills: Skills | None = None, free_skills: bool = False
) -> dict[str, Any]:
    """Return the JSON Schema of plans of a task, as :mod:`~lw_torchrl.language.formats.structured` writes them.

    It uses only what the strict modes of OpenAI, vLLM, Ollama, llama.cpp and llama-cpp-python have in common. A clause
    is three choices, not one of hundreds: OpenAI allows 1,000 words to choose from; the largest task has 320.

    Args:
        format: determines the style: a reason before each clause if it explains, a goal in a goal format.
        skills: the scripted skills to choose from; None for the shipped ones. If none suits, it is a ValueError.
        free_skills: allow skills in any words.

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
        return any(passes(value, one) for one in schema["anyOf"])
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
