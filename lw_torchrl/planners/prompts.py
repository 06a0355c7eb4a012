"""Prompts: the plans of three other tasks, then the name and the description of the one that a plan is wanted for.

Source: paper section 'Conditional Plan Generation'.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from rapidfuzz.distance import Levenshtein

from lw_torchrl._checks import check_choice, checked, shown
from lw_torchrl.language.formats import PLAN_FORMATS
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
    """The plans that a prompt shows: of pick-place, and of those tasks whose descriptions are nearest by edit distance.

    Args:
        task: the task, or its name; its own plan is never among them.
        plans: to choose from; None for the hand-written ones of MT10.
        tasks: where a task's name is looked up, as from :func:`~lw_torchrl.load_tasks`.

    Returns:
        Three plans, or as many as there are for other tasks; the nearest last, so that it stands beside the question.

    Raises:
        ValueError: an unknown task, or there is no plan of another task.

    Example:
        >>> [plan.task for plan in prompt_examples("coffee-push")]
        ['pick-place', 'reach', 'push']
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
    return _hand_written() if plans is None else as_plans(plans)


@cache
def _hand_written() -> Plans:
    return load_plans("MT10")


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

    It shows the plans of :func:`prompt_examples`, and ends with the name and the description of the task, all of it in
    the format. A model that completes texts goes on from there; what it answers is for :func:`~lw_torchrl.decode_plan`.

    Args:
        task: the task, or its name.
        format: a name in :data:`~lw_torchrl.PLAN_FORMATS`.
        plans: the plans to choose the examples from; None for the hand-written ones of MT10.
        vocabulary: also say which things the task has, and what can be asked of them.
        tasks: where a task's name is looked up, as from :func:`~lw_torchrl.load_tasks`.

    Raises:
        ValueError: an unknown task or format, or ``plans`` hold none of another task.
        TypeError: ``vocabulary`` is no bool.

    Example:
        >>> print(plan_prompt("drawer-open", "chain_py").splitlines()[-2])
        # drawer-open: Take hold of the drawer handle and pull the drawer open.
    """
    if not isinstance(vocabulary, bool):
        raise TypeError(f"vocabulary must be True or False, got {shown(vocabulary)}")
    owner = task if isinstance(task, Task) else tasks[check_task(task, tasks)]
    found = PLAN_FORMATS[check_choice("format", format, PLAN_FORMATS)]
    return found.prompt(prompt_examples(owner, plans), owner, _vocabulary(owner) if vocabulary else ())


def _vocabulary(task: Task) -> tuple[str, ...]:
    return (
        f"The things in {task.name} are: {', '.join(f'the {name}' for name in task.object_names)}.",
        f"A condition says that one of them is, or is not, {', '.join(RELATIONS)} another one, or touching the table;",
        "or that the robot's gripper is open or closed. Several conditions are joined by 'and'; there is no 'or'.",
    )
