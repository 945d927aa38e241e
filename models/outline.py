"""Extracts the feature edges of a mesh: creases and open boundaries."""

import math

import numpy as np
import numpy.typing as npt

from weldcal.models.mesh import TriMesh

Floats = npt.NDArray[np.float64]


def outline(mesh: TriMesh, least_angle_rad: float = math.radians(20.0)) -> tuple[Floats, Floats]:
    """Starts and ends (N,3) m of the edges whose two faces turn by more than the least angle, or that have one face only.

    Args:
        mesh: faces that meet share their vertices (as TriMesh's makers do).
        least_angle_rad: between the faces' normals.
    """
    corners = mesh.triangles
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(corners)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, face = edges[order], face[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    second = np.concatenate([[False], same])
    alone = ~second & ~np.concatenate([same, [False]])
    pairs = np.flatnonzero(same)
    turned = np.einsum("ni,ni->n", mesh.normals[face[pairs]], mesh.normals[face[pairs + 1]]) < math.cos(least_angle_rad)
    kept = np.concatenate([edges[alone], edges[pairs[turned]]])
    return mesh.vertices[kept[:, 0]], mesh.vertices[kept[:, 1]]
