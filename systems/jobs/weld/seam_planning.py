"""Plan the seam in the base, and the arm's approach, from a scan of the workpiece or from its drawing."""

import dataclasses as dc
import math
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform
from scipy.spatial import cKDTree

from weldcal.calibration.data.scanner_correction import TERMS, ScannerCorrection, expected_factors
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.calibration.refinement.local_field import LocalField
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces.part import Part, WeldPart, is_felt, numbered
from weldcal.models.workpieces.seat import Press
from weldcal.systems.jobs.weld.arm_way import ArmWay, Welder, find_way, free_move, leaning, leans_with_clearance
from weldcal.systems.jobs.weld.tip_to_torch import TipToTorch, tip_to_torch, torch_sigma
from weldcal.systems.messages import PlannedSeam, Scan, ScanView, SeamRecord
from weldcal.welding.locate.part.fit_up import FitUp, check_fit_up
from weldcal.welding.locate.planning import (
    OVERLAP_M,
    TIP_AHEAD,
    PlanningMethod,
    RootPlan,
    plan_root_anyhow,
    seam_above,
    tip_seam,
)
from weldcal.welding.passes.angles import AnglesAlong, angles_along, lifted
from weldcal.welding.passes.felt import PassError, WeldPass, felt_line, pass_config, pass_line
from weldcal.welding.passes.stitch import StitchConfig, StitchError
from weldcal.welding.passes.tacks import TackError
from weldcal.welding.record.schedule import GapAlong, WeldSchedule, gap_along
from weldcal.welding.seam.clearance import NoClearance, check_beside, check_clearance, check_ends, clear_pieces
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import check_feasible
from weldcal.welding.seam.restart import SPARE_M, NoRoomBehindCrater, Restart
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import WeldingState
from weldcal.welding.servo.tool_axes import check_travel
from weldcal.welding.servo.touch import check_length, touch_start_pose

Views = tuple[ScanView, ...]
PassPlan = tuple[SeamCurve, ArmWay, AnglesAlong | None]


TACK_BESIDE_M = 3e-3  # a choice: about a tack, above what a scan and a list are off along the seam
RUN_UP_S = 2.0  # from where the tip comes down until the torch is on the seam
_DRAWN = "the pose of the part is from the fixture's drawing; the scan was not used"
UNFELT = "followed from the scan and the drawing; not felt"


class UncertainSeam(WeldcalError):
    """A seam that the tip does not feel is not known well enough."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SeamPlanning(Welder):
    """What a seam is planned from besides the scan.

    What follows it, the nominal part and its expected pose, and the job's limits.
    """

    workpiece: WeldPart
    X_BP_guess: RigidTransform
    seam_length_m: float | None
    method: PlanningMethod = dc.field(default_factory=PlanningMethod)
    local_field: LocalField | None = None
    arm_errors: Mapping[str, Any] | None = None  # as the refinement states them, where there is one
    estimate: CalibrationEstimate | None = None  # by which the scan is in the base; None: by a known pose
    X_BC_sigma_m: float | None = None  # of the known pose
    tolerance_m: float = math.inf  # of sigma across a seam that is not felt
    limits: Mapping[str, tuple[float, float]] = dc.field(default_factory=dict)  # of the fit-up, see read_limits
    schedule: WeldSchedule | None = None  # of the power source
    pass_obstacles: bool = False  # the seam is interrupted there
    piece: int = 0  # of an interrupted seam
    number: int = 0  # of the seam
    restart: Restart | None = None  # the weld goes on there
    earlier: tuple[SeamRecord, ...] = ()  # of the plans before this one
    passes: tuple[WeldPass, ...] = ()  # after the root
    keeps_scan: bool = False  # for the next seam
    stitches: StitchConfig = dc.field(default_factory=StitchConfig)  # each planned as a piece; on_m of 0: none
    q_from: Array | None = None  # (6,) rad, above the end of the seam before; None: home
    order_words: str = ""  # of the seams
    configs: tuple[ServoConfig, ...] = ()  # of each seam; else `config` is that of all
    tools: tuple[WeldingTool, ...] = ()  # likewise

    def goes_on(self) -> bool:
        """Whether this seam, or its piece, is the broken one."""
        return self.restart is not None and (self.restart.seam, self.restart.piece) == (self.number, self.piece)

    def above_m(self) -> float | None:
        """Height of the seated tip above the drawn root, m; None where the groove's angle is found in the scan."""
        if self.method.method == "cloud":
            return None
        return self.workpiece.seated(self.tool, Press(self.tool.press_axial_m, self.tool.press_lateral_m)).above_m

    def of_seam(self, number: int) -> Self:
        """Return what the seam of this number is planned from."""
        config = self.configs[number] if number < len(self.configs) else self.config
        tool = self.tools[number] if number < len(self.tools) else self.tool
        return dc.replace(self, workpiece=numbered(self.workpiece, number), number=number, config=config, tool=tool)

    def without_tacks(self, points_B: Array, seam: SeamCurve) -> Array:
        """The points (n, 3) m of a scan that are not of the ordered tacks; the seam is the tip's line."""
        for tack in self.config.tacks:
            s = np.arange(tack.start - TACK_BESIDE_M, tack.end + TACK_BESIDE_M, 1e-3)
            reach = self.tool.tip_radius_m + tack.lift + TACK_BESIDE_M
            points_B = points_B[np.asarray(cKDTree(seam.position(s)).query(points_B)[0]) > reach]
        return points_B

    def field_at(self, points_B: Array) -> Array:
        """The local field (n, 3) m at points (n, 3) m of the part, for the flange's orientation in the drawn weld.

        Where that orientation is none of the calibration's, or the points lie far from its poses, this is zero.
        """
        assert self.local_field is not None
        seam = tip_seam(self.workpiece, self.X_BP_guess, self.tool, self.seam_length_m)
        R = touch_start_pose(seam, self.config).rotation() @ self.tool.X_FT.rotation().inverse()
        return self.local_field.at_places(points_B, R.matrix())

    def tip_to_torch(self, seam: SeamCurve, q_start: Array) -> TipToTorch:
        """What errors of the arm do between tip and torch along a seam."""
        return tip_to_torch(self.arm, self.tool, seam, q_start, self.arm_errors)

    def way(self, seam: SeamCurve, X_BP: RigidTransform | None) -> ArmWay:
        """The arm's way to the seam, along it and back; checked as a whole before anything moves.

        Where the upright tool on the branch of home cannot follow, the job leans it or changes the branch as far as the
        scenario allows. Beside a high part the approach is higher above the seam than the clearance.

        Raises:
            InfeasiblePath: with the place, the joint, and the change that makes the seam feasible, where one was found.
            WeldcalError: the seam is too short or not feasible, or the tool has no room beside the part at X_BP.
        """
        check_length(seam, self.config)
        order, tool = self.config.angles, self.tool
        leans = None if order is None else [self.config.torch.work_angle_rad]
        if X_BP is not None:
            leans = leans or leans_with_clearance(self, seam, X_BP)
            for lean in () if order is None else order.work_rad:
                check_clearance(self.workpiece.mesh, X_BP, seam, tool.capsules(), tool.X_FT, tool.chord_m, lean)
            check_ends(self.workpiece.mesh, X_BP, seam, tool.chord_m, tool.tip_radius_m)
        check_feasible(seam, self.tool.chord_m, self.config.weld_speed_m_s, self.config.windows)
        check_travel(seam, self.config)
        return find_way(self, seam, X_BP, leans)

    def pass_way(self, felt: SeamCurve, number: int, X_BP: RigidTransform | None) -> PassPlan:
        """Plan a pass after the root by its number, from 1, beside the felt line of the tip.

        Raises:
            InfeasiblePath: the arm cannot follow.
            WeldcalError: as `way`.
        """
        tool, order = self.tool, self.passes[number - 1]
        config, ahead_m = pass_config(self.config, order, tool.tip_radius_m), TIP_AHEAD * tool.chord_m
        seam = pass_line(felt, order, self.config, tool.tip_radius_m, ahead_m, OVERLAP_M)
        check_length(seam, config)
        try:
            if config.angles is not None:
                seam, config = lifted(seam, config)
            if X_BP is not None:
                fits = (tool.capsules(), tool.X_FT, tool.chord_m, order.lean_rad)
                check_clearance(self.workpiece.mesh, X_BP, seam, *fits)
                check_ends(self.workpiece.mesh, X_BP, seam, tool.chord_m, tool.tip_radius_m)
            check_feasible(seam, tool.chord_m, config.weld_speed_m_s, config.windows)
            check_travel(seam, config)
            way = find_way(dc.replace(self, config=config, advises=False), seam, X_BP, [order.lean_rad])
        except WeldcalError as problem:
            raise PassError(f"welding.passes[{number}]: {problem}") from problem
        return seam, way, None if config.angles is None else angles_along(seam, config)


def plan_pass(planning: SeamPlanning, root: PlannedSeam, number: int, state: WeldingState | None) -> PlannedSeam:
    """Plan the pass of this number after the root, or after the pass before it, from what the tip felt in the root."""
    felt = root.felt_line
    if felt is None:
        assert state is not None
        felt = felt_line(state, TIP_AHEAD * planning.tool.chord_m)
    last, order = root.records[-1], planning.passes[number - 1]
    record = SeamRecord(seam=last.seam, weld_pass=number, begins_m=root.begins_m, reverse=order.reverse)
    plan = dc.replace(root, weld_pass=number, felt_line=felt, records=(*root.records, record))
    try:
        seam, way, along = planning.pass_way(felt, number, root.X_BP)
    except WeldcalError as error:
        return dc.replace(plan, seam=None, reason=str(error))
    return dc.replace(
        plan,
        seam=seam,
        **way.reached,
        along=along,
        records=(*root.records, dc.replace(record, line=seam)),
        touch_arc_m=None,
    )


def _points_in_base(planning: SeamPlanning, scan: Scan, X_BC: RigidTransform, correction: ScannerCorrection) -> Array:
    points_C = scan.points_C.reshape(-1, 3).astype(float)
    points_C = points_C[np.all(np.isfinite(points_C), axis=1)]
    points_B: Array = correction.points(points_C) @ X_BC.rotation().matrix().T + X_BC.translation()
    return points_B if planning.local_field is None else points_B - planning.field_at(points_B)


def plan_seam(
    planning: SeamPlanning, scan: Scan, X_BC: RigidTransform | None, correction: ScannerCorrection, views: Views = ()
) -> PlannedSeam:
    """Plan the seam from a scan of the part and the views before it.

    A plan that fails holds the reason, nothing is raised.
    """
    known = [(view.scan, view.X_BC) for view in (*views, ScanView(scan, X_BC)) if view.X_BC is not None]
    if len(known) <= len(views):
        return PlannedSeam(
            sequence=scan.sequence,
            reason=(
                "The seam cannot be computed in the base: the scanner is not calibrated, or the arm's pose at the scan"
                " is not known."
            ),
        )
    scans = [_points_in_base(planning, one, X, correction) for one, X in known]
    eyes, points_B = np.array([X.translation() for _, X in known]), np.concatenate(scans)
    record, more = SeamRecord(seam=planning.number), False
    kept = (*views, ScanView(scan, X_BC)) if planning.keeps_scan else ()
    try:
        found = plan_root_anyhow(
            scans if views else points_B,
            planning.workpiece,
            planning.X_BP_guess,
            planning.method,
            eyes if views else eyes[0],
            planning.arm.up,
        )
        record = SeamRecord(seam=planning.number, fit_up=found.fit_up)
        if found.fit_up is not None and isinstance(planning.workpiece, Part):
            check_fit_up(found.fit_up, planning.limits, planning.workpiece.seam.joint)
        seam = whole = seam_above(found, planning.tool, planning.seam_length_m, planning.above_m())
        if isinstance(planning.workpiece, Part) and found.X_BP is not None:
            beside = (planning.without_tacks(points_B, seam), planning.workpiece.mesh, found.X_BP)
            if planning.pass_obstacles:
                stops: list[float] = []
                check_beside(*beside, seam, planning.tool, 0.0, planning.table_z_m, stops)
                if stops:
                    planning, seam, record, more = interrupted(planning, seam, stops, record)
        if planning.stitches.on_m:
            planning, seam, record, more = stitch_piece(planning, seam, record)
        arc = planning.config.touch.arc_m if record.left_out else None
        planning, seam, arc, again = gone_on(planning, seam, whole, found.X_BP, found.sigma_m, arc)
        plan = _planned(planning, scan.sequence, seam, found.X_BP)
        if isinstance(planning.workpiece, Part) and found.X_BP is not None:
            check_beside(*beside, seam, planning.tool, plan.lean_rad, planning.table_z_m, from_m=arc or 0.0)
        felt = is_felt(planning.workpiece, planning.tool)
        at, others = added_variance(planning, found, seam, plan, known[-1][1])
        # a turn about a ring moves it along itself
        part_m = found.sigma_m if found.across_m is None else found.across_m
        sigma_m = math.sqrt(np.mean(np.square(part_m)) + np.mean(others))
        summary = f"{found.summary}; with scanner and arm its sigma is {1e3 * sigma_m:.2f} mm"
        if not felt:
            sigma_m, summary = unfelt_sigma(planning, found, at, others)
        if planning.order_words:
            summary += f"; {planning.order_words}"
        return dc.replace(
            plan,
            felt=felt,
            records=(*planning.earlier, dc.replace(record, line=plan.seam, begins_m=again["begins_m"])),
            more=more,
            touch_arc_m=arc,
            part_sigma_m=found.sigma_m,
            **again,
            gap=planned_gap(planning, found.fit_up, whole, seam),
            views=kept,
            rms_m=found.rms_m,
            confidence=found.confidence,
            points_B=points_B,
            sigma_m=sigma_m,
            summary=summary,
        )
    except WeldcalError as error:
        records = (*planning.earlier, record)
        number, piece = planning.number, planning.piece
        return PlannedSeam(sequence=scan.sequence, number=number, piece=piece, reason=str(error), records=records)


def planned_gap(planning: SeamPlanning, fit_up: FitUp | None, whole: SeamCurve, piece: SeamCurve) -> GapAlong | None:
    """The measured gap along a piece of a seam; None where no schedule follows it.

    Raises:
        ScheduleError: the scan does not show the gap, or the schedule has no row for it.
    """
    schedule = planning.schedule
    if schedule is None or not schedule.by_gap:
        return None
    if fit_up is None:
        return gap_along(np.zeros(0), None, None, schedule)
    start_m = float(whole.project(np.asarray(piece.position(0.0))))
    return gap_along(fit_up.s_m - start_m, fit_up.values.get("gap"), fit_up.sigmas.get("gap"), schedule)


def interrupted(
    planning: SeamPlanning, seam: SeamCurve, stops: list[float], record: SeamRecord
) -> tuple[SeamPlanning, SeamCurve, SeamRecord, bool]:
    """The piece of an interrupted seam whose turn it is.

    Its planning, its line, its record, and whether another one follows.

    Raises:
        NoClearance: nothing is left of the seam.
    """
    chord = planning.tool.chord_m
    pieces = clear_pieces(seam, stops, chord, RUN_UP_S * planning.config.weld_speed_m_s)
    if planning.piece >= len(pieces):
        raise NoClearance("The obstacles beside the seam leave nothing of it to weld: remove them and scan again.", 0.0)
    start, end, down = pieces[planning.piece]
    ends = [0.0, *(s for a, b, _ in pieces for s in (a, b)), seam.length]
    left_out = tuple((a, b) for a, b in zip(ends[::2], ends[1::2], strict=True) if b - a > 1e-6)
    last = min(max(seam.drawn_m, seam.length), end + chord)
    s = np.linspace(start, last, max(9, round((last - start) / 0.5e-3)))
    line = SeamCurve.from_points(seam.position(s), up=seam.up(s), length=end - start if end < last else None)
    arc = max(down - start, planning.config.touch.arc_m)
    planning = dc.replace(planning, config=leaning(planning.config, 0.0, arc))
    return planning, line, dc.replace(record, left_out=left_out), planning.piece + 1 < len(pieces)


def stitch_piece(
    planning: SeamPlanning, seam: SeamCurve, record: SeamRecord
) -> tuple[SeamPlanning, SeamCurve, SeamRecord, bool]:
    """The stitch of a seam whose turn it is: its planning, its line, its record, and whether another one follows.

    Raises:
        StitchError: the seam is too short for a stitch.
    """
    pieces = planning.stitches.pieces(seam.length)
    if planning.piece >= len(pieces):
        length = f"{1e3 * seam.length:.0f} mm"
        raise StitchError(f"A seam of {length} is too short for a stitch: lower welding.stitch.on_mm.")
    config, chord, (start, end) = planning.config, planning.tool.chord_m, pieces[planning.piece]
    last = min(seam.drawn_m, end + TIP_AHEAD * chord)
    s = np.linspace(start, last, max(9, round((last - start) / 0.5e-3)))
    line = SeamCurve.from_points(seam.position(s), up=seam.up(s), length=end - start if end < last else None)
    arc = min(chord - RUN_UP_S * config.weld_speed_m_s, line.drawn_m - config.gap.end_window_m - SPARE_M)
    if start > 0.0:  # the first one of the seam feels the seam's start
        config = leaning(config, 0.0, max(arc, config.touch.arc_m))
    edges = [0.0, *(s for piece in sorted(pieces) for s in piece), seam.length]
    left_out = tuple((a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1e-6)
    record = dc.replace(record, left_out=left_out)
    return dc.replace(planning, config=config), line, record, planning.piece + 1 < len(pieces)


def _placed(planning: SeamPlanning, begins_m: float, line: SeamCurve, whole: SeamCurve) -> SeamPlanning:
    """The planning of a line that begins at a place of the whole seam: its angles are those of its places."""
    config = planning.config
    if config.angles is None:
        return planning
    angles = config.angles.between(begins_m / whole.length, min((begins_m + line.length) / whole.length, 1.0))
    torch = dc.replace(config.torch, work_angle_rad=0.5 * sum(angles.work_rad))
    return dc.replace(planning, config=dc.replace(config, angles=angles, torch=torch))


def gone_on(
    planning: SeamPlanning,
    seam: SeamCurve,
    whole: SeamCurve,
    X_BP: RigidTransform | None,
    sigma_m: float,
    arc: float | None,
) -> tuple[SeamPlanning, SeamCurve, float | None, dict[str, Any]]:
    """The rest of a broken seam, where the weld goes on; every other seam as it is, with its `arc` of the touch.

    Returns the planning, the line, where the tip comes down on it, and further values of the PlannedSeam.

    Raises:
        PartMoved, NoRoomBehindCrater: see Restart.
    """
    from_m, config, restart = float(whole.project(seam.position(0.0))), planning.config, planning.restart
    if restart is None or not planning.goes_on():
        return _placed(planning, from_m, seam, whole), seam, arc, {"begins_m": from_m}
    restart.check_unmoved(whole, X_BP, sigma_m)
    run_up_m, window_m = RUN_UP_S * config.weld_speed_m_s, config.gap.end_window_m
    cut = restart.cut(seam, planning.tool.chord_m, run_up_m, window_m, from_m)
    again = {"begins_m": cut.start_m, "question": cut.question(planning.number)}
    planning = _placed(planning, cut.start_m, cut.line, whole)
    if cut.down_m is None:
        return planning, seam, arc, again
    again["felt_before"] = restart.felt
    try:
        config = leaning(planning.config, 0.0, cut.down_m, begins_m=cut.start_m)
    except TackError as problem:
        raise NoRoomBehindCrater(f"The rest cannot be felt: weld it by hand. {problem}") from problem
    return dc.replace(planning, config=config), cut.line, cut.down_m, again


def added_variance(
    planning: SeamPlanning, found: RootPlan, seam: SeamCurve, plan: PlannedSeam, X_BC: RigidTransform
) -> tuple[npt.NDArray[np.int_], Array]:
    """Nine places of a root, and the variance m^2 across it there that scanner and arm add to the part's in the scan.

    Of a calibration by the same arm the spread of its residuals counts for the arm. Of a known pose it is the stated
    sigma, or else that of a scanner that nobody has corrected and of an arm as its maker leaves it.
    """
    left = np.cross(found.up, np.gradient(found.root, axis=0))
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    at, estimate = np.linspace(0, len(left) - 1, 9).astype(int), planning.estimate
    if estimate is not None:
        spread = [left[k] @ point_error_covariance(estimate, found.root[k]) @ left[k] for k in at]
        return at, np.array(spread) + estimate.sigma_position_m**2
    if planning.X_BC_sigma_m is not None:
        return at, np.full(len(at), planning.X_BC_sigma_m**2)
    assert plan.q_start is not None
    c = (found.root[at] - X_BC.translation()) @ X_BC.rotation().matrix()
    factors = ScannerCorrection().terms(c) * expected_factors(TERMS[1], float(np.median(c[:, 2])))
    scale = np.sum((left[at] @ X_BC.rotation().matrix()) * c, axis=1) * np.linalg.norm(factors, axis=1)
    return at, scale**2 + torch_sigma(planning.arm, planning.tool, seam, plan.q_start) ** 2


def unfelt_sigma(planning: SeamPlanning, found: RootPlan, at: npt.NDArray[np.int_], others: Array) -> tuple[float, str]:
    """The largest sigma of the torch across a seam that is not felt, m, and the plan's summary with it.

    It is that of the root in the scan, with the `added_variance` at its places.

    Raises:
        UncertainSeam: it is over the tolerance.
    """
    assert found.across_m is not None
    worst = int(np.argmax(found.across_m[at] ** 2 + others))
    part, other = float(found.across_m[at[worst]]), math.sqrt(others[worst])
    sigma = math.hypot(part, other)
    words = f"{1e3 * sigma:.2f} mm across it (part {1e3 * part:.2f} mm, scanner and arm {1e3 * other:.2f} mm)"
    if not sigma <= planning.tolerance_m:
        advice = "calibrate in the same job (job.calibrate), or state job.X_BC_sigma_mm"
        if planning.estimate is not None:
            advice = "calibrate with more scans or with calibration.refine: links"
        if other <= part:
            advice = "scan the part from nearer, or so that more of its sides are visible"
        raise UncertainSeam(
            f"The tip does not feel this seam, and its plan has a sigma of {words}, over welding.tolerance_mm "
            f"({1e3 * planning.tolerance_m:g} mm): {advice}."
        )
    return sigma, f"{found.summary}; {UNFELT}: sigma {words}"


def _planned(planning: SeamPlanning, sequence: int, seam: SeamCurve, X_BP: RigidTransform | None) -> PlannedSeam:
    """The plan of a seam that has been found; raises WeldcalError where it cannot be welded."""
    drawn, felt, along = seam, is_felt(planning.workpiece, planning.tool), None
    if planning.config.angles is not None and not felt:
        seam, config = lifted(seam, planning.config)
        planning = dc.replace(planning, config=config)
    if planning.config.angles is not None:
        along = angles_along(seam, planning.config)
    way = planning.way(seam, X_BP)
    for number in range(1, len(planning.passes) + 1):  # before the root is welded
        planning.pass_way(drawn, number, X_BP)
    share = planning.tip_to_torch(seam, way.q_start) if felt else TipToTorch(math.nan, math.nan)
    return PlannedSeam(
        sequence=sequence,
        number=planning.number,
        piece=planning.piece,
        direct=planning.q_from is not None and free_move(planning, planning.q_from, way.q_above, X_BP),
        seam=seam,
        X_BP=X_BP,
        **way.reached,
        along=along,
        felt_line=None if seam is drawn else drawn,
        records=(*planning.earlier, SeamRecord(seam=planning.number, line=seam)),
        arm_sigma_m=share.sigma_m,
        arm_turn_rad=share.turn_rad,
    )


def plan_drawn_seam(planning: SeamPlanning, sequence: int) -> PlannedSeam:
    """Plan the seam where the fixture's drawing has it; where that fails the plan holds the reason."""
    records = (*planning.earlier, SeamRecord(seam=planning.number))
    try:
        whole = tip_seam(planning.workpiece, planning.X_BP_guess, planning.tool, planning.seam_length_m)
        planning, seam, arc, again = gone_on(planning, whole, whole, planning.X_BP_guess, math.nan, None)
        plan = _planned(planning, sequence, seam, planning.X_BP_guess)
        return dc.replace(
            plan,
            records=(*planning.earlier, dc.replace(plan.records[-1], begins_m=again["begins_m"])),
            touch_arc_m=arc,
            **again,
            rms_m=0.0,
            confidence=1.0,
            points_B=np.asarray(seam.position(np.linspace(0.0, seam.length, 200))),
            summary="; ".join(filter(None, (_DRAWN, planning.order_words))),
        )
    except WeldcalError as error:
        return PlannedSeam(sequence=sequence, number=planning.number, reason=str(error), records=records)
