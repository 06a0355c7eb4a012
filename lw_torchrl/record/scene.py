"""The 3-D scene of an episode: the robot, its task, what the plan names, and where the skill in force moves things to.

Meta-World's frame: metres, x to the robot's right, y away from the robot, z up, the table's top at z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.record.conventions import GOLD, GREEN, STEEL, Color, entity_path, rr, step_color, time_columns
from lw_torchrl.record.recorded_episode import RecordedEpisode
from lw_torchrl.suites.engine import RowModel

OBJECT_COLORS: tuple[Color, ...] = ((80, 170, 255), (255, 120, 90), (200, 130, 255), (90, 220, 210))

# Measured in Meta-World's model: obs[3] is the distance between the fingers over 0.1 m; they slide along y
# and reach 4.5 cm below obs[0:3], the position of the hand.
FINGER_TRAVEL, FINGER_HALF, FINGER_DROP = 0.1, (0.010, 0.006, 0.024), 0.026
PALM_HALF, PALM_RISE = (0.018, 0.062, 0.014), 0.012
WRIST_HALF, WRIST_RISE = (0.012, 0.012, 0.055), 0.081
TABLE_CENTER, TABLE_HALF = (0.0, 0.6, -0.010), (0.7, 0.4, 0.010)
TABLE, GRID = (58, 64, 74), (92, 99, 112)


def log_scene(stream: Any, root: str, episode: RecordedEpisode, motion: Motion | None = None) -> list[str]:
    """Draw robot, objects, goal, the hand's path and the target pose under ``root``/scene; returns the trails' paths.

    A trail is one short line per row, shown up to the cursor. Without a motion, the robot is a hand over a table.
    """
    scene, times = f"{root}/scene", time_columns(np.arange(len(episode)))
    stream.log(scene, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if motion is None:
        _log_simple_robot(stream, scene, episode)
    else:
        log_model(stream, f"{scene}/bodies", model_geometry(motion.model))
        log_motion(stream, f"{scene}/bodies", motion)

    def point(path: str, position: NDArray[np.float32], label: str | None, radius: float, color: Color) -> None:
        labels = None if label is None else [label]
        style = rr.Points3D.from_fields(radii=[radius], colors=[color], labels=labels, show_labels=label is not None)
        stream.log(f"{scene}/{path}", style, static=True)
        stream.send_columns(f"{scene}/{path}", times, rr.Points3D.columns(positions=position))

    def lines(path: str, strips: NDArray[np.float32], radius: float, color: Color) -> None:
        stream.log(f"{scene}/{path}", rr.LineStrips3D.from_fields(colors=[color], radii=[radius]), static=True)
        stream.send_columns(f"{scene}/{path}", times, rr.LineStrips3D.columns(strips=strips))

    goal = np.ascontiguousarray(episode.observation[:, episode.layout.positions[-1]])
    # Objects that stand for the goal, like "target location", have its colour, and their own label.
    goals = [name for name, position in episode.objects.items() if np.allclose(goal, position, atol=1e-3)]
    others = [name for name in episode.objects if name != GRIPPER]
    colors = {GRIPPER: GOLD} | dict(zip(others, cycle(OBJECT_COLORS), strict=False))
    trails = []
    for name, color in (colors | {name: GREEN for name in goals if name != GRIPPER}).items():
        part, position = entity_path(name), episode.objects[name]
        label, size = (None, 0.005) if name == GRIPPER else (name, 0.016 if motion is None else 0.008)
        point(f"objects{part}", position, label, size, color)
        if motion is None:  # from each row straight down, or up, to the table's top
            onto = position * np.array([1, 1, 0], np.float32)
            lines(f"heights{part}", np.stack([position, onto], axis=1), 0.0012, (*color, 150))
        if motion is None or name == GRIPPER:
            # The whole way, faint, and the way so far.
            whole = rr.LineStrips3D([position], colors=[(*color, 70)], radii=[0.0012])
            stream.log(f"{scene}/paths{part}", whole, static=True)
            trails.append(f"{scene}/trails{part}")
            before = np.concatenate([position[:1], position[:-1]])
            lines(f"trails{part}", np.stack([before, position], axis=1), 0.003 if motion is None else 0.002, color)

    if goal.any():
        point("goal", goal, None if goals else "goal", 0.018, GREEN)
    _log_target(stream, scene, episode, times)
    return trails


def _log_simple_robot(stream: Any, scene: str, episode: RecordedEpisode) -> None:
    times = time_columns(np.arange(len(episode)))

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
    # Its name stands above the hand, where the objects that it handles are not.
    box("gripper/wrist", [(0.0, 0.0, WRIST_RISE)], [WRIST_HALF], STEEL, [GRIPPER])
    box("gripper/fingers", None, [FINGER_HALF] * 2, GOLD)
    stream.send_columns(f"{scene}/gripper", times, rr.Transform3D.columns(translation=episode.objects[GRIPPER]))
    half = episode.observation[:, episode.layout.opening] * FINGER_TRAVEL / 2 + FINGER_HALF[1]
    zero, drop = np.zeros_like(half), np.full_like(half, -FINGER_DROP)
    centers = np.stack([zero, half, drop, zero, -half, drop], axis=1).reshape(-1, 3)  # of two fingers, row by row
    fingers = rr.Boxes3D.columns(centers=centers.astype(np.float32))
    stream.send_columns(f"{scene}/gripper/fingers", times, fingers.partition([2] * len(episode)))


def _log_target(stream: Any, scene: str, episode: RecordedEpisode, times: Sequence[Any]) -> None:
    """An arrow from what the scripted skill in force moves to where it goes, in the step's colour."""
    if episode.in_force is None or not any(episode.target_poses):
        return
    start, end = np.zeros((2, len(episode), 3), np.float32)
    colors = np.zeros((len(episode), 4), np.uint8)
    shown = np.zeros(len(episode), bool)
    for step, pose in enumerate(episode.target_poses):
        if pose is not None:
            rows = episode.in_force == step
            start[rows], end[rows] = pose.moved[rows], pose.position[rows]
            colors[rows], shown[rows] = (*step_color(step), 255), True
    arrows = rr.Arrows3D.columns(origins=start[shown], vectors=(end - start)[shown], colors=colors[shown])
    stream.log(f"{scene}/target", rr.Arrows3D.from_fields(radii=[0.004]), static=True)
    stream.send_columns(f"{scene}/target", times, arrows.partition(shown.astype(int)))
    style = rr.Points3D.from_fields(radii=[0.012], labels=["target"], show_labels=True)
    stream.log(f"{scene}/target/position", style, static=True)
    points = rr.Points3D.columns(positions=end[shown], colors=colors[shown])
    stream.send_columns(f"{scene}/target/position", times, points.partition(shown.astype(int)))


SHOWN_GROUPS = (0, 1, 2)  # Meta-World keeps what only collides in group 4
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom that was given none: the material's counts

FINEST, COARSEST = 0.0015, 0.006
CUBES_ALONG = 40.0
"""How many cubes the longest side of a mesh is cut into; the finest and the coarsest cube bound it, metres."""

_prepared: dict[str, ModelGeometry] = {}


@dataclass(frozen=True)
class Motion:
    """Where the B bodies of a model were: ``position`` T×B×3 float32, metres; ``quaternion`` T×B×4 float32, w first."""

    model: RowModel
    position: NDArray[np.float32]
    quaternion: NDArray[np.float32]


@dataclass(frozen=True)
class ModelGeometry:
    """What is drawn of a model: its bodies' entities by number; for each part, body, name, and what is logged there."""

    bodies: dict[int, str]
    parts: tuple[tuple[str, str, tuple[Any, ...]], ...]


def model_geometry(model: RowModel) -> ModelGeometry:
    """What is drawn of a model; prepared once for each XML file, in about half a second."""
    if model.path not in _prepared:
        _prepared[model.path] = _prepare(model.model)
    return _prepared[model.path]


def log_model(stream: Any, root: str, geometry: ModelGeometry) -> None:
    """The geoms below ``root``, each under its body's name; they never change."""
    for body, part, archetypes in geometry.parts:
        stream.log(f"{root}{entity_path(body, part)}", *archetypes, static=True)


def log_motion(stream: Any, root: str, motion: Motion) -> None:
    """The poses of the bodies below ``root``, row t at step t: static where a body never moves."""
    for body, name in model_geometry(motion.model).bodies.items():
        path = f"{root}{entity_path(name)}"
        place, turn = motion.position[:, body], motion.quaternion[:, body][:, [1, 2, 3, 0]]
        moved = (place[1:] != place[:-1]).any(axis=1) | (turn[1:] != turn[:-1]).any(axis=1)
        if not moved.any():
            still = rr.Transform3D(translation=place[0], quaternion=rr.Quaternion(xyzw=turn[0]))
            stream.log(path, still, static=True)
            continue
        steps = np.flatnonzero(np.concatenate([[True], moved]))
        columns = rr.Transform3D.columns(translation=place[steps], quaternion=turn[steps])
        stream.send_columns(path, time_columns(steps), columns)


def _prepare(model: Any) -> ModelGeometry:
    bodies: dict[int, str] = {}
    parts = []
    for geom in range(model.ngeom):
        color = _color(model, geom)
        if model.geom_group[geom] not in SHOWN_GROUPS or color[3] == 0:
            continue
        shape = _shape(model, geom, color)
        if shape is None:
            continue
        body = int(model.geom_bodyid[geom])
        name = bodies.setdefault(body, model.body(body).name or f"body-{body}")
        turn = rr.Quaternion(xyzw=model.geom_quat[geom][[1, 2, 3, 0]])
        pose = rr.Transform3D(translation=model.geom_pos[geom], quaternion=turn)
        parts.append((name, f"geom-{geom}", (shape, pose)))
    return ModelGeometry(bodies, tuple(parts))


def _shape(model: Any, geom: int, color: NDArray[np.uint8]) -> Any:
    """The geom as rerun draws it, None for a plane."""
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])).name, model.geom_size[geom]
    if kind == "mjGEOM_PLANE":
        return None
    if kind == "mjGEOM_MESH":
        return rr.Mesh3D(**_clustered(*_corners(model, model.geom_dataid[geom])), albedo_factor=color)
    round_ = {"lengths": [2 * size[1]], "radii": [size[0]]}
    drawn = {
        "mjGEOM_BOX": (rr.Boxes3D, {"half_sizes": [size]}),
        "mjGEOM_SPHERE": (rr.Ellipsoids3D, {"half_sizes": [[size[0]] * 3]}),
        "mjGEOM_ELLIPSOID": (rr.Ellipsoids3D, {"half_sizes": [size]}),
        "mjGEOM_CYLINDER": (rr.Cylinders3D, round_),
        # MuJoCo's stands around its middle, rerun's begins at its origin.
        "mjGEOM_CAPSULE": (rr.Capsules3D, round_ | {"translations": [[0, 0, -size[1]]]}),
    }
    if kind not in drawn:
        raise NotImplementedError(f"geom {geom} is of type {kind}, which no model of Meta-World has")
    shape, sizes = drawn[kind]
    return shape(**sizes, colors=[color], fill_mode=rr.components.FillMode.Solid)


def _corners(model: Any, mesh: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The corners of a mesh's triangles and their normals, each F×3×3: MuJoCo numbers the two apart."""

    def part(values: Any, start: Any, count: Any) -> NDArray[np.float64]:
        return np.asarray(values[start[mesh] : start[mesh] + count[mesh]])

    faces = part(model.mesh_face, model.mesh_faceadr, model.mesh_facenum)
    normals = part(model.mesh_facenormal, model.mesh_faceadr, model.mesh_facenum)
    vertices = part(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum)
    directions = part(model.mesh_normal, model.mesh_normaladr, model.mesh_normalnum)
    return vertices[faces].astype(np.float64), directions[normals].astype(np.float64)


def _color(model: Any, geom: int) -> NDArray[np.uint8]:
    """(4,) uint8: the geom's colour or else its material's, times what the texture is on average."""
    material = model.geom_matid[geom]
    rgba = np.array(model.geom_rgba[geom], np.float64)
    if material >= 0:
        if np.allclose(rgba, DEFAULT_RGBA):
            rgba = np.array(model.mat_rgba[material], np.float64)
        textures = model.mat_texid[material]
        for texture in textures[textures >= 0][:1]:
            channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
            end = start + model.tex_height[texture] * model.tex_width[texture] * channels
            rgba[:3] *= model.tex_data[start:end].reshape(-1, channels)[:, :3].mean(axis=0) / 255.0
    return np.rint(np.clip(rgba, 0, 1) * 255).astype(np.uint8)


def _clustered(corners: NDArray[np.float64], normals: NDArray[np.float64]) -> dict[str, Any]:
    """A coarse mesh, as rerun takes it, of triangles' corners (F×3×3, metres) and their unit normals (F×3×3).

    The corners in a cube move to their mean, so no gap opens; those whose normals differ stay apart: edges stay sharp.
    """
    points, directions = corners.reshape(-1, 3), normals.reshape(-1, 3)
    low = points.min(axis=0)
    size = float(np.clip(np.ptp(points, axis=0).max() / CUBES_ALONG, FINEST, COARSEST))
    cubes, cube = np.unique(_packed(((points - low) / size).astype(np.int64)), return_inverse=True)
    places = _means(points, cube, len(cubes))
    directed = cube * 125 + _packed(np.rint(directions * 2.0).astype(np.int64) + 2, 5)
    # The first corner of each vertex tells its cube.
    _, first, vertex = np.unique(directed, return_index=True, return_inverse=True)
    mean_normals = _means(directions, vertex, len(first))
    mean_normals /= np.maximum(np.linalg.norm(mean_normals, axis=1, keepdims=True), 1e-9)
    a, b, c = cube.reshape(-1, 3).T
    triangles = vertex.reshape(-1, 3)[(a != b) & (b != c) & (a != c)]
    _, once = np.unique(_packed(triangles), return_index=True)
    used, renumbered = np.unique(triangles[once], return_inverse=True)
    return {
        "vertex_positions": places[cube[first]][used].astype(np.float32),
        "vertex_normals": mean_normals[used].astype(np.float32),
        "triangle_indices": renumbered.reshape(-1, 3).astype(np.uint32),
    }


def _packed(indices: NDArray[np.int64], base: int = 1 << 20) -> NDArray[np.int64]:
    """N×3 indices below ``base`` as one number each."""
    return (indices[:, 0] * base + indices[:, 1]) * base + indices[:, 2]


def _means(values: NDArray[np.float64], group: NDArray[np.int64], groups: int) -> NDArray[np.float64]:
    """The mean of N×3 values in each group."""
    count = np.bincount(group, minlength=groups)
    return np.stack([np.bincount(group, column, minlength=groups) / count for column in values.T], axis=1)
