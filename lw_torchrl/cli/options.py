"""Options shared by several commands, and functions that load the tasks, plans, skills and policies that these name."""

from __future__ import annotations

import json
import math
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import Count, check_value
from lw_torchrl._util.files import read_text
from lw_torchrl._util.text import counted, printable
from lw_torchrl._util.workers import start_early
from lw_torchrl.language.plan_files import PLAN_LIMIT, is_pairs, load_plans
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans
from lw_torchrl.language.skills import ScriptedSkill, load_skills
from lw_torchrl.language.tasks import TASKS, Task, load_tasks, resolve_tasks

if TYPE_CHECKING:
    from lw_torchrl.language.text import TextEncoder

Row = Mapping[str, Any]
Columns = Mapping[str, str | Callable[[Row], Any]]
"""A mapping from column headings to a row's key, or to a function that maps a row to the cell's value."""


class Output:
    """The output of a command: printed as text, or gathered in one JSON document.

    Attributes:
        fault: an error found in the user's files; :meth:`finish` raises it after all other output.
    """

    def __init__(self, as_json: bool) -> None:
        self.as_json, self.fault = as_json, ""
        self._document: dict[str, Any] = {}

    def show(self, key: str, value: Any, text: str | None = None) -> Output:
        """Print ``text`` unless it is None; with --json, add ``value`` to the JSON document instead. Return self."""
        if self.as_json:
            self._document[key] = value
        elif text is not None:
            print(text)
        return self

    def table(self, key: str, rows: Sequence[Row], columns: Columns, title: str = "") -> Output:
        """Print rows as a table, or add the rows to the JSON document."""
        if self.as_json:
            return self.show(key, [dict(row) for row in rows])
        _print_table(title, [*columns], [[_cell(row, of) for of in columns.values()] for row in rows])
        return self

    def result(self, result: lw.EvaluationResult, **more: Mapping[str, Any]) -> Output:
        """Print an evaluation's table, or add the results by task (with the columns ``more``) and the config."""
        rates = ("success_once", "success_at_end", "first_success", "mean_return")
        columns = {name: getattr(result, name) for name in rates} | more
        rows = [{"task": task, **{name: of[task] for name, of in columns.items()}} for task in result.config["tasks"]]
        self.show("tasks", rows, result.table()).show("mean_success", result.mean_success)
        return self.show("config", result.config)

    def notes(self, notes: Iterable[str]) -> None:
        """Print the notes about a language model's answers, most frequent first."""
        counts = Counter(notes).most_common()
        self.show("notes", [{"note": note, "answers": times} for note, times in counts])
        for note, times in counts:
            print(f"{counted(times, 'answer')}: {note}")

    def finish(self) -> None:
        """Print the JSON document if it was requested, then raise a :class:`ValueError` if there is a ``fault``."""
        if self.as_json:
            print(json.dumps(_plain(self._document), indent=2, allow_nan=False))
        if self.fault:
            raise ValueError(self.fault)


def _plain(value: Any) -> Any:
    """Convert a value for JSON: non-finite numbers become None, and objects of other types become strings."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (str, int)) else str(value)


def _cell(row: Row, column: str | Callable[[Row], Any]) -> str:
    value = row[column] if isinstance(column, str) else column(row)
    return "" if value is None or value is False else "yes" if value is True else printable(str(value))


def _print_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table that fits the terminal without wrapping the first column, or plain columns if stdout is a pipe."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    terminal = sys.stdout.isatty()
    table = Table(title=title or None, title_justify="left", box=SIMPLE_HEAD if terminal else None, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, no_wrap=not terminal or number == 0)
    for row in rows:
        table.add_row(*row)
    console = Console(highlight=False, markup=False, color_system=None, width=None if terminal else 10_000)
    with console.capture() as capture:
        console.print(table)
    print("\n".join(line.rstrip() for line in capture.get().splitlines()))


PLANS = "MT10 or MT50 (the shipped plans), .plan files, .json files of (condition, skill) pairs, or folders"
WHO = (
    "expert (Meta-World's scripts, or the suite's expert), scripted (plans executed by scripted skills), noisy-60 or "
    "noisy-30 (scripted, but correct only 60 or 30 % of the time), wrong (random skills of the plan), random, a "
    "policy file, a shipped policy (few-shot-mt50), or a Python object my_module:policy"
)
_DEVICE = "device for the networks: cpu, cuda, cuda:1, mps, or auto for a GPU if available (the simulation uses CPUs)"
_SUITE = "suite of the tasks, for example fetch, or a Python object my_module:suite"
_WORKERS = "number of processes that share the episodes (default: one per core if that saves time)"
_ENCODER = "custom text encoder: a Python function my_module:function that maps N texts to an N x D tensor"
_TASKS = "MT10, MT50, a suite, or names of tasks"
_EVALUATOR = (
    "evaluate conditions with a network instead of exactly: a file written by `lw-torchrl train-evaluator`, the name "
    "of an evaluator class, or a Python object my_module:evaluator"
)

# These hints replace "(default: )", "(default: None)" and "(default: False)" in tyro's help.
OPTIONAL, REQUIRED = arg(help_behavior_hint=""), arg(help_behavior_hint="(required)")
T = TypeVar("T")
Maybe = Annotated[T | None, OPTIONAL]
Flag = Annotated[bool, OPTIONAL]
TaskName = Positional[Annotated[str, arg(metavar="TASK", help="name of a task")]]
TaskNames = Positional[Annotated[tuple[str, ...], REQUIRED, arg(metavar="TASKS", help=_TASKS)]]
Who = Annotated[str, arg(metavar="POLICY", help=f"policy that acts: {WHO}")]
Json = Annotated[Flag, arg(help="print one JSON document instead of text")]
TaskFile = Annotated[Maybe[Path], arg(metavar="FILE", help="a .toml file of your tasks, added to the shipped ones")]
SkillFile = Annotated[Maybe[Path], arg(metavar="FILE", help="a .toml file of your skills, added to the shipped ones")]
Encoder = Annotated[Maybe[str], arg(metavar="MODULE:FUNCTION", help=_ENCODER)]
SuiteName = Annotated[Maybe[str], arg(metavar="SUITE", help=_SUITE)]
_LAST = "if several sources have a plan for a task, the last one is used"
PlanSources = Annotated[tuple[str, ...], arg(metavar="SOURCES", help=f"{PLANS}; {_LAST}")]
Evaluator = Annotated[Maybe[str], arg(metavar="FILE", help=_EVALUATOR)]
Device = Annotated[str, arg(metavar="DEVICE", help=_DEVICE)]
Workers = Annotated[Maybe[Count], arg(metavar="N", help=_WORKERS)]

_PLAN_TASK = re.compile(r"^def[ \t]+([a-z]\w*)[ \t]*\(", re.MULTILINE)


def import_object(option: str, name: str) -> Any:
    """Import the object given as "package.module:name", searching the working directory first."""
    module, _, attribute = name.partition(":")
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        return getattr(import_module(module), attribute)
    except (ModuleNotFoundError, AttributeError, ValueError) as error:
        raise ValueError(f"{option} must have the form my_module:name, got {name!r} ({error})") from error


def is_object(policy: str) -> bool:
    """Return whether the name of a policy has the form my_module:policy."""
    return ":" in policy and not Path(policy).exists()


def read_object(name: str) -> Any:
    """Import a policy by a name such as "my_module:policy"."""
    policy = import_object("the policy", name)
    if not callable(policy) or isinstance(policy, type):
        raise ValueError(f"the policy {name} must map a TensorDict to a TensorDict, got {policy!r:.80}")
    return policy


def start_workers(policy: str, device: str, workers: int | None, episodes: int) -> None:
    """Start the worker processes early if running ``episodes`` episodes of 500 time steps will use any."""
    if not is_object(policy) and device == "cpu":
        start_early(workers, episodes * 500)


def policy_name(policy: str) -> str:
    """Return a short policy name for labels and file names."""
    return policy.partition(":")[2] if is_object(policy) else Path(policy).stem


def read_encoder(name: str | None) -> TextEncoder | None:
    """Import the function named by --text-encoder; return None if ``name`` is None."""
    return None if name is None else import_object("--text-encoder", name)


def read_evaluator(name: str, plans: Plans, text_encoder: str | None = None) -> lw.QueryEvaluator:
    """Return an evaluator for ``plans``: loaded from a file, imported from "my_module:evaluator", or newly
    created from a registered class."""
    encoder = read_encoder(text_encoder)
    if Path(name).exists() or not (":" in name or name == "StateQueryEvaluator"):
        return lw.training.load_evaluator(name, plans, text_encoder=encoder)
    evaluator: Any = import_object("--evaluator", name) if ":" in name else lw.modules.StateQueryEvaluator
    evaluator = check_value(f"--evaluator {name}", evaluator, lw.QueryEvaluator | type[lw.QueryEvaluator])
    return evaluator(plans) if isinstance(evaluator, type) else evaluator.with_plans(plans)


def read_suite(name: str | None, tasks: Sequence[str] = ()) -> lw.suites.Suite | None:
    """Load the suite ``name`` or, without a name, the suite of ``tasks`` ("fetch/push"); return None for Meta-World."""
    from lw_torchrl.suites.suite import Suite, find_suite, load_suite, suite_name

    if name is None:
        return find_suite(tasks) if any("/" in task or suite_name(task) != "metaworld" for task in tasks) else None
    suite = import_object("the suite", name) if ":" in name else load_suite(name)
    return check_value(f"--suite {name}", suite, Suite)


def read_tasks(task_file: Path | None, names: Sequence[str] = (), suite: str | None = None) -> Mapping[str, Task]:
    """Return all tasks of the suite that contains ``names``; for Meta-World, also those in --task-file."""
    if (named_suite := read_suite(suite, names)) is not None:
        return named_suite.tasks
    return TASKS if task_file is None else load_tasks(task_file)


def tasks_of_plans(path: Path, task: str | None, task_file: Path | None) -> Mapping[str, Task]:
    """Return the tasks that a .plan file or a folder of .plan files may refer to; all belong to one suite."""
    names = [] if task is None else [task]
    for file in sorted(path.glob("*.plan")) if path.is_dir() else [path]:
        if file.suffix == ".plan" and file.is_file() and (match := _PLAN_TASK.search(read_text(file, PlanError))):
            names += [match[1].replace("__", "/", 1).replace("_", "-")] * ("__" in match[1])
    return read_tasks(task_file, names)


def is_answer(file: Path) -> bool:
    """Return whether a file holds a model's answer: neither a .plan file nor JSON with (condition, skill) pairs."""
    return file.suffix not in (".plan", ".json") or (
        file.suffix == ".json" and not is_pairs(read_text(file, PlanError, limit=PLAN_LIMIT))
    )


def task_of_answer(file: Path, text: str, known: Mapping[str, Task]) -> str:
    """Return the task named in the file's name; otherwise the task named in a function or a heading of the text."""
    names = re.findall(r"^\s*def (\w+)|\btask [\"'`]([\w/-]+)[\"'`]", text, re.MULTILINE)
    for name in (re.sub(r"-\d+$", "", file.stem), *(name for pair in names for name in pair)):
        if (task := name.replace("__", "/").replace("_", "-")) in known:
            return task
    raise ValueError(f"--task is required, because neither the name of {file.name!r} nor its text names a task")


def select_tasks(names: Sequence[str], tasks: Mapping[str, Task], suite: lw.suites.Suite | None = None) -> list[str]:
    """Expand ``names`` to task names; MT10, MT50 and a suite's name stand for several tasks."""
    if (suite := suite or read_suite(None, names)) is None:
        return list(resolve_tasks(names[0] if len(names) == 1 else names, tasks=tasks))
    return list(suite.tasks if list(names) == [suite.name] else suite.named_tasks(names))


def _suite_of(tasks: Mapping[str, Task]) -> lw.suites.Suite | None:
    from lw_torchrl.suites.suite import known_suite

    first = next(iter(tasks))
    return known_suite(first) if "/" in first else None


def read_skills(skill_file: Path | None, tasks: Mapping[str, Task]) -> Mapping[str, ScriptedSkill]:
    """Load the scripted skills of the suite that contains ``tasks``, and those in --skill-file."""
    shipped = load_skills()
    skills = shipped if skill_file is None else load_skills(skill_file, tasks=tasks)
    if (suite := _suite_of(tasks)) is None:
        return skills
    return {**(suite.skills or {}), **{text: skill for text, skill in skills.items() if shipped.get(text) != skill}}


def read_plans(sources: Sequence[str], tasks: Mapping[str, Task]) -> Plans:
    """Load the plans named by --plans. If ``tasks`` are not Meta-World's, MT10 and MT50 mean their suite's plans."""
    return Plans(find_plans(sources, tasks))


def find_plans(sources: Sequence[str], tasks: Mapping[str, Task]) -> dict[str, ConditionalPlan]:
    """Load plans as :func:`read_plans` does; the result may be empty."""
    if not sources:
        raise ValueError("--plans requires at least one source: MT10, MT50, a suite, a file or a folder")
    suite = _suite_of(tasks)
    plans: dict[str, ConditionalPlan] = {}
    for source in sources:
        if source in ("MT10", "MT50"):
            plans.update(load_plans(source) if suite is None else suite.plans or {})
        elif source in lw.suites.SUITES and not Path(source).exists():
            shipped: Mapping[str, ConditionalPlan] = lw.suites.load_suite(source).plans or {}
            plans.update({task: plan for task, plan in shipped.items() if task in tasks})
        else:
            plans.update(load_plans(source, tasks=tasks))
    for task, plan in plans.items():
        if plan.definition != tasks[task]:
            try:
                plans[task] = ConditionalPlan(task, plan.steps, tasks[task])
            except PlanError as error:
                reason = f"the shipped plan does not fit the task {task!r} in --task-file"
                raise PlanError(f"--plans: {reason}; put your own plan for this task last ({error})") from error
    return plans


def use_one_thread() -> None:
    """Use one PyTorch thread unless OMP_NUM_THREADS is set: small networks gain little from a second thread."""
    if "OMP_NUM_THREADS" not in os.environ:
        import torch

        torch.set_num_threads(1)
