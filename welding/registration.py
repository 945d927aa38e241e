"""Where a plate lies, from one scan: its top face and its outline are the datums, the groove is not.

On real parts the outline is where the drawing says and the groove is not, so nothing here looks at the groove. In
order: horizontal planes near the guess (random triples, seeded); on each, the plate's outline slid over the edge of the
seen face (an exhaustive search: flat parts give ICP nothing to hold on to sideways); then a robust plane through the
face and a robust fit of its edges to the outermost face points. Last, every stretch of the outline is checked against
what was seen on both sides of it: a plate of another size contradicts its drawing and is refused.

Accuracy in simulation (pixel pitch 1 mm, noise 0.1 mm, from above): 0.03 mm and 0.02 deg, or 0.15 mm and 0.1 deg where
the plate's edges run exactly along the pixel rows. A slanted view adds about 0.3 mm per unit of tangent of its slant,
because a scanner loses its last pixel more often at the edges that face away from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform
from scipy.optimize import least_squares

from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.mesh import inside_loops
from weldcal.models.workpieces import Workpiece
from weldcal.welding.planes import (
    PLANE_BAND_M,
    Floats,
    Raster,
    into,
    point_pitch,
    rasterise,
    robust_plane,
    turned,
    upward_planes,
)
from weldcal.welding.pose_covariance import moved_covariance, outline_covariance, pose_covariance, seam_sigma


class WorkpieceNotFound(WeldcalError):
    """The scan does not show this workpiece near the guess."""


@dataclass(frozen=True)
class RegistrationConfig:
    """How far the guess may be off, and what counts as found.

    `max_contradicted` is the largest share of the outline at which the scan may show material beyond it or the table
    inside it; `min_supported` the smallest share at which it must show the face ending there (the rest is unseen);
    `max_sigma_m` how uncertain the drawn seam may be, sideways.
    """

    max_shift_m: float = 0.030
    max_turn_rad: float = math.radians(10.0)
    max_contradicted: float = 0.10
    min_supported: float = 0.50
    max_sigma_m: float = 0.00035
    min_points: int = 1000
    seed: int = 0


@dataclass(frozen=True, eq=False)
class WorkpieceRegistration:
    """Where the plate is: X_BP (frame P of models.workpieces), and how well the scan agrees with it.

    rms_m             rms distance of the face's points from its plane, m
    outline_rms_m     rms distance of the face's outermost points from the outline, m (0.3 pixel pitches or so)
    inlier_fraction   share of the points above the plate's area that lie on its face (the groove and clutter do not)
    supported, contradicted   shares of the outline where the scan confirms, or denies, that the face ends there
    confidence        supported less contradicted, 0 to 1
    n_points          points on the face
    covariance        (6,6) of the small motion of P in P that leads from X_BP to the truth, rotation then translation
    seam_sigma_m      what that covariance makes of the drawn seam: rms over it of the sigma sideways in the face, m.
                      The groove's own displacement against the outline comes on top and is not seen here.
    """

    X_BP: RigidTransform
    rms_m: float
    outline_rms_m: float
    inlier_fraction: float
    supported: float
    contradicted: float
    confidence: float
    n_points: int
    covariance: Floats
    seam_sigma_m: float

    @property
    def words(self) -> str:
        """What was found, for a person."""
        return (
            f"{100 * self.supported:.0f} % of the outline seen where it is drawn, {100 * self.contradicted:.0f} % denied; "
            f"the drawn seam is known to {1e3 * self.seam_sigma_m:.2f} mm"
        )

    def turned_round(self, workpiece: Workpiece) -> WorkpieceRegistration:
        """The same with the part turned by 180 deg about the middle of its outline."""
        x, y = 2.0 * workpiece.outline_P.mean(axis=0)
        turn = turned(float(x), float(y), math.pi)
        covariance = moved_covariance(self.covariance, turn)
        return replace(self, X_BP=self.X_BP @ turn, covariance=covariance)


def register_workpiece(
    points_B: npt.NDArray[np.floating],
    workpiece: Workpiece,
    X_BP_guess: RigidTransform,
    config: RegistrationConfig | None = None,
    eye_B: npt.ArrayLike | None = None,
) -> WorkpieceRegistration:
    """Finds the plate in a scan (N,3) or (H,W,3), metres in base, NaN where unmeasured, near a guess.

    `eye_B` (3,): where the scanner stands; it only serves the covariance, which assumes a usual slant without it.
    A rectangle looks the same after half a turn: the guess decides. Raises WorkpieceNotFound when the scan shows no
    such plate there, InputError for a scan of the wrong shape.
    """
    config = config or RegistrationConfig()
    eye = None if eye_B is None else np.asarray(eye_B, dtype=np.float64)
    points = np.asarray(points_B, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3:
        raise InputError(f"A scan has the shape (N, 3) or (H, W, 3): this one is {points.shape}.")
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    half = 0.5 * np.array(workpiece.size_m[:2])
    reach = config.max_shift_m + float(np.hypot(*half)) * math.sin(config.max_turn_rad)
    p = into(X_BP_guess, points)
    near = (np.abs(p[:, :2]) < half + reach + 0.01).all(axis=1) & (np.abs(p[:, 2]) < reach + workpiece.size_m[2])
    points, p = points[near], p[near]
    if len(points) < config.min_points:
        raise WorkpieceNotFound(
            f"The scan has only {len(points)} points near the workpiece: move it into view or correct the guess."
        )

    rng = np.random.default_rng(config.seed)
    sample = p[rng.choice(len(p), size=min(len(p), 8000), replace=False)]
    best: tuple[float, RigidTransform] | None = None
    for X_GQ in upward_planes(sample, config.max_turn_rad + math.radians(3.0), config.min_points // 4, rng):
        X_QP, score = _slide(into(X_GQ, p), workpiece, config)
        if best is None or score > best[0]:
            best = (score, X_BP_guess @ X_GQ @ X_QP)
    if best is None:
        raise WorkpieceNotFound("The scan shows no flat face where the workpiece should be: check the guess.")
    return _refine(points, workpiece, best[1], config, eye)


def _refine(
    points: Floats, workpiece: Workpiece, X_BP: RigidTransform, config: RegistrationConfig, eye_B: Floats | None
) -> WorkpieceRegistration:
    """Plane and outline by least squares from a pose good to a few millimetres, then the check against the drawing."""
    not_found = f"The scan shows no plate of {' x '.join(f'{1e3 * v:.0f}' for v in workpiece.size_m[:2])} mm there: "
    outline = workpiece.outline_P
    core = outline * (1.0 - 0.012 / np.abs(outline).max())
    p = into(X_BP, points)
    above = inside_loops(p[:, :2], [core]) & (np.abs(p[:, 2]) < 4.0 * PLANE_BAND_M)
    if np.count_nonzero(above) < config.min_points // 2:
        raise WorkpieceNotFound(not_found + "check the guess, the workpiece and the calibration.")
    X_PQ, sigma = robust_plane(p[above])
    X_BP = X_BP @ X_PQ

    slant = None
    if eye_B is not None:
        sight = eye_B - X_BP.translation()
        slant = math.acos(min(1.0, float(sight @ X_BP.rotation().matrix()[:, 2]) / float(np.linalg.norm(sight))))
    band = max(4.0 * sigma, 0.0003)
    pitch, inset, fit_rms = 0.0, 0.0, math.inf
    for gate in (0.008, 0.004, 0.002):
        p = into(X_BP, points)
        # Points a little below the face are the side of the plate, which would move the edges the scanner looks at.
        face = p[(p[:, 2] > -0.5 * band) & (p[:, 2] < band)][:, :2]
        pitch = point_pitch(face[inside_loops(face, [core])]) if pitch == 0.0 else pitch
        rims, edges = _outermost(face, outline, max(gate, 2.0 * pitch), pitch)
        if len(edges) < 40 or len(np.unique(edges % 2)) < 2:
            raise WorkpieceNotFound(not_found + "too little of its outline is in view.")
        X_PP, inset, fit_rms, in_plane = _fit_outline(rims, edges, outline, pitch, slant, sigma)
        X_BP = X_BP @ X_PP

    p = into(X_BP, points)
    flat = np.abs(p[:, 2]) < band
    raster = rasterise(p, flat, p[:, 2] < -0.003, pitch)
    rims, edges = _outermost(p[flat][:, :2], outline, 0.008, pitch)
    displaced = _displaced(rims, edges, outline, inset, 0.0003 + 0.5 * pitch, raster)
    supported, contradicted = _check(raster, outline, displaced)
    if contradicted > config.max_contradicted:
        disagree = f"{100 * contradicted:.0f} % of its outline disagree with the scan"
        raise WorkpieceNotFound(not_found + disagree + "; check which workpiece this is.")
    if supported < config.min_supported:
        visible = f"only {100 * supported:.0f} % of its outline can be seen"
        raise WorkpieceNotFound(not_found + visible + "; clear the view or scan from higher up.")
    inside = inside_loops(p[:, :2], [core])
    on_face = flat & inside
    covariance = pose_covariance(p[on_face], in_plane, pitch)
    uncertain = seam_sigma(covariance, workpiece)
    if uncertain > config.max_sigma_m:
        raise WorkpieceNotFound(
            f"The plate is there, but its place is only known to {1e3 * uncertain:.2f} mm from this scan (noise "
            f"{1e3 * sigma:.2f} mm, points {1e3 * pitch:.1f} mm apart) and {1e3 * config.max_sigma_m:.2f} mm are required: "
            "use a finer scanner or move it nearer."
        )
    return WorkpieceRegistration(
        X_BP=X_BP,
        rms_m=float(np.sqrt(np.mean(np.square(p[on_face, 2])))),
        outline_rms_m=fit_rms,
        inlier_fraction=float(np.count_nonzero(on_face) / np.count_nonzero(inside)),
        supported=supported,
        contradicted=contradicted,
        confidence=max(0.0, supported - contradicted),
        n_points=int(np.count_nonzero(on_face)),
        covariance=covariance,
        seam_sigma_m=uncertain,
    )


def _inward(outline: Floats) -> Floats:
    """Unit normals (k,2) of the edges of a counter-clockwise outline (k,2), towards its inside."""
    along = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(normals, dtype=np.float64)


def _along(outline: Floats, spacing: float) -> tuple[Floats, Floats, npt.NDArray[np.int64]]:
    """Points (N,2) along the outline, the inward unit normals (N,2) there and the edges' numbers (N,)."""
    following = np.roll(outline, -1, axis=0)
    steps = [max(1, int(np.linalg.norm(b - a) / spacing)) for a, b in zip(outline, following, strict=True)]
    edge = np.repeat(np.arange(len(outline)), steps)
    t = np.concatenate([(np.arange(n) + 0.5) / n for n in steps])[:, None]
    return outline[edge] * (1.0 - t) + following[edge] * t, _inward(outline)[edge], edge


def _slide(q: Floats, workpiece: Workpiece, config: RegistrationConfig) -> tuple[RigidTransform, float]:
    """Best pose of the outline in plane frame Q by exhaustive search, coarse then fine, and its score."""
    raster = rasterise(q, np.abs(q[:, 2]) < PLANE_BAND_M, q[:, 2] < -0.003, point_pitch(q[:, :2]))
    solid = raster.face.astype(np.uint8)
    border = solid - cv2.erode(solid, np.ones((3, 3), dtype=np.uint8))
    gap = cv2.distanceTransform(1 - border, cv2.DIST_L2, 5) * raster.cell
    gap[0, 0] = 1.0
    rim, _, _ = _along(workpiece.outline_P, 0.005)
    low, high = workpiece.outline_P.min(axis=0), workpiece.outline_P.max(axis=0)
    steps = [np.arange(a + 0.01, b - 0.005, 0.015) for a, b in zip(low, high, strict=True)]
    fill = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)

    best = np.zeros(3)
    score = -math.inf
    for shift, step, turn, turn_step, cap in (
        (config.max_shift_m + 0.006, 0.006, config.max_turn_rad + 0.035, 0.035, 0.015),
        (0.006, 0.002, 0.035, 0.007, 0.005),
        (0.002, 0.0005, 0.007, 0.002, 0.003),
    ):
        offsets = np.arange(-shift, shift + 1e-9, step)
        centers = best[:2] + np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 1, 2)
        start, score = best, -math.inf
        for yaw in start[2] + np.arange(-turn, turn + 1e-9, turn_step):
            c, s = math.cos(yaw), math.sin(yaw)
            R = np.array([[c, s], [-s, c]])
            off = np.minimum(raster.look(gap, rim @ R + centers).astype(np.float64), cap).mean(axis=1) / cap
            filled = raster.look(raster.face, fill @ R + centers).mean(axis=1)
            merit = filled - off
            k = int(np.argmax(merit))
            if merit[k] > score:
                score, best = float(merit[k]), np.array([*centers[k, 0], yaw])
    return turned(*best), score


def _outermost(face: Floats, outline: Floats, gate: float, pitch: float) -> tuple[Floats, npt.NDArray[np.int64]]:
    """The face point nearest the outside in every strip across each edge: (M,2) and the edges' numbers (M,)."""
    found, numbers = [], []
    for k, (a, b, inward) in enumerate(zip(outline, np.roll(outline, -1, axis=0), _inward(outline), strict=True)):
        length = float(np.linalg.norm(b - a))
        t = (face - a) @ (b - a) / length
        d = (face - a) @ inward
        # Strips end short of the corners, where the neighbouring edge would answer.
        near = np.flatnonzero((np.abs(d) < gate) & (t > 0.01) & (t < length - 0.01))
        strip = (t[near] / (3.0 * pitch)).astype(np.int64)
        order = np.lexsort((d[near], strip))
        _, first = np.unique(strip[order], return_index=True)
        found.append(face[near[order[first]]])
        numbers.append(np.full(len(first), k))
    return np.concatenate(found), np.concatenate(numbers)


def _fit_outline(
    rims: Floats, edges: npt.NDArray[np.int64], outline: Floats, pitch: float, slant_rad: float | None, noise: float
) -> tuple[RigidTransform, float, float, Floats]:
    """The motion in the plane that puts outermost points (M,2) on their edges, the inset found, the rms left, m, and
    the covariance (3,3) of x, y and turn.

    The scanner's last point on the face lies up to a pitch inside the edge; that inset is one more unknown, the same at
    all edges and held near half a pitch, so that it cancels where opposite edges are seen.
    """
    a, inward = outline[edges], _inward(outline)[edges]
    prior = math.sqrt(len(edges)) * 0.1

    def residuals(v: Floats) -> Floats:
        c, s = math.cos(v[2]), math.sin(v[2])
        moved = (rims - v[:2]) @ np.array([[c, -s], [s, c]])
        inset = np.einsum("ij,ij->i", moved - a, inward)
        return np.append(inset - v[3], prior * (v[3] - 0.5 * pitch))

    start = np.array([0.0, 0.0, 0.0, 0.5 * pitch])
    limit = np.array([0.02, 0.02, 0.1])
    fit = least_squares(
        residuals,
        start,
        loss="soft_l1",
        f_scale=0.3 * pitch,
        x_scale=np.array([1e-3, 1e-3, 1e-2, 1e-3]),
        bounds=(np.append(-limit, -0.1 * pitch), np.append(limit, 1.3 * pitch)),
    )
    off = residuals(fit.x)[:-1]
    rms = float(np.sqrt(np.mean(np.square(off))))
    covariance = outline_covariance(np.asarray(fit.jac), off, edges, pitch, prior, slant_rad, noise)
    return turned(*fit.x[:3]), float(fit.x[3]), rms, covariance


def _displaced(
    rims: Floats, edges: npt.NDArray[np.int64], outline: Floats, inset: float, tolerance: float, raster: Raster
) -> set[int]:
    """Edges that most of their outermost points (M,2) put further than the tolerance from where they are drawn.

    Only points that end the face count: lower ground is seen just beyond them, not the shadow of something in front.
    """
    inward = _inward(outline)[edges]
    depth = np.einsum("ij,ij->i", rims - outline[edges], inward) - inset
    beyond = rims[:, None, :] - np.arange(0.002, 0.0125, 0.002)[:, None] * inward[:, None, :]
    ends = raster.look(raster.below, beyond).any(axis=1) | (depth < -tolerance)
    seen = [k for k in range(len(outline)) if np.count_nonzero(ends & (edges == k)) >= 10]
    return {k for k in seen if abs(float(np.median(depth[ends & (edges == k)]))) > tolerance}


def _check(raster: Raster, outline: Floats, displaced: set[int]) -> tuple[float, float]:
    """Shares of the outline where the face ends as drawn, and where the scan shows that it does not."""
    at, inward, edge = _along(outline, 0.002)
    offset = max(0.003, 2.0 * raster.cell) * inward
    face_in, face_out = raster.look(raster.face, at + offset), raster.look(raster.face, at - offset)
    missing = ~face_in & raster.look(raster.below, at + offset)
    denied = face_out | missing | np.isin(edge, sorted(displaced))
    return float(np.mean(face_in & ~denied)), float(np.mean(denied))
