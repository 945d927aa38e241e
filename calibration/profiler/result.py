"""The result of a profiler calibration: X_FS, its covariance and residuals, and its least certain direction."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.errors import DegenerateMotion
from weldcal.calibration.geometry.se3 import angle_of
from weldcal.calibration.profiler.motion import Floats

VAGUE_M = 0.02  # one sigma of a direction from which on there is no calibration
APART_RAD = np.radians(1.0)  # a choice: optima nearer than this are one
OPEN_RAD = np.radians(5.0)  # a choice: a rotation that is uncertain by more is no calibration
LEVER_M = 0.1  # a turn is weighed against a shift at this distance from the flange


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerEstimate:
    """Pose of the scan plane's frame S in the flange F: a profile point [x, z] is p_S = (x, 0, z).

    Attributes:
        rotation: R_FS (3, 3); translation: p_FS (3,) m.
        covariance: (6, 6) of [left rotation vector rad (in F); translation m]: R_FS = exp(w) R_estimate.
        residuals: (n, 2) m, measured profile point less the predicted one.
        inliers: (n,) bool; rms_m: of the inliers' residuals; reduced_chi2: of the whitened ones, 1 where the stated
            sigmas are right.
        condition: least over largest singular value of the Jacobian with columns of unit length.
        scans_chi2: reduced chi-square of what the points of a scan share, such as the robot's error: many points that
            agree within each scan must not hide few scans that disagree.
    """

    rotation: Floats
    translation: Floats
    covariance: Floats
    residuals: Floats
    inliers: NDArray[np.bool_]
    rms_m: float
    reduced_chi2: float
    condition: float
    scans_chi2: float = 1.0

    @property
    def X_FS(self) -> RigidTransform:
        """The same as a transform."""
        return RigidTransform(RotationMatrix(self.rotation), self.translation)


def worst_direction(normal_matrix: Floats) -> str:
    """Description of the direction that a motion determines least: the part of [rotation.

    Translation] (6, 6, in F) with the least information.
    """
    unit = np.diag([1.0 / LEVER_M] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(unit @ normal_matrix @ unit)
    v = vectors[:, int(np.argmin(values))]
    turn, shift = float(np.linalg.norm(v[:3])), float(np.linalg.norm(v[3:]))
    kind, part = ("rotation about", v[:3] / turn) if turn > shift else ("translation along", v[3:] / shift)
    part = part * np.sign(part[int(np.argmax(np.abs(part)))])
    return f"{kind} ({part[0]:.2f}, {part[1]:.2f}, {part[2]:.2f}) of the flange"


def refuse_open(covariance: Floats, best: Floats, rivals: Sequence[Floats], what: str, advice: str) -> None:
    """Refuse what a covariance (6, 6), which is local, does not show: another mounting as good, or hardly a rotation.

    Args:
        covariance: of the estimate; best: its R_FS (3, 3).
        rivals: rotations of other optima that explain the data as well.
        what: points or scans, for the message; advice: what to do besides tilting the flange.

    Raises:
        DegenerateMotion: a rival lies apart from the best, or the rotation is uncertain by five degrees.
    """
    sigma = float(np.sqrt(np.trace(covariance[:3, :3])))
    for other in rivals:
        angle = float(angle_of(best.T @ other))
        if angle > max(APART_RAD, 5.0 * sigma):
            raise DegenerateMotion(
                f"Two mountings of the profiler, {np.degrees(angle):.0f} deg apart, explain these {what} alike: tilt"
                f" the flange more, about two axes, and {advice}"
            )
    if sigma > OPEN_RAD:
        raise DegenerateMotion(
            f"These {what} leave the rotation uncertain by {min(np.degrees(sigma), 180.0):.0f} deg: turn the flange"
            f" further, about two axes, and {advice}"
        )


def believed_covariance(estimate: ProfilerEstimate) -> Floats:
    """Scale the covariance (6, 6) of an estimate where the residuals exceed the stated sigmas.

    The factor is the larger reduced chi-square.

    Raises:
        DegenerateMotion: a direction is so open that this is no calibration, though the motion is not quite degenerate.
    """
    covariance = np.asarray(
        estimate.covariance * max(1.0, *np.nan_to_num([estimate.reduced_chi2, estimate.scans_chi2], posinf=1.0))
    )
    unit = np.diag([LEVER_M] * 3 + [1.0] * 3)
    sigma = float(np.sqrt(np.linalg.eigvalsh(unit @ covariance @ unit)[-1]))
    if sigma > VAGUE_M:
        open_one = worst_direction(np.asarray(np.linalg.inv(covariance)))
        raise DegenerateMotion(
            f"These scans leave the {open_one} almost open (one sigma {1e3 * sigma:.0f} mm): turn the flange about two"
            " different axes between them, by more."
        )
    return covariance
