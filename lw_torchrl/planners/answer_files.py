"""Answers from language models: parsing, answer files, and a planner that replays recorded answers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from lw_torchrl._util.checks import Count, check_choice, check_value, shown, typed, unknown_name
from lw_torchrl._util.files import AnyPath, expanded, read_json, read_text, write_json, write_text
from lw_torchrl._util.reproducibility import differences
from lw_torchrl._util.text import counted
from lw_torchrl.language.formats import PLAN_FORMATS, encode_plan
from lw_torchrl.language.nearest import StepMapper
from lw_torchrl.language.plan_decoding import DecodedPlan, decode_as, decode_plan
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import Task, TaskList, named_tasks
from lw_torchrl.language.thoughts import without_thoughts
from lw_torchrl.planners.prompts import passes, read_structured

CUT_OFF = "the answer was cut off at max_tokens"
_CUT_OFF = {"length": CUT_OFF, "content_filter": "the server's content filter cut off the answer"}
_ROW = {"llm": str, "format": str, "task": str, "attempt": int, "completion": str}  # fields of a .jsonl row
_Place = tuple[str, str, int]  # (format, task, attempt)


class PlannerError(RuntimeError):
    """The error for a failed request to a planner; the message names the model, the task, the cause and a remedy.

    If ``fatal`` is true, every other request to the same planner would fail in the same way.
    """

    def __init__(self, message: str, *, fatal: bool = False) -> None:
        super().__init__(message)
        self.fatal = fatal


@dataclass(frozen=True)
class Tokens:
    """The numbers of prompt tokens and completion tokens that the server reported; 0 if it reported none."""

    prompt: int = 0
    completion: int = 0

    @property
    def total(self) -> int:
        """The sum of prompt tokens and completion tokens."""
        return self.prompt + self.completion

    def __add__(self, other: Tokens) -> Tokens:
        return Tokens(self.prompt + other.prompt, self.completion + other.completion)


@dataclass(frozen=True)
class Reply:
    """A server's reply to a request."""

    text: str  # the answer; "" if the reply has no answer
    finish: str = ""  # the server's finish_reason: "stop", "length", "content_filter", ""
    refusal: str = ""  # the model's refusal; "" if the model answered
    tokens: Tokens = field(default_factory=Tokens)
    notes: tuple[str, ...] = ()  # remarks about the server

    @property
    def is_answer(self) -> bool:
        """True if the model answered or refused. Other replies, such as reasoning without an answer, are not cached."""
        return bool(re.search(r"\w", without_thoughts(self.text, [])) or self.refusal.strip())


@dataclass(frozen=True)
class Answer:
    """A planner's answer to one request for a plan."""

    task: str
    format: str  # the requested format
    attempt: int  # the index of this answer among the answers to the same request
    text: str  # the answer in the format, for :func:`~lw_torchrl.decode_plan`
    raw: str  # the answer as the server sent it: JSON if the model was constrained, else equal to ``text``
    decoded: DecodedPlan  # the plan decoded from the answer
    tokens: Tokens = field(default_factory=Tokens)
    cached: bool = False  # whether the answer was read from a file, without a request
    notes: tuple[str, ...] = ()  # remarks, for example that the answer was cut off


class Answers(tuple[Answer, ...]):
    """A tuple of answers, sorted by format, task and attempt."""

    def __new__(cls, answers: Iterable[Answer]) -> Answers:
        return super().__new__(cls, sorted(answers, key=lambda answer: (answer.format, answer.task, answer.attempt)))

    @property
    def tokens(self) -> Tokens:
        """The token counts summed over all answers, including cached answers."""
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
    """Decode the plan in a reply. With a ``schema``, expect JSON in the reply and convert the JSON to ``format``."""
    read = PLAN_FORMATS[format].read if schema is None else read_structured
    raw = _storable(reply.text)
    decoded = decode_as(raw, read, StepMapper(task, skills))
    text = encode_plan(decoded.plan, format) if schema and decoded.plan is not None else raw
    notes = [_CUT_OFF[reply.finish]] if reply.finish in _CUT_OFF else []
    if reply.refusal:
        notes.append(f"the model refused: {shown(reply.refusal)}")
    elif not reply.is_answer:
        notes.append("the answer is empty")
    elif schema and reply.finish != "length":
        value = None
        with suppress(ValueError, RecursionError):
            value = json.loads(raw)
        notes += [] if passes(value, schema) else ["the answer does not follow the schema"]
    return Answer(task.name, format, attempt, _storable(text), raw, decoded, reply.tokens, notes=(*notes, *reply.notes))


def _storable(text: str) -> str:
    r"""Normalize a text for storage in a file: no lone surrogates, no byte order mark, and "\n" as the line ending."""
    text = text.encode("utf-8", "replace").decode()
    return text.replace("\r\n", "\n").replace("\r", "\n").lstrip("\ufeff")


@typed
def folder_name(model: str) -> str:
    """Convert a model's name to a folder name, such as "meta-llama_Llama-3.1-8B"."""
    return re.sub(r"[^\w .+-]+", "_", model).strip(" ._")[:100].rstrip(" .") or "model"


@typed
def answer_path(folder: AnyPath, model: str, format: str, task: str, attempt: int) -> Path:
    """Return the path of the file for a model's answer."""
    return expanded(folder) / folder_name(model) / format / f"{task}-{attempt}.{PLAN_FORMATS[format].extension}"


@typed
def write_answer(folder: AnyPath, model: str, answer: Answer) -> Path:
    """Write an answer (and the server's JSON, if any) to the folder, and return the answer's :func:`answer_path`."""
    path = answer_path(folder, model, answer.format, answer.task, answer.attempt)
    if answer.raw != answer.text:
        write_text(path.with_suffix(".json"), answer.raw)
    write_text(path, answer.text)
    return path


def write_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Write ``folder/settings.json``; raise a ValueError if the folder holds answers with different settings."""
    file = folder / "settings.json"
    if changed := differences(read_json(file, "out: the settings") if file.is_file() else settings, settings):
        what = f"out: {str(folder)!r} contains answers with different settings ({', '.join(changed)})"
        raise ValueError(f"{what}; use the earlier settings, or choose a new name (--name) or out folder")
    write_json(file, settings)


def recorded_answers(source: AnyPath) -> dict[str, dict[_Place, str | Path]]:
    """Map each model to its recorded answers (texts or files) by (format, task, attempt); see :class:`FilePlanner`."""
    path = expanded(source)
    if not path.exists():
        raise FileNotFoundError(f"source: no file or folder {str(path)!r}")
    answers: dict[str, dict[_Place, str | Path]] = {}
    for model, place, answer in _answers_in_folder(path) if path.is_dir() else _answers_in_lines(path):
        answers.setdefault(model, {})[place] = answer
    if not answers:
        raise ValueError(f"source: {str(path)!r} holds no answer files <model>/<format>/<task>-<attempt>.<ext>")
    return answers


def answer_text(answer: str | Path) -> str:
    """Return the text of an answer (a string or a file path) from :func:`recorded_answers`."""
    return _storable(read_text(answer, ValueError) if isinstance(answer, Path) else answer)


def _answers_in_folder(root: Path) -> Iterator[tuple[str, _Place, Path]]:
    """Yield (model, (format, task, attempt), path) for each answer file in a folder."""
    for name, format in PLAN_FORMATS.items():
        for path in root.glob(f"*/{name}/*.{format.extension}"):
            match = re.fullmatch(r"([a-z][a-z0-9-]*)-(\d{1,9})", path.stem)
            if match and path.parts[-3][0] != ".":
                yield path.parts[-3], (name, match[1], int(match[2])), path


def _answers_in_lines(file: Path) -> Iterator[tuple[str, _Place, str]]:
    """Yield (model, (format, task, attempt), text) for each line of a .jsonl file."""
    models: dict[str, str] = {}
    for number, line in enumerate(read_text(file, ValueError).split("\n"), 1):
        if not line.strip():
            continue
        where = f"{file.name}, line {number}"
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{where}: the line is not JSON: {error}") from error
        if not isinstance(row, dict) or any(type(row.get(name)) is not kind for name, kind in _ROW.items()):
            raise ValueError(f"{where}: an answer needs the fields {', '.join(_ROW)}, got {shown(row)}")
        check_choice(f"{where}: format", row["format"], PLAN_FORMATS)
        name = folder_name(row["llm"])
        if models.setdefault(name, row["llm"]) != row["llm"]:
            raise ValueError(f"{where}: models {models[name]!r} and {row['llm']!r} would have the same folder {name!r}")
        yield name, (row["format"], row["task"], row["attempt"]), row["completion"]


@runtime_checkable
class Planner(Protocol):
    """The interface of a planner, which writes plans: for example, :class:`~lw_torchrl.OpenAIPlanner`."""

    @property
    def name(self) -> str:
        """The name of the model, in the form of a folder name."""
        ...

    def plans(
        self, tasks: TaskList, *, format: str = "chain_py", attempts: int = 1, out: AnyPath | None = None
    ) -> Answers:
        """Write plans for tasks: one answer for each task and attempt.

        Args:
            tasks: "MT10", "MT50", a task's name, a :class:`~lw_torchrl.Task`, or a list of names and tasks.
            format: a name in :data:`~lw_torchrl.PLAN_FORMATS`.
            attempts: number of answers for each task.
            out: a folder; each answer is written to ``out/<name>/<format>/<task>-<attempt>.<ext>`` on arrival.

        Raises:
            PlannerError: an answer is missing; all other answers are kept.
        """
        ...


class FilePlanner:
    """A planner that replays the recorded answers of one model.

    Args:
        source: a folder with files ``<model>/<format>/<task>-<attempt>.<ext>``, as planners write them; or a .jsonl
            file with the keys "llm", "format", "task", "attempt" and "completion" on each line.
        model: the name of the model whose answers to load; None if the source has only one model.

    ``name`` is the model's name as a folder name. ``recorded`` is a sorted tuple of all (format, task, attempt).

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
            raise ValueError(f"model is required, since {str(source)!r} has several: {', '.join(sorted(answers))}")
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
        """Return the recorded answers for tasks; see :meth:`Planner.plans`."""
        check_choice("format", format, PLAN_FORMATS)
        answers = []
        for name, task in named_tasks(tasks).items():
            for attempt in range(check_value("attempts", attempts, Count)):
                if (format, name, attempt) not in self._answers:
                    recorded = [str(place[2]) for place in self.recorded if place[:2] == (format, name)]
                    what = f"no answer of {self.name!r} is recorded for {name} in {format}, attempt {attempt}"
                    raise PlannerError(f"{what}; recorded attempts: {', '.join(recorded) or 'none'}")
                text = answer_text(self._answers[format, name, attempt])
                decoded = decode_plan(text, task, format)
                answers.append(Answer(name, format, attempt, text, text, decoded, cached=True))
                if out is not None:
                    write_answer(out, self.name, answers[-1])
        return Answers(answers)
