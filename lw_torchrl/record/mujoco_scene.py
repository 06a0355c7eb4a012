"""A MuJoCo model in a recording: its geoms once, as they stand in their bodies; then where the bodies are.

Meta-World's cameras show the same geoms, but planes are left out, and a texture becomes its mean colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lw_torchrl.record.conventions import entity_path, rr, time_columns
from lw_torchrl.suites.engine import RowModel

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
