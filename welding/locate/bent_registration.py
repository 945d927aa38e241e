"""Registers a bent plate to one scan by its cylindrical face and its outline.

The drawing gives the radius. The face is found by its normals and unrolled; there the flat outline is slid over the
flat edge of what was seen. Then pose and inset are fitted together to the face (distance from the cylinder) and to its
outermost points (distance from the outline, unrolled): the face alone does not constrain the position along and around
the axis.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.optimize import least_squares

from weldcal.models.mesh import inside_loops
from weldcal.models.workpieces.plate import Workpiece
from weldcal.welding.locate.bent_face import BentFace, find_bent_faces, rolled, unrolled
from weldcal.welding.locate.outline_fit import by_the_edge, inward_normals, outermost, slide
from weldcal.welding.locate.planes import Floats, into, point_pitch, thinned
from weldcal.welding.locate.pose_covariance import (
    EDGE_NOISES,
    EDGE_PITCHES,
    HEIGHT_FLOOR_M,
    INSET_PITCHES,
    SCATTER_PITCHES,
    SLANT_PITCHES,
    USUAL_SLANT_RAD,
    points_per_independent,
)
from weldcal.welding.locate.registration_result import (
    RegistrationConfig,
    WorkpieceNotFound,
    WorkpieceRegistration,
    agreement,
    known_well_enough,
    not_found,
)

RADIUS_SHARE = 0.15  # largest relative difference between a candidate face's radius and the drawn one
MOST_SAG_M = 0.0006  # largest sag of the part against its drawing, from its middle to its ends
FACE_POINTS = 4000
COARSE_POINTS = 60_000
FORM_M, FORM_WAVES = 3e-5, 10


def flattened(workpiece: Workpiece) -> Workpiece:
    """The workpiece before bending, with its seam unrolled; a flat workpiece unchanged."""
    if not math.isfinite(workpiece.bend_radius_m):
        return workpiece
    seam = unrolled(workpiece.seam_P, workpiece.bend_radius_m)
    return replace(workpiece, seam_P=seam, bend_radius_m=math.inf, up_P=np.array([[0.0, 0.0, 1.0]]))


def into_plate(X_BP: RigidTransform, points_B: Floats, workpiece: Workpiece) -> Floats:
    """Points (N,3) expressed in the plate's frame, unrolled for a bent plate."""
    p = into(X_BP, points_B)
    return unrolled(p, workpiece.bend_radius_m) if math.isfinite(workpiece.bend_radius_m) else p


def register_bent(
    points: Floats, workpiece: Workpiece, X_BP_guess: RigidTransform, config: RegistrationConfig, eye_B: Floats | None
) -> WorkpieceRegistration:
    """Register a plate bent over a cylinder, as `register_workpiece`; points (N,3) m in base, all finite."""
    radius = workpiece.bend_radius_m
    half = 0.5 * np.array(workpiece.size_m[:2])
    reach = config.max_shift_m + float(np.hypot(*half)) * math.sin(config.max_turn_rad)
    p = into(X_BP_guess, points)
    sag = radius * (1.0 - math.cos(min(half[0] / radius, 1.5)))
    near = (np.abs(p[:, :2]) < half + reach + 0.01).all(axis=1)
    near &= (p[:, 2] < reach) & (p[:, 2] > -reach - sag - workpiece.size_m[2])
    points, p = points[near], p[near]
    if len(points) < config.min_points:
        raise WorkpieceNotFound(
            f"The scan has only {len(points)} points near the workpiece: move it into view or correct the guess."
        )
    rng = np.random.default_rng(config.seed)
    best: tuple[float, RigidTransform] | None = None
    radii = ((1.0 - RADIUS_SHARE) * radius, (1.0 + RADIUS_SHARE) * radius)
    few = thinned(p, COARSE_POINTS)
    for face in find_bent_faces(few, radii, rng):
        y = face.X_AQ.rotation().matrix()[:, 1]
        if abs(math.atan2(-y[0], y[1])) > config.max_turn_rad + math.radians(3.0):
            continue
        # The search starts at the unrolled position of the guess.
        x0, y0, _ = face.unrolled(np.zeros((1, 3)))[0]
        face = BentFace(face.at(float(x0), float(y0), 0.0), radius)
        X_QP, score = slide(face.unrolled(few), workpiece.outline_P, config.max_shift_m, math.radians(5.0))
        if best is None or score > best[0]:
            x, y_, _ = X_QP.translation()
            yaw = RollPitchYaw(X_QP.rotation()).yaw_angle()
            best = (score, X_BP_guess @ face.at(float(x), float(y_), float(yaw)))
    if best is None:
        raise WorkpieceNotFound(
            f"The scan shows no face bent over {1e3 * radius:.0f} mm where the workpiece should be: check the guess and"
            " which workpiece this is."
        )
    return _refine(points, workpiece, best[1], config, eye_B)


@dataclass(frozen=True, eq=False)
class _Seen:
    """The data of the pose fit, in the plate's frame before it: face (N,3), rims (M,3) and their edges (M,)."""

    face: Floats
    rims: Floats
    edges: npt.NDArray[np.int64]
    pitch: float
    noise: float
    crowd: float  # how many correlated face points count as one independent point


def _refine(
    points: Floats, workpiece: Workpiece, X_BP: RigidTransform, config: RegistrationConfig, eye_B: Floats | None
) -> WorkpieceRegistration:
    """Pose, inset and covariance from a pose good to a few millimetres; then the check against the drawing."""
    radius, outline = workpiece.bend_radius_m, workpiece.outline_P
    core = outline * (1.0 - 0.012 / np.abs(outline).max())
    slants = _slants(outline, radius, None if eye_B is None else into(X_BP, eye_B[None])[0])
    inset, noise, band = 0.0, 0.0, 0.0
    covariance = np.zeros((6, 6))
    u = unrolled(into(X_BP, points), radius)
    near_edge, middle = (
        points[by_the_edge(u, outline)],
        points[inside_loops(u[:, :2], [core]) & (np.abs(u[:, 2]) < 0.01)],
    )
    if len(middle) < config.min_points // 2:
        raise not_found(workpiece, "check the guess, the workpiece and the calibration.")
    middle = thinned(middle, 10 * FACE_POINTS)
    pitch = point_pitch(unrolled(into(X_BP, near_edge), radius)[:, :2])
    for gate in (0.008, 0.004, 0.002, 0.002):
        p = into(X_BP, middle)
        u = unrolled(p, radius)
        above = inside_loops(u[:, :2], [core]) & (np.abs(u[:, 2]) < gate)
        if np.count_nonzero(above) < 300:
            raise not_found(workpiece, "check the guess, the workpiece and the calibration.")
        z = u[above, 2]
        noise = 1.4826 * float(np.median(np.abs(z - np.median(z))))
        band = max(4.0 * noise, 0.0003)
        edge_p = into(X_BP, near_edge)
        edge_u = unrolled(edge_p, radius)
        on = (edge_u[:, 2] > -0.5 * band) & (edge_u[:, 2] < band)
        rows = np.column_stack([edge_u[on, :2], np.flatnonzero(on)])
        rims, edges = outermost(rows, outline, max(gate, 2.0 * pitch), pitch)
        if len(edges) < 40 or len(np.unique(edges % 2)) < 2:
            raise not_found(workpiece, "too little of its outline is in view.")
        flat = np.flatnonzero(above & (np.abs(u[:, 2]) < band))
        step = max(1, len(flat) // FACE_POINTS)
        crowd = points_per_independent(u[flat], point_pitch(u[flat][:, :2])) / step
        seen = _Seen(p[flat[::step]], edge_p[rims[:, 2].astype(np.int64)], edges, pitch, noise, crowd)
        X_PP, inset, covariance = _fit(seen, outline, radius, slants)
        X_BP = X_BP @ X_PP
    u = into_plate(X_BP, points, workpiece)
    on_face = (np.abs(u[:, 2]) < band) & inside_loops(u[:, :2], [core])
    _same_bend(u[on_face], workpiece, noise)
    supported, contradicted = agreement(u, workpiece, band, pitch, inset, config)
    return WorkpieceRegistration(
        X_BP=X_BP,
        rms_m=float(np.sqrt(np.mean(np.square(u[on_face, 2])))),
        supported=supported,
        contradicted=contradicted,
        confidence=max(0.0, supported - contradicted),
        n_points=int(np.count_nonzero(on_face)),
        covariance=covariance,
        seam_sigma_m=known_well_enough(covariance, workpiece, noise, pitch, config),
    )


def _fit(seen: _Seen, outline: Floats, radius: float, slants_rad: Floats) -> tuple[RigidTransform, float, Floats]:
    """Fit the small motion of P in P to face and rims: it, the inset, and the covariance (6,6), rotation first."""
    a, inward = outline[seen.edges], inward_normals(outline)[seen.edges]
    pitch = seen.pitch
    # A floor independent of the number of points: a real plate deviates from a cylinder in a few long waves.
    face_sigma = math.hypot(
        max(seen.noise, 1e-5) * math.sqrt(max(seen.crowd, 1e-3)), FORM_M * math.sqrt(len(seen.face) / FORM_WAVES)
    )
    common = np.sqrt(
        pitch**2 * (EDGE_PITCHES**2 + (SLANT_PITCHES * np.tan(slants_rad)) ** 2) + (EDGE_NOISES * seen.noise) ** 2
    )
    counts = np.bincount(seen.edges, minlength=len(outline))
    rim_sigma = np.hypot(SCATTER_PITCHES * pitch, common * np.sqrt(counts))[seen.edges]

    def off(v: Floats) -> tuple[Floats, Floats]:
        X = RigidTransform(RollPitchYaw(v[:3]), v[3:6])
        rims = unrolled(into(X, seen.rims), radius)[:, :2]
        return unrolled(into(X, seen.face), radius)[:, 2], np.einsum("ij,ij->i", rims - a, inward) - v[6]

    def residuals(v: Floats) -> Floats:
        face, rims = off(v)
        return np.concatenate([face / face_sigma, rims / rim_sigma, [(v[6] - 0.5 * pitch) / (INSET_PITCHES * pitch)]])

    start = np.array([*np.zeros(6), 0.5 * pitch])
    bounds = np.array([*[0.1] * 3, *[0.02] * 3])
    fit = least_squares(
        residuals,
        start,
        loss="soft_l1",
        f_scale=3.0,
        x_scale=np.array([1e-2] * 3 + [1e-3] * 4),
        bounds=(np.append(-bounds, -0.1 * pitch), np.append(bounds, 1.3 * pitch)),
    )
    face, rims = off(fit.x)
    J = np.asarray(fit.jac)
    G = np.linalg.inv(J.T @ J) @ J.T
    n = len(face)
    # Variance of a residual of weight one: its own scatter, and the error common to all points of an edge.
    scatter = max(float(np.mean(np.square(rims))), (0.5 * SCATTER_PITCHES * pitch) ** 2) / np.square(rim_sigma)
    middle = (G[:, :n] @ G[:, :n].T) + (G[:, n:-1] * scatter) @ G[:, n:-1].T + np.outer(G[:, -1], G[:, -1])
    for edge in np.unique(seen.edges):
        mine = seen.edges == edge
        hidden = max(0.0, (SCATTER_PITCHES * pitch) ** 2 - float(np.var(rims[mine])))
        together = (G[:, n:-1][:, mine] / rim_sigma[mine]).sum(axis=1)
        middle += np.outer(together, together) * (hidden + common[edge] ** 2)
    covariance = middle[:6, :6] + np.diag([0.0] * 5 + [HEIGHT_FLOOR_M**2])
    X = RigidTransform(RollPitchYaw(fit.x[:3]), fit.x[3:6])
    return X, float(fit.x[6]), np.asarray(covariance)


def _slants(outline: Floats, radius: float, eye_P: Floats | None) -> Floats:
    """For each edge (k,) the angle between the face's normal at its middle and the sight.

    The ends of the plate lean.
    """
    middle = 0.5 * (outline + np.roll(outline, -1, axis=0))
    angle = middle[:, 0] / radius
    if eye_P is None:
        return np.asarray(np.abs(angle) + USUAL_SLANT_RAD)
    at = rolled(np.column_stack([middle, np.zeros(len(middle))]), radius)
    sight = eye_P - at
    up = np.column_stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)])
    cosine = np.sum(sight * up, axis=1) / np.linalg.norm(sight, axis=1)
    return np.asarray(np.arccos(np.clip(cosine, math.cos(math.radians(75.0)), 1.0)))


def _same_bend(u: Floats, workpiece: Workpiece, noise: float) -> None:
    """Raise WorkpieceNotFound if the unrolled face (N,3) has another bend radius than drawn."""
    x, y, z = u.T
    A = np.column_stack([np.ones(len(x)), x, y, x * y, 0.5 * x * x])
    coefficients, *_ = np.linalg.lstsq(A, z, rcond=None)
    sag = 0.5 * float(coefficients[4]) * (0.5 * workpiece.size_m[0]) ** 2
    if abs(sag) > MOST_SAG_M + 0.3 * noise:
        bend = 1.0 / workpiece.bend_radius_m - float(coefficients[4])
        seen = f"{1e3 / bend:.0f} mm" if bend > 1e-3 else "nothing"
        raise not_found(
            workpiece,
            f"its face is bent over {seen} and the drawing has {1e3 * workpiece.bend_radius_m:.0f} mm; check which "
            "workpiece this is.",
        )
