"""From what a server said to an answer: the plan in it, its text in the format, and what is to be said of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from lw_torchrl._checks import shown
from lw_torchrl.language.decoding import LIMIT, SKILL_LIMIT, decode_as
from lw_torchrl.language.formats import PLAN_FORMATS, encode_plan
from lw_torchrl.language.formats.structured import read_structured
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.step_mapping import StepMapper
from lw_torchrl.language.tasks import Task
from lw_torchrl.planners.answer_cache import Reply
from lw_torchrl.planners.answers import Answer, storable
from lw_torchrl.planners.plan_schema import passes

CUT_OFF = "it was cut off at max_tokens"


def read_reply(
    reply: Reply,
    task: Task,
    format: str,
    attempt: int = 0,
    skills: Mapping[str, ScriptedSkill] | None = None,
    schema: Mapping[str, Any] | None = None,
) -> Answer:
    """The answer in a reply; whatever the server claims, it is read as any text is.

    Args:
        reply: what the server said.
        task: the task that was asked for.
        format: the format that was asked for.
        attempt: which of several answers it is.
        skills: the scripted skills to choose from; None for the shipped ones.
        schema: what the model was to be held to; JSON is expected then, and becomes a text in the format.
    """
    read = PLAN_FORMATS[format].read if schema is None else read_structured
    raw = storable(reply.text)
    decoded = decode_as(raw, read, StepMapper(task, skills, "edit", LIMIT, SKILL_LIMIT))
    text = encode_plan(decoded.plan, format) if schema and decoded.plan is not None else raw
    notes = []
    if reply.finish == "length":
        notes.append(CUT_OFF)
    elif reply.finish == "content_filter":
        notes.append("a filter of the server cut it off")
    if reply.refusal:
        notes.append(f"the model refused: {shown(reply.refusal)}")
    elif not raw.strip():
        notes.append("it is empty")
    elif schema and reply.finish != "length" and not _passes(raw, schema):
        notes.append("the server did not keep to the schema")
    return Answer(
        task.name, format, attempt, storable(text), raw, decoded, reply.tokens, notes=(*notes, *reply.notes)
    )  # fmt: skip


def _passes(text: str, schema: Mapping[str, Any]) -> bool:
    try:
        return passes(json.loads(text), schema)
    except (ValueError, RecursionError):
        return False
