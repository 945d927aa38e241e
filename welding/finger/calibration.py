"""Calibrates the finger.

The camera's intrinsics from pictures of a board, the tag's size and the tip from touches on a plate.
"""

from dataclasses import dataclass

import numpy as np

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array

FEWEST_TOUCHES = 4
LEAST_PRESS_M = 5e-4  # a choice: about ten times the tag's own noise at the tip, a sixth of the weld's deflection
FAR_OFF = 0.2  # of the nominal size: a tag that is further off is another tag
AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False, kw_only=True)
class TipCalibration:
    """What touches show.

    `scale`: displacement that the nominal tag shows over the true one, with its standard deviation; the true tag is the
    nominal one over it. `rotation_deg`: between the camera's displacements and the tool's, None where only one
    direction was pressed. `seat_m` (3,): displacement that is shown where none is expected; NaN in directions that were
    not pressed. `stiffness_N_per_m` by axis of T, for axes that were pressed with a force. `held_out_m`: median error
    of a touch that the fit did not use. `unknown`: sentences on what the touches leave open.
    """

    scale: float
    scale_sigma: float
    rotation_deg: float | None
    seat_m: Array
    stiffness_N_per_m: dict[str, float]
    held_out_m: float
    unknown: tuple[str, ...]


def calibrate_tip(pressed_m: Array, shown_m: Array, forces_N: Array | None = None) -> TipCalibration:
    """The tag's scale, the seat and the stiffness from touches on a plate that does not give way.

    `pressed_m` (n, 3): how far the robot moved the flange towards and along the plate after the contact that is
    expected, as the displacement of the tip in T. `shown_m` (n, 3): the displacement that the camera shows with the
    nominal tag. `forces_N` (n, 3): of the plate on the tip, NaN where none was measured. The fit is shown = scale * R *
    pressed + seat, by least squares (Umeyama, 1991) where two or more directions were pressed, else along the one
    direction.

    Raises:
        InputError: too few touches, too small ones, or a scale that no tag of this kind has.
    """
    pressed, shown = np.asarray(pressed_m, dtype=float), np.asarray(shown_m, dtype=float)
    if len(pressed) < FEWEST_TOUCHES:
        raise InputError(f"{len(pressed)} touches can be used, and {FEWEST_TOUCHES} are needed: press at more depths.")
    spread = np.linalg.svd(pressed - pressed.mean(axis=0))[1] / np.sqrt(len(pressed))
    if spread[0] < LEAST_PRESS_M:
        raise InputError(
            "The touches differ by less than half a millimetre: press up to the deflection of the weld, 3 mm."
        )
    turned = spread[1] > 0.2 * spread[0]
    scale, R, seat = _similar(pressed, shown, turned)
    if abs(scale - 1.0) > FAR_OFF:
        raise InputError(
            f"The tag shows {scale:.2f} times the robot's displacement: the tip slipped, the plate yielded, or the tag"
            " is another one."
        )
    left = []
    for k in range(len(pressed)):
        rest = np.arange(len(pressed)) != k
        s, Q, b = _similar(pressed[rest], shown[rest], turned)
        left.append(float(np.linalg.norm(shown[k] - (s * Q @ pressed[k] + b))))
    residual = shown - (scale * pressed @ R.T + seat)
    degrees = max(3 * len(pressed) - (7 if turned else 4), 1)
    sigma = float(np.sqrt((residual**2).sum() / degrees) / np.linalg.norm(pressed - pressed.mean(axis=0)))
    unknown, stiffness = [], _stiffness(pressed, forces_N)
    if not turned:
        unknown.append("The touches press in one direction only: how the camera is turned against the tool stays open.")
    if forces_N is None or not stiffness:
        unknown.append("No force was measured: the tip's stiffness stays open.")
    directions = np.abs(pressed).max(axis=0) > LEAST_PRESS_M
    angle = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0)))) if turned else None
    shown_seat = np.where(directions, seat, np.nan)
    return TipCalibration(
        scale=scale,
        scale_sigma=sigma,
        rotation_deg=angle,
        seat_m=shown_seat,
        stiffness_N_per_m=stiffness,
        held_out_m=float(np.median(left)),
        unknown=tuple(unknown),
    )


def _similar(a: Array, b: Array, turned: bool) -> tuple[float, Array, Array]:
    """Scale, rotation (3, 3) and shift (3,) with b = scale R a + shift.

    Without the rotation where `turned` is false.
    """
    a0, b0 = a - a.mean(axis=0), b - b.mean(axis=0)
    R = np.eye(3)
    if turned:
        U, _, Vt = np.linalg.svd(b0.T @ a0)
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    scale = float((b0 * (a0 @ R.T)).sum() / (a0**2).sum())
    return scale, R, b.mean(axis=0) - scale * R @ a.mean(axis=0)


def _stiffness(pressed: Array, forces: Array | None) -> dict[str, float]:
    """Force over displacement by axis, from the touches that differ along it; the force at no displacement is free."""
    found: dict[str, float] = {}
    if forces is None:
        return found
    for k, axis in enumerate(AXES):
        there = np.isfinite(forces[:, k])
        if there.sum() >= 3 and np.ptp(pressed[there, k]) > LEAST_PRESS_M:
            found[axis] = float(np.polyfit(pressed[there, k], forces[there, k], 1)[0])
    return found
