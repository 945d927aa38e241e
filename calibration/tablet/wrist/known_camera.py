"""Finds another pen on a camera that was calibrated before: the camera stays, the touches give the pen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.calibration.tablet.wrist.fit import (
    UNSURE_M,
    WristFit,
    WristTouches,
    differences,
    fit_wrist,
    left_out,
    move,
    open_directions,
)
from weldcal.models.arrays import Array

_MOVED = 50.0  # chi-square with six degrees of freedom; from nine touches an F of 8.3, exceeded once in 1000


@dataclass(frozen=True)
class KnownCamera:
    """A camera by its former calibration: ``X_FC`` and its ``covariance`` (6, 6) as in WristFit; ``name`` of that."""

    X_FC: RigidTransform
    covariance: Array
    name: str

    def off(self, fit: WristFit) -> Array:
        """How far the camera of a fit lies from it: (6,) [rotation; translation]."""
        turn = rotation_vector(fit.X_FC.rotation() @ self.X_FC.rotation().inverse())
        return np.concatenate([turn, fit.X_FC.translation() - self.X_FC.translation()])


def moved_camera(free: WristFit, known: KnownCamera) -> tuple[str, ...]:
    """Say that the camera of a fit with an image is another one than it was, where it is.

    The squared distance in units of both covariances has six degrees of freedom.
    """
    off = known.off(free)
    if off @ np.linalg.solve(free.covariance + known.covariance, off) < _MOVED:
        return ()
    return (
        (
            f"Picture and touches put the camera {1e3 * np.linalg.norm(off[3:]):.1f} mm and"
            f" {np.degrees(np.linalg.norm(off[:3])):.2f} deg from where '{known.name}' has it: if the page lay still,"
            " calibrate both by the same command without --known-camera. The pen is by the touches alone."
        ),
    )


def fit_pen(
    data: WristTouches, known: KnownCamera, pen_length_m: float | None = None, *, leave_one_out: bool = True
) -> WristFit:
    """Fit the pen where the camera stays; without an image the touches alone give it.

    With an image the pen is the one that goes with the known camera: the joint estimate of fit_wrist under the
    condition that X_FC is the known one. What the known camera may be off is a part of the pen's covariance. An
    upright pen thus has its length from the image. Raises what fit_wrist raises.
    """
    fit = fit_wrist(data, pen_length_m, X_FC=None if data.views else known.X_FC, leave_one_out=False)
    C = fit.joint_covariance
    gain = C[:9, 9:] @ np.linalg.inv(C[9:, 9:]) if data.views else np.zeros((9, 6))
    step = -gain @ known.off(fit)
    X_BT, p_FP = move(fit.X_BT, step[:6]), fit.p_FP + step[6:]
    spread = gain @ known.covariance
    rest = C[:9, :9] - gain @ C[9:, :9] + spread @ gain.T if data.views else C
    touch, pixel = differences(data, X_BT, p_FP, known.X_FC)
    unobservable = open_directions(data, rest[6:, 6:])
    if unobservable and not data.views and np.sqrt(np.linalg.eigvalsh(known.covariance[3:, 3:])[-1]) < UNSURE_M:
        unobservable = (*unobservable, "A picture of the page (--image, --camera) fixes them too.")
    fit = replace(
        fit,
        X_FC=known.X_FC,
        p_FP=p_FP,
        X_BT=X_BT,
        joint_covariance=np.block([[rest, spread], [spread.T, known.covariance]]),
        touch_residuals_m=touch,
        pixel_residuals=pixel,
        unobservable=unobservable,
    )
    if not leave_one_out:
        return fit
    errors = left_out(data, lambda d: fit_pen(d, known, pen_length_m, leave_one_out=False))
    return replace(fit, leave_one_out_m=errors)
