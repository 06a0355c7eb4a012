"""Meshes of CAD programs with fewer triangles: corners that lie in one small cube become one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FINEST, COARSEST = 0.0015, 0.006
CUBES_ALONG = 40.0
"""How many cubes the longest side of a mesh is cut into; the finest and the coarsest cube bound it, metres."""


class Mesh(NamedTuple):
    """Triangles with a normal for each vertex.

    Attributes:
        vertices: V×3 float32, metres.
        normals: V×3 float32, unit vectors.
        triangles: F×3 uint32, indices of vertices.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]


def clustered(corners: NDArray[np.float64], normals: NDArray[np.float64]) -> Mesh:
    """A mesh of triangles' corners (F×3×3, metres) and their normals (F×3×3), coarse enough to be kept in a file.

    The corners in a cube move to their mean, so no gap opens; corners whose normals differ stay apart, so edges stay
    sharp. Triangles that shrink to a line are left out.
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
    return Mesh(
        places[cube[first]][used].astype(np.float32),
        mean_normals[used].astype(np.float32),
        renumbered.reshape(-1, 3).astype(np.uint32),
    )


def _packed(indices: NDArray[np.int64], base: int = 1 << 20) -> NDArray[np.int64]:
    """N×3 indices below ``base`` as one number each."""
    return (indices[:, 0] * base + indices[:, 1]) * base + indices[:, 2]


def _means(values: NDArray[np.float64], group: NDArray[np.int64], groups: int) -> NDArray[np.float64]:
    """The mean of N×3 values in each group."""
    count = np.bincount(group, minlength=groups)
    return np.stack([np.bincount(group, column, minlength=groups) / count for column in values.T], axis=1)
