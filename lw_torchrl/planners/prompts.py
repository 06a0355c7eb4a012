"""What a model is asked: prompts, for chat models the messages around them, and further fields of a request."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

from rapidfuzz.distance import Levenshtein

from lw_torchrl._checks import check_choice, checked, shown
from lw_torchrl._files import parse_json
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.structured import write_structured
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.relations import RELATIONS
from lw_torchrl.language.tasks import TASKS, Task, check_task

_ALWAYS = "pick-place"  # it has skills that many tasks need
_EXAMPLES = 3


@checked
def prompt_examples(
    task: str | Task, plans: Plans | Mapping[str, ConditionalPlan] | None = None, *, tasks: Mapping[str, Task] = TASKS
) -> tuple[ConditionalPlan, ...]:
    """The plans that a prompt shows: pick-place's, and those of the tasks whose descriptions are nearest in edits.

    They are up to three, without the task's own; the nearest last, so that it stands beside the question.

    Args:
        task, tasks: as for :func:`~lw_torchrl.decode_plan`.
        plans: to choose from; None for the hand-written ones of MT10.

    Example:
        >>> [plan.task for plan in prompt_examples("coffee-push")]
        ['pick-place', 'reach', 'push']

    Source: paper section 'Conditional Plan Generation'.
    """
    owner = task if isinstance(task, Task) else tasks[check_task(task, tasks)]
    known = example_plans(plans)
    others = [plan for name, plan in known.items() if name != owner.name]
    if not others:
        raise ValueError(f"plans must hold one of another task than {owner.name!r}, got none")

    def distance(plan: ConditionalPlan) -> tuple[bool, int]:
        return plan.task != _ALWAYS, Levenshtein.distance(plan.definition.description, owner.description)

    first, *nearest = sorted(others, key=distance)[:_EXAMPLES]
    return (first, *reversed(nearest)) if first.task == _ALWAYS else (*reversed(nearest), first)


def example_plans(plans: Plans | Mapping[str, ConditionalPlan] | None) -> Plans:
    """The plans that examples are chosen from; None for the hand-written ones of MT10."""
    return _load("MT10") if plans is None else as_plans(plans)


_load = cache(load_plans)


@checked
def plan_prompt(
    task: str | Task,
    format: str,
    *,
    plans: Plans | Mapping[str, ConditionalPlan] | None = None,
    vocabulary: bool = False,
    tasks: Mapping[str, Task] = TASKS,
) -> str:
    """The text that asks a language model for a plan.

    It shows the plans of :func:`prompt_examples`, and ends with the task's name and description, all in the format. A
    model that completes texts goes on from there; :func:`~lw_torchrl.decode_plan` reads its answer.

    Args:
        task, format, tasks: as for :func:`~lw_torchrl.decode_plan`.
        plans: the plans to choose the examples from; None for the hand-written ones of MT10.
        vocabulary: also say which things the task has, and what can be asked about them.

    Example:
        >>> print(plan_prompt("drawer-open", "chain_py").splitlines()[-2])
        # drawer-open: Take hold of the drawer handle and pull the drawer open.
    """
    owner = task if isinstance(task, Task) else tasks[check_task(task, tasks)]
    found = PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)]
    hints = (
        f"The things in {owner.name} are: {', '.join(f'the {name}' for name in owner.object_names)}.",
        f"A condition says that one of them is, or is not, {', '.join(RELATIONS)} another one, or touching the table;",
        "or that the robot's gripper is open or closed. Several conditions are joined by 'and'; there is no 'or'.",
    )
    return found.prompt(prompt_examples(owner, plans), owner, hints if vocabulary else ())


_OWN_FIELDS = {"max_completion_tokens", "max_tokens", "messages", "model", "n"}
_OWN_FIELDS |= {"response_format", "seed", "stream", "temperature"}


class Question(NamedTuple):
    """One question to a model."""

    task: Task
    attempt: int  # which of several answers to the same question, from 0
    request: dict[str, Any]  # all that determines the answer

    def __str__(self) -> str:
        return f"{self.task.name}, attempt {self.attempt}"


def chat_messages(
    task: Task,
    format: str,
    plans: Plans | Mapping[str, ConditionalPlan] | None = None,
    vocabulary: bool = False,
    constrain: bool = False,
) -> list[dict[str, str]]:
    """The messages that ask for a plan: a prompt, and a system message that tells a chat model how to go on from there.

    If the model is held to a schema, that shows the last example as JSON.
    """
    how = f"You write plans for a robot arm. Answer with the plan for `{task.name}` alone, "
    if constrain:
        example = prompt_examples(task, plans)[-1]
        how += f"as JSON. The plans that you are shown are in another form; this is the one for `{example.task}` as "
        how += "JSON:\n" + write_structured(example, PLAN_FORMATS[format].style)
    else:
        how += "the whole of it, in the form of the plans that you are shown: no other tasks, and nothing before or "
        how += "after it."
    prompt = plan_prompt(task, format, plans=plans, vocabulary=vocabulary)
    return [{"role": "system", "content": how}, {"role": "user", "content": prompt}]


def request_options(options: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Further fields of a request, as JSON has them; a field that the planner sends itself is a ValueError."""
    if options is None:
        return None
    try:
        found = parse_json(json.dumps(dict(options), allow_nan=False, ensure_ascii=False).encode())
    except (TypeError, ValueError, RecursionError) as error:
        raise TypeError(f"options must be fields of a request, as JSON has them, got {shown(options)}") from error
    if taken := sorted(_OWN_FIELDS & set(found)):
        raise ValueError(f"options must be other fields than {', '.join(sorted(_OWN_FIELDS))}, got {', '.join(taken)}")
    return found or None
