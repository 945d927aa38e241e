"""Shapes, colours and scales of the 3D view, and its legend."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import Cylinder, InMemoryMesh, Mesh, Meshcat, Rgba
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud

from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.models.arrays import Array
from weldcal.models.scanners import ScannerPreset

CONE, CLOUD = Rgba(0.05, 0.45, 0.50, 1.0), Rgba(0.12, 0.25, 0.40, 1.0)
CIRCLE, UNCERTAINTY = Rgba(0.85, 0.10, 0.35, 1.0), Rgba(0.10, 0.60, 0.45, 0.45)
PLANNED, FELT, WELDED = Rgba(0.30, 0.32, 0.35, 1.0), Rgba(0.10, 0.40, 0.90, 1.0), Rgba(0.95, 0.45, 0.10, 1.0)
DEFLECTION, CAD, WAY_BACK = Rgba(0.80, 0.10, 0.45, 1.0), Rgba(0.05, 0.50, 0.42, 1.0), Rgba(0.48, 0.20, 0.80, 1.0)
# a choice: residuals below 0.1 mm stay in the pale third; half of it shows a scanner's noise in full colour
RESIDUAL_MM = 0.3
"""At the ends of the residuals' scale of colours."""
DEFLECTION_SCALE = 10.0  # a choice: a deflection of 1 mm is drawn as an arrow of 10 mm
_SIGMAS, _LARGEST_M = 3.0, 0.10
_MAGNIFICATIONS = (200, 100, 50, 20, 10, 5, 2, 1)
WELDING_PHASES = ("approach_above", "approach", "weld", "retract")
AXES = (Rgba(0.9, 0.2, 0.2, 1), Rgba(0.2, 0.75, 0.2, 1), Rgba(0.2, 0.4, 0.95, 1))
R_SIGN = RotationMatrix(RollPitchYaw(np.pi / 2, 0.0, np.deg2rad(55.0)))
"""Signs face a viewer in front of the robot (+x, -y)."""
_SEGMENTS, _RING_M = 72, 0.0022
_AXIS_M, _AXIS_RADIUS_M, _DASHES = 0.10, 0.0022, 4
_PAPER = (255, 255, 255)


class Uncertainty(NamedTuple):
    """The 3-sigma ellipsoid of a scanned point.

    Half axes (3,) m, their directions (3, 3) in B as columns, and the magnification at which it is drawn.
    """

    half_axes: Array
    R_BE: Array
    magnification: int


def uncertainty_at(estimate: CalibrationEstimate, p_BQ: Array) -> Uncertainty:
    """Return the uncertainty of a scanned point at p_BQ (3,) m, drawn with half axes of 0.1 m at most."""
    values, vectors = np.linalg.eigh(point_error_covariance(estimate, p_BQ))
    if np.linalg.det(vectors) < 0:
        vectors[:, 0] *= -1.0
    half = _SIGMAS * np.sqrt(np.maximum(values, 0.0))
    times = next((m for m in _MAGNIFICATIONS if m * half.max() <= _LARGEST_M), 1)
    return Uncertainty(half, vectors, times)


class LegendKey(NamedTuple):
    """One entry of the legend: CSS colour, how it is drawn (solid, dashed, area), and its meaning."""

    colour: str
    style: str
    text: str


def legend(phase: str, magnification: int | None = None) -> list[LegendKey]:
    """Return the legend of a phase of the weld job.

    `magnification` of the drawn uncertainty, 0 where it is written beside it, None where there is none yet.
    """
    if phase in WELDING_PHASES:
        return [
            LegendKey(_css(PLANNED), "dashed", "planned seam"),
            LegendKey(_css(FELT), "solid", "felt by the tip"),
            LegendKey(_css(WELDED), "solid", "welded"),
            LegendKey(_css(DEFLECTION), "solid", f"deflection of the tip, x {DEFLECTION_SCALE:g}"),
        ]
    if phase in ("start", "park", "home", "done", "held"):
        return []
    found = [
        LegendKey(_css(CONE), "area", "what the scanner sees"),
        LegendKey(_css(CIRCLE), "solid", "flange found; the number of its scan"),
        LegendKey(_css(CIRCLE), "dashed", "refused"),
    ]
    if magnification is not None:
        times = f", x {magnification}" if magnification > 1 else "" if magnification else ", magnified as written"
        found.append(LegendKey(_css(UNCERTAINTY), "area", f"error at the work point, 3 sigma{times}"))
    return found


def _css(rgba: Rgba) -> str:
    return f"rgb({round(255 * rgba.r())} {round(255 * rgba.g())} {round(255 * rgba.b())})"


def textured_board(
    name: str, width_m: float, height_m: float, picture: NDArray[np.uint8], *, glows: bool = False
) -> Mesh:
    """Return a rectangle centred on the origin in the x-y plane, facing +z, x to the right of the picture and y up.

    `picture` is (h, w) grey or (h, w, 3) BGR uint8. Renderers interpolate between its pixels, so its edges are smooth,
    as in a camera's picture of a print. `glows`: a viewer shows it as bright from every side of the light. Edges of
    geometry would be aliased.
    """
    w, h = 0.5 * width_m, 0.5 * height_m
    obj = (
        f"mtllib {name}.mtl\nusemtl board\nv {-w} {-h} 0\nv {w} {-h} 0\nv {w} {h} 0\nv {-w} {h} 0\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"
    )
    mtl = f"newmtl board\nKa 1 1 1\nKd 1 1 1\nmap_Kd {name}.png\n"
    if glows:
        mtl = f"newmtl board\nKa 0 0 0\nKd 0 0 0\nKe 1 1 1\nmap_Ke {name}.png\n"
    colour = picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    png = cv2.imencode(".png", colour)[1].tobytes()
    files = {
        f"{name}.mtl": MemoryFile(mtl, ".mtl", f"{name}.mtl"),
        f"{name}.png": MemoryFile(png, ".png", f"{name}.png"),
    }
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(obj, ".obj", f"{name}.obj"), supporting_files=files))


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
    """Return a cloud of points (n, 3) m, with RGB (n, 3) where they are given."""
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


def set_the_scene(meshcat: Meshcat, camera: Array, target: Array, X_WB: RigidTransform) -> None:
    """Set background and camera of the viewer; all is drawn in B, and shown as the base is in the world."""
    if not X_WB.IsExactlyIdentity():
        meshcat.SetTransform("/drake", X_WB)
        camera, target = camera + X_WB.translation(), X_WB @ target
    meshcat.SetProperty("/Background", "top_color", [0.93, 0.95, 0.97])
    meshcat.SetProperty("/Background", "bottom_color", [0.78, 0.82, 0.86])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetCameraPose(camera, target)
