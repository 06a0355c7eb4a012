"""PlannerError: no answer came, and why."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lw_torchrl._checks import counted


class PlannerError(RuntimeError):
    """A planner has no answer to a question: it says whose, to which question, what came, and what to try.

    Attributes:
        fatal: any other question to the same planner would end the same way, so none was asked after it.
    """

    def __init__(self, message: str, *, fatal: bool = False) -> None:
        super().__init__(message)
        self.fatal = fatal


def unanswered(errors: Sequence[Exception], came: int, total: int, folder: Path) -> Exception:
    """The error for questions of which some have no answer; the caller raises it.

    Args:
        errors: what each of these met with; one that is no :class:`PlannerError` goes first, as it is.
        came: how many answers there are.
        total: how many were wanted.
        folder: where those that came are kept.
    """
    first = next((error for error in errors if not isinstance(error, PlannerError)), errors[0])
    if not isinstance(first, PlannerError):
        return first
    others = f" So did {counted(len(errors) - 1, 'other question')}." if len(errors) > 1 else ""
    kept = f"{came} of {counted(total, 'answer')} are kept in {str(folder)!r}; the same again asks the rest"
    return PlannerError(f"{first}{others} {kept}.", fatal=first.fatal)
