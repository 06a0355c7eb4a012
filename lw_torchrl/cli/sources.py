"""What a user brings to a command, under the same option everywhere: --task-file, --plans, --skill-file,
--text-encoder."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from lw_torchrl.language.plans import Plans
    from lw_torchrl.language.tasks import Task
    from lw_torchrl.language.text import TextEncoder
    from lw_torchrl.modules.policy import Policy

SETS = ("MT10", "MT50")


def one_or_many(names: tuple[str, ...]) -> str | tuple[str, ...]:
    """MT10 is a set, not a list of one name."""
    return names[0] if len(names) == 1 else names


def read_tasks(task_file: Path | None) -> Mapping[str, Task]:
    """The 50 tasks, with those of --task-file in their place or beside them."""
    from lw_torchrl.language.task_files import load_tasks
    from lw_torchrl.language.tasks import TASKS

    return TASKS if task_file is None else load_tasks(task_file)


def simulated(argument: str, names: str | Sequence[str], known: Mapping[str, Task]) -> tuple[str, ...]:
    """The tasks behind ``names``, sorted, all of which the simulator has.

    Raises:
        ValueError: one is not among ``known``, or is a task of the user's that the simulator lacks.
    """
    from lw_torchrl.language.tasks import TASKS, resolve_tasks

    given = [names] if isinstance(names, str) else names
    if own := [name for name in given if name not in (*SETS, *TASKS) and name in known]:
        raise ValueError(
            f"{argument}: the simulator has no {', '.join(own)}; tasks of your own run in an engine of yours, in "
            "Python: docs/training.md"
        )
    try:
        return resolve_tasks(names, tasks=TASKS)
    except ValueError as error:
        if all(name in (*SETS, *TASKS) for name in given):
            raise
        raise ValueError(f"{error}. The simulator has no others") from error


def read_plans(sources: Sequence[str], tasks: Mapping[str, Task], skills: Literal["own", "MT10"] = "own") -> Plans:
    """The plans of --plans: MT10, MT50, files and folders; where two have a plan for a task, the later one's counts.

    A shipped plan that counts is carried over to the task of that name in ``tasks``.

    Raises:
        PlanError: (a ValueError) a source holds no valid plans, or a shipped one names what a task of the user's lacks.
    """
    from lw_torchrl.language.plan_files import load_plans
    from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans

    found: dict[str, ConditionalPlan] = {}
    for source in sources:
        try:
            found.update(load_plans(source, skills=skills) if source in SETS else load_plans(source, tasks=tasks))
        except PlanError as error:
            raise PlanError(f"--plans {source}: {error}") from error
    if not found:
        raise ValueError("--plans must name at least one source of plans: MT10, MT50, a file or a folder")
    for task, plan in found.items():
        if plan.definition != tasks[task]:
            try:
                found[task] = ConditionalPlan(task, plan.steps, tasks[task])
            except PlanError as error:
                raise PlanError(
                    f"--plans {' '.join(sources)}: the plan of {task!r} that counts is the shipped one, which does not "
                    f"fit the {task!r} of --task-file; name a plan of yours for it, last ({error})"
                ) from error
    return Plans(found)


def read_encoder(name: str | None) -> TextEncoder | None:
    """The function that --text-encoder names, "package.module:function"; the working folder is searched first.

    Raises:
        ValueError: it is no such name, or names nothing that can be called.
    """
    if name is None:
        return None
    module, _, function = name.partition(":")
    if not module or not function.isidentifier():
        raise ValueError(f"--text-encoder must be like my_texts:encode, a module and a function, got {name!r}")
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        found: Any = getattr(import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"--text-encoder {name!r} names no function: {error}") from error
    if not callable(found):
        raise ValueError(f"--text-encoder {name!r} must name a function, it names {type(found).__name__}")
    return found


def make_logger(kind: Literal["csv", "tensorboard", "wandb"], out: Path) -> Any:
    """The TorchRL logger of --logger, in a folder beside ``out``."""
    from torchrl.record import loggers

    folder = out.parent / "logs"
    try:
        if kind == "csv":
            return loggers.CSVLogger(exp_name=out.stem, log_dir=str(folder))
        if kind == "tensorboard":
            from torchrl.record.loggers.tensorboard import TensorboardLogger

            return TensorboardLogger(exp_name=out.stem, log_dir=str(folder))
        from torchrl.record.loggers.wandb import WandbLogger

        return WandbLogger(exp_name=out.stem, save_dir=str(folder))
    except ImportError as error:
        raise ImportError(f"--logger {kind} needs the package {kind}: pip install {kind}") from error


def load_policy(checkpoint: Path, seed: int, plans: Plans | None, text_encoder: str | None) -> Policy:
    """The policy of a file, with the plans that are given; none that has seen the seed's states."""
    import lw_torchrl as lw
    from lw_torchrl.trainers.checkpoint import demonstration_seeds

    if seed in demonstration_seeds(checkpoint):
        raise ValueError(f"seed must differ from the demonstrations' seed, {seed}; an evaluation wants fresh states")
    policy = lw.load_actor(checkpoint, text_encoder=read_encoder(text_encoder))
    return policy if plans is None else policy.with_plans(plans)
