"""Immutable messages of the abstract ports, each datum with its capture time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, InputPort

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.solve import CalibrationEstimate
from weldcal.calibration.eye_on_base.validation import VerificationResult as VerificationResult
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.refinement.local_field import LocalField
from weldcal.models.arms.kinematics import ArmModel
from weldcal.welding.locate.part.fit_up import FitUp
from weldcal.welding.passes.angles import AnglesAlong
from weldcal.welding.record.schedule import GapAlong
from weldcal.welding.seam.curve import SeamCurve


class Message:
    """An immutable port value. Drake deep-copies abstract state at each event; a message returns itself as its copy."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Message:
        return self


@dataclass(frozen=True, eq=False)
class Scan(Message):
    """One frame of the scanner: organised cloud p_CS (H, W, 3), m, NaN where there is no return."""

    sequence: int = 0
    capture_time: float = -np.inf
    points_C: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 0, 3), dtype=np.float32))


@dataclass(frozen=True, eq=False)
class StreamedScan(Scan):
    """A frame of a streaming scanner.

    When it was captured is not known; `arrival_time` s is on the arm's clock, `device_time` s on the device's own
    (None: it has none), which stands while the Diagram stands.
    """

    arrival_time: float = -np.inf
    device_time: float | None = None


@dataclass(frozen=True, eq=False)
class ScanStream(Message):
    """The newest frames that have arrived, oldest first."""

    frames: tuple[StreamedScan, ...] = ()


@dataclass(frozen=True, eq=False)
class Image(Message):
    """One frame of the finger camera: grey (H, W) uint8.

    `capture_time` is the time, on the arm's clock, of the pose that the frame shows; `exposed_at` the time of the
    exposure.
    """

    sequence: int = 0
    capture_time: float = -np.inf
    pixels: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 0), dtype=np.uint8))
    exposed_at: float = -np.inf


@dataclass(frozen=True, eq=False)
class ProfileScan(Message):
    """One profile: points (n, 2) [x, z] m in S, NaN where there is no return; `sequence` is 0 before the first."""

    sequence: int = 0
    capture_time: float = -np.inf
    points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))


@dataclass(frozen=True, eq=False)
class TorchTouch(Message):
    """The newest touch: its number, its start, whether it persists, and the joints (6,) rad read at its start.

    None where the sensor reads no joints, and those at `time` count.
    """

    sequence: int = 0
    time: float = -np.inf
    down: bool = False
    q: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class UrStatus(Message):
    """The state of the controller, named as in the RTDE enumerations."""

    robot_mode: str = "RUNNING"
    safety_mode: str = "NORMAL"
    program_running: bool = True
    speed_scaling: float = 1.0
    fault: str | None = None

    @property
    def ready(self) -> bool:
        """True while the controller executes velocity commands."""
        return self.fault is None and self.program_running and self.safety_mode in ("NORMAL", "REDUCED")


@dataclass(frozen=True, eq=False, kw_only=True)
class JobCommand(Message):
    """The JobSequencer's command to the other systems."""

    phase: str = "start"
    mode: str = "hold"  # hold: zero velocity; move: the FlangeMover drives; weld: the servo drives
    goal_id: int = 0
    q_goal: NDArray[np.float64] | None = None  # (6,) rad
    scan_sequence: int = 0  # number of the newest requested scan
    scan_purpose: str = ""  # calibrate, verify or workpiece: whose scan_sequence it is
    scan_label: str = ""
    streaming: bool = False  # the finger camera streams
    process_on: bool = False  # the process is enabled
    finished: bool = False
    held: bool = False
    reason: str | None = None
    speed_share: float = 1.0  # of the mover's speed, 0 to 1
    seam: int = 0  # number of the seam that is planned and welded, from 0
    weld_pass: int = 0  # number of its pass, 0: the root
    view: int = 0  # number of the newest scan of the workpiece, from 0
    views: int = 1  # number of scans that one plan is made from
    piece: int = 0  # number of its piece, where it is interrupted
    question: str = ""  # that an operator must answer before the job goes on


@dataclass(frozen=True, eq=False, kw_only=True)
class FlangeEstimate(Message):
    """The FlangeEstimator's result for one scan."""

    sequence: int = 0
    capture_time: float = -np.inf
    purpose: str = ""
    label: str = ""
    fit: FlangeFit | None = None
    pattern: HolePattern | None = None
    points_C: NDArray[np.float64] | None = None  # face points around the fit, for verification and the viewer
    reason: str | None = None  # why there is no fit
    # of a streamed scan, whose capture_time is what was believed when it was fitted
    arrival_time: float = -np.inf
    device_time: float | None = None
    center_expected_C: NDArray[np.float64] | None = None  # (3,) m


@dataclass(frozen=True, eq=False, kw_only=True)
class Refinement(Message):
    """What became of the refinement of a live calibration.

    The arm with corrected kinematics or the local field, where one is applied; the text of the kinematics file, the
    stated errors of the arm, and the JSON object of `calibrate`.
    """

    kind: str
    sentence: str
    accepted: bool = False
    arm: ArmModel | None = None
    local_field: LocalField | None = None
    kinematics: str = ""
    arm_errors: dict[str, Any] | None = None
    document: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationStatus(Message):
    """The state of the IterativeCalibrator after its newest scan."""

    sequence: int = 0  # of the newest processed scan
    calibration_scans: int = 0
    observations: tuple[Observation, ...] = ()
    patterns: Mapping[str, HolePattern] = field(default_factory=dict)  # by the observation's id, where one shows
    refused: tuple[tuple[str, str], ...] = ()
    estimate: CalibrationEstimate | None = None
    # expected error of a point at the work point, from the estimate's own covariance and noise
    predicted_error_m: float = np.inf
    history: tuple[tuple[int, float, float], ...] = ()  # scans, predicted error, held-out median; m
    verifications: tuple[VerificationResult, ...] = ()
    done: bool = False
    message: str = ""
    joints: tuple[NDArray[np.float64], ...] = ()  # (6,) rad at each observation
    refinement: Refinement | None = None

    def arm_or(self, arm: ArmModel) -> ArmModel:
        """Return the arm with the kinematics that the refinement found, else the given one."""
        found = None if self.refinement is None else self.refinement.arm
        return arm if found is None else found

    @property
    def local_field(self) -> LocalField | None:
        """The local field that belongs to the estimate; None where there is none."""
        return None if self.refinement is None else self.refinement.local_field

    @property
    def X_BC(self) -> RigidTransform | None:
        """The pose of the scanner in the base, which applies to corrected points; None before the first estimate."""
        return None if self.estimate is None else self.estimate.X_BC

    @property
    def correction(self) -> ScannerCorrection:
        """The correction of scanned points; the identity where none was estimated."""
        found = None if self.estimate is None else self.estimate.correction
        return ScannerCorrection() if found is None else found


@dataclass(frozen=True, eq=False)
class ScanView(Message):
    """A scan of the workpiece and the scanner's pose X_BC when it was taken; None: it is not known."""

    scan: Scan
    X_BC: RigidTransform | None


@dataclass(frozen=True, eq=False, kw_only=True)
class SeamRecord(Message):
    """One plan: its seam's number, how its parts lie to each other, and the stretches (from, to) m left unwelded."""

    seam: int
    fit_up: FitUp | None = None
    left_out: tuple[tuple[float, float], ...] = ()
    weld_pass: int = 0  # 0: the root
    line: SeamCurve | None = None  # of the tip
    begins_m: float = 0.0  # of the whole seam, at the line's start
    reverse: bool = False  # the line runs from the seam's end to its start

    def place(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return where on the whole seam the arc lengths s (...) m of the line are, m."""
        along = np.asarray(s, dtype=float)
        return self.begins_m + (self.line.length - along if self.reverse and self.line is not None else along)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlannedSeam(Message):
    """The SeamPlanner's result for the workpiece scan, or for several.

    Before the last one it holds the `views` so far.
    """

    sequence: int = 0
    views: tuple[ScanView, ...] = ()
    seam: SeamCurve | None = None
    X_BP: RigidTransform | None = None
    rms_m: float = np.nan
    confidence: float = 0.0
    q_start: NDArray[np.float64] | None = None  # (6,) rad, at the start of the touch
    q_above: NDArray[np.float64] | None = None
    q_retract: NDArray[np.float64] | None = None
    points_B: NDArray[np.float64] | None = None
    reason: str | None = None
    sigma_m: float = np.nan  # lateral sigma of the planned root
    felt: bool = True  # by the tip; else sigma_m is the largest one across the seam, of all that is known
    records: tuple[SeamRecord, ...] = ()  # of this plan, the last, and those before it
    more: bool = False  # another piece of this seam follows
    touch_arc_m: float | None = None  # where the tip comes down; None: near the start
    part_sigma_m: float = np.nan  # of the part's registration alone
    begins_m: float = 0.0  # of the whole seam, at the plan's start
    felt_before: NDArray[np.float64] | None = None  # (N, 4) m in B: points of an earlier run, and their lag
    question: str = ""  # that an operator must answer before the arm goes there
    summary: str = ""  # the result of the scan, in one sentence
    weld_pass: int = 0  # number of the pass that it is for, 0: the root
    number: int = 0  # of the seam, from 0
    piece: int = 0  # number of its piece
    direct: bool = False  # the way to it from the end of the last seam is free
    felt_line: SeamCurve | None = None  # of the tip in the root pass, for the passes after it
    # the torch's rms distance from the felt seam by errors of the arm, and the largest turn of the tool between tip and
    # torch at one place
    arm_sigma_m: float = np.nan
    arm_turn_rad: float = np.nan
    # of the tool across the line from torch to tip, to the seam's right, so that the arm can follow
    lean_rad: float = 0.0
    gap: GapAlong | None = None  # along this plan, where the welding schedule follows it
    along: AnglesAlong | None = None  # how the tool is led along it where angles of the wire are ordered

    @property
    def key(self) -> tuple[int, int, int]:
        """Numbers of the scan, the seam and its piece: several may be planned from one scan."""
        return self.sequence, self.number, self.piece


def believed_arm(port: InputPort, context: Context, arm: ArmModel) -> ArmModel:
    """Return the arm with refined kinematics of a `calibration_status` port.

    The given one where the port is open or has none.
    """
    if not port.HasValue(context):
        return arm
    status: CalibrationStatus = port.Eval(context)
    return status.arm_or(arm)
