"""Estimates X_BC from a recording, and refuses one whose poses contradict each other: a TCP that was set, a scanner that moved."""

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.results import matrix4
from weldcal.calibration.errors import InconsistentPoses, ScannerMoved
from weldcal.calibration.eye_on_base.change_point import ChangePoint, find_change
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.tcp import TcpOffset, find_tcp
from weldcal.calibration.flange.observation import Observation
from weldcal.models.errors import InputError
from weldcal.tools.report.calibration import error_summary


def estimate_consistent(
    observations: list[Observation], config: SolveConfig, X_FR: RigidTransform | None, flange_m: float
) -> tuple[CalibrationEstimate, tuple[str, ...]]:
    """The estimate, and a sentence where the poses look as if a TCP were set.

    Raises:
        InconsistentPoses: the TCP is surely longer than the flange's radius ``flange_m``, or explains why no calibration is found.
        ScannerMoved: the scanner moved during the recording, which explains the poses better than a TCP.
    """
    change = find_change(observations)
    try:
        estimate = estimate_eye_on_base(observations, config)
    except InconsistentPoses as refusal:
        tcp = find_tcp(observations)
        _refuse_change(change, tcp, observations)
        if tcp is None:
            raise
        raise InconsistentPoses(tcp.sentence(X_FR)) from refusal
    tcp = find_tcp(observations, estimate.X_BC)
    _refuse_change(change, tcp, observations)
    if tcp is not None and tcp.surely_beyond(flange_m):
        raise InconsistentPoses(tcp.sentence(X_FR))
    return estimate, () if tcp is None else (tcp.sentence(X_FR),)


def _refuse_change(change: ChangePoint | None, tcp: TcpOffset | None, observations: list[Observation]) -> None:
    """Refuses a recording in which the scanner moved, and offers both of its parts.

    Raises:
        ScannerMoved: naming the two poses, the shift, and the option that takes either part.
    """
    if change is None or (tcp is not None and tcp.with_m < np.sqrt(3.0) * change.with_m):
        return
    parts: list[dict[str, object]] = []
    offers = []
    for part, option in (
        (observations[: change.index], f":{change.before}"),
        (observations[change.index :], f"{change.after}:"),
    ):
        parts.append({"poses": option, "n": len(part), **_part(part)})
        offers.append(f"--poses {option} ({len(part)} scans)")
    raise ScannerMoved(
        f"The scanner or the robot's base moved between '{change.before}' and '{change.after}': the poses before and after it agree on "
        f"two camera positions, which differ by {1e3 * change.shift_m:.2f} mm at the flange and {np.degrees(change.rotation_rad):.3f} "
        f"degrees. Calibrate one part: {' or '.join(offers)}; only the later one holds where the scanner has stayed since.",
        {
            "change_point": {
                "before": change.before,
                "after": change.after,
                "shift_mm": 1e3 * change.shift_m,
                "rotation_deg": float(np.degrees(change.rotation_rad)),
                "probability_by_chance": change.probability,
                "parts": parts,
            }
        },
    )


def _part(observations: list[Observation]) -> dict[str, object]:
    """X_BC from one part of a recording and its held-out error (mm, median); None where it fixes no calibration."""
    try:
        found = estimate_eye_on_base(observations, SolveConfig(allow_coplanar=True))
    except InputError:
        return {"X_BC": None, "held_out_median_mm": None}
    error = error_summary(1e3 * found.held_out.position_m[found.inliers])["median"]
    return {"X_BC": matrix4(found.X_BC), "held_out_median_mm": error if np.isfinite(error) else None}
