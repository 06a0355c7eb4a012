"""Answers on disk, ``DIR/<model>/<format>/<task>-<attempt>.<ext>``, a planner that reads them, and the cache."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from lw_torchrl._checks import check_choice, check_int, checked, counted, differences, shown, unknown_name
from lw_torchrl._files import JSON_LIMIT, AnyPath, parse_json, read_bytes, read_json, read_text, write_json, write_text
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plan_decoding import decode_plan
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import TaskList, named_tasks
from lw_torchrl.planners.answers import Answer, Answers, PlannerError, Reply, Tokens, is_count, read_reply, storable
from lw_torchrl.planners.prompts import Question

_VERSION = 1  # of the cache
_SETTINGS = "settings.json"
_FIELDS = {"llm": str, "format": str, "task": str, "attempt": int, "completion": str}
_Place = tuple[str, str, int]  # format, task, attempt


@checked
def folder_name(model: str) -> str:
    """A model's name as that of a folder: "meta-llama_Llama-3.1-8B"."""
    return re.sub(r"[^\w .+-]+", "_", model).strip(" ._")[:100].rstrip(" .") or "model"


@checked
def answer_path(folder: AnyPath, model: str, format: str, task: str, attempt: int) -> Path:
    """Where the answer of a model is kept."""
    return Path(folder) / folder_name(model) / format / f"{task}-{attempt}.{PLAN_FORMATS[format].extension}"


@checked
def write_answer(folder: AnyPath, model: str, answer: Answer) -> Path:
    """Write an answer to its place, whole or not at all; one that came in another form beside it, as .json."""
    path = answer_path(folder, model, answer.format, answer.task, answer.attempt)
    if answer.raw != answer.text:
        write_text(path.with_suffix(".json"), answer.raw)
    write_text(path, answer.text)
    return path


def settle_folder(folder: Path, settings: Mapping[str, Any], *, reading: bool = False) -> None:
    """Write what determines a model's answers to ``folder/settings.json``, unless it is there.

    A ValueError if the folder has answers of others; with ``reading``, only the model has to be the same.
    """
    file = folder / _SETTINGS
    there = read_json(file, "out: the settings") if file.is_file() else {}
    if there == settings:
        return
    if any(path for format, known in PLAN_FORMATS.items() for path in folder.glob(f"{format}/*.{known.extension}")):
        if reading and there.get("model", settings["model"]) == settings["model"]:
            return
        differ = ", ".join(differences(there, settings)) if there else f"it has no {_SETTINGS} that says which"
        how = "give these again, or the new answers another name (--name) or out"
        raise ValueError(f"out: {str(folder)!r} holds answers of other settings: {differ}; {how}")
    if not reading:
        write_json(file, dict(settings))


def recorded_answer(
    out: AnyPath, model: str, question: Question, format: str, kept: Reply | None, skills: Skills | None
) -> Answer | None:
    """The answer recorded in ``out/<model>``, if any; ``kept`` is the reply in the cache, which knows more of it."""
    path = answer_path(out, model, format, question.task.name, question.attempt)
    if not path.is_file():
        return None
    text, raw, schema = read_text(path, ValueError), path.with_suffix(".json"), question.request["schema"]
    replies = [(kept, schema)] if kept else []
    replies += [(Reply(read_text(raw, ValueError)), schema)] if schema and raw.is_file() else []
    for reply, held_to in [*replies, (Reply(text), None)]:
        answer = read_reply(reply, question.task, format, question.attempt, skills, held_to)
        if answer.text == text:
            break  # else the file was changed since
    return replace(answer, cached=True)


def recorded_answers(source: AnyPath) -> dict[str, dict[_Place, str | Path]]:
    """Models to their answers, or files of these, by format, task and attempt; errors as of :class:`FilePlanner`."""
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"source: there is no file or folder {str(path)!r}")
    if not (found := _of_folder(path) if path.is_dir() else _of_lines(path)):
        raise ValueError(f"source: {str(path)!r} holds no answers, <model>/<format>/<task>-<attempt>.<ext>")
    return found


def answer_text(found: str | Path) -> str:
    """The text of an answer that :func:`recorded_answers` gives."""
    return storable(read_text(found, ValueError) if isinstance(found, Path) else found)


def _of_folder(root: Path) -> dict[str, dict[_Place, str | Path]]:
    found: dict[str, dict[_Place, str | Path]] = {}
    for format, known in PLAN_FORMATS.items():
        for path in root.glob(f"*/{format}/*.{known.extension}"):
            named = re.fullmatch(r"([a-z][a-z0-9-]*)-(\d{1,9})", path.stem)
            if named and path.parts[-3][0] != ".":
                found.setdefault(path.parts[-3], {})[format, named[1], int(named[2])] = path
    return found


def _of_lines(file: Path) -> dict[str, dict[_Place, str | Path]]:
    found: dict[str, dict[_Place, str | Path]] = {}
    named: dict[str, str] = {}
    for number, line in enumerate(read_text(file, ValueError).split("\n"), 1):
        if not line.strip():
            continue
        where = f"{file.name}, line {number}"
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{where}: it is no JSON: {error}") from error
        if not isinstance(row, dict) or any(type(row.get(name)) is not kind for name, kind in _FIELDS.items()):
            raise ValueError(f"{where}: an answer has {', '.join(_FIELDS)}, got {shown(row)}")
        check_choice(f"{where}: format", row["format"], PLAN_FORMATS)
        if not 0 <= row["attempt"] < 10**9:
            raise ValueError(f"{where}: attempt must be from 0 to 999999999, got {shown(row['attempt'])}")
        name = folder_name(row["llm"])
        if named.setdefault(name, row["llm"]) != row["llm"]:
            both = f"the models {named[name]!r} and {row['llm']!r} would both be {name!r}"
            raise ValueError(f"{where}: {both}; give one of them another name")
        found.setdefault(name, {})[row["format"], row["task"], row["attempt"]] = row["completion"]
    return found


def answer_key(request: dict[str, Any]) -> str:
    """The name of an answer in the cache: 64 hex digits of all that determines it, in any order."""
    return sha256(json.dumps([_VERSION, request], sort_keys=True).encode()).hexdigest()


class AnswerCache:
    """Answers in a folder, each a JSON file with its question, so that nothing is asked twice."""

    def __init__(self, folder: AnyPath) -> None:
        self.folder = Path(folder)

    def path(self, request: dict[str, Any]) -> Path:
        return self.folder / (key := answer_key(request))[:2] / f"{key}.json"

    def read(self, request: dict[str, Any]) -> Reply | None:
        """The answer to a request, None if there is none yet; a file without it is a :class:`ValueError`."""
        path = self.path(request)
        try:
            return _reply(parse_json(read_bytes(path, JSON_LIMIT)), request)
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise ValueError(f"the kept answer {str(path)!r} cannot be read: {error}") from error

    def write(self, request: dict[str, Any], reply: Reply) -> None:
        """Keep an answer, whole or not at all; one that could not be read back is a :class:`ValueError`."""
        try:
            text = json.dumps({"request": request, "answer": asdict(reply)}, indent=2, allow_nan=False) + "\n"
            if len(text) > JSON_LIMIT:
                raise ValueError(f"it is larger than {JSON_LIMIT} bytes")
            if _reply(parse_json(text.encode()), request) != reply:
                raise ValueError("it would be read back as another")
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"the answer cannot be kept: {error}") from error
        write_text(self.path(request), text)


def _reply(found: dict[str, Any], request: dict[str, Any]) -> Reply:
    try:
        if answer_key(found["request"]) != answer_key(request):
            raise ValueError("it answers another request")
        said = found["answer"]
        reply = Reply(said["text"], said["finish"], said["refusal"], Tokens(**said["tokens"]), tuple(said["notes"]))
        texts = "".join((reply.text, reply.finish, reply.refusal, *reply.notes))
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(repr(error)) from error
    texts.encode()  # a lone surrogate goes into no file of an answer
    if not (is_count(reply.tokens.prompt) and is_count(reply.tokens.completion)):
        raise ValueError("its tokens must be integers from 0 to 2**53")
    return reply


@runtime_checkable
class Planner(Protocol):
    """Whatever writes plans: :class:`~lw_torchrl.OpenAIPlanner`, :class:`~lw_torchrl.FilePlanner`, or one of yours."""

    @property
    def name(self) -> str:
        """The model's name, fit for a folder's."""
        ...

    def plans(
        self, tasks: TaskList, *, format: str = "chain_py", attempts: int = 1, out: AnyPath | None = None
    ) -> Answers:
        """Plans of tasks, an answer for each task and attempt.

        Args:
            tasks: "MT10", "MT50", a task's name, a :class:`~lw_torchrl.Task`, or a list of names and tasks.
            format: a name in :data:`~lw_torchrl.PLAN_FORMATS`.
            attempts: answers to each question.
            out: a folder; each answer is written to ``out/<name>/<format>/<task>-<attempt>.<ext>`` as it comes.

        Raises:
            PlannerError: an answer is missing. Those that came before it are kept.
        """
        ...


class FilePlanner:
    """The recorded answers of one model.

    Args:
        source: a folder ``<model>/<format>/<task>-<attempt>.<ext>``, as planners write it; or a .jsonl file, on each
            line an object with "llm", "format", "task", "attempt" and "completion".
        model: whose answers; None where there is only one.

    Attributes:
        name: the model's name, fit for a folder's.
        recorded: (format, task, attempt) of each answer there is, sorted.

    Example:
        >>> import json, pathlib, lw_torchrl as lw
        >>> row = {"llm": "by hand", "format": "chain_py", "task": "push", "attempt": 0}
        >>> row["completion"] = lw.encode_plan(lw.load_plans("MT10")["push"], "chain_py")
        >>> _ = pathlib.Path("answers.jsonl").write_text(json.dumps(row))
        >>> planner = FilePlanner("answers.jsonl")
        >>> planner.name, planner.recorded
        ('by hand', (('chain_py', 'push', 0),))
        >>> planner.plans("push", format="chain_py")[0].decoded.plan == lw.load_plans("MT10")["push"]
        True
    """

    @checked
    def __init__(self, source: AnyPath, model: str | None = None) -> None:
        found = recorded_answers(source)
        if model is None and len(found) > 1:
            raise ValueError(f"model must be given, since {str(source)!r} has answers of {', '.join(sorted(found))}")
        name = next(iter(found)) if model is None else folder_name(model)
        if name not in found:
            raise unknown_name("model", model, sorted(found))
        self.name, self._found = name, found[name]
        self.recorded = tuple(sorted(self._found))

    def __repr__(self) -> str:
        return f"FilePlanner({self.name!r}, {counted(len(self.recorded), 'answer')})"

    def plans(
        self, tasks: TaskList, *, format: str = "chain_py", attempts: int = 1, out: AnyPath | None = None
    ) -> Answers:
        """The recorded answers, see :meth:`Planner.plans`; one that is not recorded is a :class:`PlannerError`."""
        check_choice("format", format, PLAN_FORMATS)
        wanted = range(check_int("attempts", attempts, minimum=1))
        found = []
        for name, task in named_tasks(tasks).items():
            for attempt in wanted:
                text = self._found.get((format, name, attempt))
                if text is None:
                    there = [str(number) for style, other, number in self.recorded if (style, other) == (format, name)]
                    known = f"attempts {', '.join(there)}" if there else f"none in {format}"
                    what = f"no answer of {self.name!r} is recorded for {name} in {format}, attempt {attempt}"
                    raise PlannerError(f"{what}; of {name} there are {known}")
                said = answer_text(text)
                found.append(Answer(name, format, attempt, said, said, decode_plan(said, task, format), cached=True))
                if out is not None:
                    write_answer(out, self.name, found[-1])
        return Answers(found)
