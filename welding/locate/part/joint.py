"""Measures the joint along the drawn seam in the scan.

Its two walls in cuts square to the seam, and the root between them.

The unknowns are the root's shift in the cut and each wall's tilt, at knots along the seam. They follow from the
distances of the scan's points from the drawn walls; the drawing is a weak prior, and a second difference keeps them
smooth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.spatial import cKDTree

from weldcal.models.workpieces.seams import DrawnSeam
from weldcal.welding.locate.part.fit import SURFACE_RATIO, tukey
from weldcal.welding.locate.part.fit_up import FIT_UP, FitUp
from weldcal.welding.locate.part.model import PartModel

Floats = npt.NDArray[np.float64]
Rows = tuple[Floats, Floats, Floats]  # a point's place along the seam m, its coefficients (M,4), and its residual m

MOST_M = 0.0025  # of the root's shift: what is farther off is something else
KNOT_M = 0.004  # between two knots: four points of a scan with 1 mm between them
REACH_M = 0.015  # of a wall from the root
NEAR_ROOT_M = 0.0012  # points nearer to the root, and a point distance, may be of either wall
ALONG_WALL_COS = math.cos(math.radians(25.0))
PRIOR_M, PRIOR_TILT_RAD, PRIOR_KNOTS = 0.0005, math.radians(1.0), 10  # shared by so many knots
BEND_M, BEND_TILT_RAD = 2e-5, math.radians(0.1)  # second difference from knot to knot
SHOWN_GAP = 1.5  # point distances: a narrower gap is not told from the distance of two points
EDGE_SIGMA = 0.3  # of the middle between the outermost points of two edges, in point distances
SIGMA_FLOOR_M = 3e-5  # a third of a scan's noise of 0.1 mm, of which neighbours share a part
WINDOW_M = 0.010  # of the seam, for a place of the fit-up
CORRELATED = 6.0  # neighbouring points share their noise
BANDS = tuple(0.004 * k for k in range(-4, 5))  # slopes of a gap's middle: 3 mm along 150 mm, and a registration askew
STRAY = 5.0  # times the usual distance to the nearest point: exp(-5) of the points of a face are as alone
EDGE_LOST_M = 1e-4  # measured on cast scans that lose 40 % of the points at an edge over 6 mm of depth
SLOPE_FLOOR = math.radians(0.1)
KNOWN_SHARE = 0.4  # of the deviation by the drawing alone: a knot that is known better was measured


@dataclass(frozen=True, eq=False)
class MeasuredJoint:
    """A seam as measured, in the base, and how far it lies from where the drawing has it.

    Attributes:
        seam: the drawn seam with its root moved.
        shift_m: (N,) of the root, at each of the seam's points.
        share: of the seam along which the root was measured in both directions of the cut.
        share_one: the same in at least one direction: one wall was seen, and across the other the drawing holds.
        sigma_m: of the root sideways, rms over what was measured in both; nan where nothing was.
        fit_up: how the two parts stand to each other.
    """

    seam: DrawnSeam
    shift_m: Floats
    share: float
    share_one: float
    sigma_m: float
    fit_up: FitUp | None = None

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

    ``seam``: as drawn, in the same frame. Where neither wall is seen, the neighbours and the drawing decide.
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
    """The scan about the seam.

    Points and normals (N,3), the seam's nearest point k (N,), and the offset from it (N,3).
    """

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
    """Compute the knots (K,) m along the seam and the shifts (K,) m there, to the left and along the bisector.

    With their covariance (K,2,2), and the deviation (K,) by the drawing alone.
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


def measure_fit_up(points: Floats, normals: Floats, pitch_m: float, model: PartModel, seam: DrawnSeam) -> FitUp:
    """Measure gap, misalignment and angle of a joint in windows along its seam.

    The arguments are those of `measure_joint`.

    On each side a plane is fitted to the points of the wall. The gap is the distance between the places where the two
    sides' points end, and the drawing only says which points are of which side.
    """
    cut = _cut(points, normals, seam)
    s = seam.arc_length_m[cut.k]
    at = np.linspace(0.0, seam.length_m, max(1, round(seam.length_m / WINDOW_M)) + 1)
    at = 0.5 * (at[1:] + at[:-1])
    tilt = _faces_apart(cut, model, seam)[2] if seam.joint == "lap" else 0.0
    found: dict[str, Floats] = {}
    for i, middle in enumerate(at):
        here = np.abs(s - middle) < WINDOW_M
        if np.count_nonzero(here) > 40:
            one = _Cut(cut.points[here], cut.normals[here], cut.k[here], cut.offset[here])
            for name, pair in _fit_up_at(one, s[here] - middle, model, seam, pitch_m, tilt).items():
                found.setdefault(name, np.full((len(at), 2), math.nan))[i] = pair
    measured = {name: found[name] for name in FIT_UP if name in found and np.isfinite(found[name]).any()}
    return FitUp(at, {n: v[:, 0] for n, v in measured.items()}, {n: v[:, 1] for n, v in measured.items()})


class _Side(NamedTuple):
    """A wall in a window.

    Directions along it and out of it (2,), its height over the drawn one and slope with their sigmas (2,), its points
    (M,3) by left, up and along the seam, and their noise.
    """

    along: Floats
    out: Floats
    line: Floats
    sigma: Floats
    rows: Floats
    noise: float


def _side(cut: _Cut, s: Floats, seam: DrawnSeam, side: str, pitch: float) -> _Side | None:
    left = side == "left"
    normal = (seam.wall_left_P if left else seam.wall_right_P)[cut.k]
    x = np.column_stack([np.sum(normal * v[cut.k], axis=1) for v in (seam.left_P, seam.up_P)]).mean(axis=0)
    out = x / np.linalg.norm(x)
    along = np.array([out[1], -out[0]]) if left else np.array([-out[1], out[0]])
    flat = np.column_stack([np.sum(cut.offset * v[cut.k], axis=1) for v in (seam.left_P, seam.up_P)])
    a, b = flat @ along, flat @ out
    extent = float(seam.wall_height_m[0 if left else 1]) if seam.joint != "butt" else REACH_M
    wall = (np.sum(cut.normals * normal, axis=1) > ALONG_WALL_COS) & (np.abs(b) < 2.0 * MOST_M)
    use = wall & (a > NEAR_ROOT_M + 0.7 * pitch) & (a < min(extent, REACH_M) - 0.5 * pitch)
    noise = MOST_M
    for _ in range(5):
        if np.count_nonzero(use) < 20 or np.ptp(a[use]) < 3.0 * pitch:
            return None
        A = np.column_stack([np.ones(len(a)), a, s])
        fit = np.linalg.lstsq(A[use], b[use], rcond=None)[0]
        off = b - A @ fit
        noise = max(1.4826 * float(np.median(np.abs(off[use]))), 1e-6)
        use &= np.abs(off) < 3.5 * noise
    sigma = noise * np.sqrt(CORRELATED * np.diag(np.linalg.inv(A[use].T @ A[use]))[:2])
    near = np.abs(off) < max(4.0 * noise, 1e-4)
    rows = np.column_stack([flat, s])[near]
    return _Side(along, out, fit[:2], np.hypot(sigma, [SIGMA_FLOOR_M, SLOPE_FLOOR]), rows, noise)


def _fit_up_at(
    cut: _Cut, s: Floats, model: PartModel, seam: DrawnSeam, pitch: float, tilt: float
) -> dict[str, tuple[float, float]]:
    """Gap, misalignment and angle in one window with their sigmas, as far as they are measured."""
    if seam.joint == "lap":  # its upper sheet is thin: its face tells more than its edge
        height, sigma, _ = _faces_apart(cut, model, seam, tilt)
        return {"gap": (max(0.0, height if np.argmax(seam.wall_height_m) else -height), sigma)}
    left, right = (_side(cut, s, seam, side, pitch) for side in ("left", "right"))
    if left is None or right is None:
        return {}
    angle = -math.atan(left.line[1]) - math.atan(right.line[1])
    found = {"angle": (angle, math.hypot(left.sigma[1], right.sigma[1]))}
    if seam.joint == "butt":
        found["misalignment"] = float(left.line[0] - right.line[0]), math.hypot(left.sigma[0], right.sigma[0])
        found["gap"] = _opening(np.vstack([left.rows, right.rows]))
        return found
    # Directions of the walls as they are, and where they meet.
    d = np.array([side.along + side.line[1] * side.out for side in (left, right)])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    start = [side.line[0] * side.out for side in (left, right)]
    root = start[0] + np.linalg.solve(np.column_stack([d[0], -d[1]]), start[1] - start[0])[0] * d[0]
    (one, one_sigma), (other, other_sigma) = (
        _end(side, root, d[k], d[1 - k], 4.0 * max(left.noise, right.noise)) for k, side in enumerate((left, right))
    )
    if seam.joint == "v_groove" or min(one, other) == 0.0:  # else something hides the root of a fillet
        found["gap"] = float(np.linalg.norm(one * d[0] - other * d[1])), math.hypot(one_sigma, other_sigma)
    return found


def _opening(rows: Floats) -> tuple[float, float]:
    """Compute the width m of the gap between level faces, and its sigma.

    It is the widest band along the seam without a point of both (M,3), apart from one stray point. Each of its ends
    lies between two points: by their distances L across the seam, half of E[L^2] / E[L] from the nearest on average.
    """
    widest, gap, sigma = 0.0, math.nan, math.nan
    for slope in BANDS:
        x = np.unique(rows[:, 0] - slope * rows[:, 2])
        if not x[0] < -MOST_M < MOST_M < x[-1]:
            continue
        steps = np.diff(x)
        near = np.abs(x[:-1] + 0.5 * steps) < 2.0 * MOST_M
        near[[0, -1]] = False
        k = int(np.argmax(np.where(near, steps, 0.0)))
        rest, end_sigma = _rest(np.delete(steps, k))
        width = float(steps[k]) + max((d for d in steps[[k - 1, k + 1]] if d > STRAY * rest), default=0.0)
        if width > widest:
            widest, gap, sigma = width, max(0.0, width - 2.0 * rest), math.sqrt(2.0) * end_sigma
    return gap, sigma


def _rest(steps: Floats) -> tuple[float, float]:
    """Compute how far the nearest of points lies from a line on average, m, and its sigma, by the points' distances."""
    mean, two, three = (float(np.mean(steps**n)) for n in (1, 2, 3))
    rest = 0.5 * two / mean
    return rest, math.sqrt(max(0.0, three / (3.0 * mean) - rest**2) + 0.5 * EDGE_LOST_M**2)


def _end(side: _Side, root: Floats, d: Floats, other: Floats, clear: float) -> tuple[float, float]:
    """Distance m from the root (2,) along a wall at which its points end, and its sigma.

    0 where they reach the other wall.

    Points nearer to the other wall than `clear` may be of either.
    """
    flat = side.rows[:, :2] - root
    slant = abs(d[0] * other[1] - d[1] * other[0])
    a, away = flat @ d, np.abs(flat[:, 0] * other[1] - flat[:, 1] * other[0])
    x = np.unique(a[away > clear])
    if len(x) < 20:
        return math.nan, math.nan
    rest, sigma = _rest(np.diff(x))
    end, hidden = float(x[0]) - rest, clear / slant
    return (0.0, math.hypot(sigma, hidden / math.sqrt(3.0))) if end < hidden + sigma else (end, sigma)


def _faces_apart(cut: _Cut, model: PartModel, seam: DrawnSeam, tilt: float | None = None) -> tuple[float, float, float]:
    """Compute how far the sheet on the left of a lap lies above that on the right, m, against the drawing.

    With its sigma, and the tilt of both, or that given.

    NaN where one of them is not seen.
    """
    lower = (seam.wall_left_P, seam.wall_right_P)[int(np.argmax(seam.wall_height_m))]
    q, m = model.closest(cut.points)
    off = np.sum((cut.points - q) * m, axis=1)
    out = lower[cut.k]
    face = (np.sum(m * out, axis=1) > ALONG_WALL_COS) & (np.sum(out * cut.normals, axis=1) > ALONG_WALL_COS)
    face &= (np.linalg.norm(cut.points - q, axis=1) < np.abs(off) + 1e-4) & (np.abs(off) < 2.0 * MOST_M)
    x = np.sum(cut.offset * seam.left_P[cut.k], axis=1)
    use, left = face & (np.abs(x) > NEAR_ROOT_M), x > 0.0
    A = np.column_stack([left, ~left, x]).astype(float)  # the whole part may be registered askew
    if tilt is not None:
        A, off = A[:, :2], off - tilt * x
    for _ in range(4):
        if min(np.count_nonzero(use & left), np.count_nonzero(use & ~left)) < 12:
            return math.nan, math.nan, 0.0
        fit = np.linalg.lstsq(A[use], off[use], rcond=None)[0]
        residual = np.abs(off - A @ fit)
        noise = 1.4826 * float(np.median(residual[use]))
        use &= residual < max(3.5 * noise, 1e-6)
    sigma = noise * math.sqrt(CORRELATED / np.count_nonzero(use & left) + CORRELATED / np.count_nonzero(use & ~left))
    return float(fit[0] - fit[1]), math.hypot(sigma, SIGMA_FLOOR_M), float(fit[-1]) if tilt is None else tilt
