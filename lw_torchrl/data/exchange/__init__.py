"""Datasets for others, and from others: parquet, LeRobot, HDF5 and Minari."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

from lw_torchrl._checks import Count, checked
from lw_torchrl._files import AnyPath, read_json, replacing_folder
from lw_torchrl._progress import Progress
from lw_torchrl.data.dataset import METADATA, Demonstrations, read_metadata
from lw_torchrl.data.exchange import incoming
from lw_torchrl.data.exchange.table import ExchangeError, Table, table_of
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.suites.suite import Suite, find_suite, load_suite

__all__ = ["FORMATS", "ExchangeError", "ExchangeFormat", "export_dataset", "import_dataset"]

ExchangeFormat = Literal["parquet", "lerobot", "hdf5", "minari"]
FORMATS: tuple[str, ...] = get_args(ExchangeFormat)
_EXTRAS = {"av": "exchange", "h5py": "exchange", "minari": "minari"}  # the package that is absent, and what to install


def _of_format(name: str) -> Any:
    return import_module(f"lw_torchrl.data.exchange.{name}")


def _installed(name: str, act: Any, *args: Any) -> Any:
    """What ``act`` returns; an ImportError names the extra to install."""
    try:
        return act(*args)
    except ModuleNotFoundError as error:
        if (extra := _EXTRAS.get((error.name or "").partition(".")[0])) is None:
            raise
        install = f"pip install 'lw_torchrl[{extra}]'"
        raise ImportError(f"format {name!r} needs {error.name}, which is not installed: {install}") from error


@checked
def export_dataset(
    root: AnyPath,
    format: ExchangeFormat,
    out: AnyPath,
    *,
    plans: AnyPlans | None = None,
    suite: str | Suite | None = None,
) -> Path:
    """Write a dataset in a format that others read; :func:`import_dataset` gives the same dataset back, bit for bit.

    A row is a step. Its columns, (R, ...), under the names of "parquet"; docs/data.md has those of the other formats:
        observation, next.observation: (R, 39) float32, metres. action: (R, 4) float32 in [-1, 1], as executed.
        expert_action, unclipped_action: (R, 4) float32, as :func:`collect_demonstrations` stores them.
        next.reward, next.reward_sparse: (R,) float32, Meta-World's reward, and the success as 0 and 1.
        next.success, next.done, next.terminated, next.truncated: (R,) bool.
        task, task_description, plan: the task's name, what it says, and the plan's text.
        plan_holds: (R, S) bool, which of the plan's conditions hold in ``observation``, false beyond its last.
        episode_index, frame_index: (R,) int64.

    Pictures of :func:`add_pictures` become videos in "lerobot", and are left out elsewhere.

    Args:
        root: the dataset's folder, of :func:`collect_demonstrations`.
        format: "parquet", one file of all rows; "lerobot", LeRobot's of version 3; "hdf5", robomimic's; "minari".
        out: the folder to write, new or empty.
        plans: whose conditions are answered in ``plan_holds``; None for those that the suite ships.
        suite: the suite of the dataset's tasks; None for the one that their names begin with.

    Returns:
        The folder.

    Raises:
        DatasetError: (a ValueError) ``root`` holds no dataset, or a damaged one.
        ValueError: ``out`` is a file, or a folder that is not empty.
        ImportError: what the format needs is not installed; it says which extra brings it.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=20)
        ...     out = lw.export_dataset(root + "/demos", "parquet", root + "/out")
        ...     [path.name for path in out.iterdir()], lw.import_dataset(out, root + "/back").num_steps
        (['data.parquet'], 20)

    Source: huggingface/lerobot ``datasets``, Farama's Minari, robomimic's datasets.
    """
    found = read_metadata(root)
    there = find_suite(found.config.tasks, suite)
    target = _new_folder(out)
    given = there.plans if plans is None else as_plans(plans)
    table = table_of(found, read_json(found.root / METADATA, "root: the metadata"), there.tasks, given)
    with replacing_folder(target) as folder, Progress("exporting", table.rows, "row") as bar:
        _installed(format, lambda: _of_format(format).write(table, folder, bar))
    return target


@checked
def import_dataset(
    source: AnyPath,
    out: AnyPath,
    *,
    format: ExchangeFormat | None = None,
    task: str | Mapping[str, str] | None = None,
    suite: str | Suite = "metaworld",
    behaviour: str = "imported",
    episodes_per_task: Count | None = None,
) -> Demonstrations:
    """Make a dataset of what :func:`export_dataset` wrote, the same again, or of what others hold of a suite's tasks.

    Files of others need observations and actions of the suite's sizes, and to say where episodes begin. Columns are
    found by their usual names (docs/data.md). What else they lack is named in a warning, and stands there as said:
    ``("next", "observation")`` of the last row, ``success``, or the dense reward, as NaN. Their rows are shown with
    ``label="executed"``: which expert wanted what, they do not say.

    Args:
        source: the file or folder.
        out: the dataset's folder, new or empty.
        format: of ``source``; None to tell by its files.
        task: the task of all episodes, or a mapping from the file's words to tasks; None where the file has names or
            descriptions of ours, or Meta-World's own names, "reach-v3".
        suite: the :class:`~lw_torchrl.suites.Suite` of a file of others.
        behaviour: the label of its episodes, for :class:`EpisodeFilter`.
        episodes_per_task: of a file of others, the first so many episodes of each task; None for all, where there are
            as many of each.

    Returns:
        The dataset, described, as :func:`collect_demonstrations` does.

    Raises:
        ExchangeError: (a ValueError) ``source`` is damaged, of another format, or lacks what a dataset needs.
        ValueError: a task that is none or a set of them, more episodes than there are, ``out`` is a file, a link or
            not empty, or an option for files of others was given for an export of ours.
        ImportError: what the format needs is not installed; it says which extra brings it.

    Example:
        >>> import tempfile, lw_torchrl as lw, pyarrow as pa, pyarrow.parquet as pq
        >>> observation = [[0.0] * 39] * 2
        >>> rows = {"obs": observation, "next_obs": observation, "action": [[0.0] * 4] * 2, "reward": [2.0, 3.0]}
        >>> more = {"task": ["reach-v3"] * 2, "episode_index": [0, 0], "success": [False, True]}
        >>> with tempfile.TemporaryDirectory() as root:
        ...     pq.write_table(pa.table(rows | more), root + "/theirs.parquet")
        ...     lw.import_dataset(root + "/theirs.parquet", root + "/ours").success_rate
        {'reach': 1.0}

    Source: ours.
    """
    source, target = Path(source), _new_folder(out)
    if not source.exists():
        raise FileNotFoundError(f"source: there is no file or folder {str(source)!r}")
    if not (source.is_file() or source.is_dir()):
        raise ExchangeError(f"source must be a file or a folder, {str(source)!r} is neither")
    kind = _format_of(source) if format is None else format
    table: Table = _installed(kind, lambda: _of_format(kind).read(source))
    if table.about is not None:
        given = {"task": task is not None, "episodes_per_task": episodes_per_task is not None}
        given |= {"suite": suite != "metaworld", "behaviour": behaviour != "imported"}
        if named := [name for name, was in given.items() if was]:
            ours = f"{str(source)!r} is an export of a dataset of ours, which comes back whole, as it was"
            raise ValueError(f"{named[0]} must not be given: {ours}")
        with TemporaryDirectory() as folder:
            made = incoming.own_description(table, source, Path(folder))
        return incoming.write_incoming(incoming.with_our_names(table, source), source, target, made)
    there = load_suite(suite)
    names = incoming.task_names(table, source, there, task)
    table, lacking = incoming.as_ours(table, source, there)
    made, order = incoming.foreign_description(names, table, source, there, behaviour, episodes_per_task)
    return incoming.write_incoming(incoming.in_order(table, order), source, target, made, lacking)


def _new_folder(out: AnyPath) -> Path:
    """A folder that is not there, or empty, which can take its place by name; ValueError for another."""
    folder = Path(out)
    if folder.is_symlink() or folder.name == "..":
        what = "is a link" if folder.is_symlink() else "has no name of its own"
        raise ValueError(f"out must be a new folder, or an empty one, {str(folder)!r} {what}")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out must be a folder, {str(folder)!r} is a file")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"out must be a new folder, or an empty one, {str(folder)!r} holds files")
    return folder


def _format_of(source: Path) -> ExchangeFormat:
    """The format of a file, or of a folder by the files in it."""
    endings = {path.suffix for path in ([source] if source.is_file() else source.iterdir())}
    if (source / "meta" / "info.json").is_file():
        return "lerobot"
    if (source / "data" / "metadata.json").is_file() or (source / "main_data.hdf5").is_file():
        return "minari"
    if endings & {".hdf5", ".h5"}:
        return "hdf5"
    if ".parquet" in endings:
        return "parquet"
    raise ExchangeError(
        f"source: {str(source)!r} is of none of the formats {', '.join(FORMATS)}; format= names one of them"
    )
