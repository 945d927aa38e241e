"""Registers a flat plate to one scan by its top face and its outline; the groove is not used.

On real parts the outline agrees with the drawing and the groove does not, so the groove is not used here. In
order: horizontal planes near the guess (random triples, seeded); on each, the plate's outline slid over the edge of the
seen face (an exhaustive search: ICP cannot observe the lateral position of flat parts); then a robust plane through the
face and a robust fit of its edges to the outermost face points. Last, every stretch of the outline is checked against
the points on both sides of it: a plate of another size contradicts its drawing and is refused.

Accuracy in simulation (pixel pitch 1 mm, noise 0.1 mm, from above): 0.03 mm and 0.02 deg, or 0.15 mm and 0.1 deg where
the plate's edges run exactly along the pixel rows. A slanted view adds about 0.3 mm per unit of tangent of its slant,
because a scanner loses its last pixel more often at the edges that face away from it.
"""

import math

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform

from weldcal.models.mesh import inside_loops
from weldcal.models.workpieces.plate import Workpiece
from weldcal.welding.locate.bent_registration import register_bent
from weldcal.welding.locate.outline_fit import by_the_edge, fit_outline, outermost, slide
from weldcal.welding.locate.planes import (
    PLANE_BAND_M,
    Floats,
    finite_points,
    into,
    point_pitch,
    robust_plane,
    thinned,
    upward_planes,
)
from weldcal.welding.locate.pose_covariance import pose_covariance
from weldcal.welding.locate.registration_result import (
    RegistrationConfig,
    WorkpieceNotFound,
    WorkpieceRegistration,
    agreement,
    known_well_enough,
    not_found,
)

__all__ = ["RegistrationConfig", "WorkpieceNotFound", "WorkpieceRegistration", "register_workpiece"]
COARSE_POINTS = 60_000  # to slide the outline over
PLANE_POINTS = 60_000


def register_workpiece(
    points_B: npt.NDArray[np.floating],
    workpiece: Workpiece,
    X_BP_guess: RigidTransform,
    config: RegistrationConfig | None = None,
    eye_B: npt.ArrayLike | None = None,
) -> WorkpieceRegistration:
    """Register the plate to a scan (N,3) or (H,W,3), metres in base, NaN where unmeasured, near a guess.

    `eye_B` (3,): the scanner's position; only the covariance uses it, and assumes a typical slant without it.
    A rectangle looks the same after half a turn: the guess decides. Raises WorkpieceNotFound when the scan shows no
    such plate there, InputError for a scan of the wrong shape.
    """
    config = config or RegistrationConfig()
    eye = None if eye_B is None else np.asarray(eye_B, dtype=np.float64)
    (points,) = finite_points([points_B])
    if math.isfinite(workpiece.bend_radius_m):
        return register_bent(points, workpiece, X_BP_guess, config, eye)
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
    few = thinned(p, COARSE_POINTS)
    for X_GQ in upward_planes(sample, config.max_turn_rad + math.radians(3.0), config.min_points // 4, rng):
        X_QP, score = slide(into(X_GQ, few), workpiece.outline_P, config.max_shift_m, config.max_turn_rad)
        if best is None or score > best[0]:
            best = (score, X_BP_guess @ X_GQ @ X_QP)
    if best is None:
        raise WorkpieceNotFound("The scan shows no flat face where the workpiece should be: check the guess.")
    return _refine(points, workpiece, best[1], config, eye)


def _refine(
    points: Floats, workpiece: Workpiece, X_BP: RigidTransform, config: RegistrationConfig, eye_B: Floats | None
) -> WorkpieceRegistration:
    """Plane and outline by least squares from a pose good to a few millimetres, then the check against the drawing."""
    outline = workpiece.outline_P
    core = outline * (1.0 - 0.012 / np.abs(outline).max())
    p = into(X_BP, points)
    above = inside_loops(p[:, :2], [core]) & (np.abs(p[:, 2]) < 4.0 * PLANE_BAND_M)
    if np.count_nonzero(above) < config.min_points // 2:
        raise not_found(workpiece, "check the guess, the workpiece and the calibration.")
    X_PQ, sigma = robust_plane(p[above][:: max(1, np.count_nonzero(above) // PLANE_POINTS)])
    X_BP = X_BP @ X_PQ
    near_edge = points[by_the_edge(p, outline)]

    slant = None
    if eye_B is not None:
        sight = eye_B - X_BP.translation()
        slant = math.acos(min(1.0, float(sight @ X_BP.rotation().matrix()[:, 2]) / float(np.linalg.norm(sight))))
    band = max(4.0 * sigma, 0.0003)
    pitch = point_pitch(into(X_PQ, p[above])[:, :2])
    inset = 0.0
    for gate in (0.008, 0.004, 0.002):
        p = into(X_BP, near_edge)
        # Points a little below the face are the side of the plate and would shift the edges that face the scanner.
        face = p[(p[:, 2] > -0.5 * band) & (p[:, 2] < band)][:, :2]
        rims, edges = outermost(face, outline, max(gate, 2.0 * pitch), pitch)
        if len(edges) < 40 or len(np.unique(edges % 2)) < 2:
            raise not_found(workpiece, "too little of its outline is in view.")
        X_PP, inset, in_plane = fit_outline(rims, edges, outline, pitch, slant, sigma)
        X_BP = X_BP @ X_PP

    p = into(X_BP, points)
    supported, contradicted = agreement(p, workpiece, band, pitch, inset, config)
    on_face = (np.abs(p[:, 2]) < band) & inside_loops(p[:, :2], [core])
    covariance = pose_covariance(p[on_face], in_plane, pitch)
    return WorkpieceRegistration(
        X_BP=X_BP,
        rms_m=float(np.sqrt(np.mean(np.square(p[on_face, 2])))),
        supported=supported,
        contradicted=contradicted,
        confidence=max(0.0, supported - contradicted),
        n_points=int(np.count_nonzero(on_face)),
        covariance=covariance,
        seam_sigma_m=known_well_enough(covariance, workpiece, sigma, pitch, config),
    )
