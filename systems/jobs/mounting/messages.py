"""Messages of the mounting job: the state of the procedure and the status of the calibration."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.hand_eye.mountings import TargetObservation
from weldcal.calibration.hand_eye.solve import HandEyeResult
from weldcal.calibration.planning.mounting_poses import MountingPose
from weldcal.models.arrays import Array
from weldcal.systems.messages import Message


@dataclass(frozen=True, eq=False, kw_only=True)
class MountingState(Message):
    """State of the procedure. `phase`: start, move, scan, done or held; `route`: remaining moves, (arm 0 or 1, joints)."""

    phase: str = "start"
    since: float = 0.0
    goal_id: int = 0
    moving: int = 0
    q_goal: Array | None = None
    route: tuple[tuple[int, Array], ...] = ()
    visit: int = -1  # index of the planned pose
    trigger: int = 0
    purpose: str = ""  # of the newest scan: calibrate, or verify at a held-out pose
    label: str = ""
    reason: str = ""


@dataclass(frozen=True, eq=False)
class SeenCircle(Message):
    """One scan with the circle: the arms' poses, the observation, and the visible share of the circle's edge."""

    label: str
    pose: MountingPose
    observation: TargetObservation
    coverage: float


@dataclass(frozen=True)
class HeldOut:
    """Errors of the calibration's prediction of the circle in a held-out scan."""

    label: str
    error_m: float
    tilt_rad: float


@dataclass(frozen=True)
class NextBest:
    """A pose to add: joints (6,) rad, X_BF of the first arm, and the predicted sigma (3-D, m) of a scanned point without and
    with it."""

    q: Array
    q_2: Array | None
    X_BF: RigidTransform
    sigma_before_m: float
    sigma_after_m: float

    def sentence(self) -> str:
        """The proposal as one sentence for the operator."""
        joints = ", ".join(f"{v:.0f}" for v in np.degrees(self.q))
        second = "" if self.q_2 is None else f", second arm [{', '.join(f'{v:.0f}' for v in np.degrees(self.q_2))}] deg"
        p = 1e3 * self.X_BF.translation()
        return (
            f"joints [{joints}] deg{second} (flange at {p[0]:.0f}, {p[1]:.0f}, {p[2]:.0f} mm in the base): it would reduce the "
            f"sigma of a scanned point from {1e3 * self.sigma_before_m:.4f} to {1e3 * self.sigma_after_m:.4f} mm."
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class MountingStatus(Message):
    """The calibration after its newest scan."""

    sequence: int = 0
    seen: tuple[SeenCircle, ...] = ()
    refused: tuple[tuple[str, str], ...] = ()
    result: HandEyeResult | None = None
    sigma_work_m: float = np.inf  # predicted error (3-D, rms) of a point at the scanner's best distance
    history: tuple[tuple[int, float], ...] = ()
    held_out: tuple[HeldOut, ...] = ()
    next_best: NextBest | None = None
    done: bool = False
    message: str = ""
