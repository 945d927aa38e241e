"""Shapes of the 3D view: rings and triads, solid or dashed, a view cone, small signs, coloured clouds."""

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud

from weldcal.models.arrays import Array
from weldcal.models.scanners import ScannerPreset
from weldcal.systems.bodies.textured_board import textured_board

AXES = (Rgba(0.9, 0.2, 0.2, 1), Rgba(0.2, 0.75, 0.2, 1), Rgba(0.2, 0.4, 0.95, 1))
R_SIGN = RotationMatrix(RollPitchYaw(np.pi / 2, 0.0, np.deg2rad(55.0)))
"""Signs face a viewer in front of the robot (+x, -y)."""
_SEGMENTS, _RING_M = 72, 0.0022
_AXIS_M, _AXIS_RADIUS_M, _DASHES = 0.10, 0.0022, 4
_PAPER = (255, 255, 255)


def draw_ring(meshcat: Meshcat, path: str, radius_m: float, rgba: Rgba, *, dashed: bool = False) -> None:
    """Draw a flat ring of that radius about z, in the x-y plane of its path."""
    angle = np.linspace(0.0, 2.0 * np.pi, _SEGMENTS, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    vertices = np.hstack([(radius_m - 0.5 * _RING_M) * around, (radius_m + 0.5 * _RING_M) * around])
    k = np.arange(_SEGMENTS)
    if dashed:
        k = k[k % 6 < 3]
    after = (k + 1) % _SEGMENTS
    faces = np.hstack([np.stack([k, k + _SEGMENTS, after]), np.stack([after, k + _SEGMENTS, after + _SEGMENTS])])
    draw_mesh(meshcat, path, vertices, faces, rgba)


def draw_mesh(meshcat: Meshcat, path: str, vertices: Array, faces: NDArray[np.int64], rgba: Rgba) -> None:
    """Draw triangles with both of their sides: vertices (3, n) m, faces (3, m)."""
    meshcat.SetTriangleMesh(
        path,
        np.asfortranarray(vertices),
        np.asfortranarray(faces.astype(np.int32)),
        rgba,
        side=Meshcat.SideOfFaceToRender.kDoubleSide,
    )


def draw_triad(meshcat: Meshcat, path: str, *, dashed: bool = False) -> None:
    """Draw the axes of the path's frame, 0.1 m long."""
    pieces = _DASHES if dashed else 1
    step = _AXIS_M / pieces
    length = 0.5 * step if dashed else step
    for axis, rgba in enumerate(AXES):
        R = RotationMatrix.MakeFromOneVector(np.eye(3)[axis], 2)
        for k in range(pieces):
            piece = f"{path}/axis{axis}/{k}"
            meshcat.SetObject(piece, Cylinder(_AXIS_RADIUS_M, length), rgba)
            meshcat.SetTransform(piece, RigidTransform(R, (k * step + 0.5 * length) * np.eye(3)[axis]))


def draw_view_cone(meshcat: Meshcat, path: str, scanner: ScannerPreset, depth_m: float, rgba: Rgba) -> None:
    """Draw what the scanner sees, from its working range's near end to `depth_m`: faint faces and their edges."""
    u = np.array([0.0, scanner.width, scanner.width, 0.0]) - 0.5
    v = np.array([0.0, 0.0, scanner.height, scanner.height]) - 0.5
    rays = np.stack([(u - scanner.cx) / scanner.fx, (v - scanner.cy) / scanner.fy, np.ones(4)])
    apex, near, far = np.zeros((3, 4)), scanner.near_m * rays, depth_m * rays
    k, after = np.arange(4), (np.arange(4) + 1) % 4
    faces = np.hstack([np.stack([k, k + 4, after]), np.stack([after, k + 4, after + 4])])
    draw_mesh(meshcat, f"{path}/faces", np.hstack([near, far]), faces, Rgba(rgba.r(), rgba.g(), rgba.b(), 0.10))
    starts = np.hstack([apex, near, far])
    ends = np.hstack([far, near[:, after], far[:, after]])
    meshcat.SetLineSegments(f"{path}/edges", np.asfortranarray(starts), np.asfortranarray(ends), 1.0, rgba)


def draw_sign(meshcat: Meshcat, path: str, text: str, height_m: float, colour: tuple[int, int, int]) -> None:
    """Draw a small sign with the text, upright and facing the cell's camera; `colour` is its ink and edge, BGR."""
    (width, high), under = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 1.0, 2)
    picture = np.full((high + under + 16, width + 24, 3), _PAPER, dtype=np.uint8)
    cv2.rectangle(picture, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1), colour, 4)
    cv2.putText(picture, text, (12, high + 8), cv2.FONT_HERSHEY_DUPLEX, 1.0, colour, 2, cv2.LINE_AA)
    name = path.strip("/").replace("/", "_")
    meshcat.SetObject(
        path,
        textured_board(
            name, height_m * picture.shape[1] / picture.shape[0], height_m, (picture // 12) * 12, glows=True
        ),
    )


def coloured(points: Array, colours: NDArray[np.uint8] | None = None) -> PointCloud:
    """A cloud of points (n, 3) m, with RGB (n, 3) where they are given."""
    fields = BaseField.kXYZs if colours is None else BaseField.kXYZs | BaseField.kRGBs
    cloud = PointCloud(len(points), Fields(fields))
    cloud.mutable_xyzs()[:] = np.asarray(points).T
    if colours is not None:
        cloud.mutable_rgbs()[:] = colours.T
    return cloud


def diverging(share: Array) -> NDArray[np.uint8]:
    """Colours (n, 3) RGB of shares (n,) from -1 (blue) over 0 (white) to 1 (red)."""
    t = np.clip(share, -1.0, 1.0)[:, None]
    blue, white, red = np.array([33, 102, 172.0]), np.array([247, 247, 247.0]), np.array([178, 24, 43.0])
    end = np.where(t < 0.0, blue, red)
    return np.asarray(white + (end - white) * np.abs(t)).round().astype(np.uint8)
