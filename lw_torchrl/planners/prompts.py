"""What a model is asked: prompts, the messages around them, and the JSON Schema that only plans of one task pass."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

from rapidfuzz.distance import Levenshtein

from lw_torchrl._checks import check_choice, checked, shown
from lw_torchrl._files import parse_json
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


@checked
def prompt_examples(
    task: str | Task, plans: AnyPlans | None = None, *, tasks: Tasks = TASKS
) -> tuple[ConditionalPlan, ...]:
    """The plans that a prompt shows: pick-place's, and those of the tasks whose descriptions are nearest in edits.

    They are up to three, without the task's own; the nearest last, so that it stands beside the question.

    Args:
        task, tasks: as for :func:`~lw_torchrl.decode_plan`.
        plans: to choose from; None for the hand-written ones of MT10.

    Example:
        >>> [plan.task for plan in prompt_examples("coffee-push")]
        ['pick-place', 'reach', 'push']

    Source: paper section 'Conditional Plan Generation'.
    """
    owner = get_task(task, tasks)
    others = [plan for name, plan in example_plans(plans).items() if name != owner.name]
    if not others:
        raise ValueError(f"plans must hold one of another task than {owner.name!r}, got none")

    def distance(plan: ConditionalPlan) -> tuple[bool, int]:
        return plan.task != _ALWAYS, Levenshtein.distance(plan.definition.description, owner.description)

    first, *nearest = sorted(others, key=distance)[:_EXAMPLES]
    return (first, *reversed(nearest)) if first.task == _ALWAYS else (*reversed(nearest), first)


def example_plans(plans: AnyPlans | None) -> Plans:
    """The plans that examples are chosen from; None for the hand-written ones of MT10."""
    return _load("MT10") if plans is None else as_plans(plans)


_load = cache(load_plans)


@checked
def plan_prompt(
    task: str | Task, format: str, *, plans: AnyPlans | None = None, vocabulary: bool = False, tasks: Tasks = TASKS
) -> str:
    """The text that asks a language model for a plan.

    It shows the plans of :func:`prompt_examples`, and ends with the task's name and description, all in the format. A
    model that completes texts goes on from there; :func:`~lw_torchrl.decode_plan` reads its answer.

    Args:
        task, format, tasks: as for :func:`~lw_torchrl.decode_plan`.
        plans: the plans to choose the examples from; None for the hand-written ones of MT10.
        vocabulary: also say which things the task has, and what can be asked about them.

    Example:
        >>> print(plan_prompt("drawer-open", "chain_py").splitlines()[-2])
        # drawer-open: Take hold of the drawer handle and pull the drawer open.
    """
    owner = get_task(task, tasks)
    found = PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)]
    hints = (
        f"The things in {owner.name} are: {', '.join(f'the {name}' for name in owner.object_names)}.",
        f"A condition says that one of them is, or is not, {', '.join(RELATIONS)} another one, or touching the table;",
        f"or that the {' or '.join(owner.openings)} is {' or '.join(STATES)}. "
        "Several conditions are joined by 'and'; there is no 'or'.",
    )
    return found.prompt(prompt_examples(owner, plans), owner, hints if vocabulary else ())


_OWN_FIELDS = {"max_completion_tokens", "max_tokens", "messages", "model", "n"}
_OWN_FIELDS |= {"response_format", "seed", "stream", "temperature"}


class Question(NamedTuple):
    """One question to a model."""

    task: Task
    attempt: int  # which of several answers to the same question, from 0
    request: dict[str, Any]  # all that determines the answer

    def __str__(self) -> str:
        return f"{self.task.name}, attempt {self.attempt}"


def chat_messages(
    task: Task, format: str, plans: AnyPlans | None, vocabulary: bool, constrain: bool
) -> list[dict[str, str]]:
    """The messages that ask for a plan: a prompt, and a system message that tells a chat model how to go on from there.

    If the model is held to a schema, that shows the last example as JSON.
    """
    how = f"You write plans for a robot arm. Answer with the plan for `{task.name}` alone, "
    if constrain:
        example = prompt_examples(task, plans)[-1]
        how += f"as JSON. The plans that you are shown are in another form; this is the one for `{example.task}` as "
        how += "JSON:\n" + write_structured(example, PLAN_FORMATS[format].style)
    else:
        how += "the whole of it, in the form of the plans that you are shown: no other tasks, and nothing before or "
        how += "after it."
    prompt = plan_prompt(task, format, plans=plans, vocabulary=vocabulary)
    return [{"role": "system", "content": how}, {"role": "user", "content": prompt}]


def request_options(options: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Further fields of a request, as JSON has them; a field that the planner sends itself is a ValueError."""
    if options is None:
        return None
    try:
        found = parse_json(json.dumps(dict(options), allow_nan=False, ensure_ascii=False).encode())
    except (TypeError, ValueError, RecursionError) as error:
        raise TypeError(f"options must be fields of a request, as JSON has them, got {shown(options)}") from error
    if taken := sorted(_OWN_FIELDS & set(found)):
        raise ValueError(f"options must be other fields than {', '.join(sorted(_OWN_FIELDS))}, got {', '.join(taken)}")
    return found or None


MOST_STEPS, MOST_CLAUSES = 8, 5
"""So that a model that repeats itself comes to an end; the longest shipped plan has 6 steps, its conditions up to 5."""
_SKILL = "^[a-z]+( [a-z'-]+){1,12}$"
_BECAUSE = "^[A-Za-z0-9,.:;'-]+( [A-Za-z0-9,.:;'-]+){1,29}$"
PATTERNS = frozenset([_SKILL, _BECAUSE])


@checked
def plan_schema(
    task: str | Task,
    format: str = "basic_py",
    *,
    skills: Skills | None = None,
    free_skills: bool = False,
    tasks: Tasks = TASKS,
) -> dict[str, Any]:
    """The JSON Schema of plans of a task, as :mod:`~lw_torchrl.language.formats.structured` writes them.

    It uses only what the strict modes of OpenAI, vLLM, Ollama, llama.cpp and llama-cpp-python all know. A clause is
    three choices, not one of hundreds: OpenAI takes at most 1,000 words to choose from; the largest task has 320.

    Args:
        task, tasks: as for :func:`~lw_torchrl.decode_plan`.
        format: gives the style: a reason before each clause if it explains, the state to reach in a goal format.
        skills: the scripted skills to choose from; None for the shipped ones. If none suits, it is a ValueError.
        free_skills: skills in any words instead.

    Example:
        >>> schema = plan_schema("reach")
        >>> step = schema["properties"]["steps"]["items"]["properties"]
        >>> step["condition"]["items"]["anyOf"][0]["properties"]["is"]["enum"][:2]
        ['near', 'not near']
        >>> step["skill"]["enum"][0]
        'hold the gripper at the reach target'
    """
    owner = get_task(task, tasks)
    style = PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)].style
    offered = list(skills_for(owner, skills))
    if not offered and not free_skills:
        raise SkillError(f"no scripted skill suits task {owner.name!r}; free_skills=True takes any words")
    step: dict[str, Any] = {"because": {"type": "string", "pattern": _BECAUSE}} if style.explains else {}
    step["condition"] = _listed({"anyOf": _clauses(owner)}, MOST_CLAUSES)
    if style.goals:
        step["goal"] = {**step["condition"], "minItems": 0}  # the language has no words for some
    step["skill"] = {"type": "string", "pattern": _SKILL} if free_skills else _one_of(offered)
    return _object({"steps": _listed(_object(step), MOST_STEPS)})


def passes(value: Any, schema: Mapping[str, Any]) -> bool:
    """Whether JSON passes a schema of :func:`plan_schema`, whatever a server claims of it."""
    if "anyOf" in schema:
        return any(passes(value, one) for one in schema["anyOf"])
    if "enum" in schema:
        return value in schema["enum"]
    if schema["type"] == "object":
        known = schema["properties"]
        whole = isinstance(value, dict) and {*value} == {*known}
        return whole and all(passes(value[name], known[name]) for name in known)
    if schema["type"] == "array":
        fits = isinstance(value, list) and schema["minItems"] <= len(value) <= schema["maxItems"]
        return fits and all(passes(one, schema["items"]) for one in value)
    return isinstance(value, str) and re.search(schema["pattern"], value) is not None


def _clauses(task: Task) -> list[dict[str, Any]]:
    """The base queries: for each thing what it can be, and to which others, so that no choice is a wrong one."""
    others: dict[tuple[str, str], list[str | None]] = {}
    for clause in base_clauses(task, tuple(PREDICATES)):
        said = f"not {clause.predicate}" if clause.negated else clause.predicate
        others.setdefault((clause.subject, said), []).append(clause.object)
    alike: dict[tuple[str, tuple[str | None, ...]], list[str]] = {}
    for (subject, said), listed in others.items():
        alike.setdefault((subject, tuple(listed)), []).append(said)
    found = []
    for (subject, objects), words in alike.items():
        clause_of = {"first": _one_of([f"the {subject}"]), "is": _one_of(words)}
        if objects != (None,):
            clause_of["second"] = _one_of([f"the {name}" for name in objects])
        found.append(_object(clause_of))
    return found


def _one_of(words: list[str]) -> dict[str, Any]:
    return {"type": "string", "enum": words}


def _listed(items: dict[str, Any], most: int) -> dict[str, Any]:
    return {"type": "array", "items": items, "minItems": 1, "maxItems": most}


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}
