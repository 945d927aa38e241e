"""The result of a plate's registration, the check of the scan against the drawing, and the errors that refuse it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.errors import WeldcalError
from weldcal.models.workpieces.plate import Workpiece
from weldcal.welding.locate.outline_fit import check, displaced, outermost
from weldcal.welding.locate.planes import Floats, rasterise, turned
from weldcal.welding.locate.pose_covariance import moved_covariance, seam_sigma


class WorkpieceNotFound(WeldcalError):
    """The scan does not show this workpiece near the guess."""


@dataclass(frozen=True, kw_only=True)
class RegistrationConfig:
    """Limits on the guess and on the agreement of the scan with the drawing.

    `max_contradicted` is the largest share of the outline at which the scan may show material beyond it or the table
    inside it; `min_supported` the smallest share at which it must show the end of the face (the rest is unseen);
    `max_sigma_m` how uncertain the drawn seam may be, sideways.
    """

    max_shift_m: float = 0.030
    max_turn_rad: float = math.radians(10.0)
    max_contradicted: float = 0.10
    min_supported: float = 0.50
    max_sigma_m: float = 0.00035
    min_points: int = 1000
    seed: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class WorkpieceRegistration:
    """The pose X_BP of the plate (frame P of models.workpieces.plate), and how well the scan agrees with it.

    Attributes:
        rms_m: rms distance of the face's points from its plane, m.
        supported, contradicted: shares of the outline where the scan confirms, or contradicts, that the face ends
            there.
        confidence: supported less contradicted, 0 to 1.
        n_points: points on the face.
        covariance: (6,6) of the small motion of P in P that leads from X_BP to the truth, rotation then translation.
        seam_sigma_m: lateral sigma of the drawn seam from that covariance, rms over the seam, in the face, m. The
            displacement of the real groove against the outline is not included.
    """

    X_BP: RigidTransform
    rms_m: float
    supported: float
    contradicted: float
    confidence: float
    n_points: int
    covariance: Floats
    seam_sigma_m: float

    @property
    def summary(self) -> str:
        """One sentence that describes the result."""
        return (
            f"{100 * self.supported:.0f} % of the outline agrees with the drawing, {100 * self.contradicted:.0f} %"
            f" contradicts it; the drawn seam is known to {1e3 * self.seam_sigma_m:.2f} mm"
        )

    def turned_round(self, workpiece: Workpiece) -> WorkpieceRegistration:
        """The same registration with the part turned by 180 deg about the middle of its outline."""
        x, y = 2.0 * workpiece.outline_P.mean(axis=0)
        turn = turned(float(x), float(y), math.pi)
        covariance = moved_covariance(self.covariance, turn)
        return replace(self, X_BP=self.X_BP @ turn, covariance=covariance)


def not_found(workpiece: Workpiece, why: str) -> WorkpieceNotFound:
    """The error that refuses a plate, with its size."""
    size = " x ".join(f"{1e3 * v:.0f}" for v in workpiece.size_m[:2])
    return WorkpieceNotFound(f"The scan shows no plate of {size} mm there: {why}")


def agreement(
    p: Floats, workpiece: Workpiece, band: float, pitch: float, inset: float, config: RegistrationConfig
) -> tuple[float, float]:
    """Shares of the outline that points (N,3) in the plate's frame, unrolled, confirm and contradict.

    Raises:
        WorkpieceNotFound: too much of the outline is contradicted, or too little is seen.
    """
    outline = workpiece.outline_P
    flat = np.abs(p[:, 2]) < band
    raster = rasterise(p, flat, p[:, 2] < -0.003, pitch)
    rims, edges = outermost(p[flat][:, :2], outline, 0.008, pitch)
    moved = displaced(rims, edges, outline, inset, 0.0003 + 0.5 * pitch, raster)
    supported, contradicted = check(raster, outline, moved)
    if contradicted > config.max_contradicted:
        raise not_found(
            workpiece,
            f"{100 * contradicted:.0f} % of its outline disagree with the scan; check which workpiece this is.",
        )
    if supported < config.min_supported:
        raise not_found(
            workpiece, f"only {100 * supported:.0f} % of its outline is visible; clear the view or scan from higher up."
        )
    return supported, contradicted


def known_well_enough(
    covariance: Floats, workpiece: Workpiece, noise: float, pitch: float, config: RegistrationConfig
) -> float:
    """Lateral sigma of the drawn seam, m, checked against the limit.

    Raises:
        WorkpieceNotFound: it is larger than the limit.
    """
    uncertain = seam_sigma(covariance, workpiece)
    if uncertain > config.max_sigma_m:
        raise WorkpieceNotFound(
            f"The plate was found, but its position is only known to {1e3 * uncertain:.2f} mm from this scan (noise"
            f" {1e3 * noise:.2f} mm, points {1e3 * pitch:.1f} mm apart) and {1e3 * config.max_sigma_m:.2f} mm are"
            " required. Use a finer scanner or move it nearer."
        )
    return uncertain
