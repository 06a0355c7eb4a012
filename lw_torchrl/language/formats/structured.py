"""Plans as JSON: what a model writes that is held to a schema, and what else looks like it."""

import json
import re
from typing import Any

from lw_torchrl._util.checks import shown
from lw_torchrl.language.formats.base import Clause, Reading, Style
from lw_torchrl.language.plan_text import one_line
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.queries import Query

_STEPS = re.compile(r'"steps"\s*:\s*\[')
_BETWEEN = re.compile(r"\s*,?\s*")


def write_structured(plan: ConditionalPlan, style: Style) -> str:
    """The plan as JSON in one line; :func:`read_structured` reads it back::

        {"steps": [{"because": "It has to come from above.",
                    "condition": [{"first": "the robot's gripper", "is": "not above", "second": "the puck"}],
                    "goal": [{"first": "the robot's gripper", "is": "above", "second": "the puck"}],
                    "skill": "place the gripper above the puck"}]}

    "because" is in the styles that explain, "goal" in the goal style. Some servers write names in alphabetical order.
    """
    steps = []
    for step, goal in zip(plan.steps, plan.goals, strict=True):
        said: dict[str, Any] = {"because": one_line(step.reason) or "It comes next"} if style.explains else {}
        said["condition"] = _clauses(step.condition)
        if style.goals:
            said["goal"] = _clauses(goal) if goal else []
        steps.append({**said, "skill": step.skill})
    return json.dumps({"steps": steps})


def _clauses(query: Query) -> list[dict[str, str]]:
    listed = []
    for clause in query.clauses:
        predicate = f"not {clause.predicate}" if clause.negated else clause.predicate
        said = {"first": f"the {clause.subject}", "is": predicate}
        listed.append(said if clause.object is None else {**said, "second": f"the {clause.object}"})
    return listed


def read_structured(text: str) -> Reading:
    """What a text says in this form, as far as it goes; it never raises. Conditions may also be sentences."""
    reading = Reading()
    found = _STEPS.search(text)
    if found is None:
        return reading
    decoder, at, line, counted = json.JSONDecoder(), found.end(), 1, 0
    while True:
        at = _BETWEEN.match(text, at).end()  # type: ignore[union-attr]
        line, counted = line + text.count("\n", counted, at), at
        if text.startswith("]", at):
            return reading
        try:
            step, at = decoder.raw_decode(text, at)
        except (ValueError, RecursionError):
            reading.note(line, f"the answer ends or is no JSON from here: {shown(text[at : at + 60])}")
            return reading
        clause = _clause(step, line)
        if clause is None:
            reading.note(line, f"a step without a condition or a skill is left out: {shown(step)}")
        else:
            reading.section.clauses.append(clause)


def _clause(step: Any, line: int) -> Clause | None:
    if not isinstance(step, dict):
        return None
    condition, skill, because = _said(step.get("condition")), step.get("skill"), step.get("because")
    if not condition or not isinstance(skill, str) or not skill.strip():
        return None
    reason = one_line(because) if isinstance(because, str) else ""
    return Clause(line, condition, one_line(skill), _said(step.get("goal")), reason)


def _said(value: Any) -> str:
    parts = []
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, dict):
            words = [one.get("first"), "is", one.get("is"), one.get("second")]
            parts.append(" ".join(word for word in words if isinstance(word, str)))
        elif isinstance(one, str):
            parts.append(one)
    return " and ".join(one_line(part) for part in parts if part.strip())
