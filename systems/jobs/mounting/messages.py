"""What travels in a mounting cell: where the procedure stands, and what the calibration has come to."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.hand_eye.mountings import TargetObservation
from weldcal.calibration.hand_eye.solve import HandEyeResult
from weldcal.calibration.planning.mounting_poses import MountingPose
from weldcal.models.arrays import Array
from weldcal.systems.messages import Message


@dataclass(frozen=True, eq=False)
class MountingState(Message):
    """Where the procedure stands. `phase`: start, move, scan, done or held; `route`: moves still to make, (arm 0 or 1, joints)."""

    phase: str = "start"
    since: float = 0.0
    goal_id: int = 0
    moving: int = 0
    q_goal: Array | None = None
    route: tuple[tuple[int, Array], ...] = ()
    visit: int = -1  # which of the planned poses
    trigger: int = 0
    purpose: str = ""  # of the newest scan: calibrate, or verify at a pose kept aside
    label: str = ""
    reason: str = ""


@dataclass(frozen=True, eq=False)
class SeenCircle(Message):
    """One scan that showed the circle: where the arms stood, what was seen, the share of its edge."""

    label: str
    pose: MountingPose
    sighting: TargetObservation
    coverage: float


@dataclass(frozen=True)
class KeptAside:
    """How far the circle was, in a scan that the calibration never saw, from where the calibration expects it."""

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
        """What to do, for a person."""
        joints = ", ".join(f"{v:.0f}" for v in np.degrees(self.q))
        second = "" if self.q_2 is None else f", second arm [{', '.join(f'{v:.0f}' for v in np.degrees(self.q_2))}] deg"
        p = 1e3 * self.X_BF.translation()
        return (
            f"joints [{joints}] deg{second} (flange at {p[0]:.0f}, {p[1]:.0f}, {p[2]:.0f} mm in the base): it would take the "
            f"sigma of a scanned point from {1e3 * self.sigma_before_m:.4f} to {1e3 * self.sigma_after_m:.4f} mm."
        )


@dataclass(frozen=True, eq=False)
class MountingStatus(Message):
    """The calibration after its newest scan."""

    sequence: int = 0
    seen: tuple[SeenCircle, ...] = ()
    refused: tuple[tuple[str, str], ...] = ()
    result: HandEyeResult | None = None
    sigma_work_m: float = np.inf  # predicted error (3-D, rms) of a point at the scanner's best distance
    history: tuple[tuple[int, float], ...] = ()
    kept_aside: tuple[KeptAside, ...] = ()
    next_best: NextBest | None = None
    done: bool = False
    message: str = ""
