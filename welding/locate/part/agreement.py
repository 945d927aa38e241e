"""Scores a pose by the scanner's rays: which meet the part where it is predicted, pass through it, or end before it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform
from scipy.spatial import cKDTree

from weldcal.welding.locate.part.fit import contours, joined
from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.part.scan import PreparedScan
from weldcal.welding.locate.planes import into

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MOST_RAYS = 9000
NOT_MEASURED_COS = 0.22  # 77 deg: a scanner measures no face that it sees at a larger angle
VISIBLE_SAMPLES = 2500
BEYOND_M = 0.004  # beyond an edge, four times TOLERANCE_M: a pose that is right does not put the face there
SAME_FACE_COS = 0.95  # 18 deg: the same face, bent by its triangles
NEAR_M = 0.02  # error of fusion that is looked for: a ray that ends farther from the part meets another thing
THIN = 0.6  # of a sheet's thickness: a lower point is nearer to the table, one thickness below, than to the face
LEAST_NEAR, LEAST_MET = 100, 0.5  # rays of a scan that judge its fusion, and the share that meets a part in its place


@dataclass(frozen=True, eq=False, kw_only=True)
class Agreement:
    """Shares of the rays that are predicted to meet the part.

    Attributes:
        met: they do.
        passed: they see through it.
        hidden: something before it is seen.
        seen: share of the part's visible surface with a scan point near.
        goes_on: share of the edges that should end a seen face beyond which the scan shows that face go on.
    """

    met: float
    passed: float
    hidden: float
    seen: float
    n_met: int
    goes_on: float

    @property
    def score(self) -> float:
        """Met less twice the passed share and what goes on, times the square root of what is seen."""
        return max(0.0, self.met - 2.0 * self.passed - self.goes_on) * math.sqrt(self.seen)

    @property
    def score_of_rest(self) -> float:
        """The score by the rays that nothing keeps from the part."""
        met = self.met / max(1e-9, 1.0 - self.hidden)
        return max(0.0, met - 2.0 * self.passed - self.goes_on) * math.sqrt(self.seen)


def rays_near(scan: PreparedScan, model: PartModel, X_BP: RigidTransform, reach_m: float = 0.01) -> Ints:
    """Select the rays that may meet the part near X_BP: the numbers (N,) of their points in the scan."""
    middle = X_BP.multiply(model.center) - scan.eyes
    far = np.linalg.norm(middle, axis=1)
    sine = np.minimum(1.0, (model.radius + reach_m) / far)
    towards, least = (middle / far[:, None]).T, np.sqrt(1.0 - sine**2)
    near = np.flatnonzero((scan.sight @ towards > least)[np.arange(len(scan.view)), scan.view])
    eye = into(X_BP, scan.eyes)[scan.view[near]]
    d = into(X_BP, scan.points[near]) - eye
    low, high = model.mesh.bounds
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = ((low - reach_m - eye) / d).T, ((high + reach_m - eye) / d).T
    near = near[reduce(np.maximum, np.minimum(a, b)) <= reduce(np.minimum, np.maximum(a, b))]
    stride = max(1.0, len(near) / MOST_RAYS)
    return np.asarray(near[(np.arange(int(len(near) / stride)) * stride).astype(int)])


def cast(rays: Ints, scan: PreparedScan, model: PartModel, X_BP: RigidTransform) -> tuple[Floats, ...]:
    """Cast rays (N,) at the part at X_BP: d (N,3) m from the scanner, lengths, distances hit (N,) m, normals (N,3)."""
    eye = into(X_BP, scan.eyes)[scan.view[rays]]
    d = into(X_BP, scan.points[rays]) - eye
    far = np.sqrt(np.vecdot(d, d))
    return d, far, *model.ranges(eye, d / far[:, None])


def compared(
    rays: Ints, scan: PreparedScan, model: PartModel, X_BP: RigidTransform, tolerance_m: float
) -> tuple[Mask, Mask, Mask]:
    """Tell which of rays (N,) meet the part at X_BP as predicted, which pass through it, and which end before it."""
    d, far, hit, normal = cast(rays, scan, model, X_BP)
    cosine = np.abs(np.vecdot(d, normal)) / far
    # Along a slanted surface the same error of the pose is a larger error of the range.
    slack = tolerance_m / np.maximum(cosine, 0.3)
    meets = np.isfinite(hit) & (cosine > NOT_MEASURED_COS)
    behind = far - hit
    return meets & (np.abs(behind) < slack), meets & (behind > slack), meets & (behind < -slack)


def agreement(rays: Ints, scan: PreparedScan, model: PartModel, X_BP: RigidTransform, tolerance_m: float) -> Agreement:
    """Compare these rays (N,) of the scan with the part at X_BP."""
    met, passed, hidden = compared(rays, scan, model, X_BP, tolerance_m)
    total = max(1, int(met.sum() + passed.sum() + hidden.sum()))
    # Which of the visible surface the scan shows: rays back to samples of the part.
    s, n = model.points[::12][:VISIBLE_SAMPLES], model.normals[::12][:VISIBLE_SAMPLES]
    visible = np.zeros(len(s), dtype=bool)
    for one in into(X_BP, scan.eyes):
        v = s - one
        away = np.linalg.norm(v, axis=1)
        first, _ = model.ranges(one, v / away[:, None])
        visible |= (-np.sum(v * n, axis=1) / away > 0.3) & (np.abs(first - away) < 0.001)
    s = s[visible]
    seen = 0.0
    if len(s) and met.any():
        spacing = 2.0 * scan.pitch_m * max(1.0, (len(scan.points) / max(1, len(rays))) ** 0.5)
        near, _ = cKDTree(into(X_BP, scan.points[rays[met]])).query(s, distance_upper_bound=max(0.005, 2.0 * spacing))
        seen = float(np.mean(np.isfinite(near)))
    return Agreement(
        met=float(met.sum() / total),
        passed=float(passed.sum() / total),
        hidden=float(hidden.sum() / total),
        seen=seen,
        n_met=int(met.sum()),
        goes_on=_goes_on(scan, model, X_BP, tolerance_m),
    )


def views_off(scan: PreparedScan, model: PartModel, X_BP: RigidTransform, tolerance_m: float) -> list[int]:
    """List the scans that show the part's surface near X_BP, but not at it: their pose is wrong."""
    rays = rays_near(scan, model, X_BP)
    _, far, hit, normal = cast(rays, scan, model, X_BP)
    gap = np.abs(far - hit)
    main = np.argmax(np.abs(normal), axis=1)
    side = 2 * main + (normal[np.arange(len(normal)), main] > 0.0)  # of the six sides of the part
    # A scan that is off along one side agrees at the others: each side is judged by itself where another scan shows it.
    met = np.full((len(scan.eyes), 7), np.nan)
    for k in range(len(scan.eyes)):
        own = (scan.view[rays] == k) & (gap < NEAR_M)
        for group in range(7):
            chosen = own if group == 6 else own & (side == group)
            if np.count_nonzero(chosen) > LEAST_NEAR:
                met[k, group] = np.mean(gap[chosen] < 2.0 * tolerance_m)
    off = met < LEAST_MET
    off[:, :6] &= (met[:, :6] >= LEAST_MET).any(axis=0)
    return [int(k) for k in np.flatnonzero(off.any(axis=1))]


def _goes_on(scan: PreparedScan, model: PartModel, X_BP: RigidTransform, tolerance_m: float) -> float:
    """Share of the edges that end a face with scan points on it, beyond which the scan has points in the same face."""
    edges = joined(contours(model, X_BP, scan))
    band = min(0.8 * tolerance_m, THIN * model.thickness_m)
    if len(edges.point) < 8:
        return 0.0
    away = max(BEYOND_M, 2.5 * scan.pitch_m, 1.5 * tolerance_m)
    reach = max(0.0015, 1.5 * scan.pitch_m)
    there = [
        _on_face(scan, X_BP, edges.point + side * away * edges.outward, edges.normal, reach, band)
        for side in (-1.0, 1.0)
    ]
    # Across a gap of the part's own the same face begins again.
    beyond = edges.point + away * edges.outward
    q, m = model.closest(beyond)
    own = (np.linalg.norm(beyond - q, axis=1) < reach + tolerance_m) & (
        np.sum(m * edges.normal, axis=1) > SAME_FACE_COS
    )
    shown = there[0] & ~own
    return float(np.mean(there[1][shown])) if np.count_nonzero(shown) > 6 else 0.0


def _on_face(scan: PreparedScan, X_BP: RigidTransform, p: Floats, n: Floats, reach: float, band: float) -> Mask:
    """Whether a scan point lies near each point p (N,3) of P and in the plane through it with normal n (N,3)."""
    R = X_BP.rotation().matrix()
    at = p @ R.T + X_BP.translation()
    _, k = scan.tree.query(at, k=3, distance_upper_bound=reach + band)
    found = k < len(scan.points)
    d = scan.points[np.where(found, k, 0)] - at[:, None]
    height = np.abs(np.einsum("ijk,ik->ij", d, n @ R.T))
    return np.asarray((found & (height < band)).any(axis=1))
