"""Errors of the weld and of the calibration of a run against the ground truth of the simulation."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context

from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.geometry.se3 import fit_rigid
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.workpieces.part import is_felt, numbered, seam_count
from weldcal.systems.cell import Cell
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.settings import angles_order, seam_tool, seated_tip, work_point
from weldcal.systems.jobs.weld.welding_velocity_servo import PHASE_CODES, TELEMETRY
from weldcal.systems.messages import SeamRecord
from weldcal.systems.runner import Run
from weldcal.systems.station import Truth
from weldcal.tools.report.render import csv_text
from weldcal.welding.locate.part.fit_up import FIT_UP, FitUp
from weldcal.welding.passes.felt import WeldPass
from weldcal.welding.record.process import PathError, path_error, wire_angles
from weldcal.welding.record.welded_seam import touch_numbers
from weldcal.welding.seam.curve import SeamCurve, ringed
from weldcal.welding.servo.settings import TORCH_ABOVE_ROOT_M
from weldcal.welding.servo.state import Phase
from weldcal.welding.servo.weave import WeaveConfig, weave_at

HELD_S = 0.1  # between two rows with the arc on: it was out in between
LATEST_S = 0.35  # a choice: an arc that takes 0.12 s, a stop of 0.15 s, and the arm's lag


def true_work_point(
    arm: ArmModel,
    true_arm: ArmModel,
    X_FT: RigidTransform | None,
    p_BWork: Array,
    q_home: Array,
    poses: Sequence[Array],
) -> Array:
    """The place (3,) m in the true base that the arm reports as the work point (3,) m.

    With a tool: where its tip is when it is reported there, upright as at ``q_home`` (6,) rad. Without one no posture
    belongs to the work point: it is mapped by the rigid transform that fits the true to the reported flange positions
    of the calibration ``poses`` (n, 6) rad best.
    """
    if X_FT is not None:
        p_FT = np.asarray(X_FT.translation())
        R = forward_kinematics(arm, q_home).rotation()
        q = nearest_solution(arm, RigidTransform(R, p_BWork - R.multiply(p_FT)), q_home)
        if q is not None:
            shift = forward_kinematics(true_arm, q).multiply(p_FT) - forward_kinematics(arm, q).multiply(p_FT)
            return np.asarray(p_BWork + shift)
    reported, true = (np.array([forward_kinematics(a, q).translation() for q in poses]) for a in (arm, true_arm))
    return np.asarray(fit_rigid(true, reported).multiply(p_BWork))


@dataclass(frozen=True, kw_only=True, eq=False)
class WeldLog:
    """The weld's time series, one row per servo tick; (N,) and (N, 3) arrays in B, SI units."""

    time: Array
    telemetry: dict[str, Array]
    torch_on: NDArray[np.bool_]
    p_BTip: Array  # tip position measured by the servo from the arm's pose and the tag
    p_BRobot: Array  # origin of T: the "robot end effector" of the paper
    R_BT: Array  # (N, 3, 3)
    p_BW: Array  # wire point, from the measured joints
    p_BTorch: Array  # the true one in a simulation
    work: Array  # (N,) angles of the wire against the seam, rad
    travel: Array
    deflection_T: Array
    sigma_min: Array
    arc: Array | None = None  # (N, 3) arc reported 1 or 0, current A, voltage V of the power source; NaN where none
    scheduled: Array | None = None  # (N, 5) as SET_VALUES of the schedule, then the gap m; NaN where none


@dataclass(frozen=True, kw_only=True, eq=False)
class WeldOutcome:
    """Errors of the weld against the true seam (simulation only)."""

    log: WeldLog
    true_seam: SeamCurve | None
    planned: SeamCurve | None
    error: PathError | None  # torch while the arc burned
    plan_error: PathError | None  # of the newest plan, that of the last seam
    seams: tuple[PathError, ...] = ()  # the torch's error on each seam, where there are several
    plans: tuple[tuple[int, int], ...] = ()  # numbers of seam and pass of each of `seams`, from 0


@dataclass(frozen=True)
class CalibrationError:
    """Error of X_BC against the ground truth: at the camera's origin, and for a point at the work point."""

    translation_m: float
    rotation_rad: float
    at_work_m: float


def calibration_error(X_BC: RigidTransform, X_BC_true: RigidTransform, p_BWork: Array) -> CalibrationError:
    """Difference of two camera poses; `at_work_m` is the position error of a point whose true position is p_BWork."""
    turn = RotationMatrix(X_BC_true.rotation().inverse() @ X_BC.rotation()).ToAngleAxis().angle()
    landed = X_BC @ (X_BC_true.inverse() @ p_BWork)
    return CalibrationError(
        translation_m=float(np.linalg.norm(X_BC.translation() - X_BC_true.translation())),
        rotation_rad=float(abs(turn)),
        at_work_m=float(np.linalg.norm(landed - p_BWork)),
    )


def live_calibration_error(
    cell: Cell[WeldJob], estimate: CalibrationEstimate, arm: ArmModel | None = None
) -> CalibrationError | None:
    """Compute the error of a live calibration where scanner and arm have errors; None without truth.

    `at_work_m` is the distance between where scanner and calibration put the work point and where the arm reports it:
    by ``arm``, the refined one, where given.
    """
    station, scenario = cell.station, cell.scenario
    truth, work = station.truth, work_point(scenario)
    if truth.X_BC is None or truth.arm is None:
        return None
    X_FT = None if station.tool is None else station.tool.X_FT
    poses = [p.q for p in cell.job.poses]
    p_true = true_work_point(arm or station.arm, truth.arm, X_FT, work, np.deg2rad(scenario.home_deg), poses)
    p_C = truth.X_BC.inverse().multiply(p_true)
    seen = p_C if truth.scanner is None else truth.scanner.device.measured(p_C)
    corrected = seen if estimate.correction is None else estimate.correction.points(seen)
    off = calibration_error(estimate.X_BC, truth.X_BC, work)
    return replace(off, at_work_m=float(np.linalg.norm(estimate.X_BC.multiply(corrected) - work)))


def true_seam(truth: Truth, seam: int = 0) -> SeamCurve | None:
    """The reference path of the torch on a seam by its number: above the true groove's root, in B."""
    if truth.workpiece is None or truth.X_BP is None:
        return None
    part = numbered(truth.workpiece, seam)
    ups = part.up_P
    line = part.seam_P + TORCH_ABOVE_ROOT_M * ups
    R = truth.X_BP.rotation().matrix()
    line, ups, turn_m = ringed(line @ R.T + truth.X_BP.translation(), np.broadcast_to(ups, line.shape) @ R.T)
    return SeamCurve.from_points(line, up=ups, length=turn_m)


def weld_log(cell: Cell[WeldJob], root: Context) -> WeldLog | None:
    """The log rows in which the servo was active; None where there are none."""
    if not cell.logs:
        return None
    series = {name: sink.FindLog(root).data() for name, sink in cell.logs.items()}
    # a run that is interrupted within a tick leaves some logs a row shorter
    rows = min(data.shape[1] for data in series.values())
    series = {name: data[:, :rows] for name, data in series.items()}
    telemetry = series["telemetry"]
    ticks = telemetry[TELEMETRY.index("tick_time")]
    keep = (telemetry[0] >= 0.0) & (telemetry[0] != PHASE_CODES[Phase.DONE])
    keep &= new_ticks(ticks)
    if keep.sum() < 3:
        return None
    tool = cell.station.tool
    assert tool is not None
    missing = np.full((1, rows), np.nan)
    named = {name: np.array(telemetry[k, keep]) for k, name in enumerate(TELEMETRY)}
    p_BRobot = columns(named, "p_BT")
    q = columns(named, "q_BT", "wxyz")
    plan = cell.job.planned_seam(root)
    lines = [(record.seam, record.line) for record in plan.records] or [(0, plan.seam)]
    number = np.minimum(weld_numbers(named["phase"]), len(lines) - 1)
    wires = np.array([seam_tool(cell.scenario, cell.station, seam).p_TW for seam, _ in lines])[number]
    R_BT = np.array([RotationMatrix(Quaternion(w / np.linalg.norm(w))).matrix() for w in q])
    deflection = series["deflection"][:3, keep].T
    p_BW = p_BRobot + np.einsum("nij,nj->ni", R_BT, wires)
    if "torch" in series:  # of the tool's own stick-out
        true = series["torch"][:, keep].T + np.einsum("nij,nj->ni", R_BT, wires - tool.p_TW)
    angles = np.full((2, len(number)), np.nan)
    for k, (_, line) in enumerate(lines):
        if line is not None and (rows := number == k).any():
            s = named["s_torch"][rows]
            frame = (line.tangent(s), line.normal(s), line.up(s))
            angles[:, rows] = wire_angles(R_BT[rows], *frame, tool.torch_tilt_rad)
    return WeldLog(
        time=named["tick_time"],
        telemetry=named,
        torch_on=np.array(series["torch_on"][0, keep] > 0.5),
        p_BTip=p_BRobot + np.einsum("nij,nj->ni", R_BT, deflection),
        p_BRobot=p_BRobot,
        R_BT=R_BT,
        p_BW=p_BW,
        p_BTorch=true if "torch" in series else p_BW,
        work=angles[0],
        travel=angles[1],
        deflection_T=np.array(deflection),
        sigma_min=np.array(series["margin"][0, keep]),
        arc=np.vstack([series.get("arc", missing), series.get("arc_values", missing.repeat(2, axis=0))])[:, keep].T,
        scheduled=np.vstack([series["set_values"], series["gap"]])[:, keep].T if "set_values" in series else None,
    )


def new_ticks(ticks: Array) -> NDArray[np.bool_]:
    """Mask of the ticks' times (N,) s, NaN outside a weld, that are later than all previous ones.

    After a fault the last report repeats, and a robot's clock may stall or restart.
    """
    newest = np.fmax.accumulate(np.nan_to_num(ticks, nan=-np.inf))
    return np.asarray(ticks > np.concatenate([[-np.inf], newest[:-1]]))


def columns(table: dict[str, Array], name: str, axes: str = "xyz") -> Array:
    """The columns name_x, name_y ... side by side, (N, len(axes))."""
    return np.column_stack([table[f"{name}_{axis}"] for axis in axes])


def weld_outcome(cell: Cell[WeldJob], root: Context) -> WeldOutcome | None:
    """Measure the weld, with its errors where the ground truth is known; None where nothing was welded."""
    number = cell.job.command(root).seam
    log, seam = weld_log(cell, root), true_seam(cell.station.truth, number)
    if log is None:
        return None
    planned = cell.job.planned_seam(root)
    plan, plan_error = planned.seam, None
    if plan is not None and seam is not None and planned.weld_pass == 0:
        lowered = plan.raised(TORCH_ABOVE_ROOT_M - seated_tip(cell.station, number).above_m)
        line = lowered.position(np.linspace(0.0, lowered.length, 200))
        plan_error = path_error(line, seam)
    if log.torch_on.sum() < 30:
        return WeldOutcome(log=log, true_seam=seam, planned=plan, error=None, plan_error=plan_error)
    weave, passes = cell.job.servo_config.weave, cell.scenario.welding.later_passes()
    plans = dict(enumerate((record.seam, record.weld_pass) for record in planned.records))
    errors, judged = [], []
    for k, part in enumerate(welds(log)):
        of_seam, of_pass = plans.get(k, (k, 0))
        on, true = part & log.torch_on, true_seam(cell.station.truth, of_seam)
        order = passes[of_pass - 1] if of_pass else WeldPass()
        if true is not None and of_pass:
            true = true.raised(order.vertical_m, order.lateral_m)
        curve = plan if true is None and part[-1] else true
        if curve is None or not on.any():
            continue
        off = path_error(log.p_BTorch[on], curve, backwards=order.reverse)
        if weave.amplitude_m:
            off = _unwoven(log.time[on], off, weave)
        if true is not None:
            errors.append(off)
            judged.append((of_seam, of_pass))
    outcome = WeldOutcome(log=log, true_seam=seam, planned=plan, error=None, plan_error=plan_error)
    if not errors:
        return outcome
    error = PathError(*(np.concatenate([getattr(e, name) for e in errors]) for name in ("s", "lateral", "height")))
    return replace(outcome, error=error, seams=tuple(errors), plans=tuple(judged))


def _unwoven(time: Array, off: PathError, weave: WeaveConfig) -> PathError:
    """The torch's distance (N,) from the ordered weave, which begins anew where the arc does, as late as fits best."""
    s, lateral, height = off.s.copy(), off.lateral.copy(), off.height.copy()
    c, d = math.cos(weave.plane_rad), math.sin(weave.plane_rad)
    for rows in np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > HELD_S) + 1):
        t = time[rows] - time[rows[0]]
        grid = np.arange(-LATEST_S, t[-1] + 0.1, 1e-3)
        swings = np.array([weave_at(weave, at) for at in grid])
        side = c * lateral[rows] + d * height[rows]
        late = min(
            np.arange(-0.05, LATEST_S, 2e-3), key=lambda by: np.ptp(side - np.interp(t - by, grid, swings[:, 0]))
        )
        across, ahead = (np.interp(t - late, grid, swings[:, k]) for k in (0, 2))
        lateral[rows] -= c * across
        height[rows] -= d * across
        s[rows] -= ahead
    return PathError(s, lateral, height)


def pass_documents(weld: WeldOutcome, passes: Sequence[WeldPass], errors: list[dict[str, float]]) -> list[object]:
    """Each pass of each seam: what was ordered, and the torch's error against that."""
    found: list[object] = []
    for (seam, number), error in zip(weld.plans, errors, strict=True):
        order = passes[number - 1] if number else WeldPass()
        ordered = {
            "lateral_mm": 1e3 * order.lateral_m,
            "vertical_mm": 1e3 * order.vertical_m,
            "angle_deg": math.degrees(order.angle_rad),
            "reverse": order.reverse,
        }
        found.append({"seam": seam + 1, "pass": number + 1, **ordered, **error})
    return found


def ordered_weave(order: WeaveConfig) -> dict[str, Any]:
    """Return what is ordered of a weave."""
    return {
        "shape": order.shape,
        "amplitude_mm": 1e3 * order.amplitude_m,
        "frequency_hz": order.frequency_hz,
        "dwell_s": [order.dwell_left_s, order.dwell_right_s],
        "bow_mm": 1e3 * order.lag_m,
        "plane_deg": float(np.degrees(order.plane_rad)),
    }


def weld_numbers(phase: Array) -> NDArray[np.int_]:
    """The number (N,) of the weld of each row: one begins where the tip is brought into touch again."""
    held = np.isin(phase, (PHASE_CODES[Phase.HELD], PHASE_CODES[Phase.BACK]))
    return touch_numbers(phase == PHASE_CODES[Phase.TOUCH], held)


def welds(log: WeldLog) -> list[NDArray[np.bool_]]:
    """Masks (N,) of the log's rows, one for each weld."""
    number = weld_numbers(log.telemetry["phase"])
    return [number == k for k in range(int(number[-1]) + 1)]


def felt_seams(run: Run[WeldJob]) -> list[bool]:
    """Whether the tip feels each of the seams, in the order of welding."""
    cad, tool = run.cell.station.cad, run.cell.station.tool
    return [] if cad is None or tool is None else [is_felt(numbered(cad, k), tool) for k in range(seam_count(cad))]


def ordered_angles(run: Run[WeldJob]) -> list[dict[str, Any] | None]:
    """What is ordered of the wire's angles on each seam, in the order of welding; None: nothing."""
    cad, scenario = run.cell.station.cad, run.cell.scenario
    orders = [] if cad is None else [angles_order(scenario, cad, k) for k in range(seam_count(cad))]
    return [None if order is None else asdict(order) for order in orders]


def fit_up_document(found: FitUp | None) -> dict[str, dict[str, float]]:
    """List least, mean and largest gap, misalignment and angle along a seam, mm and deg, with typical sigma."""
    if found is None:
        return {}
    rows = {}
    for name, value in found.values.items():
        unit, factor = FIT_UP[name]
        figures = (np.nanmin(value), np.nanmean(value), np.nanmax(value), np.nanmedian(found.sigmas[name]))
        rows[f"{name}_{unit}"] = dict(
            zip(("least", "mean", "most", "sigma"), (factor * float(v) for v in figures), strict=True)
        )
    return rows


def fit_up_csv(records: Sequence[SeamRecord]) -> str:
    """Write a line per plan and place: gap, misalignment and angle with sigmas; empty where not seen."""
    columns = [f"{name}{kind}_{unit}" for name, (unit, _) in FIT_UP.items() for kind in ("", "_sigma")]
    rows = []
    for record in records:
        found = record.fit_up
        for k, s in enumerate(() if found is None else found.s_m):
            row: list[object] = [record.seam + 1, f"{1e3 * s:.1f}"]
            for name, (_, factor) in FIT_UP.items():
                for values in (found.values, found.sigmas):  # type: ignore[union-attr]  # it has places
                    value = factor * float(values[name][k]) if name in values else np.nan
                    row.append(f"{value:.3f}" if np.isfinite(value) else "")
            rows.append(row)
    return csv_text(("seam", "place_mm", *columns), rows)
