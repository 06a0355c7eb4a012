"""Export datasets to LeRobot and Minari, and import datasets from LeRobot, Minari and robomimic's HDF5."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.files import AnyPath, LimitError, parse_json, read_json, replacing_folder
from lw_torchrl._util.progress import Progress
from lw_torchrl.data.dataset import METADATA, Demonstrations, parse_metadata, read_metadata
from lw_torchrl.data.exchange.imported import (
    ExchangeError,
    complete_columns,
    describe,
    exported_columns,
    find_ends,
    read_files,
    task_names,
    write_dataset,
)
from lw_torchrl.data.exchange.reader import HDF5, PARQUET, data_files
from lw_torchrl.data.exchange.table import ABOUT, table_of
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.suites.suite import Suite, find_suite, load_suite

__all__ = [
    "FORMATS", "ExchangeError", "ExportFormat", "ImportFormat", "MissingDataWarning", "export_dataset",
    "import_dataset",
]  # fmt: skip

ExportFormat = Literal["lerobot", "minari"]
ImportFormat = Literal["lerobot", "minari", "robomimic"]
FORMATS: tuple[str, ...] = get_args(ExportFormat)
_EXTRAS = {"av": "exchange", "h5py": "exchange", "pyarrow": "exchange", "minari": "minari"}
"""The extra that installs each package."""


class MissingDataWarning(UserWarning):
    """A warning that an imported file lacks some of the standard dataset columns."""


@contextmanager
def _needing(format: str) -> Iterator[None]:
    """If a package for a format is missing, raise an ImportError that names the extra to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (extra := _EXTRAS.get((error.name or "").partition(".")[0])) is None:
            raise
        install = f"pip install 'lw_torchrl[{extra}]'"
        raise ImportError(f"format {format!r} requires {error.name}, which is not installed: {install}") from error


@typed
def export_dataset(
    root: AnyPath,
    format: ExportFormat,
    out: AnyPath,
    *,
    plans: AnyPlans | None = None,
    suite: str | Suite | None = None,
) -> Path:
    """Write a dataset in another library's format, and return the folder of the exported dataset.

    :func:`import_dataset` restores the dataset bit-exactly. docs/data.md lists the columns of both formats: the
    dataset's columns, the task's name and description, the plan's text, and ``plan_holds`` (R, S) bool, the conditions
    of the plan that hold in each row (time step). "lerobot" stores pictures of :func:`add_pictures` as videos.

    Args:
        root: the dataset's folder, written by :func:`collect_demonstrations`.
        format: "lerobot" (version 3 of LeRobot's format) or "minari".
        out: the folder to write, which must be new or empty.
        plans: the plans for ``plan_holds``; None for the suite's plans.
        suite: the suite of the dataset's tasks; None to derive the suite from the tasks' names.

    Raises:
        DatasetError: (a ValueError) ``root`` holds no dataset, or a corrupted dataset.
        ValueError: ``out`` is a file, or a folder that is not empty.
        ImportError: the format requires a package that is not installed; the message names the extra.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=20)
        ...     out = lw.export_dataset(root + "/demos", "lerobot", root + "/out")
        ...     lw.import_dataset(out, root + "/again").num_steps
        20

    Source: huggingface/lerobot ``datasets``, Farama's Minari.
    """
    demonstrations = read_metadata(root)
    suite = find_suite(demonstrations.config.tasks, suite)
    target = _new_folder(out)
    metadata = read_json(demonstrations.root / METADATA, "root: the metadata")
    table = table_of(demonstrations, metadata, suite, suite.plans if plans is None else as_plans(plans))
    with replacing_folder(target) as folder, Progress("exporting", table.rows, "row") as bar, _needing(format):
        import_module(f"lw_torchrl.data.exchange.{format}").write(table, folder, bar)
    return target


@typed
def import_dataset(
    source: AnyPath,
    out: AnyPath,
    *,
    format: ImportFormat | None = None,
    task: str | Mapping[str | int, str | int] | None = None,
    suite: str | Suite = "metaworld",
    behaviour: str = "imported",
    episodes_per_task: Count | None = None,
    episode_length: Count | None = None,
) -> Demonstrations:
    """Convert files of another format to a dataset, and return the dataset's description.

    Files written by :func:`export_dataset` are restored bit-exactly; the options after ``format`` only apply to other
    files, whose observations and actions must have the suite's sizes. docs/data.md lists the recognized column names
    and the values that replace missing columns. Load such a dataset with ``label="executed"``, because it has no expert
    actions.

    A child process with a limit on memory and on time reads the files, because damaged or hostile files can make
    pyarrow and HDF5 allocate gigabytes or never return.

    Args:
        source: the file or folder to import.
        out: the dataset's folder, which must be new or empty.
        format: "lerobot" (also parquet files without LeRobot's metadata), "minari", or "robomimic" (HDF5, also
            LIBERO's and ManiSkill's); None to detect the format from the files.
        task: the task of all episodes, or a mapping from the file's task names or numbers to lw_torchrl's names; None
            if the file has lw_torchrl's task names or descriptions, or Meta-World's task names, such as "reach-v3".
        suite: the :class:`~lw_torchrl.suites.Suite` of the tasks.
        behaviour: the label of the episodes, for :class:`EpisodeFilter`.
        episodes_per_task: import only the first N episodes of each task; None for all.
        episode_length: the number of steps of each episode, for files that do not state where episodes end; None for
            the suite's number of steps.

    Warns:
        MissingDataWarning: (a UserWarning) columns are missing; the message names the values used instead.

    Raises:
        ExchangeError: (a ValueError) ``source`` is corrupted, of another format, lacks observations or actions, or
            declares more data than its size allows.
        ValueError: a task is unknown, the tasks have different numbers of episodes, or ``out`` is not an empty folder.
        ImportError: the format requires a package that is not installed; the message names the extra.
        OSError: the system cannot read the files, for example because too many files are open.

    Source: LeRobot's format 2.0 to 3.0, Minari, robomimic's, LIBERO's and ManiSkill's HDF5 layouts.
    """
    source, target = Path(source), _new_folder(out)
    if not source.exists():
        raise FileNotFoundError(f"source: no such file or folder {str(source)!r}")
    format = _format_of(source) if format is None else format
    with _reading(source):
        metadata = _own_metadata(source)
        description = None if metadata is None else parse_metadata(metadata, target)
    if description is not None:
        if (task, suite, behaviour, episodes_per_task, episode_length) != (None, "metaworld", "imported", None, None):
            options = "task, suite, behaviour, episodes_per_task and episode_length"
            raise ValueError(f"{options} must not be given: {str(source)!r} was written by export_dataset")
        with _needing(format), _reading(source):
            table = read_files(source, format != "lerobot", description.config.layout)
            columns, spans = exported_columns(table), [*table.spans()]
            if tuple(episode.length for episode in description.episodes) != table.lengths:
                raise ExchangeError("the episodes' lengths differ from those in the exported metadata")
        return write_dataset(columns, spans, description, target, exported_as=source)
    suite = load_suite(suite)
    with _needing(format), _reading(source):
        table = read_files(source, format != "lerobot", suite.layout)
    table = find_ends(table, suite, episode_length)
    names = task_names(table, suite, task)
    description, spans = describe(names, table, suite, behaviour, episodes_per_task)
    with _reading(source):
        columns, lacking = complete_columns(table, suite)
    if lacking:
        warnings.warn(f"source: {str(source)!r} lacks {'; '.join(lacking)}", MissingDataWarning, stacklevel=3)
    return write_dataset(columns, spans, description, target)


@contextmanager
def _reading(source: Path) -> Iterator[None]:
    """Add the path of the source to errors raised within a ``with`` block."""
    try:
        yield
    except (ExchangeError, LimitError) as error:
        raise ExchangeError(f"source: {str(source)!r}: {error}") from error
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ExchangeError(f"source: {str(source)!r} has invalid metadata ({error!r})") from error


def _new_folder(out: AnyPath) -> Path:
    folder = Path(out)
    if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise ValueError(f"out must be a new folder or an empty folder, got {str(folder)!r}")
    return folder


def _format_of(source: Path) -> ImportFormat:
    """Detect the format of a file, or of the files in a folder."""
    if (source / "meta" / "info.json").is_file():
        return "lerobot"
    if (source / "data" / "metadata.json").is_file() or (source / "main_data.hdf5").is_file():
        return "minari"
    for format, endings in (("robomimic", HDF5), ("lerobot", PARQUET)):
        if any(path.suffix.lower() in endings for path in data_files(source, endings)):
            return format  # type: ignore[return-value]
    raise ExchangeError(f"source: {str(source)!r} is not a LeRobot, Minari or robomimic dataset; if it is, set format")


def _own_metadata(source: Path) -> Mapping[str, Any] | None:
    """Return the original dataset's metadata from files written by :func:`export_dataset`; None for other files."""
    if (path := source / "meta" / f"{ABOUT}.json").is_file():
        return read_json(path, "the metadata of lw_torchrl")
    for path in (source / "data" / "metadata.json", source / "metadata.json"):
        if path.is_file() and (text := read_json(path, "Minari's metadata").get(ABOUT)):
            return parse_json(str(text).encode())
    return None
