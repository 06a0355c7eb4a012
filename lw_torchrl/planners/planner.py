"""Planner: whatever writes plans."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from lw_torchrl.language.tasks import Task
from lw_torchrl.planners.answers import Answers


@runtime_checkable
class Planner(Protocol):
    """Whatever writes plans: :class:`~lw_torchrl.OpenAIPlanner`, :class:`~lw_torchrl.FilePlanner`, or one of yours.

    Attributes:
        name: the model's name, fit for a folder's.
    """

    @property
    def name(self) -> str: ...

    def plans(
        self,
        tasks: str | Task | Iterable[str | Task],
        *,
        format: str = "chain_py",
        attempts: int = 1,
        out: str | os.PathLike[str] | None = None,
    ) -> Answers:
        """Plans of tasks.

        Args:
            tasks: "MT10", "MT50", a task's name, a :class:`~lw_torchrl.Task`, or a list of names and tasks.
            format: a name in :data:`~lw_torchrl.PLAN_FORMATS`.
            attempts: answers to each question.
            out: a folder; each answer is written to ``out/<name>/<format>/<task>-<attempt>.<ext>`` as it comes.

        Returns:
            An answer for each task and attempt.

        Raises:
            PlannerError: an answer is missing. Those that came before it are kept.
            ValueError: an unknown task or format.
        """
        ...
