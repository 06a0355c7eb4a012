"""Planner, the protocol of whatever writes plans, and FilePlanner, recorded answers as if they were asked for."""

from __future__ import annotations

import os
from typing import Protocol, runtime_checkable

from lw_torchrl._checks import check_choice, check_int, checked, counted, unknown_name
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plan_decoding import decode_plan
from lw_torchrl.language.tasks import TaskList, named_tasks
from lw_torchrl.planners.answer_files import answer_text, folder_name, recorded_answers, write_answer
from lw_torchrl.planners.answers import Answer, Answers, PlannerError


@runtime_checkable
class Planner(Protocol):
    """Whatever writes plans: :class:`~lw_torchrl.OpenAIPlanner`, :class:`~lw_torchrl.FilePlanner`, or one of yours."""

    @property
    def name(self) -> str:
        """The model's name, fit for a folder's."""
        ...

    def plans(
        self, tasks: TaskList, *, format: str = "chain_py", attempts: int = 1, out: str | os.PathLike[str] | None = None
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
        self, tasks: TaskList, *, format: str = "chain_py", attempts: int = 1, out: str | os.PathLike[str] | None = None
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
