"""Fits a part's pose to a scan: points to the surface, and the rims of the seen faces to the part's sharp edges.

A flat face does not fix the pose along itself. What does is where it ends: at an edge beyond which the part faces away
from the scanner, the outermost points of the face lie a share of a point distance inside the edge. That share is
estimated too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from weldcal.welding.locate.part.model import PartModel, SharpEdges
from weldcal.welding.locate.part.scan import PreparedScan, View
from weldcal.welding.locate.planes import into

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SAME_SIDE_COS = math.cos(math.radians(38.0))
HIDDEN_COS = math.cos(math.radians(77.0))  # a face seen at a larger angle is not measured
INSET, INSET_SIGMA = 0.35, 0.2  # of the outermost points of a face, in point distances
RIM_SIGMA = 0.40  # of one of them, in point distances
RIM_GATE, STILL_M = 4.5, 2e-5  # in point distances; a step smaller than this is the last with one gate
LEAST_OWN = 0.15  # share of the rims with something behind them, below which nothing lies behind the part
BEHIND_M = 0.002  # a face ends where the scan shows something so far behind it: over ten times the noise of a scan
# The same for a thinner sheet, in its thickness: nearer to its table, one thickness below, than to itself.
BEHIND = 0.55
SHARED_M = 0.08  # the warp of the tests' scans is one error over such a length: 60 points of 1 mm, smoothed
RIM_FLOOR = 0.15  # error common to the points of one edge, in point distances
SURFACE_RATIO = 6.0  # neighbouring points per independent one, in the balance against the rims
PATCHES = 14.0  # size of a patch whose points share their error, in point distances
SIGMA_FLOOR_M, CREEP_M, SLOW_M = 2e-5, 2e-5, 3e-5
FINE_GATE_M, FINE_GATE = 0.008, 1.0 / 40.0  # first gate, at least, and in the part's radius: a cell of the search
CLUSTERS = 100_000  # numbers reserved for the clusters of each scan: more than its points on rims
MOST_POINTS, EARLY_POINTS, COARSE_POINTS = 15_000, 4000, 1200
NEAR_CELLS = 128  # along the longest side, in which points near an edge are found: a choice, two million at most


@dataclass(frozen=True, eq=False)
class Equations:
    """Linearised equations in P.

    Rows (M,6) of rotation and translation, and residuals (M,) m, with weights and clusters (M,).
    """

    rows: Floats
    residual: Floats
    weight: Floats
    cluster: npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PartFit:
    """A pose with the equations that fixed it, and rms_m of the surface."""

    X_BP: RigidTransform
    equations: tuple[Equations, Equations | None, float, float]  # of surface and rims, with sigma and point distance, m
    rms_m: float

    @cached_property
    def covariance(self) -> Floats:
        """The covariance (6,6) of the motion in P."""
        return covariance(*self.equations)


def moved(X: RigidTransform, xi: Floats) -> RigidTransform:
    """X times the small motion xi (6,) in P, rotation then translation."""
    return X @ RigidTransform(RotationMatrix(Rotation.from_rotvec(xi[:3]).as_matrix()), xi[3:])


def _within(p: Floats, middle: Floats, reach: float) -> Mask:
    """Which points (N,3) lie nearer than `reach` to a point (3,)."""
    d = p - middle
    return np.asarray(np.vecdot(d, d) < reach**2)


def surface_rows(p: Floats, n: Floats, model: PartModel, gate: float, same: float = SAME_SIDE_COS) -> Equations:
    """Set up the point-to-plane equations of points p (N,3) in P with normals n (N,3).

    Only of those that lie within `gate` of the surface.
    """
    near = _within(p, model.center, model.radius + gate)
    p, n = p[near], n[near]
    q, m = model.closest(p) if len(p) else (p, n)
    away = np.linalg.norm(p - q, axis=1)
    keep = (away < gate) & (np.sum(n * m, axis=1) > same)
    p, q, m = p[keep], q[keep], m[keep]
    r = np.sum((p - q) * m, axis=1)
    return Equations(-np.hstack([np.cross(p, m), m]), r, np.ones(len(r)), np.zeros(len(r), dtype=np.int64))


def contour(model: PartModel, eye: Floats) -> SharpEdges:
    """Select the samples of sharp edges that, seen from the eye (3,) in P, end a measured face.

    Those that hide something of the face are left out.
    """
    e = model.edges
    if not len(e.point):
        return e
    view = eye - e.point
    view = view / np.linalg.norm(view, axis=1, keepdims=True)
    at = np.sum(view * e.normal, axis=1)
    index = np.flatnonzero((at > 0.45) & (np.sum(view * e.other, axis=1) < HIDDEN_COS))
    inner = e.point[index] - 0.0015 * e.outward[index]
    d = inner - eye
    far = np.linalg.norm(d, axis=1)
    hit, _ = model.ranges(eye, d / far[:, None])
    index = index[np.abs(hit - far) < 0.0008]
    # A sample needs depth behind it: just beyond the edge the part must not continue at nearly the same depth.
    d = e.point[index] + 0.0015 * e.outward[index] - eye
    far = np.linalg.norm(d, axis=1)
    hit, _ = model.ranges(eye, d / far[:, None])
    index = index[hit > far + 0.0025]
    return SharpEdges(*(getattr(e, f.name)[index] for f in fields(e)))


_Rows = TypeVar("_Rows", SharpEdges, Equations)


def contours(model: PartModel, X_BP: RigidTransform, scan: PreparedScan) -> list[SharpEdges]:
    """Compute the contour from each of the scanner's positions."""
    return [contour(model, eye) for eye in into(X_BP, scan.eyes)]


def joined(parts: list[_Rows]) -> _Rows:
    """Join the edges, or the equations, of several scans; chains, or clusters, of two scans keep different numbers."""
    if len(parts) == 1:
        return parts[0]
    rows = {f.name: np.concatenate([getattr(one, f.name) for one in parts]) for f in fields(parts[0])}
    last = fields(parts[0])[-1].name
    rows[last] += CLUSTERS * np.repeat(np.arange(len(parts)), [len(getattr(one, last)) for one in parts])
    return type(parts[0])(**rows)


def rim_rows(
    p: Floats, edges: SharpEdges, gate: float, band: float, view: View, behind: float, X_BP: RigidTransform
) -> Equations | None:
    """Equations of the outermost points of the faces among p (N,3) in P against the edges that end them.

    A face may also end where something hides it, or where nothing was measured. So just beyond its outermost point the
    scan has to show something behind it; where no edge does, for nothing lies in the scanner's range behind the part,
    all edges are used.
    """
    pitch = view.pitch_m
    if len(edges.point) < 4 or not len(p):
        return None
    away, k = (
        np.asarray(found) for found in cKDTree(edges.point).query(p, distance_upper_bound=math.hypot(gate, 0.002))
    )
    near = np.isfinite(away)
    p, k = p[near], k[near]
    d = p - edges.point[k]
    out, height = np.sum(d * edges.outward[k], axis=1), np.sum(d * edges.normal[k], axis=1)
    on = (np.abs(height) < band) & (np.abs(np.sum(d * edges.tangent[k], axis=1)) < max(0.0018, 1.2 * pitch))
    k, out = k[on], out[on]
    n = len(edges.point)
    count = np.bincount(k, minlength=n)
    last = np.full(n, -np.inf)
    np.maximum.at(last, k, out)
    # The face must be there within, and must end within the gate.
    good = np.flatnonzero((count >= 3) & (last > -gate + 2.0 * pitch) & (last < gate - 1.5 * pitch))
    if len(good) < 4:
        return None
    beyond = edges.point[good] + (last[good] + 1.5 * pitch)[:, None] * edges.outward[good]
    own = _ends_itself(beyond, edges.normal[good], view, behind, X_BP)
    if np.count_nonzero(own) > max(4, LEAST_OWN * len(good)):
        good = good[own]
    m, at = edges.outward[good], edges.point[good]
    r = last[good] + INSET * pitch
    return Equations(-np.hstack([np.cross(at, m), m]), r, np.ones(len(r)), _shared(edges, good))


def _ends_itself(beyond: Floats, normal: Floats, view: View, behind: float, X_BP: RigidTransform) -> Mask:
    """Tell whether faces with normals (N,3) end by themselves at points (N,3) of P just beyond their rims.

    The scan then shows something behind the faces there and nothing before them.
    """
    R = X_BP.rotation().matrix()
    at = beyond @ R.T + X_BP.translation()
    d = at - view.eye
    away = np.linalg.norm(d, axis=1)
    reach = 2.5 * view.pitch_m / float(np.median(away))
    _, k = view.rays.query(d / away[:, None], k=9, distance_upper_bound=reach)
    found = np.asarray(k) < len(view.measured)
    height = np.einsum("ijk,ik->ij", view.measured[np.where(found, k, 0)] - at[:, None], normal @ R.T)
    return np.asarray((found & (height < -behind)).any(axis=1) & ~(found & (height > BEHIND_M)).any(axis=1))


def _shared(edges: SharpEdges, index: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Numbers (N,) of the groups of edge samples that share their error: the same direction, nearly the same place."""
    key = np.hstack([np.round(2.0 * edges.outward[index]), np.round(edges.point[index] / SHARED_M)]).astype(np.int64)
    return np.asarray(np.unique(key, axis=0, return_inverse=True)[1]).ravel()


def _beside(p: Floats, edges: SharpEdges, reach: float) -> Mask:
    """Which points (N,3) in P lie near an edge: in the cells around those of the edges, which hold all within reach."""
    if not len(edges.point):
        return np.zeros(len(p), dtype=bool)
    low, high = edges.point.min(axis=0), edges.point.max(axis=0)
    cell = max(reach + 0.002, float((high - low).max()) / NEAR_CELLS)
    size = ((high - low) / cell).astype(np.int64) + 3  # with a border of one cell
    near = np.zeros(size, dtype=bool)
    near[tuple((((edges.point - low) / cell).astype(np.int64) + 1).T)] = True
    for axis in range(3):
        ahead = np.moveaxis(near, axis, 0)
        before = ahead.copy()
        ahead[1:] |= before[:-1]
        ahead[:-1] |= before[1:]
    at = np.floor((p - low) / cell).astype(np.int64) + 1
    inside = ((at >= 0) & (at < size)).all(axis=1)
    inside[inside] = near[tuple(at[inside].T)]
    return np.asarray(inside)


def tukey(r: Floats, c: float) -> Floats:
    """Tukey's weights."""
    return np.asarray(np.square(np.maximum(1.0 - np.square(r / c), 0.0)))


def _rim_weights(rims: Equations, pitch: float, reach: float) -> Floats:
    """Tukey's weights of the rims, those within a reach at least."""
    c = max(3.0 * pitch, 2.0 * float(np.median(np.abs(rims.residual))), reach)
    return tukey(rims.residual, c) / (RIM_SIGMA * pitch) ** 2


def step(
    surface: Equations, rims: Equations | None, c: float, sigma: float, pitch: float, reach: float = 0.0
) -> Floats | None:
    """The motion (6,) of one Gauss-Newton step, the inset of the rims estimated with it.

    None where too few points are near.

    reach: how far off, m, rims still count: where a few of many sides are, they would be taken for others.
    """
    if len(surface.residual) < 30:
        return None
    w = tukey(surface.residual, c) / (SURFACE_RATIO * sigma**2)
    A = np.zeros((7, 7))
    b = np.zeros(7)
    A[:6, :6] = (surface.rows * w[:, None]).T @ surface.rows
    b[:6] = (surface.rows * w[:, None]).T @ -surface.residual
    if rims is not None:
        J = np.hstack([rims.rows, np.ones((len(rims.rows), 1))])
        v = _rim_weights(rims, pitch, reach)
        A += (J * v[:, None]).T @ J
        b += (J * v[:, None]).T @ -rims.residual
    A[6, 6] += 1.0 / (INSET_SIGMA * pitch) ** 2
    # Directions that nothing fixes stay where they are.
    A[:6, :6] += np.diag([1.0 / math.radians(8.0) ** 2] * 3 + [1.0 / 0.02**2] * 3)
    return np.asarray(np.linalg.solve(A, b)[:6])


def coarse_fit(
    scan: PreparedScan, model: PartModel, X: RigidTransform, gates: tuple[float, ...]
) -> RigidTransform | None:
    """A pose by the coarse points, its gate narrowing; None where they do not touch the part."""
    near = _within(scan.coarse, X.multiply(model.center), model.radius + 2.0 * gates[0])
    points, normals = scan.coarse[near], scan.coarse_normals[near]
    if len(points) > COARSE_POINTS:
        index = (np.arange(COARSE_POINTS) * (len(points) / COARSE_POINTS)).astype(int)
        points, normals = points[index], normals[index]
    for gate in gates:
        p, n = into(X, points), normals @ X.rotation().matrix()
        xi = step(surface_rows(p, n, model, gate, 0.7), None, gate, 0.5 * gate, scan.pitch_m)
        if xi is None:
            return None
        X = moved(X, xi)
    return X


def fine_fit(scan: PreparedScan, model: PartModel, X: RigidTransform) -> PartFit | None:
    """Fit surface and rims from a pose good to the gate, with its covariance; None where too few points are near."""
    pitch, gate = scan.pitch_m, max(FINE_GATE_M, FINE_GATE * model.radius)
    middle, around = X.multiply(model.center), model.radius + 0.02
    near = _within(scan.points, middle, around)
    points, normals = scan.points[near], scan.normals[near]
    stride = max(1.0, len(points) / MOST_POINTS)
    few = (np.arange(int(len(points) / stride)) * stride).astype(int)
    every = [v.measured[_within(v.measured, middle, around)] for v in scan.views]
    behind = min(BEHIND_M, BEHIND * model.thickness_m)
    sigma = 0.5e-3
    surface, rims = None, None
    for g, steps in ((gate, 3), (0.5 * gate, 3), (0.004, 3), (0.002, 6)):
        edges = contours(model, X, scan)
        rim_gate = max(g, RIM_GATE * pitch)
        beside = [p[_beside(into(X, p), e, 2.0 * rim_gate)] for p, e in zip(every, edges, strict=True)]
        some = few if g <= 0.002 else few[:: max(1, len(few) // EARLY_POINTS)]
        for _ in range(steps):
            near_m = max(g, 3.5 * pitch) if g > 0.002 else max(0.001, 8.0 * sigma)
            surface = surface_rows(into(X, points[some]), normals[some] @ X.rotation().matrix(), model, near_m)
            if len(surface.residual) < 30:
                return None
            sigma = max(SIGMA_FLOOR_M, 1.4826 * float(np.median(np.abs(surface.residual))))
            # A narrower gate would only let through the rims that agree with the pose already.
            band = max(4.0 * sigma, 0.0004)
            found = [
                rim_rows(into(X, p), e, rim_gate, band, v, behind, X)
                for p, e, v in zip(beside, edges, scan.views, strict=True)
            ]
            some_rims = [one for one in found if one is not None]
            rims = joined(some_rims) if some_rims else None
            reach = rim_gate if g > 0.002 else 0.0
            xi = step(surface, rims, max(4.0 * sigma, 0.0004), sigma, pitch, reach)
            if xi is None:
                return None
            X = moved(X, xi)
            if math.hypot(model.radius * float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))) < STILL_M:
                break
    assert surface is not None
    return PartFit(
        X,
        (surface, rims, sigma, pitch),
        float(np.sqrt(np.mean(np.square(surface.residual[np.abs(surface.residual) < max(4.0 * sigma, 0.0004)])))),
    )


def _acts_at(equations: Equations) -> Floats:
    """Where equations act (N,3) in P: the foot of the origin on each one's line of action."""
    return np.cross(equations.rows[:, 3:], equations.rows[:, :3])


def _patches(equations: Equations, size: float) -> npt.NDArray[np.int64]:
    """Numbers (N,) of the patches that equations belong to, told apart by place and by direction."""
    key = np.hstack([np.floor(_acts_at(equations) / size), np.round(-2.0 * equations.rows[:, 3:])]).astype(np.int64)
    return np.asarray(np.unique(key, axis=0, return_inverse=True)[1]).ravel()


def covariance(surface: Equations, rims: Equations | None, sigma: float, pitch: float) -> Floats:
    """Compute the covariance (6,6) of the pose by the sandwich of the normal equations.

    Points of a patch, or of an edge, share errors.

    The points of a patch of PATCHES point distances are one cluster, those of a piece of an edge another (Liang and
    Zeger 1986). Added are errors that a patch or a side has in common: CREEP_M in a patch, SLOW_M in one of SHARED_M,
    RIM_FLOOR on a side.
    """
    w = tukey(surface.residual, max(4.0 * sigma, 0.0004)) / (SURFACE_RATIO * sigma**2)
    A = np.zeros((7, 7))
    A[:6, :6] = (surface.rows * w[:, None]).T @ surface.rows
    A[6, 6] = 1.0 / (INSET_SIGMA * pitch) ** 2
    G = np.hstack([surface.rows, np.zeros((len(w), 1))]) * w[:, None]
    patch = _patches(surface, PATCHES * pitch)
    score = np.zeros((int(patch.max()) + 1, 7))
    np.add.at(score, patch, G * surface.residual[:, None])
    middle = score.T @ score + np.diag([0.0] * 6 + [A[6, 6]])
    # Errors of the surface and the scanner that the residuals do not show, for the pose follows them.
    for size, error in ((PATCHES * pitch, CREEP_M), (SHARED_M, SLOW_M)):
        patch = _patches(surface, size)
        lean = np.zeros((int(patch.max()) + 1, 7))
        np.add.at(lean, patch, G)
        middle += error**2 * (lean.T @ lean)
    if rims is not None:
        J = np.hstack([rims.rows, np.ones((len(rims.rows), 1))])
        v = _rim_weights(rims, pitch, 0.0)
        H = J * v[:, None]
        A += H.T @ J
        r = np.clip(rims.residual, -2.0 * pitch, 2.0 * pitch)
        piece = np.unique(
            np.column_stack([rims.cluster, np.floor(_acts_at(rims) / (PATCHES * pitch))]), axis=0, return_inverse=True
        )[1].ravel()
        pieces = np.zeros((int(piece.max()) + 1, 7))
        np.add.at(pieces, piece, H * r[:, None])
        middle += pieces.T @ pieces + (H * (0.15 * pitch) ** 2).T @ H
        for chain in np.unique(rims.cluster):
            total = H[rims.cluster == chain].sum(axis=0)
            middle += np.outer(total, total) * (RIM_FLOOR * pitch) ** 2
    scale = np.sqrt(np.maximum(np.diag(A), 1e-9))
    inverse = np.linalg.pinv(A / np.outer(scale, scale) + 1e-9 * np.eye(7)) / np.outer(scale, scale)
    free = np.zeros((7, 7))
    values, vectors = np.linalg.eigh(A[:6, :6] / np.outer(scale[:6], scale[:6]))
    for value, vector in zip(values, vectors.T, strict=True):
        if value < 1e-4:  # nothing fixes this direction: it is as unknown as the search's step
            direction = vector / scale[:6]
            size = math.hypot(float(np.linalg.norm(direction[:3])) / 0.1, float(np.linalg.norm(direction[3:])) / 0.02)
            free[:6, :6] += np.outer(direction, direction) / max(size, 1e-12) ** 2
    return np.asarray((inverse @ middle @ inverse + free)[:6, :6])
