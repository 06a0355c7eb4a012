"""The subcommands of ``lw-torchrl`` about words: tasks, queries, skills and plans, and plans carried out by scripts."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from lw_torchrl.cli.outputs import check_folder

if TYPE_CHECKING:
    from lw_torchrl.language.skills import ScriptedSkill
    from lw_torchrl.language.tasks import Task


def _print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    class Printer(Console):
        def on_broken_pipe(self) -> None:  # rich's own exits with status 1
            raise

    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, no_wrap=number == 0)
    for row in rows:
        table.add_row(*row)
    wide = None if sys.stdout.isatty() else 160
    Printer(highlight=False, markup=False, width=wide).print(table)


def tasks(names: Positional[tuple[str, ...]] = (), /) -> None:
    """List tasks: their descriptions, and the objects that queries can name.

    Example: lw-torchrl tasks MT10

    Args:
        names: MT10, MT50, or names of tasks; all 50 if none is given.
    """
    import lw_torchrl as lw

    rows = []
    for name in lw.resolve_tasks(names[0] if len(names) == 1 else names or "MT50"):
        task = lw.TASKS[name]
        objects = ", ".join(o.name + (" (ours)" if getattr(o, "ours", False) else "") for o in task.objects[1:])
        rows.append((name, "yes" if name in lw.MT10 else "", task.description, objects))
    _print_table(f"{len(rows)} tasks", ("task", "MT10", "description", "objects beside the gripper"), rows)


def skills(task: Positional[str | None] = None, /, nearest: str | None = None, file: Path | None = None) -> None:
    """List the scripted skills, or find the one closest to a text.

    Example: lw-torchrl skills push --nearest "grab the puck"

    Args:
        task: only those that this task can use.
        nearest: a text; the closest skill is shown.
        file: skills of yours that join or replace ours.
    """
    import lw_torchrl as lw
    from lw_torchrl.language.tasks import check_task

    table = lw.load_skills(file)
    if task is not None:
        check_task(task)
    if nearest is not None:
        skill, score = lw.nearest_skill(nearest, task, table)
        print(f"{skill.text}   (similarity {score:.2f})")
        return
    rows = []
    for skill in table.values():
        if task is not None and not skill.suits(task):
            continue
        shown = skill if task is None else skill.for_task(task)
        moved = "" if shown.moved == "robot's gripper" else shown.moved
        offset = " ".join(f"{x:g}" for x in shown.offset)
        gain = f"{shown.gain[0]:g}" if len(set(shown.gain)) == 1 else " ".join(f"{x:g}" for x in shown.gain)
        rows.append((skill.text, shown.target, moved, offset, gain, f"{shown.gripper:g}"))
    columns = ("skill", "target", "moved", "offset, m", "gain", "gripper")
    _print_table(f"{len(rows)} scripted skills", columns, rows)


def plans(
    names: Positional[tuple[str, ...]] = (), /, skills: Literal["own", "MT10"] = "own", file: Path | None = None
) -> None:
    """Show plans: the whole text of those named, or a list of all.

    Example: lw-torchrl plans drawer-open

    Args:
        names: MT10, MT50, or names of tasks.
        skills: the set with scripted skills of its own, or the one worded as MT10's plans are.
        file: a .plan file or a folder of them, instead of ours.
    """
    import lw_torchrl as lw

    loaded = lw.load_plans("MT50", skills=skills) if file is None else lw.load_plans(file)
    if names:
        chosen = lw.resolve_tasks(names[0] if len(names) == 1 else names)
        loaded.require(chosen)
        print("\n".join(str(loaded[name]) for name in chosen))
        return
    rows = [
        (name, str(len(plan.steps)), "; ".join(dict.fromkeys(step.skill for step in plan.steps)))
        for name, plan in loaded.items()
    ]
    _print_table(f"{len(rows)} plans", ("task", "steps", "skills"), rows)


def queries(
    task: Positional[str], text: Positional[str | None] = None, /, by: Literal["edit", "embedding"] = "edit"
) -> None:
    """List a task's base queries, or find the one closest to a text.

    Example: lw-torchrl queries push "the gripper touches the puck"

    Args:
        task: a task's name.
        text: any words; what the query answering function makes of them is shown.
        by: closest in spelling, or in meaning, which wants the extra [text].
    """
    import lw_torchrl as lw

    if text is not None:
        found = lw.nearest_query(text, task, by=by)
        print(f"{found.query}   (similarity {found.score:.2f})")
        return
    listed = lw.supported_queries(task)
    published = set(lw.supported_queries(task, published_only=True))
    for query in listed:
        print(query + ("" if query in published else "   (ours)"))
    print(f"\n{len(listed)} base queries; each may be negated, and joined to others by 'and'")


def check(
    file: Positional[Path], /, task: str | None = None, skills: Path | None = None, tasks: Path | None = None
) -> None:
    """Validate a file of plans, skills or tasks of your own: what is wrong, where, and the nearest allowed text.

    Example: lw-torchrl check my-plans/push.plan

    Args:
        file: a .plan file, a folder of them, or a .toml file of skills or of tasks.
        task: the task that a plan must be for.
        skills: skills of yours that join ours, for the plans.
        tasks: tasks of yours that join or replace ours, for the plans and skills.
    """
    import lw_torchrl as lw
    from lw_torchrl._files import read_text

    if not file.exists():
        raise FileNotFoundError(f"file: there is no {str(file)!r}")
    known = lw.TASKS if tasks is None else lw.load_tasks(tasks)
    if file.suffix == ".toml":
        print(_check_table(file, known))
        return
    paths = sorted(file.glob("*.plan")) if file.is_dir() else [file]
    if not paths:
        raise ValueError(f"file: the folder {str(file)!r} holds no .plan files")
    table = lw.load_skills(skills, tasks=known)
    wrong = 0
    for path in paths:
        faults, steps, notes = _check_plan(read_text(path, lw.PlanError), task, path.name, table, known)
        wrong += len(faults)
        print("\n".join([*faults, *notes, f"{path.name}: " + (_count(faults) if faults else f"{steps} steps, valid")]))
    if wrong:
        raise ValueError(f"{wrong} fault{'s' * (wrong > 1)} in {len(paths)} file{'s' * (len(paths) > 1)}")


def _count(faults: list[str]) -> str:
    return f"{len(faults)} fault" + "s" * (len(faults) > 1)


def _check_table(file: Path, known: Mapping[str, Task]) -> str:
    import lw_torchrl as lw
    from lw_torchrl._checks import nearest
    from lw_torchrl._files import read_toml

    rows = read_toml(file, ValueError)
    if any(isinstance(row, dict) and ("description" in row or "objects" in row) for row in rows.values()):
        lw.load_tasks(file)
        for name in sorted(set(rows) - set(lw.TASKS)):
            close = nearest(name, lw.TASKS, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            print(f"{file.name}: note: task {name!r} is none of the simulator's{hint}")
        return f"{file.name}: {len(rows)} tasks, valid"
    table = lw.load_skills(file, tasks=known)
    for text in rows:
        if not any(table[text].suits(task) for task in known.values()):
            print(
                f"{file.name}: skill {text!r} suits no task; it needs {table[text].target!r} and {table[text].moved!r}"
            )
    return f"{file.name}: {len(rows)} skills, valid"


def _check_plan(
    text: str, task: str | None, source: str, skills: Mapping[str, ScriptedSkill], tasks: Mapping[str, Task]
) -> tuple[list[str], int, list[str]]:
    """Every fault of a plan, the steps it has if there is none, and what the scripted skills make of it."""
    import lw_torchrl as lw
    from lw_torchrl.language.formats.chain_py import check_plan

    plan, faults = check_plan(text, task, source, tasks)
    if plan is None:
        return faults, 0, []
    notes = []
    for step in plan.steps:
        if step.skill not in skills or not skills[step.skill].suits(plan.definition):
            found, score = lw.nearest_skill(step.skill, plan.definition, skills)
            notes.append(
                f"{source}: note: no scripted skill {step.skill!r} suits {plan.task}; the nearest is {found.text!r} "
                f"({score:.2f}). A learned policy needs none"
            )
    return [], len(plan.steps), notes


def scripted(
    names: Positional[tuple[str, ...]] = ("MT10",),
    /,
    episodes: int = 50,
    seed: int = 1000,
    select: Literal["first", "random", "mix"] = "first",
    noise: float = 0.0,
    plans: str = "MT50",
    skills: Path | None = None,
    full: bool = False,
    out: Path = Path("runs/scripted"),
) -> None:
    """Carry out plans with scripted skills, and say how each step fared: no training, no expert.

    Example: lw-torchrl scripted MT50 --episodes 50

    Args:
        names: MT10, MT50, or names of tasks.
        episodes: of each task.
        seed: fixes initial states and goals.
        select: of several true steps, take the first, a random one, as in the paper, or mix them.
        noise: standard deviation of the noise on the executed action.
        plans: MT10 or MT50 for the shipped plans, or a .plan file or a folder of them.
        skills: skills of yours that join or replace ours.
        full: run all 500 steps, instead of stopping at the first success.
        out: folder for results.json, plan_use.json and success.png.
    """
    check_folder("--out", out)
    import lw_torchrl as lw
    from lw_torchrl._files import write_json
    from lw_torchrl.evaluation.plan_use import PlanUse

    chosen = lw.resolve_tasks(names[0] if len(names) == 1 else names)
    loaded = lw.load_plans(plans)
    loaded.require(chosen)
    loaded = type(loaded)({task: loaded[task] for task in chosen})
    use = PlanUse(loaded)
    result = lw.evaluate(
        lw.ScriptedSkillActor(loaded, select, skills=lw.load_skills(skills)),
        tasks=chosen,
        episodes_per_task=episodes,
        seed=seed,
        noise_scale=noise,
        stop_at_success=not full,
        also_record=["qaf", "skill_weights"],
        on_episode=use,
    )
    seen = use.tasks()
    for task, found in seen.items():
        print(f"{task}: success {result.success_once[task]:.2f}")
        for step, true, taken, stuck in zip(loaded[task].steps, found.true, found.chosen, found.stuck, strict=True):
            at_end = f", stuck here in {stuck} of {found.failed} failed episodes" if stuck else ""
            print(f"    true {true:4.0%}  chosen {taken:4.0%}  {step.skill}{at_end}")
    print(f"\n{result.table()}")
    out.mkdir(parents=True, exist_ok=True)
    result.save(out / "results.json")
    write_json(out / "plan_use.json", {task: found.to_json() for task, found in seen.items()})
    lw.plot_success(result, out / "success.png", title=f"plans and scripted skills, {episodes} episodes a task")
    print(f"written to {out}")
