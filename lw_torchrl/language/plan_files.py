"""Plans on disk: .plan files, folders of them, JSON of language models' pairs."""

from __future__ import annotations

from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Literal

from lw_torchrl._util.checks import shown, typed
from lw_torchrl._util.files import AnyPath, parse_json, read_text, write_text
from lw_torchrl.language.nearest import nearest_query
from lw_torchrl.language.plan_text import MOST_STEPS, PLAN_LIMIT, no_task, too_many_steps
from lw_torchrl.language.plans import AnyPlans, ConditionalPlan, PlanError, Plans, PlanStep, as_plans, parse_plan
from lw_torchrl.language.queries import QueryError
from lw_torchrl.language.tasks import MT10, TASKS, Tasks

_MOST_PAIRS = 2_000  # of a file, each compared with all queries of its task


@typed
def load_plans(source: AnyPath, *, skills: Literal["own", "MT10"] = "own", tasks: Tasks = TASKS) -> Plans:
    """Load plans.

    A .json file maps task names to lists of (condition, skill) pairs, at its top or under the key "plans", as language
    models wrote them. A condition outside the query language is replaced by the nearest query (:func:`nearest_query`),
    and the step's ``reason`` keeps its words.

    Args:
        source: "MT10" or "MT50" for the shipped plans of a set; otherwise the path of a .plan or .json file, or of a
            folder of .plan files. A .plan file may have any name but that of another task.
        skills: which of the shipped plans: "own", where every step has a scripted skill; "MT10", where every step is
            worded as in the plans of MT10, for policies that have only seen these.
        tasks: whose objects the conditions name, by task name, as from :func:`~lw_torchrl.load_tasks`.

    Raises:
        PlanError: (a ValueError) a file holds no valid plan, or one for another task than the one it is named after.

    Example:
        >>> load_plans("MT10")["reach"].task
        'reach'
    """
    if source in ("MT10", "MT50"):
        data = files("lw_torchrl.language") / "data"
        other = "plans_mt10_skills" if skills == "MT10" else "plans"
        names = MT10 if source == "MT10" else tuple(TASKS)
        return _read_all([data / ("plans" if task in MT10 else other) / f"{task}.plan" for task in names], tasks)
    if skills != "own":
        raise ValueError(f"skills={skills!r} is for the shipped plans, 'MT10' and 'MT50', got source {str(source)!r}")
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"no plan file or folder {str(path)!r}; 'MT10' and 'MT50' name the shipped plans")
    if path.suffix == ".json":
        return _read_pairs(path, tasks)
    # A name with a dot in front is what a killed save_plans leaves.
    listed = [path] if path.is_file() else sorted(p for p in path.glob("*.plan") if p.name[0] != ".")
    if not listed:
        how = "lw.decode_plan reads a language model's answer, lw.save_plans writes .plan files"
        raise FileNotFoundError(f"the folder {str(path)!r} holds no .plan files; {how}")
    return _read_all(list[Traversable](listed), tasks)


def _read_all(found: list[Traversable], tasks: Tasks) -> Plans:
    plans: dict[str, tuple[str, ConditionalPlan]] = {}
    for file in found:
        stem = file.name.removesuffix(".plan").replace("__", "/")
        text = read_text(file, PlanError, limit=PLAN_LIMIT)
        plan = parse_plan(text, stem if stem in tasks else None, file.name, tasks)
        first, _ = plans.setdefault(plan.task, (file.name, plan))
        if first != file.name:
            raise PlanError(f"{file.name}: a second plan for {plan.task!r}; {first} holds one, too")
    return Plans([plan for _, plan in plans.values()])


def _read_pairs(path: Path, tasks: Tasks) -> Plans:
    try:
        whole = parse_json(read_text(path, PlanError, limit=PLAN_LIMIT).encode())
    except ValueError as error:
        raise PlanError(f"{path.name}: expected JSON, task names with lists of pairs: {error}") from error
    found = whole.get("plans", whole)
    if not isinstance(found, dict):
        raise PlanError(f"{path.name}: expected task names with lists of (condition, skill) pairs, got {shown(found)}")
    if (number := sum(len(pairs) for pairs in found.values() if isinstance(pairs, list))) > _MOST_PAIRS:
        raise PlanError(f"{path.name}: its plans must have at most {_MOST_PAIRS} pairs in all, got {number}")
    plans = []
    for name, pairs in found.items():
        if name not in tasks:
            raise PlanError(no_task(path.name, name, tasks))
        if not isinstance(pairs, list):
            raise PlanError(f"{path.name}, {name}: expected a list of (condition, skill) pairs, got {shown(pairs)}")
        if len(pairs) > MOST_STEPS:
            raise PlanError(too_many_steps(f"{path.name}, {name}", len(pairs)))
        steps = []
        for number, pair in enumerate(pairs, 1):
            where = f"{path.name}, {name}, step {number}"
            if not (isinstance(pair, list) and len(pair) == 2 and all(isinstance(text, str) for text in pair)):
                raise PlanError(f"{where}: expected a condition and a skill, two strings, got {shown(pair)}")
            try:
                match = nearest_query(pair[0], tasks[name])
            except QueryError as error:
                raise PlanError(f"{where}: {error}") from error
            steps.append(PlanStep(match.query, pair[1], "" if match.score == 1.0 else f"nearest to: {pair[0]}"))
        plans.append(ConditionalPlan(name, tuple(steps), tasks[name]))
    return Plans(plans)


@typed
def save_plans(plans: AnyPlans, folder: AnyPath) -> list[Path]:
    """Write each plan to ``folder``/<task>.plan, "__" for a slash; a file is replaced whole or not at all."""
    texts = {Path(folder) / f"{task.replace('/', '__')}.plan": str(plan) for task, plan in as_plans(plans).items()}
    Path(folder).mkdir(parents=True, exist_ok=True)
    for file, text in texts.items():
        write_text(file, text)
    return list(texts)
