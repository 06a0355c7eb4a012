"""Draw the 3-D scene of an episode: the robot, the objects, and the target of the active skill.

The scene uses Meta-World's frame: metres, x to the robot's right, y away from the robot, z up, table top at z = 0. If
the robot's layout is unknown, only the objects are drawn, and the camera is placed so that all are visible.
"""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.record.entities import GOLD, GREEN, STEEL, Color, changes, entity_path, rr, send_images, step_color
from lw_torchrl.record.meshes import GHOST_COLOR, LoggedMeshes, Motion, log_motion
from lw_torchrl.record.recorded_episode import Ghost, RecordedEpisode

OBJECT_COLORS: tuple[Color, ...] = ((80, 170, 255), (255, 120, 90), (200, 130, 255), (90, 220, 210))

# Measured in Meta-World's model: obs[3] is the distance between the fingers divided by 0.1 m. The fingers slide along y
# and reach 4.5 cm below the hand position obs[0:3].
FINGER_TRAVEL, FINGER_HALF, FINGER_DROP = 0.1, (0.010, 0.006, 0.024), 0.026
PALM_HALF, PALM_RISE = (0.018, 0.062, 0.014), 0.012
WRIST_HALF, WRIST_RISE = (0.012, 0.012, 0.055), 0.081
TABLE_CENTER, TABLE_HALF = (0.0, 0.6, -0.010), (0.7, 0.4, 0.010)
TABLE, GRID = (58, 64, 74), (92, 99, 112)
SAME_PLACE = 0.05  # maximum distance (metres) between a body's origin and the position of the object it belongs to
FOCAL, LABEL, LETTER = 160.0, 26.0, 6.5
"""Focal length, height of a label and width of a letter, in pixels of the scene view in a window of 1100×700."""

Point = tuple[float, float, float]
# Camera position and target, from behind the robot's right shoulder: without the arm, and with the arm. The center of
# the table is at (0, 0.6, 0).
SIMPLE_EYE: tuple[Point, Point] = ((0.54, 0.23, 0.46), (0.03, 0.63, 0.10))
ROBOT_EYE: tuple[Point, Point] = ((0.54, 0.18, 0.47), (-0.02, 0.62, 0.13))


def scene_size(episode: RecordedEpisode) -> float:
    """Return the size of a scene in metres: 1 for a robot at a table, otherwise the extent of the objects."""
    if episode.layout is not None or not episode.objects:
        return 1.0
    places = np.concatenate([*episode.objects.values()])
    return max(float(np.ptp(places, axis=0).max()), 1e-3)


def eye_of(episode: RecordedEpisode, motion: Motion | None) -> tuple[Point, Point]:
    """Return the camera position of a scene, and the position that the camera looks at."""
    if episode.layout is not None or not episode.objects:
        return SIMPLE_EYE if motion is None else ROBOT_EYE
    places, size = np.concatenate([*episode.objects.values()]), scene_size(episode)
    x, y, z = ((places.min(axis=0) + places.max(axis=0)) / 2).tolist()
    return (x + 0.7 * size, y - 1.4 * size, z + 0.9 * size), (x, y, z)


def log_scene(
    stream: Any,
    root: str,
    episode: RecordedEpisode,
    motion: Motion | None,
    meshes: LoggedMeshes,
    drawn: NDArray[np.int64],
    eye: tuple[Point, Point],
    ghost: Ghost | None = None,
) -> tuple[list[str], dict[str, str]]:
    """Draw the robot, objects, goal, hand path and target pose below ``root``/scene, for a camera at ``eye``.

    Return the entity paths of the trails, and the result of :func:`log_motion`. A trail consists of one short line per
    row in ``drawn``; the lines up to the time cursor are visible. Without a motion, a hand over a table is drawn
    instead of the robot; without a layout, no robot is drawn.
    """
    frames: dict[str, str] = {}
    scene, size = f"{root}/scene", scene_size(episode)
    stream.log(scene, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if motion is None and episode.layout is not None:
        _log_simple_robot(stream, scene, episode, drawn)
    elif motion is not None:
        frames = log_motion(stream, f"{scene}/bodies", motion, meshes, episode.step_time, drawn)

    def point(path: str, position: NDArray[np.float32], label: str | None, radius: float, color: Color) -> None:
        labels = None if label is None else [label]
        rows = drawn[changes(position[drawn])]
        static = position[rows] if len(rows) == 1 else None
        style = rr.Points3D.from_fields(positions=static, radii=[radius * size], colors=[color], labels=labels)
        stream.log(f"{scene}/{path}", style, static=True)
        if static is None:
            stream.send_columns(f"{scene}/{path}", episode.times(rows), rr.Points3D.columns(positions=position[rows]))

    def named_point(path: str, name: str, radius: float, color: Color) -> None:
        """Draw a point with a label; the label is moved if it would overlap another label."""
        away = offsets[name]
        point(path, positions[name], None if away.any() else name, radius, color)
        if away.any():
            point(f"names{entity_path(name)}", positions[name] + away, name, 0.0005, color)

    def lines(path: str, strips: NDArray[np.float32], radius: float, color: Color) -> None:
        colors, radii = np.tile(np.array(color, np.uint8), (len(drawn), 1)), np.full(len(drawn), radius * size)
        look = {"colors": colors, "radii": radii}
        stream.send_columns(f"{scene}/{path}", episode.times(drawn), rr.LineStrips3D.columns(strips=strips, **look))

    goal = episode.goal
    # Objects at the goal, such as "target location", have the goal's color but their own label.
    goals = [] if goal is None else [name for name, at in episode.objects.items() if np.allclose(goal, at, atol=1e-3)]
    positions = {name: position for name, position in episode.objects.items() if name != GRIPPER}
    colors: dict[str, Color] = {GRIPPER: GOLD} if GRIPPER in episode.objects else {}
    colors |= dict(zip(positions, cycle(OBJECT_COLORS), strict=False))
    if goal is not None and goal.any() and not goals:
        positions.setdefault("goal", goal)
    offsets = name_offsets({name: position[drawn] for name, position in positions.items()}, eye)
    trails = []
    for name, color in (colors | {name: GREEN for name in goals if name != GRIPPER}).items():
        part, position = entity_path(name), episode.objects[name]
        if name != GRIPPER:
            named_point(f"objects{part}", name, 0.016 if motion is None else 0.008, color)
        elif motion is None:
            point(f"objects{part}", position, None, 0.005, color)
        if motion is None and episode.layout is not None:  # a vertical line from each position to the table top
            foot = position * np.array([1, 1, 0], np.float32)
            lines(f"heights{part}", np.stack([position, foot], axis=1)[drawn], 0.0012, (*color, 150))
        if motion is None or name == GRIPPER:
            trails.append(f"{scene}/trails{part}")
            path = position[drawn]
            before = np.concatenate([path[:1], path[:-1]])
            lines(f"trails{part}", np.stack([before, path], axis=1), 0.003 if motion is None else 0.002, color)

    if "goal" in positions and "goal" not in episode.objects:
        named_point("goal", "goal", 0.018, GREEN)
    _log_target(stream, scene, episode, drawn)
    if ghost is not None:
        path = ghost.episode.objects[GRIPPER]
        stream.log(f"{scene}/ghost", rr.LineStrips3D([path], colors=[GHOST_COLOR], radii=[0.002]), static=True)
        if motion is not None and ghost.motion is not None:
            bodies = f"{scene}/ghost"
            frames |= log_motion(stream, bodies, ghost.motion, meshes, episode.step_time, drawn, ghost=True)
    return trails, frames


def touched_objects(motion: Motion, episode: RecordedEpisode) -> tuple[str, ...] | None:
    """Return, for each row, the name of the object, or of another body, that the fingers touched."""
    if motion.touched is None:
        return None
    touched, model = np.array(motion.touched[: len(episode)]), motion.model.model
    names = {}
    for body in set(touched.tolist()) & {model.body(number).name for number in range(model.nbody)}:
        rows = np.flatnonzero(touched == body)
        origin = motion.position[rows, model.body(body).id]
        gaps = {name: position[rows] - origin for name, position in episode.objects.items() if name != GRIPPER}
        distances = [(float(np.linalg.norm(gap, axis=1).mean()), name) for name, gap in gaps.items()]
        if distances and min(distances)[0] < SAME_PLACE:
            names[body] = min(distances)[1]
    return tuple(names.get(body, body) for body in touched.tolist())


def log_pictures(stream: Any, root: str, episode: RecordedEpisode, drawn: NDArray[np.int64]) -> float:
    """Log the policy's input images to ``root``/seen for the ``drawn`` rows in which they change; return the images'
    aspect ratio (width / height)."""
    if episode.pixels is None:
        return 0.0
    rows = drawn[changes(episode.pixels[drawn].reshape(len(drawn), -1))]
    send_images(stream, f"{root}/seen", episode.times(rows), episode.pixels[rows])
    _, height, width, _ = episode.pixels.shape
    return width / height


def name_offsets(positions: dict[str, NDArray[np.float32]], eye: tuple[Point, Point]) -> dict[str, NDArray[Any]]:
    """Return, by name, an offset (3,) in metres between an object's positions (T×3) and the object's label. The offsets
    are chosen so that the labels overlap least when seen from ``eye``."""
    place, ahead = np.array(eye[0], np.float32), np.subtract(eye[1], eye[0]).astype(np.float32)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1]).astype(np.float32)
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    offsets: dict[str, NDArray[Any]] = {}
    placed: list[tuple[NDArray[Any], float]] = []  # positions in pixels, and width, of the labels placed so far
    for name, position in positions.items():
        depth = np.maximum((position - place) @ ahead, 0.05)
        pixels = np.stack([(position - place) @ right, (position - place) @ up], axis=1) * (FOCAL / depth)[:, None]
        width = LETTER * len(name) + 2 * LETTER

        def overlap(lines: int, pixels: Any = pixels, width: float = width) -> float:
            """Return the fraction of rows in which this label would overlap another label, summed over labels."""
            shifted = pixels + np.array([0, lines * LABEL])
            gaps = [(np.abs(shifted - other), (width + other_width) / 2) for other, other_width in placed]
            return sum(float(((gap[:, 0] < reach) & (gap[:, 1] < 0.85 * LABEL)).mean()) for gap, reach in gaps)

        lines = min((0, 1, -1, 2, -2, 3), key=lambda lines: overlap(lines) + 0.1 * abs(lines))
        placed.append((pixels + np.array([0, lines * LABEL]), width))
        offsets[name] = (up * lines * LABEL * float(depth.mean()) / FOCAL).astype(np.float32)
    return offsets


def _log_simple_robot(stream: Any, scene: str, episode: RecordedEpisode, drawn: NDArray[np.int64]) -> None:
    times, opening = episode.times(drawn), episode.opening
    assert opening is not None

    def box(path: str, centers: Any, half_sizes: Any, color: Color, labels: list[str] | None = None) -> None:
        size = {"centers": centers, "half_sizes": half_sizes}
        look = {"colors": [color] * len(half_sizes), "fill_mode": rr.components.FillMode.Solid}
        boxes = rr.Boxes3D.from_fields(**size, **look, labels=labels, show_labels=labels is not None)
        stream.log(f"{scene}/{path}", boxes, static=True)

    box("table", [TABLE_CENTER], [TABLE_HALF], TABLE)
    (x, y, _), (width, depth, _), z = TABLE_CENTER, TABLE_HALF, 0.0005
    across, along = np.arange(y - depth, y + depth + 1e-6, 0.1), np.arange(x - width, x + width + 1e-6, 0.1)
    grid = [[(x - width, at, z), (x + width, at, z)] for at in across.tolist()]
    grid += [[(at, y - depth, z), (at, y + depth, z)] for at in along.tolist()]
    stream.log(f"{scene}/table/grid", rr.LineStrips3D(grid, colors=[GRID], radii=[0.0007]), static=True)
    box("gripper/palm", [(0.0, 0.0, PALM_RISE)], [PALM_HALF], STEEL)
    # The label is above the hand, away from the objects that the hand moves.
    box("gripper/wrist", [(0.0, 0.0, WRIST_RISE)], [WRIST_HALF], STEEL, [GRIPPER])
    box("gripper/fingers", None, [FINGER_HALF] * 2, GOLD)
    stream.send_columns(f"{scene}/gripper", times, rr.Transform3D.columns(translation=episode.objects[GRIPPER][drawn]))
    half = opening[drawn] * FINGER_TRAVEL / 2 + FINGER_HALF[1]
    zero, drop = np.zeros_like(half), np.full_like(half, -FINGER_DROP)
    centers = np.stack([zero, half, drop, zero, -half, drop], axis=1).reshape(-1, 3)  # two fingers in each row
    fingers = rr.Boxes3D.columns(centers=centers.astype(np.float32))
    stream.send_columns(f"{scene}/gripper/fingers", times, fingers.partition([2] * len(drawn)))


def _log_target(stream: Any, scene: str, episode: RecordedEpisode, drawn: NDArray[np.int64]) -> None:
    """Draw an arrow, in the plan step's color, between the object that the active skill moves and its target."""
    if episode.active is None or not any(episode.target_poses):
        return
    start, end = np.zeros((2, len(episode), 3), np.float32)
    colors = np.zeros((len(episode), 4), np.uint8)
    shown = np.zeros(len(episode), bool)
    for step, pose in enumerate(episode.target_poses):
        if pose is not None:
            rows = episode.active == step
            start[rows], end[rows] = pose.moved[rows], pose.position[rows]
            colors[rows], shown[rows] = (*step_color(step), 255), True
    rows = drawn[changes(np.concatenate([start, end, colors, shown[:, None]], axis=1)[drawn])]
    start, end, colors, shown, times = start[rows], end[rows], colors[rows], shown[rows], episode.times(rows)
    look = {"colors": colors[shown], "radii": np.full(shown.sum(), 0.004)}
    arrows = rr.Arrows3D.columns(origins=start[shown], vectors=(end - start)[shown], **look)
    stream.send_columns(f"{scene}/target", times, arrows.partition(shown.astype(int)))
