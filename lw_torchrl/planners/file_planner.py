"""FilePlanner: answers that were recorded, as if they were asked for."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lw_torchrl._checks import check_choice, check_int, checked, counted, shown, unknown_name
from lw_torchrl._files import read_text
from lw_torchrl.language.decoding import decode_plan
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.tasks import Task, named_tasks
from lw_torchrl.planners.answers import Answer, Answers, folder_name, storable, write_answer
from lw_torchrl.planners.errors import PlannerError

_FIELDS = {"llm": str, "format": str, "task": str, "attempt": int, "completion": str}
_Place = tuple[str, str, int]  # format, task, attempt


class FilePlanner:
    """The recorded answers of one model.

    Args:
        source: a folder ``<model>/<format>/<task>-<attempt>.<ext>``, as planners write it; or a .jsonl file, on each
            line an object with "llm", "format", "task", "attempt" and "completion".
        model: whose answers; None where there is only one.

    Attributes:
        name: the model's name, fit for a folder's.
        recorded: (format, task, attempt) of each answer there is, sorted.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: no answers in it, or of several models and none is named; a line that is no answer; or two models
            whose names differ in what no folder's name can have.

    Example:
        >>> import json, lw_torchrl as lw
        >>> row = {"llm": "by hand", "format": "chain_py", "task": "push", "attempt": 0}
        >>> row["completion"] = lw.encode_plan(lw.load_plans("MT10")["push"], "chain_py")
        >>> _ = Path("answers.jsonl").write_text(json.dumps(row))
        >>> planner = FilePlanner("answers.jsonl")
        >>> planner.name, planner.recorded
        ('by hand', (('chain_py', 'push', 0),))
        >>> planner.plans("push", format="chain_py")[0].decoded.plan == lw.load_plans("MT10")["push"]
        True
    """

    @checked
    def __init__(self, source: str | os.PathLike[str], model: str | None = None) -> None:
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
        self,
        tasks: str | Task | Iterable[str | Task],
        *,
        format: str = "chain_py",
        attempts: int = 1,
        out: str | os.PathLike[str] | None = None,
    ) -> Answers:
        """The recorded answers, see :meth:`Planner.plans`.

        Raises:
            PlannerError: one is not recorded.
            ValueError: an unknown task or format, or a file that is no text.
        """
        check_choice("format", format, PLAN_FORMATS)
        wanted = range(check_int("attempts", attempts, minimum=1))
        found = []
        for name, task in named_tasks(tasks).items():
            for attempt in wanted:
                text = self._found.get((format, name, attempt))
                if text is None:
                    there = [str(number) for style, other, number in self.recorded if (style, other) == (format, name)]
                    known = f"attempts {', '.join(there)}" if there else f"none in {format}"
                    raise PlannerError(
                        f"no answer of {self.name!r} is recorded for {name} in {format}, attempt {attempt}; of {name} "
                        f"there are {known}"
                    )
                said = answer_text(text)
                found.append(Answer(name, format, attempt, said, said, decode_plan(said, task, format), cached=True))
                if out is not None:
                    write_answer(out, self.name, found[-1])
        return Answers(found)


def recorded_answers(source: str | os.PathLike[str]) -> dict[str, dict[_Place, str | Path]]:
    """Models to their answers, or files of these, by format, task and attempt; errors as of :class:`FilePlanner`."""
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"source: there is no file or folder {str(path)!r}")
    found = _of_folder(path) if path.is_dir() else _of_lines(path)
    if not found:
        raise ValueError(f"source: {str(path)!r} holds no answers, <model>/<format>/<task>-<attempt>.<ext>")
    return found


def ignored_files(source: str | os.PathLike[str]) -> list[Path]:
    """Files of a folder that lie where answers do and look like some, but have another name or ending."""
    root = Path(source)
    if not root.is_dir():
        return []
    read = {path for answers in _of_folder(root).values() for path in answers.values()}
    endings = {f".{known.extension}" for known in PLAN_FORMATS.values()} | {".txt"}
    return sorted(
        path
        for format in PLAN_FORMATS
        for path in root.glob(f"*/{format}/*")
        if path.suffix in endings and path not in read and path.name[0] != "." and path.parts[-3][0] != "."
    )


def answer_text(found: str | Path) -> str:
    """The text of an answer that :func:`recorded_answers` gives."""
    return storable(read_text(found, ValueError) if isinstance(found, Path) else found)


def _of_folder(root: Path) -> dict[str, dict[_Place, str | Path]]:
    """Models to the files of their answers; whatever else is in the folder is left alone."""
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
        row = _row(line, f"{file.name}, line {number}")
        name = folder_name(row["llm"])
        if named.setdefault(name, row["llm"]) != row["llm"]:
            raise ValueError(
                f"{file.name}, line {number}: the models {named[name]!r} and {row['llm']!r} would both be {name!r}; "
                "give one of them another name"
            )
        found.setdefault(name, {})[row["format"], row["task"], row["attempt"]] = row["completion"]
    return found


def _row(line: str, where: str) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: it is no JSON: {error}") from error
    for name, kind in _FIELDS.items():
        if not isinstance(row, dict) or type(row.get(name)) is not kind:
            raise ValueError(f"{where}: an answer has {', '.join(_FIELDS)}, got {shown(row)}")
    check_choice(f"{where}: format", row["format"], PLAN_FORMATS)
    if not 0 <= row["attempt"] < 10**9:
        raise ValueError(f"{where}: attempt must be from 0 to 999999999, got {shown(row['attempt'])}")
    return dict(row)
