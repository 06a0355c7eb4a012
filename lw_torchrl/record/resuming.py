"""What of a recording a logger must know to go on in it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl.record.conventions import METRIC_TIMELINE
from lw_torchrl.record.recording_file import find_recording, is_whole
from lw_torchrl.record.tabs import OF_TRAINING, Layout
from lw_torchrl.record.writer import cut_to_messages


@dataclass(frozen=True)
class Begun:
    """A recording that was begun: its ids and layout, the next step of each entity, the hyperparameters, the meshes."""

    application_id: str
    recording_id: str
    layout: Layout
    counters: dict[str, int]
    hparams: dict[str, str]
    meshes: dict[str, bytes]

    @classmethod
    def read(cls, path: Path) -> Begun:
        """Of a file; :class:`ValueError` if it is no recording of this version's."""
        from rerun.chunk import RrdReader

        if not is_whole(find_recording(path)):
            cut_to_messages(path)  # a kill while it is written leaves half a message
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that there is no index
                reader = RrdReader(path)
                known = reader.recordings()
                layout = Layout.read(reader) if known else None
        except RuntimeError as error:
            raise ValueError(f"resume: {str(path)!r} is no recording: {error}") from error
        if layout is None:
            raise ValueError(f"resume: {str(path)!r} holds no recording that this version wrote; give another path")
        counters: dict[str, int] = {}
        hparams: dict[str, str] = {}
        meshes: dict[str, bytes] = {}
        for chunk in reader.stream(store=known[0]):
            entity, rows = str(chunk.entity_path), chunk.to_record_batch()
            kind = entity.split("/")[1]
            if kind in OF_TRAINING and METRIC_TIMELINE in chunk.timeline_names and len(rows):
                last = int(np.max(rows.column(METRIC_TIMELINE).to_numpy(zero_copy_only=False)))
                counters[entity] = max(counters.get(entity, 0), last + 1)
            elif kind == "hparams":
                hparams |= _hparams(rows.column("TextDocument:text")[-1].as_py()[0])
            elif kind in ("meshes", "ghosts"):
                meshes[entity] = _pose(rows) or meshes.get(entity, b"")
        return cls(known[0].application_id, known[0].recording_id, layout, counters, hparams, meshes)


def _hparams(table: str) -> dict[str, str]:
    """What :meth:`RerunLogger.log_hparams` made a table of."""
    cells = (row[2:-2].split(" | ", 1) for row in table.splitlines()[2:])
    return {key.replace("\\|", "|"): value.replace("\\|", "|") for key, value in cells}


def _pose(rows: Any) -> bytes:
    """The pose of what stands still, as :func:`log_motion` has it."""
    parts = [f"Transform3D:{part}" for part in ("translation", "quaternion")]
    if not set(parts) <= set(rows.schema.names):
        return b""
    return b"".join(np.array(rows.column(part)[-1].as_py()[0], np.float32).tobytes() for part in parts)
