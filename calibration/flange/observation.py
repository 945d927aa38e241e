"""One observation of the flange: its pose in the base from the robot, and its centre and normal from the scanner."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.flange.fit import FlangeFit
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError


@dataclass(frozen=True)
class Observation:
    """A pair for eye-on-base calibration.

    ``X_BR``: pose of the flange feature R (origin at the circle centre in the face plane, z the outward normal) in the
    base, from the robot at the time of capture. ``p_CR`` (3,) m and ``n_C`` (3,) or None: centre and outward unit
    normal seen in the camera frame. ``center_covariance`` (3, 3) m^2 and ``normal_sigma`` rad per axis: noise of the
    fit, None where unknown. Raises InputError for numbers that are not finite or a normal that is not a unit vector.
    """

    id: str
    X_BR: RigidTransform
    p_CR: Array
    n_C: Array | None = None
    center_covariance: Array | None = None
    normal_sigma: float | None = None

    def __post_init__(self) -> None:
        if np.shape(self.p_CR) != (3,) or not np.isfinite(self.p_CR).all():
            raise InputError(f"The flange centre of pose '{self.id}' must be three finite numbers.")
        if not np.isfinite(self.X_BR.GetAsMatrix34()).all():
            raise InputError(f"The robot pose of '{self.id}' holds numbers that are not finite.")
        if self.n_C is not None and (np.shape(self.n_C) != (3,) or not abs(np.linalg.norm(self.n_C) - 1.0) < 1e-6):
            raise InputError(f"The flange normal of pose '{self.id}' must be a unit vector.")

    @property
    def p_BR(self) -> Array:
        """Circle centre in the base (3,) m."""
        return np.asarray(self.X_BR.translation(), dtype=float)

    @property
    def n_B(self) -> Array:
        """Outward normal of the feature in the base (3,)."""
        # matrix() copies; RotationMatrix.col() would hand out a view that dies with the pose
        return np.asarray(self.X_BR.rotation().matrix()[:, 2], dtype=float)


def observation_from_fit(
    id: str, X_BF: RigidTransform, fit: FlangeFit, X_FR: RigidTransform | None = None
) -> Observation:
    """Pair a fitted flange with the flange pose of the robot.

    ``X_FR`` places the feature on the flange (identity: bare).
    """
    X_BR = X_BF if X_FR is None else X_BF @ X_FR
    return Observation(id, X_BR, fit.center_C, fit.normal_C, fit.center_covariance, fit.normal_sigma)
