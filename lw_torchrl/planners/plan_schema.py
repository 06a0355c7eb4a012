"""A JSON Schema that only plans of one task pass: its base queries as conditions, its scripted skills."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from lw_torchrl._checks import check_choice, checked
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.queries import base_clauses
from lw_torchrl.language.relations import RELATIONS
from lw_torchrl.language.skills import ScriptedSkill, SkillError, skills_for
from lw_torchrl.language.tasks import TASKS, Task, check_task

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
    skills: Mapping[str, ScriptedSkill] | None = None,
    free_skills: bool = False,
    tasks: Mapping[str, Task] = TASKS,
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
    owner = task if isinstance(task, Task) else tasks[check_task(task, tasks)]
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
    for clause in base_clauses(task, tuple(RELATIONS)):
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
    rules = {"required": list(properties), "additionalProperties": False}
    return {"type": "object", "properties": properties, **rules}
