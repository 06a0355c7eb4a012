"""The 3-D scene that is drawn from an episode.

Meta-World's frame: metres, x to the robot's right, y away from the robot, z up, the table's top at z = 0.
Static things are sent once; what moves is sent as whole columns, one call per entity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.record.recorded_episode import GRIPPER, RecordedEpisode
from lw_torchrl.record.timelines import entity_path, time_columns

if TYPE_CHECKING:
    from rerun import RecordingStream

Color = tuple[int, ...]

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

STEEL, GOLD, GREEN, TABLE, GRID = (205, 210, 220), (255, 200, 60), (90, 220, 120), (58, 64, 74), (92, 99, 112)
OBJECT_COLORS = ((80, 170, 255), (255, 120, 90), (200, 130, 255), (90, 220, 210))


def log_scene(stream: RecordingStream, root: str, episode: RecordedEpisode) -> list[str]:
    """Draw the table, the gripper, the objects, their paths and the goal under ``root``/scene.

    Returns:
        The entity paths of the trails: one short line per row, to be shown up to the time cursor.
    """
    import rerun as rr

    scene, times = f"{root}/scene", time_columns(np.arange(len(episode)))
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

    stream.log(scene, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    box("table", [TABLE_CENTER], [TABLE_HALF], TABLE)
    stream.log(f"{scene}/table/grid", rr.LineStrips3D(_grid(), colors=[GRID], radii=[0.0007]), static=True)
    box("gripper/palm", [(0.0, 0.0, PALM_RISE)], [PALM_HALF], STEEL)
    # Its name stands above the hand, where the objects that it handles are not.
    box("gripper/wrist", [(0.0, 0.0, WRIST_RISE)], [WRIST_HALF], STEEL, [GRIPPER])
    box("gripper/fingers", None, [FINGER_HALF] * 2, GOLD)
    stream.send_columns(f"{scene}/gripper", times, rr.Transform3D.columns(translation=episode.objects[GRIPPER]))
    fingers = rr.Boxes3D.columns(centers=_finger_centers(episode.observation[:, 3]))
    stream.send_columns(f"{scene}/gripper/fingers", times, fingers.partition([2] * len(episode)))

    def point(path: str, position: NDArray[np.float32], label: str | None, radius: float, color: Color) -> None:
        labels = None if label is None else [label]
        style = rr.Points3D.from_fields(radii=[radius], colors=[color], labels=labels, show_labels=label is not None)
        stream.log(f"{scene}/{path}", style, static=True)
        stream.send_columns(f"{scene}/{path}", times, rr.Points3D.columns(positions=position))

    def lines(path: str, strips: NDArray[np.float32], radius: float, color: Color) -> None:
        style = rr.LineStrips3D.from_fields(colors=[color], radii=[radius])
        stream.log(f"{scene}/{path}", style, static=True)
        stream.send_columns(f"{scene}/{path}", times, rr.LineStrips3D.columns(strips=strips))

    goal = np.ascontiguousarray(episode.observation[:, 36:39])
    # Objects that stand for the goal, like "target location", have its colour, and their own label.
    goals = [name for name, position in episode.objects.items() if np.allclose(goal, position, atol=1e-3)]
    trails = []
    for name, color in _colors(episode.objects, goals).items():
        part, position = entity_path(name), episode.objects[name]
        point(
            f"objects{part}",
            position,
            None if name == GRIPPER else name,
            0.005 if name == GRIPPER else 0.016,
            color,
        )
        lines(f"heights{part}", _to_table(position), 0.0012, (*color, 150))
        # The whole way, faint, and the way so far.
        whole = rr.LineStrips3D([position], colors=[(*color, 70)], radii=[0.0012])
        stream.log(f"{scene}/paths{part}", whole, static=True)
        trails.append(f"{scene}/trails{part}")
        lines(f"trails{part}", _from_row_before(position), 0.003, color)

    if goal.any():
        point("goal", goal, None, 0.022, (*GREEN, 120))
        lines("goal/height", _to_table(goal), 0.0012, GREEN)
        if not goals:
            point("goal/foot", _to_table(goal)[:, 1], "goal", 0.005, GREEN)
    return trails


def _grid(spacing: float = 0.1) -> list[list[tuple[float, float, float]]]:
    """Lines on the table, ``spacing`` metres apart."""
    (left, near), (right, far) = (
        tuple(c + sign * h for c, h in zip(TABLE_CENTER[:2], TABLE_HALF[:2], strict=True)) for sign in (-1, 1)
    )
    z = 0.0005
    across = [[(left, y, z), (right, y, z)] for y in np.arange(near, far + 1e-6, spacing).tolist()]
    along = [[(x, near, z), (x, far, z)] for x in np.arange(left, right + 1e-6, spacing).tolist()]
    return across + along


def _colors(objects: Mapping[str, Any], goals: Sequence[str]) -> dict[str, Color]:
    others = [name for name in objects if name != GRIPPER]
    palette: dict[str, Color] = {name: OBJECT_COLORS[i % len(OBJECT_COLORS)] for i, name in enumerate(others)}
    return {GRIPPER: GOLD} | palette | dict.fromkeys([name for name in goals if name != GRIPPER], GREEN)


def _finger_centers(opening: NDArray[np.float32]) -> NDArray[np.float32]:
    """2T×3 centres of the fingers of T rows, metres in the gripper's frame; ``opening`` T in [0,1]."""
    half = opening * FINGER_TRAVEL / 2 + FINGER_HALF[1]
    zero, drop = np.zeros_like(half), np.full_like(half, -FINGER_DROP)
    return np.stack([zero, half, drop, zero, -half, drop], axis=1).reshape(-1, 3).astype(np.float32)


def _from_row_before(position: NDArray[np.float32]) -> NDArray[np.float32]:
    """T×2×3 lines: from the row before (the first: from itself) to each row."""
    return np.stack([np.concatenate([position[:1], position[:-1]]), position], axis=1)


def _to_table(position: NDArray[np.float32]) -> NDArray[np.float32]:
    """T×2×3 lines: from each row straight down (or up) to the table's top."""
    return np.stack([position, position * np.array([1, 1, 0], np.float32)], axis=1)
