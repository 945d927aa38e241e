"""Configuration and messages of the tablet job: nominal pen and tablet, the motion, pictures and touches."""

import dataclasses as dc

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import NoDevice, check_range
from weldcal.systems.messages import Message
from weldcal.systems.scenario.schema import Scenario

MOST_LANDMARKS = 100
STEEPEST_DEG = 45.0  # largest tilt at which the pen still touches with its tip and not with its side
_POSITIVE = (
    *("columns", "rows", "across_mm", "down_mm", "ring_mm", "margin_mm", "px_per_mm"),
    *("look_distance_mm", "clearance_mm", "descent_mm_s", "deepest_mm"),
)


@dc.dataclass
class PenConfig:
    """The sprung pen of `tool: pen`: nominal tip position in the flange frame, and the deviation of the true one."""

    tip_m: list[float] = dc.field(default_factory=lambda: [0.0, -0.022, 0.165])
    mounting_mm: float = 3.0  # deviation of the true tip from the nominal one, drawn from the seed
    radius_mm: float = 0.7  # of its round tip
    stiffness_N_per_m: float = 300.0


@dc.dataclass(kw_only=True)
class TabletConfig:
    """`tablet:` the page's nominal pose (first landmark, x right, y down the page, z into it), and the motion."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.60, 0.045, 0.010])
    rpy_deg: list[float] = dc.field(default_factory=lambda: [180.0, 0.0, 0.0])
    columns: int = 3
    rows: int = 3
    across_mm: float = 60.0
    down_mm: float = 38.0
    ring_mm: float = 8.0
    margin_mm: float = 25.0
    px_per_mm: float = 5.256  # of the page: 267 pixels per inch at a display scale of 2
    pen: PenConfig = dc.field(default_factory=PenConfig)
    look_distance_mm: float = 300.0
    clearance_mm: float = 15.0
    descent_mm_s: float = 12.0
    deepest_mm: float = 12.0  # below the nominal tablet, at which the touch is abandoned
    turn_deg: float = 22.5  # rotation of the flange from touch to touch
    tilt_deg: float = 12.0  # tilt of the pen, in varying directions; 0: an upright pen

    def pose(self) -> RigidTransform:
        """Return the nominal X_BT."""
        return RigidTransform(RollPitchYaw(np.deg2rad(self.rpy_deg)), self.xyz_m)

    def landmarks_m(self) -> Array:
        """Landmarks (n, 2) m of the page from its first, row by row."""
        return 1e-3 * np.array(
            [[i * self.across_mm, j * self.down_mm] for j in range(self.rows) for i in range(self.columns)]
        )


def check_tablet(scenario: Scenario) -> None:
    """Check the tablet job of a scenario.

    Raises:
        InputError: one sentence that says what to change.
    """
    tablet = scenario.part(TabletConfig)
    assert tablet is not None
    if scenario.job.calibrate or scenario.job.weld:
        raise InputError(
            "The tablet job neither calibrates a scanner nor welds: run it with weldcal demo or weldcal tablet "
            "demo, and write job: {calibrate: false, weld: false} in its scenario."
        )
    if scenario.tool != "pen":
        raise InputError(f"The tablet job needs tool: pen in the scenario, not tool: {scenario.tool}.")
    for name in ("wrist_camera", "digitizer"):
        if isinstance(getattr(scenario, name), NoDevice):
            example = "!RenderedWristCamera {}" if name == "wrist_camera" else "!SimulatedTablet {}"
            raise InputError(f"The tablet job needs a {name}: write {name}: {example} in the scenario.")
    for name in _POSITIVE:
        if getattr(tablet, name) <= 0:
            raise InputError(f"tablet.{name} must be a positive number, not {getattr(tablet, name):g}.")
    if tablet.columns < 2 or tablet.rows < 2:
        raise InputError(
            "tablet.columns and tablet.rows must be at least 2: landmarks on one line do not determine a pose."
        )
    if tablet.columns * tablet.rows > MOST_LANDMARKS:
        raise InputError(
            f"tablet.columns by tablet.rows are more than {MOST_LANDMARKS} landmarks; a dozen is sufficient."
        )
    if tablet.ring_mm >= min(tablet.across_mm, tablet.down_mm):
        raise InputError("tablet.ring_mm must be smaller than the landmarks' spacing, or the rings overlap.")
    check_range("tablet.tilt_deg", tablet.tilt_deg, 0.0, STEEPEST_DEG)
    check_pen(tablet.pen)


def check_pen(pen: PenConfig) -> None:
    """Raise InputError for a pen that cannot be built."""
    if len(pen.tip_m) != 3:
        raise InputError(f"tablet.pen.tip_m must hold 3 numbers, not {len(pen.tip_m)}.")
    if pen.tip_m[2] < 0.03:
        raise InputError("tablet.pen.tip_m must be at least 0.03 m in front of the flange.")
    if pen.radius_mm <= 0.0 or pen.stiffness_N_per_m <= 0.0 or pen.mounting_mm < 0.0:
        raise InputError("tablet.pen: radius_mm and stiffness_N_per_m must be positive, mounting_mm not negative.")


@dc.dataclass(frozen=True, eq=False)
class WristPicture(Message):
    """One picture: grey (h, w) uint8 and depth (h, w) m with its noise; `sequence` 0 before the first."""

    sequence: int = 0
    capture_time: float = -np.inf
    grey: NDArray[np.uint8] = dc.field(default_factory=lambda: np.empty((0, 0), dtype=np.uint8))
    depth_m: Array = dc.field(default_factory=lambda: np.empty((0, 0)))


@dc.dataclass(frozen=True, eq=False)
class TabletTouch(Message):
    """One touch as the page records it: position (2,) px from the first landmark, to a tenth.

    `sequence` 0 before the first.
    """

    sequence: int = 0
    time: float = -np.inf
    position_px: Array = dc.field(default_factory=lambda: np.full(2, np.nan))
    down: bool = False


@dc.dataclass(frozen=True, eq=False)
class TabletTruth(Message):
    """Ground truth of the simulation: camera and pen tip (its centre, at rest) on the flange, tablet in the base."""

    X_FC: RigidTransform
    p_FP: Array
    X_BT: RigidTransform
