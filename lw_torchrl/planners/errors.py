"""PlannerError: no answer came, and why."""

from __future__ import annotations


class PlannerError(RuntimeError):
    """A planner has no answer to a question: it says whose, to which question, what came, and what to try.

    Attributes:
        fatal: any other question to the same planner would end the same way, so none was asked after it.
    """

    def __init__(self, message: str, *, fatal: bool = False) -> None:
        super().__init__(message)
        self.fatal = fatal
