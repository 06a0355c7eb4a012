"""What is sent to a chat model: the prompt, before it how to answer, and further fields of the request."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from lw_torchrl._checks import shown
from lw_torchrl._files import parse_json
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.structured import write_structured
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.planners.prompts import plan_prompt, prompt_examples

_OWN_FIELDS = frozenset(
    [
        "max_completion_tokens",
        "max_tokens",
        "messages",
        "model",
        "n",
        "response_format",
        "seed",
        "stream",
        "temperature",
    ]
)


class Question(NamedTuple):
    """One question to a model.

    Attributes:
        task: that a plan is wanted for.
        attempt: which of several answers to the same question, from 0.
        request: all that determines the answer.
    """

    task: Task
    attempt: int
    request: dict[str, Any]

    def __str__(self) -> str:
        return f"{self.task.name}, attempt {self.attempt}"


def chat_messages(
    task: Task,
    format: str,
    *,
    plans: Plans | Mapping[str, ConditionalPlan] | None = None,
    vocabulary: bool = False,
    constrain: bool = False,
) -> list[dict[str, str]]:
    """The messages that ask for a plan.

    A prompt ends where a model that completes texts would go on; a chat model is told so by the system message.
    Where it is held to a schema, that shows the last example as JSON.

    Example:
        >>> from lw_torchrl.language.tasks import TASKS
        >>> [message["role"] for message in chat_messages(TASKS["drawer-open"], "chain_py")]
        ['system', 'user']
    """
    if constrain:
        example = prompt_examples(task, plans)[-1]
        how = (
            f"You write plans for a robot arm. Answer with the plan for `{task.name}` alone, as JSON. The plans that "
            f"you are shown are in another form; this is the one for `{example.task}` as JSON:\n"
            + write_structured(example, PLAN_FORMATS[format].style)
        )
    else:
        how = (
            f"You write plans for a robot arm. Answer with the plan for `{task.name}` alone, the whole of it, in the "
            "form of the plans that you are shown: no other tasks, and nothing before or after it."
        )
    prompt = plan_prompt(task, format, plans=plans, vocabulary=vocabulary)
    return [{"role": "system", "content": how}, {"role": "user", "content": prompt}]


def request_options(options: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Further fields of a request, as JSON has them, since the name of an answer is made of them.

    Raises:
        TypeError: they are no JSON.
        ValueError: one is a field that the planner sends itself.
    """
    if options is None:
        return None
    try:
        found = parse_json(json.dumps(dict(options), allow_nan=False, ensure_ascii=False).encode())
    except (TypeError, ValueError, RecursionError) as error:
        raise TypeError(f"options must be fields of a request, as JSON has them, got {shown(options)}") from error
    if taken := sorted(_OWN_FIELDS & set(found)):
        raise ValueError(f"options must be other fields than {', '.join(sorted(_OWN_FIELDS))}, got {', '.join(taken)}")
    return found or None
