"""Answers of language models: the plans in them, their files, and the planner that reads these."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from lw_torchrl._util.checks import Count, check_choice, check_value, counted, differences, shown, typed, unknown_name
from lw_torchrl._util.files import AnyPath, read_json, read_text, write_json, write_text
from lw_torchrl.language.formats import PLAN_FORMATS, encode_plan
from lw_torchrl.language.nearest import StepMapper
from lw_torchrl.language.plan_decoding import DecodedPlan, decode_as, decode_plan
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import Task, TaskList, named_tasks
from lw_torchrl.planners.prompts import passes, read_structured

CUT_OFF = "it was cut off at max_tokens"
_CUT_OFF = {"length": CUT_OFF, "content_filter": "the server's content filter cut it off"}
_ROW = {"llm": str, "format": str, "task": str, "attempt": int, "completion": str}  # of a .jsonl file
_Place = tuple[str, str, int]  # format, task, attempt


class PlannerError(RuntimeError):
    """A planner could not answer a question; the message names the model, the question, the cause and a remedy.

    After a ``fatal`` error, every other question to the same planner would fail in the same way.
    """

    def __init__(self, message: str, *, fatal: bool = False) -> None:
        super().__init__(message)
        self.fatal = fatal


@dataclass(frozen=True)
class Tokens:
    """The number of tokens of prompts and of answers, as counted by the server; 0 if it does not count."""

    prompt: int = 0
    completion: int = 0

    @property
    def total(self) -> int:
        return self.prompt + self.completion

    def __add__(self, other: Tokens) -> Tokens:
        return Tokens(self.prompt + other.prompt, self.completion + other.completion)


@dataclass(frozen=True)
class Reply:
    """A server's reply to a question."""

    text: str  # the answer; "" if there is none
    finish: str = ""  # the server's finish_reason: "stop", "length", "content_filter", ""
    refusal: str = ""  # the model's refusal
    tokens: Tokens = field(default_factory=Tokens)
    notes: tuple[str, ...] = ()  # remarks about the server


@dataclass(frozen=True)
class Answer:
    """A planner's answer to one question."""

    task: str
    format: str  # the requested format
    attempt: int  # the index of this answer among several to the same question
    text: str  # the answer in the format, for :func:`~lw_torchrl.decode_plan`
    raw: str  # the answer as the server sent it: JSON if the model was constrained, otherwise equal to ``text``
    decoded: DecodedPlan  # the plan that was read from it
    tokens: Tokens = field(default_factory=Tokens)
    cached: bool = False  # read from a file, without a request
    notes: tuple[str, ...] = ()  # remarks, such as that the answer was cut off


class Answers(tuple[Answer, ...]):
    """Answers, sorted by format, task and attempt."""

    def __new__(cls, answers: Iterable[Answer]) -> Answers:
        return super().__new__(cls, sorted(answers, key=lambda answer: (answer.format, answer.task, answer.attempt)))

    @property
    def tokens(self) -> Tokens:
        """The tokens of all answers, including cached ones."""
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
    """Read the plan in a reply. With a ``schema`` the reply should be JSON, which is rewritten in the format."""
    read = PLAN_FORMATS[format].read if schema is None else read_structured
    raw = _storable(reply.text)
    decoded = decode_as(raw, read, StepMapper(task, skills))
    text = encode_plan(decoded.plan, format) if schema and decoded.plan is not None else raw
    notes = [_CUT_OFF[reply.finish]] if reply.finish in _CUT_OFF else []
    if reply.refusal:
        notes.append(f"the model refused: {shown(reply.refusal)}")
    elif not raw.strip():
        notes.append("it is empty")
    elif schema and reply.finish != "length":
        valid = False
        with suppress(ValueError, RecursionError):
            valid = passes(json.loads(raw), schema)
        notes += [] if valid else ["the server did not keep to the schema"]
    return Answer(task.name, format, attempt, _storable(text), raw, decoded, reply.tokens, notes=(*notes, *reply.notes))


def _storable(text: str) -> str:
    r"""Return a text as a file gives it back: no lone surrogates or byte order mark, and "\n" as line end."""
    text = text.encode("utf-8", "replace").decode()
    return text.replace("\r\n", "\n").replace("\r", "\n").lstrip("\ufeff")


@typed
def folder_name(model: str) -> str:
    """Turn a model's name into a folder's: "meta-llama_Llama-3.1-8B"."""
    return re.sub(r"[^\w .+-]+", "_", model).strip(" ._")[:100].rstrip(" .") or "model"


@typed
def answer_path(folder: AnyPath, model: str, format: str, task: str, attempt: int) -> Path:
    """Return the path of a model's answer."""
    return Path(folder) / folder_name(model) / format / f"{task}-{attempt}.{PLAN_FORMATS[format].extension}"


@typed
def write_answer(folder: AnyPath, model: str, answer: Answer) -> Path:
    """Write an answer to its path; if the server sent JSON, also write that, as .json."""
    path = answer_path(folder, model, answer.format, answer.task, answer.attempt)
    if answer.raw != answer.text:
        write_text(path.with_suffix(".json"), answer.raw)
    write_text(path, answer.text)
    return path


def write_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Write ``folder/settings.json``; raise :class:`ValueError` if the folder holds answers with other settings."""
    file = folder / "settings.json"
    before = read_json(file, "out: the settings") if file.is_file() else settings
    if before != settings:
        difference = ", ".join(differences(before, settings))
        advice = "use these settings again, or give the new answers another name (--name) or out"
        raise ValueError(f"out: {str(folder)!r} holds answers of other settings: {difference}; {advice}")
    write_json(file, settings)


def recorded_answers(source: AnyPath) -> dict[str, dict[_Place, str | Path]]:
    """Return each model's answers, or their files, by format, task and attempt; see :class:`FilePlanner`."""
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"source: there is no file or folder {str(path)!r}")
    answers = defaultdict[str, dict[_Place, str | Path]](dict)
    for model, place, answer in _answers_in_folder(path) if path.is_dir() else _answers_in_lines(path):
        answers[model][place] = answer
    if not answers:
        raise ValueError(f"source: {str(path)!r} holds no answers, <model>/<format>/<task>-<attempt>.<ext>")
    return dict(answers)


def answer_text(answer: str | Path) -> str:
    """Return the text of an answer that :func:`recorded_answers` gives."""
    return _storable(read_text(answer, ValueError) if isinstance(answer, Path) else answer)


def _answers_in_folder(root: Path) -> Iterator[tuple[str, _Place, Path]]:
    for name, format in PLAN_FORMATS.items():
        for path in root.glob(f"*/{name}/*.{format.extension}"):
            match = re.fullmatch(r"([a-z][a-z0-9-]*)-(\d{1,9})", path.stem)
            if match and path.parts[-3][0] != ".":
                yield path.parts[-3], (name, match[1], int(match[2])), path


def _answers_in_lines(file: Path) -> Iterator[tuple[str, _Place, str]]:
    models: dict[str, str] = {}
    for number, line in enumerate(read_text(file, ValueError).split("\n"), 1):
        if not line.strip():
            continue
        where = f"{file.name}, line {number}"
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{where}: it is not JSON: {error}") from error
        if not isinstance(row, dict) or any(type(row.get(name)) is not kind for name, kind in _ROW.items()):
            raise ValueError(f"{where}: an answer needs {', '.join(_ROW)}, got {shown(row)}")
        check_choice(f"{where}: format", row["format"], PLAN_FORMATS)
        name = folder_name(row["llm"])
        if models.setdefault(name, row["llm"]) != row["llm"]:
            raise ValueError(f"{where}: the folders of {models[name]!r} and {row['llm']!r} would both be {name!r}")
        yield name, (row["format"], row["task"], row["attempt"]), row["completion"]


@runtime_checkable
class Planner(Protocol):
    """The interface of everything that writes plans, such as :class:`~lw_torchrl.OpenAIPlanner`."""

    @property
    def name(self) -> str:
        """The model's name, as a folder's name."""
        ...

    def plans(
        self, tasks: TaskList, *, format: str = "chain_py", attempts: int = 1, out: AnyPath | None = None
    ) -> Answers:
        """Write plans of tasks: one answer for each task and attempt.

        Args:
            tasks: "MT10", "MT50", a task's name, a :class:`~lw_torchrl.Task`, or a list of names and tasks.
            format: a name in :data:`~lw_torchrl.PLAN_FORMATS`.
            attempts: answers to each question.
            out: a folder; each answer is written to ``out/<name>/<format>/<task>-<attempt>.<ext>`` as it arrives.

        Raises:
            PlannerError: an answer is missing; the others are kept.
        """
        ...


class FilePlanner:
    """The recorded answers of one model.

    Args:
        source: a folder ``<model>/<format>/<task>-<attempt>.<ext>``, as planners write it; or a .jsonl file with an
            object of "llm", "format", "task", "attempt" and "completion" on each line.
        model: the model whose answers to read; None if there is only one.

    ``name`` is the model's name, as a folder's name; ``recorded`` has (format, task, attempt) of each answer, sorted.

    Example:
        >>> import json, pathlib, lw_torchrl as lw
        >>> row = {"llm": "by hand", "format": "chain_py", "task": "push", "attempt": 0}
        >>> row["completion"] = lw.encode_plan(lw.load_plans("MT10")["push"], "chain_py")
        >>> _ = pathlib.Path("answers.jsonl").write_text(json.dumps(row))
        >>> FilePlanner("answers.jsonl").plans("push", format="chain_py")[0].decoded.plan.task
        'push'
    """

    @typed
    def __init__(self, source: AnyPath, model: str | None = None) -> None:
        answers = recorded_answers(source)
        if model is None and len(answers) > 1:
            raise ValueError(f"model must be given, since {str(source)!r} has answers of {', '.join(sorted(answers))}")
        name = next(iter(answers)) if model is None else folder_name(model)
        if name not in answers:
            raise unknown_name("model", model, sorted(answers))
        self.name, self._answers = name, answers[name]
        self.recorded = tuple(sorted(self._answers))

    def __repr__(self) -> str:
        return f"FilePlanner({self.name!r}, {counted(len(self.recorded), 'answer')})"

    def plans(
        self, tasks: TaskList, *, format: str = "chain_py", attempts: int = 1, out: AnyPath | None = None
    ) -> Answers:
        """Return the recorded answers; see :meth:`Planner.plans`."""
        check_choice("format", format, PLAN_FORMATS)
        count = check_value("attempts", attempts, Count)
        answers = []
        for name, task in named_tasks(tasks).items():
            for attempt in range(count):
                if (format, name, attempt) not in self._answers:
                    recorded = [str(place[2]) for place in self.recorded if place[:2] == (format, name)]
                    what = f"no answer of {self.name!r} is recorded for {name} in {format}, attempt {attempt}"
                    raise PlannerError(f"{what}; there are attempts: {', '.join(recorded) or 'none'}")
                text = answer_text(self._answers[format, name, attempt])
                decoded = decode_plan(text, task, format)
                answers.append(Answer(name, format, attempt, text, text, decoded, cached=True))
                if out is not None:
                    write_answer(out, self.name, answers[-1])
        return Answers(answers)
