"""Checks that the tool has room at the part: its body along the whole seam, tip and torch beyond its ends."""

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
ACROSS_COS = 0.5  # a wall within 60 degrees of square to the way stops the tool
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


def check_ends(mesh: TriMesh, X_BP: RigidTransform, seam: SeamCurve, chord_m: float, tip_radius_m: float) -> None:
    """Check that nothing of the part stands in the way of the tip beyond the seam's end and of the torch before its start.

    The tip runs `chord_m` ahead of the torch, straight on where the seam ends; the torch comes from as far behind its start.

    Raises:
        NoRoom: with how much of the seam to cut off.
    """
    triangles = mesh.transformed(X_BP).vertices[mesh.triangles]
    for name, s, sign, who in (("end", seam.length, 1.0, "tip"), ("start", 0.0, -1.0, "torch")):
        frame = seam.frame(s)
        free = _free_length(triangles, np.asarray(frame.position), sign * np.asarray(frame.tangent))
        needed = chord_m + tip_radius_m
        if free < needed:
            raise NoRoom(
                f"The part stands across the seam {1e3 * free:.0f} mm beyond its {name}, and the {who} needs {1e3 * needed:.0f} mm there: "
                f"set {name}_mm of the seam {1e3 * (needed - free) + 1.0:.0f} mm larger, or weld it from elsewhere."
            )


def _free_length(triangles: NDArray[np.float64], origin: Array, direction: Array) -> float:
    """Distance m from a point along a unit vector to the first of the triangles (M,3,3); infinite without one.

    Source: Moeller and Trumbore, Fast, minimum storage ray/triangle intersection, 1997.
    """
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(direction, ac)
    det = np.sum(ab * p, axis=1)
    safe = np.where(np.abs(det) > 1e-15, det, np.inf)
    to = origin - a
    u = np.sum(to * p, axis=1) / safe
    q = np.cross(to, ab)
    v = (q @ direction) / safe
    t = np.sum(ac * q, axis=1) / safe
    # A wall that is met at a slant, as that of a curved groove, leads the tip on.
    normal = np.cross(ab, ac)
    across = np.abs(normal @ direction) > ACROSS_COS * np.linalg.norm(normal, axis=1)
    hit = across & np.isfinite(safe) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    return float(t[hit].min()) if hit.any() else math.inf


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
