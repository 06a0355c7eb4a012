"""Answers of planners: what a server replied, the plan in it, and the error where there is none."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from lw_torchrl._checks import counted, shown
from lw_torchrl.language.formats import PLAN_FORMATS, encode_plan
from lw_torchrl.language.formats.structured import read_structured
from lw_torchrl.language.nearest import StepMapper
from lw_torchrl.language.plan_decoding import LIMIT, SKILL_LIMIT, DecodedPlan, decode_as
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import Task
from lw_torchrl.planners.prompts import passes

CUT_OFF = "it was cut off at max_tokens"


class PlannerError(RuntimeError):
    """A planner has no answer to a question: it says whose, to which question, what came, and what to try.

    Attributes:
        fatal: any other question to the same planner would end the same way, so none was asked after it.
    """

    def __init__(self, message: str, *, fatal: bool = False) -> None:
        super().__init__(message)
        self.fatal = fatal


def unanswered(errors: Sequence[Exception], came: int, total: int, folder: Path) -> Exception:
    """The error for questions without an answer, or the first that is no :class:`PlannerError`, as it is."""
    if not isinstance(first := min(errors, key=lambda error: isinstance(error, PlannerError)), PlannerError):
        return first
    others = f" So did {counted(len(errors) - 1, 'other question')}." if len(errors) > 1 else ""
    kept = f"{came} of {counted(total, 'answer')} are kept in {str(folder)!r}; the same again asks the rest"
    return PlannerError(f"{first}{others} {kept}.", fatal=first.fatal)


@dataclass(frozen=True)
class Tokens:
    """How many tokens of questions and of answers there were, as the server counts them; 0 if it does not."""

    prompt: int = 0
    completion: int = 0

    @property
    def total(self) -> int:
        return self.prompt + self.completion

    def __add__(self, other: Tokens) -> Tokens:
        return Tokens(self.prompt + other.prompt, self.completion + other.completion)


def is_count(value: object) -> TypeGuard[int]:
    """Whether it can be a number of tokens."""
    return type(value) is int and 0 <= value < 2**53


def storable(text: str) -> str:
    r"""A text as a file gives it back: without half characters and byte order marks, and with "\n" as line ends."""
    whole = text.encode("utf-8", "replace").decode()
    return whole.replace("\r\n", "\n").replace("\r", "\n").lstrip("\ufeff")


@dataclass(frozen=True)
class Reply:
    """What a server said."""

    text: str  # the answer; "" if there is none
    finish: str = ""  # why it ends, in the server's words: "stop", "length", "content_filter", ""
    refusal: str = ""  # what the model said instead of an answer
    tokens: Tokens = Tokens()
    notes: tuple[str, ...] = ()  # what was different from what was asked


@dataclass(frozen=True)
class Answer:
    """What a planner answered to one question."""

    task: str
    format: str  # that was asked for
    attempt: int  # which of several answers to the same question, from 0
    text: str  # the answer in the format, for :func:`~lw_torchrl.decode_plan`
    raw: str  # as it came; JSON if the model was held to a schema, else the same as ``text``
    decoded: DecodedPlan  # what was made of it
    tokens: Tokens = Tokens()  # what it cost when it was asked for
    cached: bool = False  # it had been asked for before
    notes: tuple[str, ...] = ()  # further remarks: it was cut off, the server did not keep to the schema


class Answers(tuple[Answer, ...]):
    """Answers in the order of formats, tasks and attempts."""

    def __new__(cls, answers: Iterable[Answer]) -> Answers:
        return super().__new__(cls, sorted(answers, key=lambda answer: (answer.format, answer.task, answer.attempt)))

    @property
    def tokens(self) -> Tokens:
        """Of all answers, cached ones included."""
        return sum((answer.tokens for answer in self), Tokens())

    def __repr__(self) -> str:
        plans = sum(answer.decoded.plan is not None for answer in self)
        return f"Answers({len(self)} answers, {plans} plans, {self.tokens.total} tokens)"


def read_reply(
    reply: Reply,
    task: Task,
    format: str,
    attempt: int = 0,
    skills: Skills | None = None,
    schema: Mapping[str, Any] | None = None,
) -> Answer:
    """The answer in a reply to a question for a plan; whatever the server claims, it is read as any text is.

    With a ``schema``, which the model was to be held to, JSON is expected, and becomes a text in the format.
    """
    read = PLAN_FORMATS[format].read if schema is None else read_structured
    raw = storable(reply.text)
    decoded = decode_as(raw, read, StepMapper(task, skills, "edit", LIMIT, SKILL_LIMIT))
    text = encode_plan(decoded.plan, format) if schema and decoded.plan is not None else raw
    ended = {"length": CUT_OFF, "content_filter": "a filter of the server cut it off"}
    notes = [ended[reply.finish]] if reply.finish in ended else []
    if reply.refusal:
        notes.append(f"the model refused: {shown(reply.refusal)}")
    elif not raw.strip():
        notes.append("it is empty")
    elif schema and reply.finish != "length":
        kept = False
        with suppress(ValueError, RecursionError):
            kept = passes(json.loads(raw), schema)
        notes += [] if kept else ["the server did not keep to the schema"]
    notes += reply.notes
    return Answer(task.name, format, attempt, storable(text), raw, decoded, reply.tokens, notes=tuple(notes))
