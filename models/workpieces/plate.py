"""Plates with a V-groove along a straight, S or L seam: the nominal geometry and the manufactured part.

Frame P: origin on the top face at the centre of the (uncut) plate, x along it, z up; the groove is cut from above.
The groove runs right through: the seam starts at one plate edge and ends at another. On real parts the plate outline is
where the drawing says and the groove is not; `X_PG` moves the groove alone (G is the groove's own drawing frame).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.optimize import brentq

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, grid, merge, plane_mesh, triangulate_polygon
from weldcal.models.workpieces.seat import JointSection, Press, Seated, SeatedTip, TipApproach, seat

Floats = npt.NDArray[np.float64]

INCLUDED_ANGLE_RAD = math.radians(45.0)
GROOVE_DEPTH_M = 0.008
SEAM_SPACING_M = 0.0005
GROOVE_BAND_M = 0.012
PRESS_AXIAL_M, PRESS_LATERAL_M = 0.003, 0.002
BESIDE_GROOVE_M = 0.005
END_WINDOW_M = 0.006


@dataclass(frozen=True)
class PlanarPath:
    """A smooth plane curve of straight and circular pieces, running on straight beyond both ends.

    `start` = (x, y, heading); `pieces` = (length m, curvature 1/m, positive turning left) in order of travel.
    """

    start: tuple[float, float, float]
    pieces: tuple[tuple[float, float], ...]

    @property
    def length_m(self) -> float:
        """Arc length from the first to the last piece's end, m."""
        return sum(length for length, _ in self.pieces)

    def at(self, s: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Points (N,2) and headings (N,) at arc lengths s (N,), exact on every piece."""
        s = np.atleast_1d(np.asarray(s, dtype=np.float64))
        x, y, heading = self.start
        points = np.empty((len(s), 2))
        headings = np.empty(len(s))
        done = 0.0
        pieces = [(0.0, 0.0), *self.pieces, (math.inf, 0.0)]
        for k, (length, curvature) in enumerate(pieces):
            low = -math.inf if k == 0 else done
            here = (s >= low) & (s < done + length)
            u = np.append(s[here] - done, length if math.isfinite(length) else 0.0)
            turned = heading + curvature * u
            # A circular chord: its length is u sinc(half the turn) and it points along the middle heading.
            chord = u * np.sinc(0.5 * curvature * u / math.pi)
            middle = heading + 0.5 * curvature * u
            px, py = x + chord * np.cos(middle), y + chord * np.sin(middle)
            points[here] = np.column_stack([px, py])[:-1]
            headings[here] = turned[:-1]
            x, y, heading, done = float(px[-1]), float(py[-1]), float(turned[-1]), done + length
        return points, headings

    def offset(self, s: npt.ArrayLike, left_m: float) -> Floats:
        """Points (N,2) that lie `left_m` to the left of the path at arc lengths s (N,)."""
        points, heading = self.at(s)
        return points + left_m * np.column_stack([-np.sin(heading), np.cos(heading)])

    def moved(self, x: float, y: float, yaw: float) -> PlanarPath:
        """Return the same path in a frame in which its own frame is at (x, y), turned by yaw."""
        x0, y0, heading = self.start
        c, s = math.cos(yaw), math.sin(yaw)
        return replace(self, start=(x + c * x0 - s * y0, y + s * x0 + c * y0, heading + yaw))


@dataclass(frozen=True, eq=False, kw_only=True)
class Workpiece:
    """A grooved plate in frame P, metres and radians.

    Attributes:
        mesh: closed surface of the whole plate (for rendering, registration and the eye).
        groove_mesh: closed solid of the groove walls and a narrow band of the top face (for rigid hydroelastic
            contact).
        seam_P: (N,3) the groove's root line from edge to edge, evenly spaced; tangents_P (N,3); arc_length_m (N,).
        outline_P: (4,2) corners of the top face, counter-clockwise; size_m (x, y, z) of the uncut plate.
        X_PG: where the groove lies relative to its drawing; identity on the drawing itself.
        up_P: (N,3) or (1,3) the surface's normal along the seam; bend_radius_m of a plate bent over a cylinder.
    """

    name: str
    shape: str
    mesh: TriMesh
    groove_mesh: TriMesh
    seam_P: Floats
    tangents_P: Floats
    arc_length_m: Floats
    outline_P: Floats
    size_m: tuple[float, float, float]
    half_angle_rad: float
    depth_m: float
    path: PlanarPath
    X_PG: RigidTransform
    bend_radius_m: float = math.inf
    up_P: Floats = field(default_factory=lambda: np.array([[0.0, 0.0, 1.0]]))

    @property
    def length_m(self) -> float:
        """Arc length of the seam from plate edge to plate edge, m."""
        return float(self.arc_length_m[-1])

    @property
    def half_width_m(self) -> float:
        """Half the width of the groove's mouth in the top face, m."""
        return self.depth_m * math.tan(self.half_angle_rad)

    def tip_height(self, tip_radius_m: float) -> float:
        """Height of a ball's centre above the root line when it touches both walls: radius / sin(half angle), m.

        Raises InputError when the ball would ride on the groove's edges instead of its walls.
        """
        if tip_radius_m * math.cos(self.half_angle_rad) >= self.half_width_m:
            tip_mm, groove_mm = tip_radius_m * 1e3, 2e3 * self.half_width_m
            raise InputError(f"A tip of radius {tip_mm:.3g} mm is too large for a groove {groove_mm:.3g} mm wide.")
        return tip_radius_m / math.sin(self.half_angle_rad)

    @property
    def end_window_m(self) -> float:
        """How far from the drawn end the groove may end: the plate's edge is where it is sawn."""
        return END_WINDOW_M

    @property
    def section(self) -> JointSection:
        """The groove's walls in a cut square to the seam."""
        wall = self.depth_m / math.cos(self.half_angle_rad)
        return JointSection(self.half_angle_rad, wall, wall)

    def press(self, tip: SeatedTip, axial_m: float | None, lateral_m: float | None) -> Press:
        """Return how deep the tip is pressed into the groove, m; a given value is used as it is."""
        return Press(PRESS_AXIAL_M if axial_m is None else axial_m, PRESS_LATERAL_M if lateral_m is None else lateral_m)

    def seated(self, tip: SeatedTip, press: Press) -> Seated:
        """Where the centre of the loaded tip rests, from the root.

        Raises:
            InputError: it rides on the groove's edges, or climbs out of the groove.
        """
        self.tip_height(tip.tip_radius_m)
        return seat(self.section, tip, press)

    def entry(self, tip: SeatedTip, seated: Seated) -> TipApproach:
        """How the tip is brought into the groove in which it then rests: it lands on the face beside it."""
        return TipApproach(-BESIDE_GROOVE_M, self.depth_m + tip.tip_radius_m - seated.above_m)


def seeded_groove_error(
    rng: np.random.Generator, translation_m: float = 0.002, rotation_rad: float = math.radians(0.5)
) -> RigidTransform:
    """X_PG of a groove cut in the wrong place: exactly that far in a random direction, turned by +-rotation."""
    direction = rng.uniform(-math.pi, math.pi)
    yaw = rotation_rad * (1.0 if rng.random() < 0.5 else -1.0)
    shift: Any = translation_m * np.array([math.cos(direction), math.sin(direction), 0.0])
    return RigidTransform(RollPitchYaw(0.0, 0.0, yaw), shift)


def make_workpiece(
    shape: str,
    *,
    name: str | None = None,
    length_m: float = 0.300,
    radius_m: float | None = None,
    width_m: float | None = None,
    thickness_m: float = 0.020,
    included_angle_rad: float = INCLUDED_ANGLE_RAD,
    depth_m: float = GROOVE_DEPTH_M,
    X_PG: RigidTransform | None = None,
    end_cut_m: float | None = None,
    spacing_m: float = 0.001,
) -> Workpiece:
    """A plate with a V-groove: "straight", "s" (two 60 deg arcs, radius 60 mm) or "l" (90 deg corner, radius 20 mm).

    `length_m` is the seam from edge to edge on the drawing; the plate is as long as that needs. `X_PG` displaces the
    groove in the top face. `end_cut_m` ends the plate early, parallel to its exit edge, at that seam arc length: a part
    shorter than its CAD. `spacing_m` samples the walls and the plate edges. Raises InputError for impossible sizes.
    """
    half_angle = 0.5 * included_angle_rad
    half_width = depth_m * math.tan(half_angle)
    path, size, radius = _drawing(shape, length_m, radius_m, width_m, thickness_m)
    if not 0.0 < depth_m < thickness_m:
        raise InputError(f"A groove {depth_m * 1e3:.3g} mm deep does not fit a plate {thickness_m * 1e3:.3g} mm thick.")
    if radius <= half_width + 0.0005:
        least = (half_width + 0.0005) * 1e3
        raise InputError(f"A corner of radius {radius * 1e3:.3g} mm folds the groove: use more than {least:.3g} mm.")
    X = RigidTransform() if X_PG is None else X_PG
    x, y, z = X.translation()
    roll, pitch, yaw = RollPitchYaw(X.rotation()).vector()
    if max(abs(z), abs(roll), abs(pitch)) > 1e-9:
        raise InputError("The groove can only be displaced within the top face: give X_PG no height, roll or pitch.")
    path = path.moved(float(x), float(y), float(yaw))

    outline = 0.5 * np.array([(-size[0], -size[1]), (size[0], -size[1]), (size[0], size[1]), (-size[0], size[1])])
    # Index of the outline edge (from corner k to k + 1) where the seam leaves; it always enters through the left one.
    exit_edge = 2 if shape == "l" else 1
    cut = path.length_m if end_cut_m is None else end_cut_m
    if end_cut_m is not None:
        # Before the corner of an L the exit edge would run along the groove.
        least, most = path.length_m - path.pieces[-1][0] if shape == "l" else 0.02, path.length_m
        if not least <= end_cut_m < most:
            raise InputError(f"Cut this plate between {least * 1e3:.0f} and {most * 1e3:.0f} mm of seam (end_cut_m).")
        (end,), _ = path.at([end_cut_m])
        axis = 0 if exit_edge == 1 else 1
        outline[[exit_edge, exit_edge + 1], axis] = end[axis]
    columns = np.array([half_width, 0.0, -half_width])
    s0, s1 = (_crossings(path, columns, outline, edge, near) for edge, near in ((3, 0.0), (exit_edge, cut)))

    start, stop = float(s0[1]), float(s1[1])
    count = round((stop - start) / SEAM_SPACING_M) + 1
    s = np.linspace(start, stop, count)
    points, heading = path.at(s)
    stations = np.arange(max(s0) + 0.5 * spacing_m, min(s1) - 0.25 * spacing_m, spacing_m)
    walls = _sweep(path, columns, np.array([0.0, -depth_m, 0.0]), stations, s0, s1)
    return Workpiece(
        name=name or f"{shape}_groove",
        shape=shape,
        mesh=_plate(walls, outline, exit_edge, thickness_m, spacing_m),
        groove_mesh=_groove_solid(path, outline, exit_edge, cut, half_width, depth_m, thickness_m, radius, spacing_m),
        seam_P=np.column_stack([points, np.full(count, -depth_m)]),
        tangents_P=np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)]),
        arc_length_m=s - start,
        outline_P=outline,
        size_m=size,
        half_angle_rad=half_angle,
        depth_m=depth_m,
        path=path,
        X_PG=X,
    )


def _drawing(
    shape: str, length: float, radius: float | None, width: float | None, thickness: float
) -> tuple[PlanarPath, tuple[float, float, float], float]:
    """Return the seam's path in P, the plate's size and the corner radius, as drawn."""
    if shape == "straight":
        return PlanarPath((-0.5 * length, 0.0, 0.0), ((length, 0.0),)), (length, width or 0.200, thickness), math.inf
    if shape == "s":
        r, turn = radius or 0.060, math.radians(60.0)
        straight = 0.5 * (length - 2.0 * r * turn)
        run, rise = 2.0 * straight + 2.0 * r * math.sin(turn), 2.0 * r * (1.0 - math.cos(turn))
        pieces = ((straight, 0.0), (r * turn, 1.0 / r), (r * turn, -1.0 / r), (straight, 0.0))
        path, size = PlanarPath((-0.5 * run, -0.5 * rise, 0.0), pieces), (run, width or 0.200, thickness)
    elif shape == "l":
        r = radius or 0.020
        straight = 0.5 * (length - r * math.pi / 2)
        # The virtual corner lies `reach` from both edges; the plate keeps 60-odd mm of material beyond it.
        reach, w = straight + r, width or 0.220
        size = (reach + 0.085, w, thickness)
        start = (-0.5 * size[0], 0.5 * w - reach, 0.0)
        path = PlanarPath(start, ((straight, 0.0), (r * math.pi / 2, 1.0 / r), (straight, 0.0)))
    else:
        raise InputError(f"Workpiece shape '{shape}' is not known: use straight, s or l.")
    margin = 0.5 * size[1] - float(np.abs(path.at(np.linspace(0.0, path.length_m - straight, 200))[0][:, 1]).max())
    if straight < 0.02 or margin < 0.02:
        raise InputError(
            f"A seam of {length * 1e3:.0f} mm does not fit this plate: change its length, radius or width."
        )
    return path, size, r


def _crossings(path: PlanarPath, columns: Floats, outline: Floats, edge: int, near: float) -> Floats:
    """Arc length at which the path, moved left by each of `columns`, meets the line of an outline edge."""
    a, b = outline[edge], outline[(edge + 1) % len(outline)]
    inward = np.array([a[1] - b[1], b[0] - a[0]]) / math.hypot(*(b - a))

    def depth(s: float, left: float) -> float:
        return float((path.offset([s], left)[0] - a) @ inward)

    try:
        return np.array([brentq(depth, near - 0.045, near + 0.045, args=(c,), xtol=1e-12) for c in columns])
    except ValueError:
        raise InputError("The groove misses the plate edge it should end at: displace it by less than 20 mm.") from None


def _sweep(path: PlanarPath, columns: Floats, heights: Floats, stations: Floats, s0: Floats, s1: Floats) -> Floats:
    """(rows, columns, 3): the cross-section at every station; first and last row lie in the plate's edge planes."""
    s = np.vstack([s0, np.repeat(stations[:, None], len(columns), axis=1), s1])
    swept = [
        np.column_stack([path.offset(s[:, k], c), np.full(len(s), h)])
        for k, (c, h) in enumerate(zip(columns, heights, strict=True))
    ]
    return np.stack(swept, axis=1)


def _plate(walls: Floats, outline: Floats, exit_edge: int, thickness: float, spacing: float) -> TriMesh:
    """The closed plate: two groove walls, the top face on both sides, four sides with notches, and the bottom."""
    left, right = walls[:, 0], walls[:, 2]
    # The rim, counter-clockwise from the left lip at the entry: entry edge down, round, exit edge, over the notches.
    around_right = [right[0, :2], *outline[: exit_edge + 1], right[-1, :2]]
    around_left = [left[-1, :2], *outline[exit_edge + 1 :], left[0, :2]]
    rim_right, rim_left = _polyline(around_right, spacing), _polyline(around_left, spacing)
    faces = []
    for rim, lip in ((rim_right, right[::-1, :2]), (rim_left, left[:, :2])):
        loop = np.vstack([rim[:-1], lip[:-1]])
        faces.append(plane_mesh(loop, triangulate_polygon(loop), 0.0, up=True))
    # Both rims joined over the two notches: every top point has a twin below, so the sides need no triangulation.
    top = np.vstack([_at(rim_right, 0.0), walls[-1, 1], _at(rim_left, 0.0), walls[0, 1]])
    bottom = np.column_stack([top[:, :2], np.full(len(top), -thickness)])
    sides = grid(np.stack([bottom, top], axis=1), close_rows=True)
    floor = plane_mesh(bottom[:, :2], triangulate_polygon(bottom[:, :2]), -thickness, up=False)
    return merge(*faces, grid(walls).flipped(), sides, floor, tolerance_m=1e-9)


def _groove_solid(
    path: PlanarPath,
    outline: Floats,
    exit_edge: int,
    cut: float,
    half_width: float,
    depth: float,
    thickness: float,
    radius: float,
    spacing: float,
) -> TriMesh:
    """Return the walls with a band of top face and a body below, closed; long triangles where the seam is straight."""
    band = half_width + min(GROOVE_BAND_M, 0.8 * (radius - half_width))
    floor = -0.5 * (depth + thickness)
    columns = np.array([band, half_width, 0.0, -half_width, -band, -band, band])
    heights = np.array([0.0, 0.0, -depth, 0.0, 0.0, floor, floor])
    s0, s1 = (_crossings(path, columns, outline, edge, near) for edge, near in ((3, 0.0), (exit_edge, cut)))
    stations, done = [max(s0) + spacing], 0.0
    for length, curvature in path.pieces:
        step = 0.010 if curvature == 0.0 else spacing
        stations += list(done + np.linspace(0.0, length, max(1, math.ceil(length / step)), endpoint=False))
        done += length
    inner = np.unique([s for s in stations if max(s0) + 0.5 * spacing < s < min(s1) - 0.5 * spacing])
    ring = _sweep(path, columns, heights, inner, s0, s1)
    body = grid(ring, close_columns=True).flipped()
    cap = np.array([(0, 1, 6), (1, 2, 6), (2, 5, 6), (2, 3, 5), (3, 4, 5)])
    return merge(body, TriMesh(ring[0], cap[:, ::-1]), TriMesh(ring[-1], cap), tolerance_m=1e-9)


def _polyline(corners: list[Floats], spacing: float) -> Floats:
    """Points along straight legs between corners, corners included, no two further apart than `spacing`."""
    legs = [
        np.linspace(a, b, max(1, math.ceil(float(np.linalg.norm(b - a)) / spacing)), endpoint=False)
        for a, b in pairwise(corners)
    ]
    return np.vstack([*legs, corners[-1]])


def _at(points: Floats, z: float) -> Floats:
    return np.column_stack([points, np.full(len(points), z)])
