"""The 3-D scene of an episode: the robot and its task, and what the plan speaks of.

Meta-World's frame: metres, x to the robot's right, y away from the robot, z up, the table's top at z = 0.
Static things are sent once; what moves is sent as whole columns, one call per entity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.record.colors import GOLD, GREEN, Color, step_color
from lw_torchrl.record.mujoco_scene import Motion, log_model, log_motion, model_geometry
from lw_torchrl.record.recorded_episode import RecordedEpisode
from lw_torchrl.record.simple_scene import log_simple_robot, to_table
from lw_torchrl.record.timelines import entity_path, time_columns

if TYPE_CHECKING:
    from rerun import RecordingStream

OBJECT_COLORS = ((80, 170, 255), (255, 120, 90), (200, 130, 255), (90, 220, 210))


def log_scene(stream: RecordingStream, root: str, episode: RecordedEpisode, motion: Motion | None = None) -> list[str]:
    """Draw the robot, the objects, the goal, the hand's path and what it is aiming at under ``root``/scene.

    Without a motion, the robot is a hand over a table, and what it handles are points.

    Returns:
        The entity paths of the trails: one short line per row, to be shown up to the time cursor.
    """
    import rerun as rr

    scene, times = f"{root}/scene", time_columns(np.arange(len(episode)))
    stream.log(scene, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if motion is None:
        log_simple_robot(stream, scene, episode)
    else:
        log_model(stream, f"{scene}/bodies", model_geometry(motion.model))
        log_motion(stream, f"{scene}/bodies", motion)

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
        label, size = (None, 0.005) if name == GRIPPER else (name, 0.016 if motion is None else 0.008)
        point(f"objects{part}", position, label, size, color)
        if motion is None:
            lines(f"heights{part}", to_table(position), 0.0012, (*color, 150))
        if motion is None or name == GRIPPER:
            # The whole way, faint, and the way so far.
            whole = rr.LineStrips3D([position], colors=[(*color, 70)], radii=[0.0012])
            stream.log(f"{scene}/paths{part}", whole, static=True)
            trails.append(f"{scene}/trails{part}")
            lines(f"trails{part}", _from_row_before(position), 0.003 if motion is None else 0.002, color)

    if goal.any():
        point("goal", goal, None if goals else "goal", 0.018, GREEN)
    _log_aim(stream, scene, episode, times)
    return trails


def _log_aim(stream: RecordingStream, scene: str, episode: RecordedEpisode, times: Sequence[Any]) -> None:
    """An arrow from what the skill in force moves to where it goes, in the step's colour; none where no scripted
    skill is in force."""
    import rerun as rr

    if episode.in_force is None or not any(episode.aims):
        return
    start, end = np.zeros((2, len(episode), 3), np.float32)
    colors = np.zeros((len(episode), 4), np.uint8)
    shown = np.zeros(len(episode), bool)
    for step, aim in enumerate(episode.aims):
        if aim is not None:
            rows = episode.in_force == step
            start[rows], end[rows] = aim.moved[rows], aim.point[rows]
            colors[rows], shown[rows] = (*step_color(step), 255), True
    arrows = rr.Arrows3D.columns(origins=start[shown], vectors=(end - start)[shown], colors=colors[shown])
    stream.log(f"{scene}/aim", rr.Arrows3D.from_fields(radii=[0.004]), static=True)
    stream.send_columns(f"{scene}/aim", times, arrows.partition(shown.astype(int)))
    balls = rr.Points3D.columns(positions=end[shown], colors=colors[shown])
    stream.log(
        f"{scene}/aim/point", rr.Points3D.from_fields(radii=[0.012], labels=["aim"], show_labels=True), static=True
    )
    stream.send_columns(f"{scene}/aim/point", times, balls.partition(shown.astype(int)))


def _colors(objects: Mapping[str, Any], goals: Sequence[str]) -> dict[str, Color]:
    others = [name for name in objects if name != GRIPPER]
    palette: dict[str, Color] = {name: OBJECT_COLORS[i % len(OBJECT_COLORS)] for i, name in enumerate(others)}
    return {GRIPPER: GOLD} | palette | dict.fromkeys([name for name in goals if name != GRIPPER], GREEN)


def _from_row_before(position: NDArray[np.float32]) -> NDArray[np.float32]:
    """T×2×3 lines: from the row before (the first: from itself) to each row."""
    return np.stack([np.concatenate([position[:1], position[:-1]]), position], axis=1)
