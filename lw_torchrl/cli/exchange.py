"""``lw-torchrl data export`` and ``data import``: datasets in the formats of others."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._checks import counted
from lw_torchrl.cli import options
from lw_torchrl.cli.output import Columns, Output
from lw_torchrl.language.tasks import TASKS

ExportFormat = Literal["lerobot", "minari"]
ImportFormat = Literal["lerobot", "minari", "robomimic"]


def export(
    folder: Positional[Annotated[Path, arg(metavar="FOLDER")]],  # of `lw-torchrl collect`
    /,
    to: ExportFormat,
    out: Path,  # the folder to write, new or empty
    plans: options.PlanSources = (),
    suite: options.SuiteName = None,
    json: options.Json = False,
) -> Output:
    """Write a dataset in a format that others read. `data import` gives the same dataset back, bit for bit.

    Example: lw-torchrl data export demos/mt10 --to lerobot --out lerobot/mt10

    Args:
        to: lerobot, version 3 of LeRobot's format; or minari.
        plans: whose conditions are answered for each row; by default those that the suite ships.
    """
    options.check_new_folder("--out", out)
    options.check_dataset("folder", folder)
    there = options.read_suite(suite)
    tasks = TASKS if there is None else there.tasks
    made = lw.export_dataset(folder, to, out, suite=there, plans=options.read_plans(plans, tasks) if plans else None)
    files = [path for path in made.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    output = Output(json).show("out", made).show("format", to).show("files", len(files))
    return output.show("bytes", size, f"{counted(len(files), 'file')} of {size / 1e6:.1f} MB in {made}")


def import_(
    source: Positional[Annotated[Path, arg(metavar="SOURCE")]],  # LeRobot or Minari folder, or HDF5
    /,
    out: Path,  # the dataset's folder, new or empty
    format: ImportFormat | None = None,  # of the source; by default as its files say
    task: str | None = None,  # of all its episodes, where it does not say
    suite: options.SuiteName = None,
    behaviour: str = "imported",  # the label of its episodes
    episodes: int | None = None,  # of each task, the first ones; by default all, where there are as many of each
    json: options.Json = False,
) -> Output:
    """Make a dataset of what `data export` wrote, the same again, or of what others hold of a suite's tasks.

    What their files lack is named.

    Example: lw-torchrl data import lerobot/mt10 --out demos/mt10
    """
    options.check_new_folder("--out", out)
    if not source.exists():
        raise FileNotFoundError(f"source: there is no file or folder {str(source)!r}")
    how: dict[str, Any] = {"format": format, "task": task, "behaviour": behaviour, "episodes_per_task": episodes}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        made = lw.import_dataset(source, out, suite=options.read_suite(suite) or "metaworld", **how)
    rates = made.success_rate
    columns: Columns = {"task": "task", "success": lambda row: f"{row['success']:.2f}"}
    output = Output(json).table("tasks", [{"task": task, "success": rate} for task, rate in rates.items()], columns)
    lacking = [str(one.message) for one in said if str(one.message).startswith("source: ")]
    output.show("lacking", lacking, "\n".join(lacking) or None).show("dataset", made.root)
    return output.show("steps", made.num_steps, f"{counted(made.num_steps, 'step')} in {made.root}")
