"""Answers of planners, and the folder that holds them: ``DIR/<model>/<format>/<task>-<attempt>.<ext>``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeGuard, overload

from lw_torchrl._checks import checked
from lw_torchrl._files import write_text
from lw_torchrl.language.decoded import DecodedPlan
from lw_torchrl.language.formats import PLAN_FORMATS


@dataclass(frozen=True)
class Tokens:
    """What was read and written, as the server counts it; 0 where it does not.

    Attributes:
        prompt: tokens of questions.
        completion: tokens of answers.
    """

    prompt: int = 0
    completion: int = 0

    @property
    def total(self) -> int:
        return self.prompt + self.completion

    def __add__(self, other: Tokens) -> Tokens:
        return Tokens(self.prompt + other.prompt, self.completion + other.completion)


NO_TOKENS = Tokens()


def is_count(value: object) -> TypeGuard[int]:
    """Whether it can be a number of tokens."""
    return type(value) is int and 0 <= value < 2**53


def storable(text: str) -> str:
    r"""A text as it reads once it was in a file: without half characters and marks of byte order, and its lines end in
    one way.

    Example:
        >>> storable("\ufeffone\r\ntwo \ud800")
        'one\ntwo ?'
    """
    whole = text.encode("utf-8", "replace").decode()
    return whole.replace("\r\n", "\n").replace("\r", "\n").lstrip("\ufeff")


@dataclass(frozen=True)
class Answer:
    """What a planner answered to one question.

    Attributes:
        task: the task's name.
        format: the format that was asked for.
        attempt: which of several answers to the same question, from 0.
        text: the answer in the format, for :func:`~lw_torchrl.decode_plan`.
        raw: as it came; JSON where the model was held to a schema, else the same as ``text``.
        decoded: what was made of it.
        tokens: what it cost when it was asked for.
        cached: it had been asked for before.
        notes: what else there is to say: that it was cut off, that the server did not keep to the schema.
    """

    task: str
    format: str
    attempt: int
    text: str
    raw: str
    decoded: DecodedPlan
    tokens: Tokens = NO_TOKENS
    cached: bool = False
    notes: tuple[str, ...] = ()


class Answers(Sequence[Answer]):
    """Answers in the order of tasks and attempts."""

    def __init__(self, answers: Iterable[Answer]) -> None:
        self._answers = tuple(sorted(answers, key=lambda answer: (answer.format, answer.task, answer.attempt)))

    @overload
    def __getitem__(self, index: int) -> Answer: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Answer]: ...

    def __getitem__(self, index: int | slice) -> Answer | Sequence[Answer]:
        return self._answers[index]

    def __len__(self) -> int:
        return len(self._answers)

    @property
    def tokens(self) -> Tokens:
        """Of all answers, whether they were cached or not."""
        return sum((answer.tokens for answer in self), NO_TOKENS)

    def __repr__(self) -> str:
        plans = sum(answer.decoded.plan is not None for answer in self)
        return f"Answers({len(self)} answers, {plans} plans, {self.tokens.total} tokens)"


@checked
def folder_name(model: str) -> str:
    """A model's name as that of a folder.

    Example:
        >>> folder_name("meta-llama/Llama-3.1-8B"), folder_name("PaLM 2")
        ('meta-llama_Llama-3.1-8B', 'PaLM 2')
    """
    return re.sub(r"[^\w .+-]+", "_", model).strip(" ._")[:100].rstrip(" .") or "model"


@checked
def answer_path(folder: str | os.PathLike[str], model: str, format: str, task: str, attempt: int) -> Path:
    """Where the answer of a model is kept."""
    return Path(folder) / folder_name(model) / format / f"{task}-{attempt}.{PLAN_FORMATS[format].extension}"


@checked
def write_answer(folder: str | os.PathLike[str], model: str, answer: Answer) -> Path:
    """Write an answer to its place, whole or not at all; one that came in another form beside it, as .json."""
    path = answer_path(folder, model, answer.format, answer.task, answer.attempt)
    if answer.raw != answer.text:
        write_text(path.with_suffix(".json"), answer.raw)
    write_text(path, answer.text)
    return path
