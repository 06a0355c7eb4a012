"""Generated pages of the reference: the API by subpackage, the commands, and tables of the package's data files."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from lw_torchrl.cli.main import COMMANDS
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.relations import PREDICATES, PUBLISHED, STATES, Comparison
from lw_torchrl.language.tasks import MT10, TASKS, Task
from lw_torchrl.suites.fetch import FETCH
from lw_torchrl.suites.fetch import TASKS as FETCH_TASKS

ROOT = Path(__file__).parents[2]
NAMES = re.findall(r"^from (\S+) import (\S+) as", (ROOT / "lw_torchrl/__init__.pyi").read_text("utf-8"), re.MULTILINE)
ROOMS = [name for module, name in NAMES if module == "lw_torchrl"]
WORDS = (
    "tasks queries relations query_program plans plan_files formats plan_decoding canonical roles skills nearest "
    "text layout"
)
"""The modules of ``language``, a subpackage that exports no names itself."""


def pages() -> dict[str, str]:
    rooms = {f"api/{room}.md": room_page(room) for room in ROOMS}
    return {"api/index.md": top_level(), "commands.md": commands(), "tables.md": tables(), **rooms}


def room_page(room: str) -> str:
    modules = [f"::: lw_torchrl.language.{word}\n" for word in WORDS.split()] if room == "language" else []
    whole = f"::: lw_torchrl.{room}\n    options: {{show_root_heading: false, show_root_toc_entry: false}}\n"
    return "\n".join([f"# lw.{room}", "", *(modules or [whole])])


def commands() -> str:
    """Return a page with the ``--help`` of each command, by group."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_COLOR": "1", "COLUMNS": "100"}
    about = "The `--help` of each command. [Exit status, pipes and JSON](reference.md#commands)"
    parts, group = ["# Commands", "", about, ""], ""
    for name, (its_group, _, _) in COMMANDS.items():
        if its_group != group:
            group = its_group
            parts += [f"## {group}", ""]
        line = [sys.executable, "-m", "lw_torchrl", *name.split(), "--help"]
        text = subprocess.run(line, env=environment, capture_output=True, text=True, check=True).stdout
        parts += [f"### {name}", "", "``` {.text .wrap}", text.strip(), "```", ""]
    return "\n".join(parts)


FIRST = ("PlanConditionedActor", "load_plans", "LanguageWorldEnv", "QAFTransform", "evaluate")


def top_level() -> str:
    names = sorted(NAMES, key=lambda name: FIRST.index(name[1]) if name[1] in FIRST else len(FIRST))
    rows = [
        f'| <autoref identifier="{module}.{name}" optional>`lw.{name}`</autoref> | [{room}]({room}.md) |'
        for module, name in names
        if module != "lw_torchrl"
        for room in [module.split(".")[1]]
    ]
    about = "`import lw_torchrl as lw` gives these names and the subpackages, for example `lw.data`."
    return "\n".join(["# API", "", about, "", "| name | subpackage |", "|---|---|", *rows, ""])


RELATIONS = """# Relations, layouts, tasks

Made from the library's data when the site is built.

## Relations

x, y, z are the first position minus the second, in metres; ‖·‖ is the length over the named axes. An opening is from 0,
closed, to 1, open. A logit is the distance to the threshold divided by the temperature.
[More](reference.md#relations).

| predicate | holds where | temperature | published |
|---|---|---|---|"""
LAYOUTS = """
## Layouts

Indices of the numbers of an observation and of an action. [Your robot](your-robot.md).

| | metaworld | fetch |
|---|---|---|"""


def tables() -> str:
    """Return a page with the relations, layouts and tasks of the library's data files."""
    parts = [RELATIONS]
    for name, comparisons in PREDICATES.items():
        holds = " and ".join(comparison_text(comparison, name in STATES) for comparison in comparisons)
        temperatures = ", ".join(sorted({f"{comparison.temperature:g}" for comparison in comparisons}))
        parts.append(f"| {name} | {holds} | {temperatures} | {'yes' if name in PUBLISHED else ''} |")
    layouts = zip(layout_rows(METAWORLD).items(), layout_rows(FETCH).values(), strict=True)
    parts += [LAYOUTS, *(f"| {name} | {metaworld} | {fetch} |" for (name, metaworld), fetch in layouts)]
    for heading, tasks in (("Meta-World's tasks", TASKS), ("Fetch's tasks", FETCH_TASKS)):
        parts += ["", f"## {heading}", "", "| task | description | objects | our points |", "|---|---|---|---|"]
        parts += [task_row(task) for _, task in sorted(tasks.items())]
    return "\n".join([*parts, ""])


def comparison_text(comparison: Comparison, opening: bool) -> str:
    value = f"‖{comparison.axes}‖" if comparison.length else "opening" if opening else comparison.axes
    raised = f", z raised by {comparison.raise_z:g}" if comparison.raise_z else ""
    return f"{value} {comparison.sense} {comparison.threshold:g}{raised}"


def layout_rows(layout: Layout) -> dict[str, str]:
    places = [(span(thing.position, 3), thing.quaternion) for thing in layout.things]
    objects = [place if turned is None else f"{place}, quaternion {span(turned, 4)}" for place, turned in places]
    moved = "none" if layout.displacement is None else f"{span(layout.displacement, 3)}, {layout.reach:g} m at 1"
    return {
        "numbers of an observation": f"{layout.size}",
        "the hand's position": span(layout.hand, 3),
        "its opening": f"{layout.opening}",
        "the objects' positions": "; ".join(objects),
        "the goal's position": span(layout.goal, 3),
        "the previous step": "none" if layout.past is None else f"each index + {layout.past}",
        "numbers of an action": f"{layout.action_size}",
        "displacement of the hand": moved,
        "effort of the gripper": "none" if layout.gripper is None else f"{layout.gripper}, {layout.closes:+d} closes",
        "its own thresholds": ", ".join(f"{name} {at:g}" for name, at in layout.thresholds.items()) or "none",
    }


def span(start: int, length: int) -> str:
    return f"{start} to {start + length - 1}"


def task_row(task: Task) -> str:
    mark = " (MT10)" if task.name in MT10 else ""
    objects, points = (", ".join(item.name for item in task.objects if item.ours == ours) for ours in (False, True))
    return f"| {task.name}{mark} | {task.description} | {objects} | {points} |"
