"""Touches as a person or a job records them: the robot's pose, its tip, and the feature that the scanner measured
there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

POINT, PLANE, SPHERE, EDGE = "point", "plane", "sphere", "edge"
FEATURES = (POINT, PLANE, SPHERE, EDGE)
SIGMA_TIP_M = 5e-5  # a choice; the column sigma_tip sets another
"""Assumed standard deviation per axis of the tip's place on the flange, as a TCP is taught with care."""
SIGMA_RADIUS_M = 1e-5  # a choice: a diameter by caliper to 0.02 mm; the column sigma_radius sets another
"""Assumed standard deviation of the tip's radius."""
SIGMA_SCAN_M = 5e-5  # a choice: a fit to some hundred points; the column sigma_scan sets another
"""Assumed standard deviation of a feature in the scan, per axis."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Touch:
    """One touch.

    ``X_BF``: flange pose by the robot; ``p_FT`` (3,) m: centre of the tip's ball on the flange, ``radius`` m of that
    ball (0: a point). ``p_C`` (3,) m as the scanner gave it, not corrected: the point, a point of the plane or edge, or
    the sphere's centre; ``direction_C`` (3,): outward normal of a plane, direction of an edge, else None;
    ``feature_radius`` m of a sphere. ``q`` (n,) rad where known.
    """

    id: str
    feature: str
    X_BF: RigidTransform
    p_FT: Array
    radius: float
    p_C: Array
    direction_C: Array | None = None
    feature_radius: float = 0.0
    sigma_tip: float = SIGMA_TIP_M
    sigma_radius: float = SIGMA_RADIUS_M
    sigma_scan: float = SIGMA_SCAN_M
    q: Array | None = None

    @property
    def p_BT(self) -> Array:
        """The tip's centre in the base (3,) m, as the robot says."""
        return np.asarray(self.X_BF.multiply(self.p_FT))


def require_touches(touches: Sequence[Touch]) -> None:
    """Check touches that no file has checked. Raises InputError naming the touch."""
    if not touches:
        raise InputError("There are no touches: touch three points and more.")
    for t in touches:
        if t.feature not in FEATURES:
            raise InputError(
                f"Touch '{t.id}': the feature is {', '.join(FEATURES[:-1])} or {FEATURES[-1]}, not '{t.feature}'."
            )
        if t.feature in (PLANE, EDGE) and t.direction_C is None:
            what = "outward normal" if t.feature == PLANE else "direction"
            raise InputError(
                f"Touch '{t.id}': a touched {t.feature} needs its {what} (camera_nx, camera_ny, camera_nz)."
            )
        if t.feature == SPHERE and not t.feature_radius > 0.0:
            raise InputError(f"Touch '{t.id}': a touched sphere needs its radius (feature_radius, m).")
