"""The robot where nothing but observations is known: a table, a hand with two fingers, and lines down to the table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.record.colors import GOLD, STEEL, Color
from lw_torchrl.record.recorded_episode import RecordedEpisode
from lw_torchrl.record.timelines import time_columns

if TYPE_CHECKING:
    from rerun import RecordingStream

# Measured in Meta-World's model: obs[3] is the distance between the fingers over 0.1 m; they slide along y
# and reach 4.5 cm below obs[0:3], the position of the hand.
FINGER_TRAVEL = 0.1
FINGER_HALF = (0.010, 0.006, 0.024)
FINGER_DROP = 0.026
PALM_HALF = (0.018, 0.062, 0.014)
PALM_RISE = 0.012
WRIST_HALF = (0.012, 0.012, 0.055)
WRIST_RISE = 0.081
TABLE_CENTER, TABLE_HALF = (0.0, 0.6, -0.010), (0.7, 0.4, 0.010)
TABLE, GRID = (58, 64, 74), (92, 99, 112)


def log_simple_robot(stream: RecordingStream, scene: str, episode: RecordedEpisode) -> None:
    """The table and the gripper below ``scene``."""
    import rerun as rr

    times = time_columns(np.arange(len(episode)))
    solid = rr.components.FillMode.Solid

    def box(path: str, centers: Any, half_sizes: Any, color: Color, labels: list[str] | None = None) -> None:
        boxes = rr.Boxes3D.from_fields(
            centers=centers,
            half_sizes=half_sizes,
            colors=[color] * len(half_sizes),
            fill_mode=solid,
            labels=labels,
            show_labels=labels is not None,
        )
        stream.log(f"{scene}/{path}", boxes, static=True)

    box("table", [TABLE_CENTER], [TABLE_HALF], TABLE)
    stream.log(f"{scene}/table/grid", rr.LineStrips3D(_grid(), colors=[GRID], radii=[0.0007]), static=True)
    box("gripper/palm", [(0.0, 0.0, PALM_RISE)], [PALM_HALF], STEEL)
    # Its name stands above the hand, where the objects that it handles are not.
    box("gripper/wrist", [(0.0, 0.0, WRIST_RISE)], [WRIST_HALF], STEEL, [GRIPPER])
    box("gripper/fingers", None, [FINGER_HALF] * 2, GOLD)
    stream.send_columns(f"{scene}/gripper", times, rr.Transform3D.columns(translation=episode.objects[GRIPPER]))
    fingers = rr.Boxes3D.columns(centers=_finger_centers(episode.observation[:, 3]))
    stream.send_columns(f"{scene}/gripper/fingers", times, fingers.partition([2] * len(episode)))


def to_table(position: NDArray[np.float32]) -> NDArray[np.float32]:
    """T×2×3 lines: from each row straight down (or up) to the table's top."""
    return np.stack([position, position * np.array([1, 1, 0], np.float32)], axis=1)


def _grid(spacing: float = 0.1) -> list[list[tuple[float, float, float]]]:
    """Lines on the table, ``spacing`` metres apart."""
    (left, near), (right, far) = (
        tuple(c + sign * h for c, h in zip(TABLE_CENTER[:2], TABLE_HALF[:2], strict=True)) for sign in (-1, 1)
    )
    z = 0.0005
    across = [[(left, y, z), (right, y, z)] for y in np.arange(near, far + 1e-6, spacing).tolist()]
    along = [[(x, near, z), (x, far, z)] for x in np.arange(left, right + 1e-6, spacing).tolist()]
    return across + along


def _finger_centers(opening: NDArray[np.float32]) -> NDArray[np.float32]:
    """2T×3 centres of the fingers of T rows, metres in the gripper's frame; ``opening`` T in [0,1]."""
    half = opening * FINGER_TRAVEL / 2 + FINGER_HALF[1]
    zero, drop = np.zeros_like(half), np.full_like(half, -FINGER_DROP)
    return np.stack([zero, half, drop, zero, -half, drop], axis=1).reshape(-1, 3).astype(np.float32)
