"""TouchPlanner: finds flat places beside the groove in a scan, and the arm's positions above them."""

import dataclasses as dc
import itertools
from pathlib import Path

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.planning.clearance import Obstacle, Surroundings, arm_bodies
from weldcal.calibration.touch.touches import around, fit_touched_plane
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.background import Answer, Background, BackgroundSystem
from weldcal.systems.drivers.config import FingerCameraConfig, NoDevice, check_range
from weldcal.systems.jobs.weld.arm_way import CLEAR_OF_PART_M, SeamObstructed, SeamOutOfReach
from weldcal.systems.jobs.weld.seam_planning import SeamPlanning
from weldcal.systems.messages import JobCommand, Message, Scan
from weldcal.systems.motion.guarded_path import check_path, straight
from weldcal.systems.scenario.schema import FILE, Scenario
from weldcal.welding.locate.planning import plan_root_anyhow
from weldcal.welding.seam.curve import SeamCurve

FEWEST, MOST = 3, 60
_POSITIVE = ("aside_mm", "clearance_mm", "descent_mm_s", "press_mm", "deepest_mm")


@dc.dataclass(kw_only=True)
class TouchConfig:
    """`touch:` places on the part beside its groove, and how the tip goes down to them."""

    # a result of calibrate or demo: its folder, or calibration.yaml
    result: str = dc.field(default="", metadata=FILE)
    points: int = 8  # along the seam, on both sides in turn
    aside_mm: float = 9.0  # of the groove's middle, where the face is flat
    clearance_mm: float = 20.0  # of the tip above the face, where the descent begins; the torch hangs as low as the tip
    descent_mm_s: float = 3.0
    press_mm: float = 1.0  # deflection of the tip at which it has touched
    deepest_mm: float = 5.0  # below the scanned face, where the touch is abandoned
    turn_deg: float = 20.0  # of the tool to either side, from touch to touch


def check_touch(scenario: Scenario) -> None:
    """Check the touch job of a scenario.

    Raises:
        InputError: one sentence that says what to change.
    """
    touch = scenario.part(TouchConfig)
    assert touch is not None
    if scenario.job.calibrate or scenario.job.weld:
        raise InputError(
            "The touch job neither calibrates nor welds: write job: {calibrate: false, weld: false}, or run it with"
            " weldcal verify RESULT --scenario NAME."
        )
    if not touch.result or not Path(touch.result).exists():
        raise InputError(f"touch.result must be a result of weldcal calibrate, and there is none at '{touch.result}'.")
    if not scenario.welds or scenario.workpiece is None or not isinstance(scenario.finger_camera, FingerCameraConfig):
        raise InputError("A touch needs a tool with a soft tip, a finger_camera and a workpiece in the scenario.")
    if isinstance(scenario.scanner, NoDevice):
        raise InputError("A touch needs the scanner that was calibrated: write scanner: in the scenario.")
    for name in _POSITIVE:
        if not getattr(touch, name) > 0.0:
            raise InputError(f"touch.{name} must be a positive number, not {getattr(touch, name):g}.")
    if not FEWEST <= touch.points <= MOST:
        raise InputError(f"touch.points must be from {FEWEST} to {MOST}, not {touch.points}.")
    check_range("touch.turn_deg", touch.turn_deg, 0.0, 45.0)


_COLUMN_M = 0.003  # points of the scan this near to a line along `up` show the face's height there
_FLAT_M = 0.004  # of the face around a place, to which a plane is fitted
_LEAST_COLUMN, _LEAST_FLAT = 5, 8  # points

Joints = Array


@dc.dataclass(frozen=True, eq=False)
class TouchPlace(Message):
    """A place to touch: joints above it, its scanned plane, and its point and outward normal in the base.

    The plane is raw, in the camera's frame, with a sigma in m.
    """

    q_above: Joints
    p_C: Array
    n_C: Array
    sigma_m: float
    p_B: Array
    n_B: Array


@dc.dataclass(frozen=True, eq=False)
class PlannedTouches(Message):
    """The places of a scan, or the reason why there are none."""

    sequence: int = 0
    places: tuple[TouchPlace, ...] = ()
    reason: str | None = None


@dc.dataclass(frozen=True, eq=False)
class TouchPlanning:
    """What touches are planned from.

    Part, tool and arm as for a seam, the calibration to judge, and the job's numbers.
    """

    seam: SeamPlanning
    X_BC: RigidTransform
    correction: ScannerCorrection
    config: TouchConfig


class TouchPlanner(BackgroundSystem):
    """Plans the touches from the workpiece's scan, beside the control loop.

    .. pydrake_system::

        name: TouchPlanner
        input_ports:
        - scan
        - job
        output_ports:
        - planned_touches
    """

    def __init__(self, planning: TouchPlanning, background: Background | None = None, period_s: float = 0.02) -> None:
        super().__init__("planned_touches", PlannedTouches(), background, period_s)
        self._planning = planning
        self._scan = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))

    def ask(self, context: Context, newest: PlannedTouches) -> Answer[PlannedTouches] | None:
        """Ask for the places in a new scan of the workpiece."""
        scan: Scan = self._scan.Eval(context)
        job: JobCommand = self._job.Eval(context)
        if scan.sequence <= newest.sequence or scan.sequence != job.scan_sequence:
            return None
        return self.background.ask(plan_touches, self._planning, scan)


def plan_touches(planning: TouchPlanning, scan: Scan) -> PlannedTouches:
    """Plan the touches in a scan; where that fails the plan holds the reason, and no exception is raised."""
    seam, X_BC, config = planning.seam, planning.X_BC, planning.config
    raw = scan.points_C.reshape(-1, 3).astype(float)
    raw = raw[np.all(np.isfinite(raw), axis=1)]
    points_B = planning.correction.points(raw) @ X_BC.rotation().matrix().T + X_BC.translation()
    try:
        found = plan_root_anyhow(
            points_B, seam.workpiece, seam.X_BP_guess, seam.method, X_BC.translation(), seam.arm.up
        )
        root = SeamCurve.from_points(found.root, up=np.broadcast_to(found.up, found.root.shape))
        places: list[TouchPlace] = []
        for k in range(config.points):
            frame = root.frame(root.length * (k + 0.5) / config.points)
            side = 1.0 if k % 2 == 0 else -1.0
            aside = frame.position + side * 1e-3 * config.aside_mm * frame.normal
            face = _face(raw, points_B, aside, np.asarray(frame.up))
            n_C = planning.correction.normals(face[0], face[1])
            p_B = X_BC.multiply(planning.correction.points(face[0]))
            n_B = X_BC.rotation().multiply(n_C)
            x = frame.tangent - (frame.tangent @ n_B) * n_B
            x = x / np.linalg.norm(x)
            turned = RollPitchYaw(0.0, 0.0, side * np.radians(config.turn_deg)).ToRotationMatrix()
            R_BT = RotationMatrix.ProjectToRotationMatrix(np.column_stack([x, np.cross(n_B, x), n_B])) @ turned
            p_BT = p_B + (seam.tool.tip_radius_m + 1e-3 * config.clearance_mm) * n_B
            near = places[-1].q_above if places else seam.q_near
            q = nearest_solution(seam.arm, RigidTransform(R_BT, p_BT) @ seam.tool.X_FT.inverse(), near)
            if q is None:
                raise SeamOutOfReach(f"The arm cannot reach place {k + 1} of the part", "move it towards the robot")
            way = -1e-3 * (config.clearance_mm + config.deepest_mm) * n_B
            descent = straight(
                f"the descent to place {k + 1}",
                RigidTransform(R_BT, p_BT),
                way,
                1e-3 * config.descent_mm_s,
                seam.tool.X_FT,
            )
            check_path(seam.arm, q, [descent])
            places.append(TouchPlace(q, face[0], face[1], face[2], np.asarray(p_B), np.asarray(n_B)))
        if found.X_BP is not None:
            _check_moves(planning, found.X_BP, [seam.q_near, *(p.q_above for p in places), seam.q_near])
    except WeldcalError as error:
        return PlannedTouches(scan.sequence, reason=str(error))
    return PlannedTouches(scan.sequence, tuple(places))


def _face(raw: Array, points_B: Array, p_B: Array, up: Array) -> tuple[Array, Array, float]:
    """Plane of the face on the line through p_B along ``up``.

    Point and normal towards the scanner as scanned, and the sigma, m.
    """
    away = points_B - p_B
    height = away @ up
    column = (np.linalg.norm(away - height[:, None] * up, axis=1) < _COLUMN_M) & (np.abs(height) < 0.03)
    if column.sum() < _LEAST_COLUMN:
        raise SeamObstructed("The scan does not show the face beside the groove", "change touch.aside_mm")
    seed = raw[column][np.argmin(np.abs(height[column] - np.median(height[column])))]
    return fit_touched_plane(around(raw, seed, _FLAT_M, "beside the groove", _LEAST_FLAT))


def _check_moves(planning: TouchPlanning, X_BP: RigidTransform, way: list[Joints]) -> None:
    """Check that the moves keep clear of the part and the surroundings. Raises SeamObstructed."""
    seam = planning.seam
    part = Obstacle("part", seam.workpiece.mesh.transformed(X_BP), CLEAR_OF_PART_M)
    around_it = Surroundings((part, *seam.surroundings.obstacles))
    bodies = arm_bodies(seam.arm, seam.tool.capsules())
    for a, b in itertools.pairwise(way):
        if name := around_it.touched_on_path(seam.arm, bodies, a, b):
            raise SeamObstructed(
                f"The arm or its tool would come too close to '{name}' between two touches",
                "raise touch.clearance_mm, or choose another home_deg",
            )
