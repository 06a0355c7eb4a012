"""The subcommands of ``lw-torchrl`` that list words: tasks, queries, skills and plans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from lw_torchrl._checks import counted
from lw_torchrl.cli.sources import one_or_many, read_plans, read_tasks
from lw_torchrl.cli.tables import print_table


def tasks(
    names: Positional[Annotated[tuple[str, ...], arg(metavar="[NAMES ...]")]] = (),
    /,
    task_file: Path | None = None,
) -> None:
    """List tasks: their descriptions, and the objects that queries can name.

    Example: lw-torchrl tasks MT10

    Args:
        names: MT10, MT50, or names of tasks; all there are if none is given.
        task_file: tasks of yours, instead of ours of the same name or beside ours.
    """
    import lw_torchrl as lw

    known = read_tasks(task_file)
    rows = []
    for name in lw.resolve_tasks(one_or_many(names) or list(known), tasks=known):
        task = known[name]
        objects = ", ".join(o.name + (" (ours)" if getattr(o, "ours", False) else "") for o in task.objects[1:])
        rows.append((name, "yes" if name in lw.MT10 else "", task.description, objects))
    print_table(counted(len(rows), "task"), ("task", "MT10", "description", "objects beside the gripper"), rows)


def skills(
    task: Positional[Annotated[str | None, arg(metavar="[TASK]")]] = None,
    /,
    nearest: str | None = None,
    skill_file: Path | None = None,
    task_file: Path | None = None,
) -> None:
    """List the scripted skills, or find the one closest to a text.

    Example: lw-torchrl skills push --nearest "grab the puck"

    Args:
        task: only those that this task can use.
        nearest: a text; the closest skill is shown.
        skill_file: skills of yours that join ours, or replace those of the same text.
        task_file: tasks of yours, instead of ours of the same name or beside ours.
    """
    import lw_torchrl as lw
    from lw_torchrl.language.tasks import check_task

    known = read_tasks(task_file)
    table = lw.load_skills(skill_file, tasks=known)
    definition = None if task is None else known[check_task(task, known)]
    if nearest is not None:
        skill, score = lw.nearest_skill(nearest, definition, table)
        print(f"{skill.text}   (similarity {score:.2f})")
        return
    rows = []
    for skill in table.values():
        if definition is not None and not skill.suits(definition):
            continue
        shown = skill if definition is None else skill.for_task(definition)
        moved = "" if shown.moved == "robot's gripper" else shown.moved
        offset = " ".join(f"{x:g}" for x in shown.offset)
        gain = f"{shown.gain[0]:g}" if len(set(shown.gain)) == 1 else " ".join(f"{x:g}" for x in shown.gain)
        rows.append((skill.text, shown.target, moved, offset, gain, f"{shown.gripper:g}"))
    columns = ("skill", "target", "moved", "offset, m", "gain", "gripper")
    print_table(counted(len(rows), "scripted skill"), columns, rows)


def plans(
    names: Positional[Annotated[tuple[str, ...], arg(metavar="[NAMES ...]")]] = (),
    /,
    plans: tuple[str, ...] = ("MT50",),
    skill_set: Literal["own", "MT10"] = "own",
    roles: bool = False,
    task_file: Path | None = None,
) -> None:
    """Show plans: the whole text of those named, or a list of all; or which thing each of their steps brings where.

    Example: lw-torchrl plans drawer-open --roles

    Args:
        names: MT10, MT50, or names of tasks.
        plans: MT10 or MT50 for the shipped plans, .plan files, each named after its task (push.plan), .json files of
            pairs, or folders; where several have a plan for a task, the last one's counts.
        skill_set: of the shipped plans, those with scripted skills of their own, or those worded as MT10's are.
        roles: a table of the steps, what each moves and what it goes to, and what told: "skill", the text is a scripted
            skill's; "reworded", the text speaks of other tasks' things, and the shipped plan has a scripted skill under
            the same condition; "words", the text's; "condition", the things that it compares; "nothing".
        task_file: tasks of yours, instead of ours of the same name or beside ours.
    """
    import lw_torchrl as lw

    known = read_tasks(task_file)
    loaded = read_plans(plans, known, skill_set)
    chosen = lw.resolve_tasks(one_or_many(names), tasks=known) if names else tuple(loaded)
    loaded.require(chosen)
    if roles:
        from lw_torchrl.language.roles import plan_roles

        told = [
            (name, step.skill, one.moved or "?", one.target or "?", one.source)
            for name in chosen
            for step, one in zip(loaded[name].steps, plan_roles(loaded[name]), strict=True)
        ]
        print_table(counted(len(told), "step"), ("task", "skill", "moved", "target", "told by"), told)
        return
    if names:
        print("\n".join(str(loaded[name]) for name in chosen))
        return
    rows = [
        (name, str(len(plan.steps)), "; ".join(dict.fromkeys(step.skill for step in plan.steps)))
        for name, plan in loaded.items()
    ]
    print_table(counted(len(rows), "plan"), ("task", "steps", "skills"), rows)


def queries(
    task: Positional[Annotated[str, arg(metavar="TASK")]],
    text: Positional[Annotated[str | None, arg(metavar="[TEXT]")]] = None,
    /,
    by: Literal["edit", "embedding"] = "edit",
    task_file: Path | None = None,
) -> None:
    """List a task's base queries, or find the one closest to a text.

    Example: lw-torchrl queries push "the gripper touches the puck"

    Args:
        task: a task's name.
        text: any words; what the query answering function makes of them is shown.
        by: closest in spelling, or in meaning, which wants the extra [text].
        task_file: tasks of yours, instead of ours of the same name or beside ours.
    """
    import lw_torchrl as lw
    from lw_torchrl.language.tasks import check_task

    known = read_tasks(task_file)
    definition = known[check_task(task, known)]
    if text is not None:
        found = lw.nearest_query(text, definition, by=by)
        print(f"{found.query}   (similarity {found.score:.2f})")
        return
    listed = lw.supported_queries(definition)
    published = set(lw.supported_queries(definition, published_only=True))
    for query in listed:
        print(query + ("" if query in published else "   (ours)"))
    print(f"\n{len(listed)} base queries; each may be negated, and joined to others by 'and'")
