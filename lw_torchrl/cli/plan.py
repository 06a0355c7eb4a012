"""``lw-torchrl plan``: plans from language models, one command for each thing to do with them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lw_torchrl.cli.sources import read_plans, read_tasks


def prompt(
    task: Positional[Annotated[str, arg(metavar="TASK")]],
    /,
    format: str = "chain_py",
    vocabulary: bool = False,
    plans: tuple[str, ...] = ("MT10",),
    task_file: Path | None = None,
) -> None:
    """Print the text that asks a language model for a plan: plans of three other tasks, then the task.

    Example: lw-torchrl plan prompt drawer-open --format chain_py

    Args:
        task: the task that a plan is wanted for.
        format: how plans are written: basic, chain or goal, then _py, _py_md or _md.
        vocabulary: also say which things the task has, and what can be asked of them.
        plans: where the examples come from: MT10 or MT50 for the shipped plans, .plan files, .json files or folders.
        task_file: tasks of yours, instead of ours of the same name or beside ours.
    """
    from lw_torchrl.planners.prompts import plan_prompt

    known = read_tasks(task_file)
    found = plan_prompt(task, format, plans=read_plans(plans, known), vocabulary=vocabulary, tasks=known)
    print(found, end="")


COMMANDS: dict[str, Callable[..., None]] = {"prompt": prompt}


def plan() -> None:
    """Plans from language models: the prompt that asks for one."""
