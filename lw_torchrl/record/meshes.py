"""Draw MuJoCo models. A body's mesh is logged once per recording; each episode logs the body's poses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import blake2s
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lw_torchrl.record.entities import entity_path, rr, time_columns
from lw_torchrl.suites.engine import RowModel

SHOWN_GROUPS = (0, 1, 2)  # Meta-World keeps geoms that only collide in group 4
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default color, which is replaced by the material's color

FINEST, COARSEST = 0.0015, 0.010  # smallest and largest edge of the cubes in which vertices are merged, metres
CUBES_ALONG = 18.0  # number of cubes along the longest side of a mesh
AROUND, ALONG = 24, 7  # number of vertices of a round shape around the axis, and of a quarter circle along the axis
GHOST_COLOR = (150, 190, 255, 90)

Vertices = dict[str, NDArray[Any]]
_prepared: dict[str, ModelGeometry] = {}


@dataclass(frozen=True)
class Motion:
    """The poses of a model's B bodies in T states, and the bodies that the fingers touched."""

    model: RowModel
    position: NDArray[np.float32]  # T×B×3, metres
    quaternion: NDArray[np.float32]  # T×B×4, in w, x, y, z order
    touched: tuple[str, ...] | None = None  # T body names, or "nothing"; None if the engine does not report contacts


@dataclass(frozen=True)
class ModelGeometry:
    """The geometry of a model. A body that is fixed to a moving body is part of the moving body's mesh."""

    bodies: dict[int, str]  # body index -> name
    meshes: tuple[tuple[int, str, Vertices], ...]  # body index, mesh name and mesh; equal meshes have equal names


def model_geometry(model: RowModel) -> ModelGeometry:
    """Return the geometry of a model, cached by XML file; the first call for a file takes about half a second."""
    if model.path not in _prepared:
        _prepared[model.path] = _prepare(model.model)
    return _prepared[model.path]


LoggedMeshes = dict[str, bytes]
"""A mapping from the meshes already in a recording to their static poses (b"" if each episode sets the pose)."""


def log_motion(
    stream: Any,
    root: str,
    motion: Motion,
    logged: LoggedMeshes,
    step_time: float,
    drawn: NDArray[np.int64] | None = None,
    *,
    ghost: bool = False,
) -> dict[str, str]:
    """Log the bodies' poses below ``root`` (row t at time step t), and their meshes below /meshes (once per recording).

    ``drawn`` holds the rows to draw, including the first; None draws all rows. A ``ghost`` has translucent meshes below
    /ghosts, for moving bodies only. Return a dict from each mesh's entity to the coordinate frame in which a view shows
    the mesh ("" if the mesh does not move).
    """
    geometry = model_geometry(motion.model)
    last = len(motion.position) - 1
    drawn = np.arange(last + 1) if drawn is None else np.append(drawn[drawn < last], last)
    poses = np.concatenate([motion.position[drawn], motion.quaternion[drawn][..., [1, 2, 3, 0]]], axis=2)
    moves = np.ones(poses.shape[:2], bool)
    moves[1:] = (poses[1:] != poses[:-1]).any(axis=2)
    frames: dict[str, str] = {}
    frame_poses: dict[str, tuple[NDArray[np.int64], NDArray[np.float32]]] = {}
    for body, name, mesh in geometry.meshes:
        path = entity_path("ghosts" if ghost else "meshes", name)
        position, quaternion = poses[:, body, :3], poses[:, body, 3:]
        moved = np.flatnonzero(moves[:, body])
        pose = b"" if len(moved) > 1 else position[0].tobytes() + quaternion[0].tobytes()
        if ghost and pose:
            continue
        if path not in logged:
            logged[path] = pose
            look: dict[str, Any] = {"albedo_factor": GHOST_COLOR, "vertex_colors": None} if ghost else {}
            stream.log(path, rr.Mesh3D(**(mesh | look)), static=True)
            if pose:
                static_pose = rr.Transform3D(translation=position[0], quaternion=rr.Quaternion(xyzw=quaternion[0]))
                stream.log(path, static_pose, static=True)
        # A mesh with the same pose as in the first episode needs no frame; each frame adds two kilobytes to a page.
        if pose and logged[path] == pose:
            frames[path] = ""
            continue
        frames[path] = f"{stream.get_recording_id()[-8:]}{root}/{geometry.bodies[body]}"
        frame_poses.setdefault(frames[path], (drawn[moved], poses[moved, body]))
    if frame_poses:  # log all frames to one entity: an entity for each body would double the size
        rows, values = (np.concatenate(parts) for parts in zip(*frame_poses.values(), strict=True))
        order = np.argsort(rows, kind="stable")
        names = np.repeat([*frame_poses], [len(own) for own, _ in frame_poses.values()])[order].tolist()
        values = values[order]
        columns = rr.Transform3D.columns(translation=values[:, :3], quaternion=values[:, 3:], child_frame=names)
        stream.send_columns(root, time_columns(rows[order], step_time), columns)
    return frames


def _prepare(model: Any) -> ModelGeometry:
    bodies: dict[int, str] = {}
    parts: dict[tuple[int, int], list[tuple[Vertices, NDArray[np.uint8]]]] = {}
    for geom in range(model.ngeom):
        color = _color(model, geom)
        if model.geom_group[geom] not in SHOWN_GROUPS or color[3] == 0:
            continue
        shape = _shape(model, geom)
        if shape is None:
            continue
        body = int(model.geom_bodyid[geom])
        shape = _placed(shape, model.geom_pos[geom], model.geom_quat[geom])
        while model.body_weldid[body] not in (0, body):
            shape = _placed(shape, model.body_pos[body], model.body_quat[body])
            body = int(model.body_parentid[body])
        bodies.setdefault(body, model.body(body).name or f"body-{body}")
        parts.setdefault((body, int(color[3])), []).append((shape, color))
    meshes = []
    for (body, alpha), shapes in parts.items():
        mesh = _joined(shapes)
        color = np.array([255, 255, 255, alpha], np.uint8)
        if (mesh["vertex_colors"] == mesh["vertex_colors"][0]).all():
            color[:3] = mesh.pop("vertex_colors")[0, :3]
        digest = blake2s(b"".join(mesh[key].tobytes() for key in sorted(mesh)) + color.tobytes(), digest_size=4)
        meshes.append((body, f"{bodies[body]}-{digest.hexdigest()}", mesh | {"albedo_factor": color}))
    return ModelGeometry(bodies, tuple(meshes))


def _joined(shapes: Iterable[tuple[Vertices, NDArray[np.uint8]]]) -> Vertices:
    """Join single-color shapes into one mesh with vertex colors."""
    parts: dict[str, list[NDArray[Any]]] = {}
    start = 0
    for vertices, color in shapes:
        corners = len(vertices["vertex_positions"])
        moved = {**vertices, "triangle_indices": vertices["triangle_indices"] + np.uint32(start)}
        for key, values in (moved | {"vertex_colors": np.tile([*color[:3], 255], (corners, 1))}).items():
            parts.setdefault(key, []).append(values)
        start += corners
    return {key: np.concatenate(values) for key, values in parts.items()}


def _placed(shape: Vertices, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> Vertices:
    """Move a shape to a pose; the quaternion is in w, x, y, z order."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    turn = matrix.reshape(3, 3).T
    return shape | {
        "vertex_positions": (shape["vertex_positions"] @ turn + position).astype(np.float32),
        "vertex_normals": (shape["vertex_normals"] @ turn).astype(np.float32),
    }


def _shape(model: Any, geom: int) -> Vertices | None:
    """Return a geom's surface in the geom's own frame, or None for a plane."""
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])).name, model.geom_size[geom]
    angle = np.linspace(0, np.pi / 2, ALONG)
    quarter, up, out = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.array([0, 1]), np.array([1, 0])
    low = quarter[::-1] * [1, -1]
    if kind == "mjGEOM_PLANE":
        return None
    if kind == "mjGEOM_MESH":
        return _clustered(*_corners(model, model.geom_dataid[geom]))
    if kind == "mjGEOM_BOX":
        return _box(size)
    if kind in ("mjGEOM_SPHERE", "mjGEOM_ELLIPSOID"):
        ball, scale = np.concatenate([low, quarter[1:]]), size if kind == "mjGEOM_ELLIPSOID" else size[[0, 0, 0]]
        sphere = _turned([(ball, ball)])
        normals = sphere["vertex_normals"] / scale
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return sphere | {"vertex_positions": sphere["vertex_positions"] * scale, "vertex_normals": normals}
    radius, half = size[0], size[1]
    if kind == "mjGEOM_CAPSULE":
        rims = np.concatenate([low * radius - up * half, quarter * radius + up * half])
        return _turned([(rims, np.concatenate([low, quarter]))])
    if kind == "mjGEOM_CYLINDER":
        bottom, top = np.array([[0, -half], [radius, -half]]), np.array([[radius, half], [0, half]])
        side = np.stack([bottom[1], top[0]])
        ones = np.ones((2, 1))
        return _turned([(bottom, ones * -up), (side, ones * out), (top, ones * up)])
    raise NotImplementedError(f"geom {geom} has the type {kind}, which cannot be drawn")


def _box(half: NDArray[np.float64]) -> Vertices:
    front = np.array([(1.0, -1.0, -1.0), (1.0, 1.0, -1.0), (1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
    faces = np.stack([np.roll(side, axis, axis=1) for axis in range(3) for side in (-front[::-1], front)])
    triangles = 4 * np.arange(6)[:, None, None] + [(0, 1, 2), (0, 2, 3)]
    return {
        "vertex_positions": (faces * half).reshape(-1, 3),
        "vertex_normals": np.repeat(faces.mean(axis=1), 4, axis=0),
        "triangle_indices": triangles.reshape(-1, 3).astype(np.uint32),
    }


def _turned(profile: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> Vertices:
    """Create a surface of revolution around z from polylines, each with K vertices (K×2: radius and height, from bottom
    to top) and their normals (K×2)."""
    angle = np.arange(AROUND) * 2 * np.pi / AROUND
    circle = np.stack([np.cos(angle), np.sin(angle), np.ones(AROUND)], axis=1)
    corners, normals = (
        np.concatenate([line[:, None, [0, 0, 1]] * circle for line in lines]).reshape(-1, 3)
        for lines in zip(*profile, strict=True)
    )
    triangles: list[NDArray[np.int64]] = []
    start = 0
    for line, _ in profile:
        here = start + np.arange(len(line) * AROUND).reshape(-1, AROUND)
        a, b, c, d = here[:-1], np.roll(here[:-1], -1, axis=1), np.roll(here[1:], -1, axis=1), here[1:]
        triangles += [np.stack(three, axis=-1).reshape(-1, 3) for three in ((a, b, c), (a, c, d))]
        start += here.size
    indices = np.concatenate(triangles).astype(np.uint32)
    return {"vertex_positions": corners, "vertex_normals": normals, "triangle_indices": indices}


def _corners(model: Any, mesh: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the vertices of a mesh's triangles (F×3×3) and their normals (F×3×3), which MuJoCo indexes separately."""

    def part(values: Any, start: Any, count: Any) -> NDArray[np.float64]:
        return np.asarray(values[start[mesh] : start[mesh] + count[mesh]])

    faces = part(model.mesh_face, model.mesh_faceadr, model.mesh_facenum)
    normals = part(model.mesh_facenormal, model.mesh_faceadr, model.mesh_facenum)
    vertices = part(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum)
    directions = part(model.mesh_normal, model.mesh_normaladr, model.mesh_normalnum)
    return vertices[faces].astype(np.float64), directions[normals].astype(np.float64)


def _color(model: Any, geom: int) -> NDArray[np.uint8]:
    """Return a geom's color (4,) uint8: the color of the geom or material, times the mean color of the texture."""
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
    """Simplify a mesh given by the triangles' vertices (F×3×3, metres) and unit normals (F×3×3).

    All vertices in a cube of a grid move to their mean, so no gaps open; vertices with different normals stay separate.
    """
    points, directions = corners.reshape(-1, 3), normals.reshape(-1, 3)
    low = points.min(axis=0)
    size = float(np.clip(np.ptp(points, axis=0).max() / CUBES_ALONG, FINEST, COARSEST))
    cubes, cube = np.unique(_packed(((points - low) / size).astype(np.int64)), return_inverse=True)
    places = _means(points, cube, len(cubes))
    directed = cube * 125 + _packed(np.rint(directions * 2.0).astype(np.int64) + 2, 5)
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
    """Pack N×3 integer indices, each less than ``base``, into one integer per row."""
    return (indices[:, 0] * base + indices[:, 1]) * base + indices[:, 2]


def _means(values: NDArray[np.float64], group: NDArray[np.int64], groups: int) -> NDArray[np.float64]:
    """Return the mean of N×3 ``values`` in each group, as an array groups×3."""
    count = np.bincount(group, minlength=groups)
    return np.stack([np.bincount(group, column, minlength=groups) / count for column in values.T], axis=1)
