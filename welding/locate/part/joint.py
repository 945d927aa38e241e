"""Measures the joint along the drawn seam in the scan: its two walls in cuts square to the seam, and the root between them.

The unknowns are the root's shift in the cut and each wall's tilt, at knots along the seam. They follow from the distances of the
scan's points from the drawn walls; the drawing is a weak prior, and a second difference keeps them smooth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.spatial import cKDTree

from weldcal.models.workpieces.seams import DrawnSeam
from weldcal.welding.locate.part.fit import SURFACE_RATIO, tukey
from weldcal.welding.locate.part.model import PartModel

Floats = npt.NDArray[np.float64]
Rows = tuple[Floats, Floats, Floats]  # a point's place along the seam m, its coefficients (M,4), and its residual m

MOST_M = 0.0025  # of the root's shift: what is farther off is something else
KNOT_M = 0.004
REACH_M = 0.015  # of a wall from the root
NEAR_ROOT_M = 0.0012  # points nearer to the root, and a point distance, may be of either wall
ALONG_WALL_COS = math.cos(math.radians(25.0))
PRIOR_M, PRIOR_TILT_RAD, PRIOR_KNOTS = 0.0005, math.radians(1.0), 10  # shared by so many knots
BEND_M, BEND_TILT_RAD = 2e-5, math.radians(0.1)  # second difference from knot to knot
SHOWN_GAP = 1.5  # point distances: a narrower gap is not told from the distance of two points
EDGE_SIGMA = 0.3  # of the middle between the outermost points of two edges, in point distances
SIGMA_FLOOR_M = 3e-5
KNOWN_SHARE = 0.4  # of the deviation by the drawing alone: a knot that is known better was measured


@dataclass(frozen=True, eq=False)
class MeasuredJoint:
    """A seam as measured, in the base, and how far it lies from where the drawing has it.

    seam      the drawn seam with its root moved
    shift_m   (N,) of the root, at each of the seam's points
    share     of the seam along which the root was measured in both directions of the cut; share_one: in at least one, for one
              wall was seen. Across the other the drawing holds.
    sigma_m   of the root sideways, rms over what was measured in both; nan where nothing was
    """

    seam: DrawnSeam
    shift_m: Floats
    share: float
    share_one: float
    sigma_m: float

    @property
    def summary(self) -> str:
        """What was measured, in words."""
        if self.share_one == 0.0:
            return "the joint itself could not be measured in the scan"
        rms = float(np.sqrt(np.mean(np.square(self.shift_m))))
        return (
            f"the joint was measured along {100 * self.share:.0f} % of the seam, one wall of it along "
            f"{100 * self.share_one:.0f} %: {1e3 * rms:.2f} mm rms and "
            f"{1e3 * float(self.shift_m.max()):.2f} mm at most off the drawing"
        )


def measure_joint(points: Floats, normals: Floats, pitch_m: float, model: PartModel, seam: DrawnSeam) -> MeasuredJoint:
    """Measure a joint in a scan's points (N,3) with normals (N,3), all in the registered part's frame, m.

    seam: as drawn, in the same frame. Where neither wall is seen, the neighbours and the drawing decide.
    """
    cut = _cut(points, normals, seam)
    rows = [r for side in ("left", "right") if (r := _wall_rows(cut, model, seam, side, pitch_m)) is not None]
    if seam.joint == "butt" and (middle := _gap_rows(cut, seam, pitch_m)) is not None:
        rows.append(middle)
    nothing = MeasuredJoint(seam, np.zeros(len(seam.points_P)), 0.0, 0.0, math.nan)
    if not rows:
        return nothing
    at, x, y, spread, drawn = _solved(rows, seam.length_m, pitch_m)
    values = np.sqrt(np.linalg.eigvalsh(spread))  # ascending
    known, one = values[:, 1] < KNOWN_SHARE * drawn, values[:, 0] < KNOWN_SHARE * drawn
    sigma = np.sqrt(spread[:, 0, 0])
    if not one.any():
        return nothing
    s = seam.arc_length_m
    shift = np.column_stack([np.interp(s, at, x), np.interp(s, at, y)])
    size = np.linalg.norm(shift, axis=1)
    shift *= np.minimum(1.0, MOST_M / np.maximum(size, 1e-12))[:, None]
    moved = seam.points_P + shift[:, :1] * seam.left_P + shift[:, 1:] * seam.up_P
    return MeasuredJoint(
        replace(seam, points_P=moved),
        np.linalg.norm(shift, axis=1),
        float(known.mean()),
        float(one.mean()),
        float(np.sqrt(np.mean(np.square(sigma[known])) + SIGMA_FLOOR_M**2)) if known.any() else math.nan,
    )


@dataclass(frozen=True, eq=False)
class _Cut:
    """The scan about the seam: points and normals (N,3), the seam's nearest point k (N,), and the offset from it (N,3)."""

    points: Floats
    normals: Floats
    k: npt.NDArray[np.int64]
    offset: Floats


def _cut(points: Floats, normals: Floats, seam: DrawnSeam) -> _Cut:
    away, k = cKDTree(seam.points_P).query(points, distance_upper_bound=REACH_M + MOST_M)
    near = np.isfinite(np.asarray(away))
    k = np.asarray(k)[near]
    offset = points[near] - seam.points_P[k]
    # Points beyond the ends belong to no cut.
    within = np.abs(np.sum(offset * seam.tangents_P[k], axis=1)) < 0.001
    return _Cut(points[near][within], normals[near][within], k[within], offset[within])


def _wall_rows(cut: _Cut, model: PartModel, seam: DrawnSeam, side: str, pitch: float) -> Rows | None:
    """The points of one wall: their distance from the part's surface, by the root's shift and the wall's tilt."""
    left = side == "left"
    normal = (seam.wall_left_P if left else seam.wall_right_P)[cut.k]
    to_left = seam.left_P[cut.k]
    along = np.cross(seam.tangents_P[cut.k], normal)
    along *= np.sign(np.sum(along * to_left, axis=1))[:, None] * (1.0 if left else -1.0)
    a = np.sum(cut.offset * along, axis=1) - 0.5 * seam.gap_m
    extent = float(seam.wall_height_m[0 if left else 1]) if seam.joint != "butt" else REACH_M
    on = (a > NEAR_ROOT_M + 0.7 * pitch) & (a < min(extent, REACH_M) - 0.5 * pitch)
    on &= np.abs(np.sum(cut.offset * normal, axis=1)) < 2.0 * MOST_M
    on &= np.sum(cut.normals * normal, axis=1) > ALONG_WALL_COS
    if np.count_nonzero(on) < 12:
        return None
    q, m = model.closest(cut.points[on])
    r = np.sum((cut.points[on] - q) * m, axis=1)
    index = np.flatnonzero(on)
    good = (np.sum(m * normal[on], axis=1) > ALONG_WALL_COS) & (np.abs(r) < MOST_M)
    # Off the surface along its normal only: beside an edge the nearest point says nothing about the wall.
    good &= np.linalg.norm(cut.points[on] - q, axis=1) < np.abs(r) + 1e-4
    index, r, m = index[good], r[good], m[good]
    k = cut.k[index]
    tilt = a[index]
    zero = np.zeros(len(k))
    x, y = np.sum(m * to_left[index], axis=1), np.sum(m * seam.up_P[k], axis=1)
    return seam.arc_length_m[k], np.column_stack([x, y, *((tilt, zero) if left else (zero, tilt))]), r


def _gap_rows(cut: _Cut, seam: DrawnSeam, pitch: float) -> Rows | None:
    """The middle of a gap, by the outermost points of the faces on its two sides, in strips across the seam."""
    x = np.sum(cut.offset * seam.left_P[cut.k], axis=1)
    y = np.sum(cut.offset * seam.up_P[cut.k], axis=1)
    s = seam.arc_length_m[cut.k]
    beside = (np.abs(x) > 0.5 * seam.gap_m - MOST_M) & (np.abs(x) < 0.5 * seam.gap_m + REACH_M) & (np.abs(y) < MOST_M)
    if np.count_nonzero(beside) < 12 or seam.gap_m <= SHOWN_GAP * pitch:
        return None
    level = float(np.median(y[beside]))
    beside &= np.abs(y - level) < 0.0008
    strips = max(1, int(seam.length_m / (1.3 * pitch)))
    strip = np.minimum((s / seam.length_m * strips).astype(int), strips - 1)
    # The widest gap between neighbours across a strip is the joint's.
    where, middle = [], []
    order = np.lexsort((x, strip))
    order = order[beside[order]]
    for one in np.split(order, np.flatnonzero(np.diff(strip[order])) + 1):
        if len(one) < 6:
            continue
        steps = np.diff(x[one])
        j = int(np.argmax(np.where(np.abs(x[one][:-1] + 0.5 * steps) < MOST_M, steps, 0.0)))
        if abs(steps[j] - seam.gap_m) < 1.0 * pitch + 0.5 * seam.gap_m:
            where.append(float(s[one].mean()))
            middle.append(float(x[one[j]] + 0.5 * steps[j]))
    if len(where) < 6:
        return None
    # A row counts as one measurement of EDGE_SIGMA, whatever the points' own noise is.
    return np.array(where), np.tile([1.0, 0.0, math.nan, math.nan], (len(where), 1)), np.array(middle)


def _solved(rows: list[Rows], length: float, pitch: float) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Knots (K,) m along the seam with the shifts to the left and along the bisector (K,) m, their covariance (K,2,2), and the
    deviation (K,) by the drawing alone.
    """
    count = max(3, math.ceil(length / KNOT_M) + 1)
    at = np.linspace(0.0, length, count)
    s, J, r = (np.concatenate(part) for part in zip(*rows, strict=True))
    edge = np.isnan(J[:, 2])
    J = np.nan_to_num(J)
    i = np.clip(np.searchsorted(at, s) - 1, 0, count - 2)
    f = (s - at[i]) / (at[1] - at[0])
    n = np.arange(len(s))
    column = [4 * (i + end)[:, None] + np.arange(4) for end in (0, 1)]
    value = [J * (1.0 - f)[:, None], J * f[:, None]]
    A = sparse.csr_matrix(
        (np.hstack(value).ravel(), (np.repeat(n, 8), np.hstack(column).ravel())), shape=(len(s), 4 * count)
    )
    prior = np.tile([PRIOR_M**-2, PRIOR_M**-2, PRIOR_TILT_RAD**-2, PRIOR_TILT_RAD**-2], count) / PRIOR_KNOTS
    D = np.kron(np.diff(np.eye(count), 2, axis=0), np.eye(4))
    bend = np.tile([BEND_M**-2, BEND_M**-2, BEND_TILT_RAD**-2, BEND_TILT_RAD**-2], count - 2)
    fixed = np.diag(prior) + D.T @ (bend[:, None] * D)
    xi, off = np.zeros(4 * count), r
    for gate in (MOST_M, MOST_M, 0.5 * MOST_M, 0.0, 0.0, 0.0):
        sigma = max(SIGMA_FLOOR_M, 1.4826 * float(np.median(np.abs(off[~edge])))) if (~edge).any() else 1e-4
        c = np.where(edge, max(gate, 2.0 * pitch), max(gate, 4.5 * sigma, 2e-4))
        w = tukey(off / c, 1.0) / np.where(edge, (EDGE_SIGMA * pitch) ** 2, SURFACE_RATIO * min(sigma, 2e-4) ** 2)
        N = (A.T @ sparse.diags_array(w) @ A).toarray() + fixed
        xi = np.linalg.solve(N, A.T @ (w * r))
        off = r - A @ xi
    k = 4 * np.arange(count)[:, None, None]
    spread = np.linalg.inv(N)[k + np.array([[0], [1]]), k + np.array([[0, 1]])]
    return at, xi[0::4], xi[1::4], spread, np.sqrt(np.diag(np.linalg.inv(fixed))[0::4])
