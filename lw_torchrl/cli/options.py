"""Options that mean the same in every command: the user's files, plans, policies and encoders; places to write to.

What names and files alone can tell is checked without torch.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from tyro.conf import arg

import lw_torchrl as lw
from lw_torchrl._checks import check_choice, unknown_name
from lw_torchrl._files import absent_policy, read_text, shipped_policy
from lw_torchrl._registry import entry_points_of
from lw_torchrl.cli.parsing import own_module
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.plan_text import PLAN_LIMIT
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import TASKS, Task, load_tasks, resolve_tasks

if TYPE_CHECKING:
    from lw_torchrl.language.text import TextEncoder

Loaded = TypeVar("Loaded")
SETS = ("MT10", "MT50")
ACTORS = ("expert", "scripted", "spoilt-60", "spoilt-30", "wrong", "random")
"""The names of :data:`lw_torchrl.data.BEHAVIOURS`."""
CONDITIONS = ("pcbc", "dc", "one-hot")
"""Our names of :data:`lw_torchrl.modules.METHODS`."""
_PLAN = re.compile(r"^def[ \t]+([a-z]\w*)[ \t]*\(", re.MULTILINE)
_METHODS = (
    "pcbc, by plan; or a baseline: dc, by description, one-hot, by number; or a class of yours (docs/extending.md)."
)
Condition = Annotated[str, arg(metavar="NAME", help=f"how policies are conditioned: {_METHODS}")]

Json = Annotated[bool, arg(help="print one JSON document instead, see docs/cli.md.")]
TaskFile = Annotated[Path | None, arg(help="a file of your tasks, which replace ours of the same name or join them.")]
SkillFile = Annotated[Path | None, arg(help="a file of your skills, which replace ours of the same text or join them.")]
EncoderName = Annotated[str | None, arg(help="your function from texts to vectors, as my_texts:encode.")]
OwnEncoder = Annotated[str | None, arg(help="the function of yours, if any, it was trained with, as my_texts:encode.")]
_SUITES = "the suite that has the tasks, fetch for example, or yours, as my_module:suite."
SuiteName = Annotated[str | None, arg(help=_SUITES)]
_SPEED = "of a policy that was trained with another robot: times the metres a step that it moved there."
Speed = Annotated[float, arg(help=_SPEED)]
_DEVICES = "where networks work: cpu; cuda, or cuda:1 for the second of several; mps, a Mac's; or auto, the GPU if "
Device = Annotated[str, arg(help=f"{_DEVICES}there is one. The simulation is always on the CPU.")]
_PLANS = "MT10 or MT50 for the shipped plans, .plan files, .json files of pairs, or folders. "
PlanSources = Annotated[tuple[str, ...], arg(help=f"{_PLANS}If several have a plan for a task, the last one counts.")]
File = Annotated[Path, arg(metavar="FILE")]
Names = Annotated[tuple[str, ...], arg(metavar="[NAMES ...]")]
Text = Annotated[str | None, arg(metavar="[TEXT]")]
TaskNames = Annotated[tuple[str, ...], arg(metavar="TASKS ...", help="MT10, MT50, or names of tasks.")]


def one_or_many(names: tuple[str, ...]) -> str | tuple[str, ...]:
    """MT10 is a set, not a list of one name; a suite's name stands for all its tasks."""
    if len(names) != 1:
        return names
    suite = read_suite(None, names)
    return names[0] if suite is None or names[0] != suite.name else tuple(suite.tasks)


def read_tasks(task_file: Path | None, names: Sequence[str] = ()) -> Mapping[str, Task]:
    """The tasks of the suite that ``names`` are of, or the 50, which those of --task-file replace or join."""
    if (suite := read_suite(None, names)) is None:
        return TASKS if task_file is None else _load("--task-file", task_file, load_tasks)
    if task_file is not None:
        raise ValueError(f"--task-file is for tasks of Meta-World, those named are of the suite {suite.name}")
    return suite.tasks


def tasks_of(files: Sequence[Path], task_file: Path | None) -> Mapping[str, Task]:
    """The tasks that plan files, all of one suite, may speak of: the suite's, else as :func:`read_tasks`."""
    from lw_torchrl.suites.suite import SUITES

    found: dict[str, tuple[str, str]] = {}  # a suite to the first file of it, and that one's task
    for file in files:
        written = file.is_file() and file.suffix == ".plan"
        if written and (plan := _PLAN.search(read_text(file, PlanError, limit=PLAN_LIMIT))):
            task = plan[1].replace("__", "/", 1).replace("_", "-")
            suite = task.partition("/")[0] if "/" in task else ""
            found.setdefault(suite if suite in SUITES else "metaworld", (file.name, task))
    if len(found) > 1:
        told = " and ".join(f"{suite} ({file})" for suite, (file, _) in found.items())
        raise ValueError(f"plans must be of one suite, got plans of {told}; give each suite's a folder of its own")
    return read_tasks(task_file, tuple(task for suite, (_, task) in found.items() if suite != "metaworld"))


def read_skills(skill_file: Path | None, tasks: Mapping[str, Task]) -> Mapping[str, ScriptedSkill]:
    """The scripted skills of the suite that ``tasks`` are of, with those of --skill-file."""
    own = {} if skill_file is None else _load("--skill-file", skill_file, partial(load_skills, tasks=tasks))
    if (suite := _suite_of(tasks)) is None:
        return own or load_skills()
    shipped = load_skills()
    return {**(suite.skills or {}), **{text: skill for text, skill in own.items() if shipped.get(text) != skill}}


def _load(option: str, file: Path, load: Callable[[Path], Loaded]) -> Loaded:
    """What ``load`` reads from a file; errors name the option that it is of."""
    if not file.is_file():
        raise FileNotFoundError(f"{option}: there is no file {str(file)!r}")
    try:
        return load(file)
    except ValueError as error:
        raise ValueError(f"{option} {error}") from error


def simulated(
    argument: str, names: str | Sequence[str], known: Mapping[str, Task], suite: lw.suites.Suite | None = None
) -> tuple[str, ...]:
    """The tasks behind ``names``, sorted; a task of the user's that the simulator lacks is refused."""
    given = [names] if isinstance(names, str) else names
    if (there := suite or read_suite(None, given)) is not None:
        return tuple(there.named_tasks(names))
    if own := [name for name in given if name not in (*SETS, *TASKS) and name in known]:
        raise ValueError(
            f"{argument}: the simulator has no {', '.join(own)}; "
            "tasks of your own run in a suite of yours: docs/extending.md"
        )
    return resolve_tasks(names, tasks=TASKS)


def read_plans(
    sources: Sequence[str],
    tasks: Mapping[str, Task],
    skills: Literal["own", "MT10"] = "own",
    *,
    option: str = "--plans",
) -> Plans:
    """The plans of an option, of which the last for a task counts; shipped ones are carried over to ``tasks``.

    Where these are of a suite, MT10 and MT50 stand for the plans that the suite ships.
    """
    suite = _suite_of(tasks)
    found: dict[str, ConditionalPlan] = {}
    for source in sources:
        try:
            if suite is not None and source in SETS:
                found.update(suite.plans or {})
            else:
                found.update(load_plans(source, skills=skills) if source in SETS else load_plans(source, tasks=tasks))
        except (PlanError, FileNotFoundError) as error:
            raise type(error)(f"{option} {source}: {error}") from error
    if not found:
        raise ValueError(f"{option} must name at least one source of plans: MT10, MT50, a file or a folder")
    for task, plan in found.items():
        if plan.definition != tasks[task]:
            try:
                found[task] = ConditionalPlan(task, plan.steps, tasks[task])
            except PlanError as error:
                raise PlanError(
                    f"{option} {' '.join(sources)}: the plan of {task!r} that counts is the shipped one, which does "
                    f"not fit the {task!r} of --task-file; name a plan of yours for it, last ({error})"
                ) from error
    return Plans(found)


def check_folder(option: str, path: Path) -> Path:
    """Return ``path`` if it is a folder that can be written to, or one could be made there."""
    here = path
    while not os.path.lexists(here):
        here = here.parent
    if not here.is_dir():
        where = f"{str(path)!r} is none" if here == path else f"{str(path)!r} lies below the file {str(here)!r}"
        raise ValueError(f"{option} must be a folder, {where}")
    try:
        with tempfile.TemporaryFile(dir=here):
            pass
    except OSError as error:
        raise ValueError(f"{option}: {str(here)!r} cannot be written to ({error.strerror})") from error
    return path


def check_new_folder(option: str, path: Path) -> Path:
    """Return ``path`` if it can be made as a folder, or is one without files."""
    if check_folder(option, path).is_dir() and any(path.iterdir()):
        raise ValueError(f"{option} must be a new folder, or an empty one, {str(path)!r} holds files")
    return path


def check_file(option: str, path: Path, ending: str = "") -> Path:
    """Return ``path`` if it is a file that can be written to, or one could be made there."""
    if path.is_dir():
        raise ValueError(f"{option} must be a file, {str(path)!r} is a folder")
    check_folder(f"{option}'s folder", path.parent)
    if not path.name.endswith(ending):
        raise ValueError(f"{option} must end in {ending!r}, got {str(path)!r}")
    return path


def check_encoder(name: str | None) -> None:
    """Raise :class:`ValueError` for a --text-encoder that is not "package.module:function"; nothing is imported."""
    module, _, function = "m:f".partition(":") if name is None else name.partition(":")
    if not module or not function.isidentifier():
        raise ValueError(f"--text-encoder must be like my_texts:encode, a module and a function, got {name!r}")


def check_dataset(argument: str, folder: Path) -> None:
    """Raise :class:`FileNotFoundError` where there is no dataset's folder."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{argument}: no dataset folder {str(folder)!r}; make one with `lw-torchrl collect`")


def check_condition(argument: str, *names: str) -> None:
    """Refuse the first name of a method that is neither ours nor added by a module or a package."""
    groups = ("methods", "policies", "encoders")
    for name in names:
        if name in CONDITIONS:
            continue
        if "lw_torchrl.modules" not in sys.modules and not any(entry_points_of(f"lw_torchrl.{one}") for one in groups):
            raise unknown_name(argument, name, CONDITIONS)
        from lw_torchrl.modules.registry import find_method

        find_method(name, argument)


def check_listed(argument: str, name: str, ours: Sequence[str], place: str, groups: Sequence[str]) -> None:
    """Refuse a name that is neither ours nor in the table at ``place``, which is imported only if users may have added
    to it: a module that --import names, or an installed package, by an entry point in one of ``groups``."""
    module, _, table = place.partition(":")
    if name in ours:
        return
    if module not in sys.modules and not any(entry_points_of(f"lw_torchrl.{group}") for group in groups):
        raise unknown_name(argument, name, ours)
    check_choice(argument, name, getattr(import_module(module), table))


def check_reference(sources: Sequence[str], attribute: bool) -> None:
    """Refuse sources of --reference without --attribute, and one that is neither a set of plans nor there."""
    if sources and not attribute:
        raise ValueError("--reference is for --attribute, which runs failed episodes again with these plans")
    for source in sources:
        if source not in SETS and not Path(source).exists():
            shipped = "'MT10' and 'MT50' name the shipped"
            raise FileNotFoundError(f"--reference: no plan file or folder {source!r}; {shipped}")


def check_saved(argument: str, path: Path, what: str = "policy", writer: str = "train") -> None:
    """Refuse a path where there is no file of a policy, or of what else a command writes."""
    if path.is_dir():
        raise ValueError(f"{argument}: {str(path)!r} is a folder; a {what} is one file")
    if not path.exists() and (what != "policy" or shipped_policy(path) is None):
        raise FileNotFoundError(f"{argument}: {absent_policy(path, writer)}")


def check_actor(argument: str, who: str) -> None:
    """Raise :class:`ValueError` for who is neither one of :data:`ACTORS` nor a policy's file."""
    if who not in ACTORS and shipped_policy(who) is None:
        if not who.endswith(".safetensors") and not Path(who).exists():
            raise unknown_name(argument, who, [*ACTORS, "a policy's file"])
        check_saved(argument, Path(who))


def imported(option: str, name: str, kind: str) -> Any:
    """What "package.module:name" names."""
    module, _, attribute = name.partition(":")
    absent = f"{option} {name!r} names no {kind}"
    found = own_module(absent, module)
    try:
        return getattr(found, attribute)
    except AttributeError as error:
        raise ValueError(f"{absent}: {error}") from None


def read_encoder(name: str | None) -> TextEncoder | None:
    """The function that --text-encoder names, "package.module:function"; the working folder is searched first."""
    if name is None:
        return None
    check_encoder(name)
    found = imported("--text-encoder", name, "function")
    if not callable(found):
        raise ValueError(f"--text-encoder {name!r} must name a function, it names {type(found).__name__}")
    return found


def is_suite(name: str) -> bool:
    """Whether a word names a suite: a shipped one, or an object as my_module:suite."""
    from lw_torchrl.suites.suite import SUITES

    module, _, attribute = name.partition(":")
    return name in SUITES or (attribute.isidentifier() and all(part.isidentifier() for part in module.split(".")))


def read_suite(name: str | None, tasks: Sequence[str] = ()) -> lw.suites.Suite | None:
    """The suite of --suite: a name, or "package.module:object", for which the working folder is searched first; without
    one that of ``tasks``, fetch or fetch/push. None for Meta-World."""
    from lw_torchrl.suites.suite import Suite, find_suite, load_suite, suite_name

    if name is None:
        other = any("/" in task or task == "metaworld" or suite_name(task) != "metaworld" for task in tasks)
        return find_suite(tasks) if other else None
    if ":" not in name:
        return load_suite(name)
    found = imported("suite", name, "object")
    if not isinstance(found, Suite):
        raise ValueError(f"suite {name!r} must name a Suite, it names {type(found).__name__}")
    return found


def _suite_of(tasks: Mapping[str, Task]) -> lw.suites.Suite | None:
    """The suite that :func:`read_tasks` took all of ``tasks`` from; None for Meta-World."""
    from lw_torchrl.suites.suite import known_suite

    first = next(iter(tasks))
    return known_suite(first) if "/" in first else None


Logs = Literal["csv", "tensorboard", "wandb", "rerun"]


def make_logger(kind: Logs, out: Path) -> Any:
    """The TorchRL logger of --logger, in a folder beside ``out``; rerun writes a new recording for each run."""
    if kind == "rerun":
        return lw.RerunLogger(out.parent / "logs" / f"{out.stem}.rrd", exp_name=f"{out.parent.name}/{out.stem}")
    from torchrl.record.loggers import get_logger

    try:
        return get_logger(kind, str(out.parent / "logs"), out.stem)
    except ImportError as error:
        raise ImportError(f"--logger {kind} needs the package {kind}: pip install {kind}") from error


def load_policy(
    file: Path, seed: int, plans: Plans | None, text_encoder: str | None, suite: lw.suites.Suite | None, speed: float
) -> lw.Policy:
    """The policy of a file, with the plans that are given; none that has seen the seed's states. Where it was trained
    with another robot than a suite's, it is turned into that one's actions."""
    from lw_torchrl.modules.composed_actors import TransferredActor
    from lw_torchrl.training.checkpoint import demonstration_seeds

    if seed in demonstration_seeds(file):
        raise ValueError(f"seed must differ from the demonstrations' seed, {seed}; an evaluation wants fresh states")
    policy = lw.load_actor(file, text_encoder=read_encoder(text_encoder))
    if suite is None or policy.layout == suite.layout:
        return policy if plans is None else policy.with_plans(plans)
    if (there := plans or suite.plans) is None:
        raise ValueError(f"--suite {suite.name} has no plans of its own; name yours with --plans")
    return TransferredActor(policy, there, speed=speed)


def use_one_thread() -> None:
    """One thread for PyTorch, unless OMP_NUM_THREADS says otherwise: networks this small gain little from a second."""
    if "OMP_NUM_THREADS" not in os.environ:
        import torch

        torch.set_num_threads(1)
