"""One cross-section of a V-groove: two walls and the face on both sides, fitted robustly to the points of a slice.

The profile is z(n) = min(face, root + slope_side |n - centre|), n to the left of the seam. The noise of a scanner that
looks down is in z, so z is regressed on n and no point is chosen by its depth: on walls this steep, choosing by depth
would turn them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from weldcal.welding.locate.planes import Floats

ITERATIONS = 12
ENOUGH = 3  # points on a wall to be a wall
WIDE_M = 0.0015  # how far off in z points may at first be, on a line that is not yet the groove's
SHOULDER_PITCHES = 1.5  # how far the end of the face may lie from the shoulder and be it
BAND_M = 0.006  # of face beyond each shoulder that takes part


@dataclass(frozen=True, eq=False)
class Section:
    """A fitted cross-section; metres, slopes as rise over run, left then right where there are two.

    centre, root    where the walls meet: n and z; covariance (2,2) of the two
    slopes, faces   of the walls, and the heights of the face beside them
    on_walls        points on each wall that agree; agreeing: share of the points that do
    spread          the walls' points about the profile, in z
    """

    centre: float
    root: float
    slopes: tuple[float, float]
    faces: tuple[float, float]
    covariance: Floats
    on_walls: tuple[int, int]
    agreeing: float
    spread: float

    @property
    def shoulders(self) -> tuple[float, float]:
        """n of the left and the right edge of the opening."""
        left, right = ((face - self.root) / slope for face, slope in zip(self.faces, self.slopes, strict=True))
        return self.centre + left, self.centre - right

    @property
    def depth(self) -> float:
        """Of the root below the face on its two sides, their mean."""
        return 0.5 * (self.faces[0] + self.faces[1]) - self.root

    @property
    def width(self) -> float:
        """Of the opening."""
        return self.shoulders[0] - self.shoulders[1]

    @property
    def angle(self) -> float:
        """Between the walls, rad."""
        return math.atan(1.0 / self.slopes[0]) + math.atan(1.0 / self.slopes[1])


@dataclass(frozen=True)
class Profile:
    """What a section is expected to look like: slopes of the walls and depth, and how far they may differ (1 sigma)."""

    slopes: tuple[float, float]
    depth: float
    slope_sigma: float = 0.15  # relative
    depth_sigma: float = 0.30


def fit_section(
    n: Floats, z: Floats, guess: tuple[float, Profile], sigma: float, pitch: float, faces_known: bool = True
) -> Section | None:
    """The V through points (N,) at n and z of one slice, or None where they show none.

    `guess`: the centre's n and the expected profile; `sigma` the noise of the face, `pitch` the distance of points.
    Where one wall was hardly measured the edge of the face there and the expected slope stand in for it, and the
    covariance says what that is worth.
    """
    centre, profile = guess
    slopes = np.array(profile.slopes)
    half = profile.depth / float(slopes.min())
    faces = _faces(n - centre, z, half, sigma) if faces_known else (0.0, 0.0)
    near = np.abs(n - centre) < half + BAND_M
    n, z = n[near], z[near]
    if len(n) < 6:
        return None
    x = np.array([centre, 0.5 * (faces[0] + faces[1]) - profile.depth, *slopes])
    prior = x.copy()
    prior_sigma = np.array([2.0 * half, profile.depth_sigma * profile.depth, *(profile.slope_sigma * slopes)])
    edges = _edges(n - centre, z, faces, half, sigma)
    scale = max(2.5 * sigma, WIDE_M)
    floor = max(sigma, 1e-5)
    weights = np.ones(len(n))
    information = np.eye(4)
    lever = float(np.mean(slopes))
    for step in range(ITERATIONS):
        left = n > x[0]
        run = np.abs(n - x[0])
        slope = np.where(left, x[2], x[3])
        wall = x[1] + slope * run
        face = np.where(left, faces[0], faces[1])
        on_wall = wall < face
        residual = z - np.where(on_wall, wall, face)
        J = np.zeros((len(n), 4))
        J[:, 0] = np.where(left, -slope, slope)
        J[:, 1] = 1.0
        J[:, 2], J[:, 3] = run * left, run * ~left
        J *= on_wall[:, None]
        if np.count_nonzero(on_wall) >= 6:
            spread = 1.4826 * float(np.median(np.abs(residual[on_wall])))
            # Shrinking slowly: the first residuals are those of a wrong centre.
            scale = max(min(scale, 3.0 * spread if step > 1 else scale), 2.5 * floor)
        sigma_point = np.where(on_wall, max(scale / 2.5, floor), floor)
        u = residual / (sigma_point * 2.5)
        weights = 1.0 / (1.0 + u * u) ** 2 / sigma_point**2
        A = J.T @ (J * weights[:, None]) + np.diag(1.0 / prior_sigma**2)
        b = J.T @ (weights * residual) + (prior - x) / prior_sigma**2
        for side, edge in enumerate(edges):
            enough = np.count_nonzero(on_wall & (left == (side == 0))) >= ENOUGH
            if edge is None or enough:
                continue
            # The shoulder lies where the face was seen to end.
            sign = 1.0 if side == 0 else -1.0
            rise = faces[side] - x[1]
            row = np.zeros(4)
            row[0], row[1], row[2 + side] = 1.0, -sign / x[2 + side], -sign * rise / x[2 + side] ** 2
            off = centre + edge - (x[0] + sign * rise / x[2 + side])
            # Where something hides the groove the face ends at its shadow, and not at the shoulder.
            belief = 1.0 if step < 3 else 1.0 / (1.0 + (off / (SHOULDER_PITCHES * pitch)) ** 2) ** 2
            A += belief * np.outer(row, row) / (0.5 * pitch) ** 2
            b += belief * row * off / (0.5 * pitch) ** 2
        information = A
        change = np.linalg.solve(A, b)
        change[0] = np.clip(change[0], -0.5 * half, 0.5 * half)
        x = x + change
        x[2:] = np.clip(x[2:], 0.4 * slopes, 2.5 * slopes)
        if abs(change[0]) + abs(change[1]) / lever < 1e-6:
            break
    good = weights * sigma_point**2 > 0.25
    counted = max(1, int(np.count_nonzero(on_wall)))
    on_left, on_right = (int(np.count_nonzero(good & on_wall & (left == side))) for side in (True, False))
    if x[1] >= min(faces) or on_left + on_right < 5:
        return None
    spread = float(np.sqrt(np.mean(np.square(residual[good & on_wall]))))
    return Section(
        centre=float(x[0]),
        root=float(x[1]),
        slopes=(float(x[2]), float(x[3])),
        faces=faces,
        covariance=np.asarray(np.linalg.inv(information)[:2, :2], dtype=np.float64),
        on_walls=(on_left, on_right),
        agreeing=float(np.count_nonzero(good & on_wall) / counted),
        spread=spread,
    )


def _faces(n: Floats, z: Floats, half: float, sigma: float) -> tuple[float, float]:
    """Height of the face to the left and to the right, 0 where too little of it is in view."""
    heights = []
    for sign in (1.0, -1.0):
        beside = (sign * n > half + 0.5e-3) & (sign * n < half + BAND_M) & (np.abs(z) < max(5.0 * sigma, 0.002))
        heights.append(float(np.median(z[beside])) if np.count_nonzero(beside) >= 10 else 0.0)
    return heights[0], heights[1]


def _edges(n: Floats, z: Floats, faces: tuple[float, float], half: float, sigma: float) -> list[float | None]:
    """n at which the face ends on the left and on the right, where it was seen at all."""
    edges: list[float | None] = []
    for sign, face in zip((1.0, -1.0), faces, strict=True):
        level = (np.abs(z - face) < 2.5 * sigma) & (sign * n > 0.3 * half)
        edges.append(float(sign * np.min(sign * n[level])) if np.count_nonzero(level) >= 10 else None)
    return edges
