"""Parquet: one file, a row a step, for pandas, polars, DuckDB and Spark."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl._files import parse_json
from lw_torchrl._progress import Progress
from lw_torchrl.data.exchange.table import (
    ABOUT,
    EPISODES,
    NAMES,
    Array,
    ExchangeError,
    Table,
    check_rows,
    lengths_of,
    of_episodes,
    of_names,
)

FILE = "data.parquet"
_BLOCK = 50_000  # rows of a row group
_FIRST = {name: others[0] for name, others in NAMES.items()}  # the names that files of ours have


def as_arrow(column: Array) -> Any:
    """A column as an Arrow array: (R,) as it is, (R, n) as lists of n."""
    import pyarrow as pa

    flat = pa.array(np.ascontiguousarray(column).reshape(-1))
    return flat if column.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, column.shape[1])


def as_numpy(where: Path, name: str, column: Any) -> Array | None:
    """An Arrow column as numbers, (R,) or (R, n); None for texts and other things; ExchangeError if some are absent."""
    import pyarrow as pa

    column = column.combine_chunks()
    kind, width = column.type, None
    listed = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    values, kind = (column.flatten(), kind.value_type) if listed else (column, kind)
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
        return None
    if column.null_count or values.null_count:
        absent = column.null_count or values.null_count
        raise ExchangeError(f"source: {str(where)!r}: {name} must hold numbers, {absent} of them are absent")
    if listed:
        width, odd = divmod(len(values), max(1, len(column)))
        sizes = column.value_lengths() if not pa.types.is_fixed_size_list(kind := column.type) else None
        if odd or (sizes is not None and len(column) and len(sizes.unique()) != 1):
            raise ExchangeError(f"source: {str(where)!r}: {name} must hold as many numbers in each row")
    found = values.to_numpy(zero_copy_only=False)
    return found.reshape(len(column), width) if listed else found


def write(table: Table, folder: Path, bar: Progress) -> None:
    """Write a table as one file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = sorted({*table.tasks})
    place = table.of_rows([kinds.index(task) for task in table.tasks]).astype(np.int32)

    def texts(values: Iterable[str]) -> Any:
        return pa.DictionaryArray.from_arrays(pa.array(place), pa.array(list(values), pa.string()))

    columns = {"episode_index": pa.array(table.of_rows(range(len(table.lengths))))}
    columns["frame_index"] = pa.array(np.concatenate([np.arange(length) for length in table.lengths]))
    columns |= {_FIRST.get(name, name): as_arrow(column) for name, column in table.columns.items()}
    columns |= {"task": texts(kinds), "task_description": texts(table.words[task] for task in kinds)}
    if table.plans:
        columns["plan"] = texts(table.plans.get(task, "") for task in kinds)
    made = pa.table(columns)
    made = made.replace_schema_metadata({ABOUT: json.dumps(table.about)})
    texts_of = [name for name in columns if pa.types.is_dictionary(made.schema.field(name).type)]
    with pq.ParquetWriter(folder / FILE, made.schema, compression="zstd", use_dictionary=texts_of) as writer:
        for first in range(0, table.rows, _BLOCK):
            part = made.slice(first, _BLOCK)
            writer.write_table(part, row_group_size=_BLOCK)
            bar.update(len(part))


def files_of(source: Path) -> list[Path]:
    """The parquet files of a file or folder."""
    return [source] if source.is_file() else sorted(path for path in source.rglob("*.parquet") if path.is_file())


def read_arrow(path: Path) -> Any:
    """The Arrow table of a file; ExchangeError if it is none, or damaged."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        raise ExchangeError(f"source: there is no file {str(path)!r}")
    try:
        return pq.read_table(path, partitioning=None)
    except (pa.ArrowException, OSError) as error:
        raise ExchangeError(f"source: {str(path)!r} is no parquet file, or damaged ({str(error)[:200]})") from error


def read_numbers(paths: Iterable[Path]) -> tuple[dict[str, Array], dict[str, Any], dict[bytes, bytes]]:
    """The columns of numbers of files one after another, the other columns as Arrow has them, and the metadata."""
    import pyarrow as pa

    parts = {path: read_arrow(path) for path in paths}
    first, made = next(iter(parts.items()))
    for path, part in parts.items():
        if not part.schema.equals(made.schema):
            raise ExchangeError(f"source: {str(path)!r} must have the columns of {str(first)!r}, they differ")
    whole = pa.concat_tables(parts.values())
    numbers: dict[str, Array] = {}
    others: dict[str, Any] = {}
    for name in whole.column_names:
        found = as_numpy(first, name, whole.column(name))
        if found is None:
            others[name] = whole.column(name)
        else:
            numbers[name] = found
    return numbers, others, dict(made.schema.metadata or {})


def read(source: Path) -> Table:
    """Read a file, or all of a folder; ExchangeError if they are damaged or no parquet."""
    where = f"source: {str(source)!r}"
    paths = files_of(source)
    if not paths:
        raise ExchangeError(f"{where} holds no parquet file")
    columns, others, metadata = read_numbers(paths)
    rows = len(next(iter(columns.values()), ()))
    check_rows(source, columns, rows)
    lengths = lengths_of(source, columns)
    if not of_names(columns, EPISODES, "frame"):
        _check_files(paths, lengths)
    tasks = [""] * len(lengths)
    if named := of_names(others, EPISODES, "task"):
        tasks = _tasks(source, named[0], others[named[0]], lengths)
    about = None
    if (stated := metadata.get(ABOUT.encode())) is not None:
        try:
            about = parse_json(stated)
        except ValueError as error:
            raise ExchangeError(f"{where} is damaged: its {ABOUT} metadata cannot be read ({error})") from error
    return Table(columns, lengths, tuple(tasks), about=about)


def _check_files(paths: list[Path], lengths: tuple[int, ...]) -> None:
    """Raise where an episode is in two files: without frame_index nothing tells one from two of the same number."""
    import pyarrow.parquet as pq

    ends = np.cumsum([pq.read_metadata(path).num_rows for path in paths])
    if odd := [path for path, end in zip(paths, ends, strict=True) if end not in np.cumsum([0, *lengths])]:
        told = "its last one goes on in the next file, and no column frame_index says that it is the same"
        raise ExchangeError(f"source: {str(odd[0])!r} must hold whole episodes: {told}")


def _tasks(source: Path, name: str, column: Any, lengths: tuple[int, ...]) -> list[str]:
    """The task of each episode, which its rows agree on; "" where they do not say."""
    import pyarrow as pa

    try:
        coded = column.cast(pa.string()).combine_chunks().dictionary_encode()
    except pa.ArrowException as error:
        raise ExchangeError(f"source: {str(source)!r}: {name} must hold texts, it holds {column.type}") from error
    words = dict(enumerate(coded.dictionary.to_pylist()))
    number = coded.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    return [word or "" for word in of_episodes(source, name, number, lengths, words)]
