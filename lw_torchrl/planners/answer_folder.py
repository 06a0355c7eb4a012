"""The folder of a planner's answers: whose they are, and what lies there already. Answers of two runs never mix."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from lw_torchrl._checks import differences
from lw_torchrl._files import read_json, read_text, write_json
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.planners.answer_cache import Reply
from lw_torchrl.planners.answers import Answer, answer_path
from lw_torchrl.planners.questions import Question
from lw_torchrl.planners.replies import read_reply

SETTINGS = "settings.json"


def settle_folder(folder: Path, settings: Mapping[str, Any], *, reading: bool = False) -> None:
    """Write what determines answers beside them, as ``folder/settings.json``, unless it is there.

    Args:
        folder: of one model's answers, ``out/<name>``.
        settings: what determines them, as JSON has it.
        reading: nothing is to be written to it, so that the model alone has to be the same.

    Raises:
        ValueError: there are answers in it of other settings, or of settings that are not recorded.
    """
    file = folder / SETTINGS
    there = read_json(file, "out: the settings") if file.is_file() else {}
    if there == settings:
        return
    if any(path for format, known in PLAN_FORMATS.items() for path in folder.glob(f"{format}/*.{known.extension}")):
        if reading and there.get("model", settings["model"]) == settings["model"]:
            return
        differ = ", ".join(differences(there, settings)) if there else f"it has no {SETTINGS} that says which"
        raise ValueError(
            f"out: {str(folder)!r} holds answers of other settings: {differ}; give these again, or the new answers "
            "another name (--name) or out"
        )
    if not reading:
        write_json(file, dict(settings))


def recorded_answer(
    out: str | os.PathLike[str],
    model: str,
    question: Question,
    format: str,
    kept: Reply | None,
    skills: Mapping[str, ScriptedSkill] | None = None,
) -> Answer | None:
    """The answer to a question that is recorded in ``out/<model>``, None if there is none.

    Args:
        out, model, question, format: which one.
        kept: the reply it may come from, which knows more of it than the file; None if there is none.
        skills: as for :func:`~lw_torchrl.planners.replies.read_reply`.
    """
    path = answer_path(out, model, format, question.task.name, question.attempt)
    if not path.is_file():
        return None
    text, raw, schema = read_text(path, ValueError), path.with_suffix(".json"), question.request["schema"]
    replies = [] if kept is None else [(kept, schema)]
    if schema and raw.is_file():
        replies.append((Reply(read_text(raw, ValueError)), schema))
    for reply, held_to in [*replies, (Reply(text), None)]:
        answer = read_reply(reply, question.task, format, question.attempt, skills, held_to)
        if answer.text == text:
            break  # else the file was changed since
    return replace(answer, cached=True)


def already_answered(out: str | os.PathLike[str], model: str, answer: Answer) -> ValueError:
    """The error for an answer that another one would replace; the caller raises it."""
    path = answer_path(out, model, answer.format, answer.task, answer.attempt)
    return ValueError(
        f"out: {str(path)!r} is there already, the answer to another question; it is not replaced: give the new ones "
        "another name (--name) or out"
    )
