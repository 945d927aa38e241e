"""Checks that the tool's body has room beside the part along the whole seam."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.models.arms.urdf import Capsule
from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh
from weldcal.welding.numerics import Array, unit
from weldcal.welding.seam.curve import SeamCurve

CLEARANCE_M = 0.001
NEAR_TIP_M = 0.030  # finger and wire are in the joint by design: only what lies farther from the tip is checked
SAMPLES = 20_000
STEP_M = 0.02


class NoRoom(WeldcalError):
    """The tool's body would touch the part while the tip is in the joint."""


def check_room(
    mesh: TriMesh,
    X_BP: RigidTransform,
    seam: SeamCurve,
    capsules: Sequence[Capsule],
    X_FT: RigidTransform,
    chord_m: float,
) -> None:
    """Check the distance between the tool's capsules (in the flange frame) and the part's surface along the seam.

    The tool stands as the servo holds it: its axis along the mean of the bisectors at tip and torch.

    Raises:
        NoRoom: less than 1 mm, with the place.
    """
    points, _ = mesh.sample(SAMPLES, np.random.default_rng(0))
    points_B = points @ X_BP.rotation().matrix().T + X_BP.translation()
    spans = [span for capsule in capsules if (span := _above_tip(capsule, X_FT)) is not None]
    for s in np.linspace(0.0, seam.length, max(2, math.ceil(seam.length / STEP_M) + 1)):
        tip, torch = seam.frame(float(s)), seam.frame(float(s) - chord_m)
        up = unit(tip.up + torch.up, tip.up)
        x = tip.position - torch.position
        x = unit(x - (x @ up) * up, tip.tangent)
        R = np.column_stack([x, np.cross(up, x), up])
        points_T = (points_B - tip.position) @ R
        for a, b, radius in spans:
            near = float(_distances(points_T, a, b).min()) - radius
            if near < CLEARANCE_M:
                raise NoRoom(
                    f"The tool does not fit at {1e3 * s:.0f} mm of the seam: leaning to the joint's bisector its body would come within "
                    f"{1e3 * CLEARANCE_M:.0f} mm of the part ({1e3 * near:.1f} mm); use a longer finger or weld the joint from elsewhere."
                )


def _above_tip(capsule: Capsule, X_FT: RigidTransform) -> tuple[Array, Array, float] | None:
    """A capsule's axis in the tip frame, cut off near the tip; None where nothing is left."""
    X_TF = X_FT.inverse()
    a, b = (np.asarray(X_TF.multiply(np.asarray(end))) for end in (capsule.p_start, capsule.p_end))
    low, high = (a, b) if a[2] <= b[2] else (b, a)
    if high[2] < NEAR_TIP_M:
        return None
    if low[2] < NEAR_TIP_M:
        low = low + (NEAR_TIP_M - low[2]) / (high[2] - low[2]) * (high - low)
    return low, high, float(capsule.radius)


def _distances(points: NDArray[np.float64], a: Array, b: Array) -> Array:
    d = b - a
    share = np.clip((points - a) @ d / max(float(d @ d), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - share[:, None] * d, axis=1))
