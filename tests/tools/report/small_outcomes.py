"""Small outcomes of every command that computes a pose, put together without a job, and the pages of their reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from tests.calibration.eye_on_base.test_solve import make_observations
from tests.calibration.hand_eye.made_boards import Made as MadeBoard
from tests.calibration.hand_eye.made_boards import seen
from tests.calibration.hand_eye.poses import eye_in_hand, random_poses
from tests.calibration.hand_eye.rendering import SIZE
from tests.worlds.light_runs import mounted_world
from weldcal.calibration.data.results import CalibrationResult, PoseRecord, statistics
from weldcal.calibration.data.scanner_correction import ScannerClock
from weldcal.calibration.eye_on_base.observations import FlangeObservations
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import Convergence
from weldcal.calibration.hand_eye.mountings import get_mounting
from weldcal.calibration.hand_eye.pictures.boards import parse_board
from weldcal.calibration.hand_eye.pictures.camera import CameraEstimate, camera_of
from weldcal.calibration.hand_eye.pictures.search import Picture
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem
from weldcal.calibration.motion.drift.sequential import MOVED, DriftEvent
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.planning.mounting_estimate import solve_mounting
from weldcal.calibration.profiler.features.bead_course import bead_course
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.recorded_carried import CarriedCalibration
from weldcal.calibration.recorded_hand_eye import MethodRow
from weldcal.calibration.tablet.result import TabletResult
from weldcal.calibration.verified_scans import PoseError
from weldcal.systems.messages import CalibrationStatus, PlannedSeam, VerificationResult
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.report.calibration import CalibrationReport, calibration_report
from weldcal.tools.report.demo import DemoResult, demo_pictures, demo_report
from weldcal.tools.report.first_screen import NO_TOLERANCE, FirstScreen
from weldcal.tools.report.hand_eye import HandEyeReport, hand_eye_report
from weldcal.tools.report.monitor import MonitorReport, monitor_page
from weldcal.tools.report.motion_calibration import MotionReport, motion_report
from weldcal.tools.report.mounting import MountingReport, mounting_report
from weldcal.tools.report.profiler_file import (
    BEAD,
    ProfilerBead,
    ProfilerFile,
    ProfilerSeam,
    profiler_report,
    seam_report,
)
from weldcal.tools.report.profiler_live import LiveOutcome, PoseOutcome, ProfilerLive, live_report
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.tablet import Shown, tablet_screen
from weldcal.tools.report.tablet import calibration_report as tablet_report
from weldcal.tools.report.verify import VerifyReport, verify_report

Made = tuple[FirstScreen, str]
OUT = Path("result")
X = RigidTransform(RollPitchYaw(3.1, 0.02, 0.4), [0.65, 0.02, 0.94])
COVARIANCE = np.diag([1e-4] * 3 + [5e-5] * 3) ** 2
OBSERVATIONS = make_observations(10, 3)
ESTIMATE = estimate_eye_on_base(OBSERVATIONS, SolveConfig(hypotheses=40))
RESULT = CalibrationResult(
    X_BC=ESTIMATE.X_BC,
    covariance=ESTIMATE.covariance,
    held_out_mm=statistics(1e3 * ESTIMATE.held_out.position_m),
    tilt_deg={"median": 0.01, "p95": 0.03},
    poses=tuple(
        PoseRecord(
            id=o.id, used=True, reason="", residual_mm=0.1, held_out_mm=0.2, tilt_deg=0.01, held_out_tilt_deg=0.02
        )
        for o in OBSERVATIONS
    ),
    warnings=("A <warning> of this calibration.",),
    robot="ur10e",
    flange="iso9409-1-50-4-m6",
    scanner="phoxi_m",
    sigma_position_mm=1e3 * ESTIMATE.sigma_position_m,
    data_hashes={"clouds/p0.ply": "0123456789abcdef" * 4},
)


def calibration(**changes: Any) -> CalibrationReport:
    """The report of ten scans within its tolerance, with a warning; `changes` replace its fields."""
    counts = np.arange(4, 10)
    curve = Convergence(counts, 1e-4 * np.ones((2, len(counts))))
    report = CalibrationReport(
        result=RESULT,
        estimate=ESTIMATE,
        observations=tuple(OBSERVATIONS),
        scanner=None,
        seen=FlangeObservations(tuple(OBSERVATIONS), {}, {}, {}, ()),
        refused=(("p99", "No flange was found."),),
        outliers=(),
        algorithm1=None,
        convergence=curve,
        k_fold_mm=statistics(np.array([0.2])),
        seconds=1.0,
        out=OUT,
        advice=("Add a pose near (1, 2, 3).",),
        limit_mm=2.0,
    )
    return replace(report, **changes)


def calibrate() -> Made:
    """`calibrate` of ten scans within its tolerance, with a warning."""
    report = calibration()
    return report.first, calibration_report(report, dataset="scans")


def verify() -> Made:
    """`verify` on scans of which some were used before."""
    poses = tuple(PoseError(o.id, 0.1 + 0.01 * k, 0.02, k < 3) for k, o in enumerate(OBSERVATIONS))
    report = VerifyReport(
        result=RESULT,
        correction=None,
        observations=tuple(OBSERVATIONS),
        fits={},
        poses=poses,
        refused=(("p99", "Empty."),),
        warnings=("Take new scans.",),
        hashes={},
        out=OUT,
        limit_mm=0.4,
        source="given",
        concerns=("Something.",),
    )
    return report.first, verify_report(report, dataset="others")


def motion() -> Made:
    """`calibrate` of a recording in motion."""
    n = 30
    rng = np.random.default_rng(0)
    values = 1e-4 * np.abs(rng.standard_normal((6, n)))
    p_C = np.array([o.p_CR for o in make_observations(n, 1)])
    estimate = SimpleNamespace(
        X_BC=RESULT.X_BC,
        clock=ScannerClock(
            kind="arrival", offset_s=0.03, sigma_s=1e-4, jitter_s=1e-3, reference_s=0.0, reason="There is no other."
        ),
        start=SimpleNamespace(delays=np.linspace(0.0, 0.1, 20), rms_m=1e-3 * np.ones(20), delay_s=0.03),
        inliers=np.ones(n, bool),
        capture=np.linspace(0.0, 3.0, n),
        residual_m=values[0],
        along_m=values[1],
        before_m=values[2],
        held_out_m=values[3],
    )
    frames = ObservedFrames(
        ids=tuple(map(str, range(n))),
        arrival=np.linspace(0.0, 3.0, n),
        device=None,
        p_C=p_C,
        n_C=np.tile([0.0, 0.0, 1.0], (n, 1)),
        covariance=np.tile(1e-9 * np.eye(3), (n, 1, 1)),
        normal_sigma=1e-3 * np.ones(n),
    )
    report = MotionReport(
        result=RESULT,
        estimate=cast(Any, estimate),
        frames=frames,
        refused=(("31", "No flange."),),
        outliers=(),
        seconds=1.0,
        out=OUT,
    )
    return report.first, motion_report(report, "Calibration in motion of moving")


def monitor() -> Made:
    """`monitor` that found a move."""
    n = 60
    rng = np.random.default_rng(0)
    event = DriftEvent(
        kind=MOVED,
        time_s=2.0,
        time_sigma_s=0.05,
        found_s=2.3,
        translation_m=np.array([1e-3, 0.0, 0.0]),
        rotation_rad=np.zeros(3),
        covariance=COVARIANCE,
        X_BC_after=X,
        model="translation",
        statistic=80.0,
        threshold=30.0,
        cause="the scanner or the base has moved",
    )
    clock = SimpleNamespace(
        clock=SimpleNamespace(kind="arrival"), delay_s=0.1, sigma_s=1e-3, jitter_s=1e-3, source="recording"
    )
    watched = SimpleNamespace(
        ids=tuple(map(str, range(n))),
        rows=SimpleNamespace(times=np.linspace(0.0, 4.0, n)),
        residuals=1e-4 * rng.standard_normal((n, 3)),
        tilts=1e-4 * rng.standard_normal((n, 2)),
        before=1e-3 * rng.standard_normal((n, 3)),
        offsets=1e-3 * rng.standard_normal(n),
        gross=np.zeros(n, bool),
        statistic=np.linspace(1.0, 80.0, n),
        threshold=30.0,
        events=(event,),
        X_BC=X,
        covariance=COVARIANCE,
        since_s=2.0,
        clock=clock,
        noise=SimpleNamespace(jitter_s=1e-3),
        dropped=(("q", "No flange: 3"),),
        rms_m=2e-4,
        rms_after_m=1e-4,
    )
    report = MonitorReport(
        watched=cast(Any, watched),
        calibration=RESULT,
        recalibrated=None,
        cause=event.cause,
        false_alarms_per_hour=1e-3,
        warnings=(),
        seconds=1.0,
        out=OUT,
    )
    return report.first, monitor_page(report, recording="moving")


def _hand_eye() -> Any:
    F, G, *_ = eye_in_hand(12, np.random.default_rng(2), 1e-4, 1e-4)
    mounting = get_mounting("eye_in_hand")
    return solve_problem(
        full_problem(F, G, free=(True, True, False)),
        config=HandEyeConfig(),
        equation=mounting.equation,
        labels=mounting.labels,
    )


def hand_eye() -> Made:
    """`hand-eye ax-yb` without a tolerance."""
    comparison = (MethodRow("weldcal", 0.01, 0.1), MethodRow("TSAI", float("nan"), float("nan")))
    mounting = get_mounting("eye_in_hand")
    report = HandEyeReport(
        result=_hand_eye(),
        mounting=mounting,
        comparison=comparison,
        next_pose=None,
        files=(),
        seconds=0.1,
        advice="Like sample 3, turned.",
        folder=OUT,
    )
    return report.first, hand_eye_report(report, "samples.npz", "ab" * 32)


def _run(name: str, **job: Any) -> Any:
    """A finished run of a scenario that was not run."""
    scenario = load_scenario(name)
    timing: dict[str, object] = {"simulated_seconds": 10.0, "wall_seconds": 5.0, "real_time_factor": 2.0}
    context = SimpleNamespace(get_time=lambda: 10.0)
    cell = SimpleNamespace(scenario=scenario, job=SimpleNamespace(**job))
    return SimpleNamespace(
        cell=cell,
        root=context,
        held=False,
        ended_by_operator=False,
        reason=None,
        clock=None,
        seconds=10.0,
        wall_seconds=5.0,
        phases=[("start", 0.0, 0.0), ("scan_pose", 1.0, 0.5), ("done", 9.0, 4.5)],
        timing=lambda: timing,
    )


def mounting() -> Made:
    """a live mounting, without ground truth."""
    world = mounted_world("eye_in_hand", 0, scans=9)
    status = CarriedCalibration(
        seen=tuple(world.seen),
        refused=(("pose3", "No circle."),),
        result=solve_mounting(world.scene, world.seen, folds=5),
        sigma_work_m=2e-5,
        error_95_m=4e-5,
        history=((4, 4e-5), (9, 2e-5)),
        held_out=(VerificationResult("pose9", 1e-4, 1e-3),),
    )
    run = _run("eye_in_hand", truth={})
    run.cell.station = SimpleNamespace(truth=SimpleNamespace(scanner=None))
    report = MountingReport(
        scene=world.scene,
        status=status,
        folder=OUT,
        seconds=5.0,
        limit=(run.cell.scenario.calibration.required_error_mm, "calibration.required_error_mm"),
        description="A cell.",
        source=("scenario.yaml", ""),
        run=run,
    )
    return report.first, mounting_report(report, None)


def _demo(estimate: Any, *, held: bool, begun: bool = True) -> Made:
    sequencer = SimpleNamespace(
        GetMyContextFromRoot=lambda root: root, state_in=lambda context: SimpleNamespace(warnings=("A remark.",))
    )
    run = _run("calibrate_only", sequencer=sequencer, drift=lambda root: None, planned_seam=lambda root: PlannedSeam())
    if held:
        run.held, run.reason = True, "The tag was lost."
    if not begun:
        run.phases = []
    status = CalibrationStatus(
        sequence=11,
        calibration_scans=10,
        observations=tuple(OBSERVATIONS),
        refused=(("p77", "No ring."),),
        estimate=estimate,
        predicted_error_m=9e-5,
        history=((4, 3e-4, 1e-4), (10, 9e-5, 5e-5)),
        verifications=(VerificationResult("pose11", 1e-4, 1e-3),),
    )
    result = DemoResult(
        options=RunOptions(scenario="calibrate_only", out=OUT), run=run, status=status, calibration=None, weld=None
    )
    return result.first, demo_report(result, demo_pictures(result), recording=True)


def demo() -> Made:
    """`demo` that calibrated."""
    return _demo(ESTIMATE, held=False)


def held() -> Made:
    """`demo` that was held before it had a pose."""
    return _demo(None, held=True)


def unbegun() -> Made:
    """`demo` that the operator ended before its first phase."""
    return _demo(None, held=True, begun=False)


RECORD = ProfilerRecord(
    method="sphere, affine",
    rotation=X.rotation().matrix(),
    translation=np.array([0.03, -0.07, 0.16]),
    covariance=COVARIANCE,
)


def profiler() -> Made:
    """`profiler sphere` with a tolerance that it misses."""
    points = np.random.default_rng(0).uniform([-0.02, 0.15], [0.02, 0.2], (100, 2))
    found = {"scans": 20, "model": "affine", "rms_mm": 0.05, "without_sphere": [3], "warnings": ["Check the radius."]}
    made = ProfilerFile(
        record=RECORD,
        found=found,
        points=points,
        held_out_mm=np.linspace(0.1, 0.4, 19),
        source="sphere.npz",
        out=OUT,
        limit_mm=0.2,
    )
    return made.first, profiler_report(made)


def seam() -> Made:
    """`profiler seam`."""
    found = {"scans": 20, "found": 19, "without_groove": [4], "rms_mm": 0.05, "error_95_mm": 0.12, "method": "sphere"}
    made = ProfilerSeam(
        record=RECORD,
        found=found,
        root_mm=np.random.default_rng(0).uniform(0.0, 100.0, (19, 3)),
        source="groove.npz",
        calibration=OUT,
        out=OUT,
    )
    return made.first, seam_report(made)


def bead() -> Made:
    """`profiler bead`."""
    values = np.array([0.012, 0.0035, 34e-6]) * np.linspace(1.0, 1.05, 9)[:, None]
    course = bead_course(values, 0.002 * values, np.arange(9))
    names = ("mean", "smallest", "smallest_at", "largest", "largest_at", "sigma", "left_out_rms")
    spread = dict(zip(names, (12.0, 11.8, 3.0, 12.2, 5.0, 0.04, 0.05), strict=True))
    found = {"scans": 10, "found": 9, "without_bead": [9], **dict.fromkeys(BEAD, spread), "unlike_profiles": [4]}
    made = ProfilerBead(record=None, found=found, course=course, source="bead.npz", out=OUT)
    return made.first, made.page


def profiler_live() -> Made:
    """`profiler live` of an edge."""
    estimate = SimpleNamespace(rotation=RECORD.rotation, translation=RECORD.translation, covariance=COVARIANCE)
    edge = SimpleNamespace(estimate=estimate, held_out_mm=np.array([0.1, 0.2, 0.1, 0.3, 0.2]), lost=0)
    estimate.inliers, estimate.reduced_chi2 = np.ones(5, bool), 1.0
    scans = tuple(SimpleNamespace(points=np.array([[0.0, 0.2], [0.01, 0.2]])) for _ in range(5))
    state = SimpleNamespace(
        edge=edge, sphere=None, seam=None, edge_scans=scans, sphere_scans=(), seam_scans=(), touches=()
    )
    run = _run("profiler_edge", state=lambda root: state)
    outcome = LiveOutcome(
        edge=PoseOutcome(0.1, 0.01, 0.1, 0.01, np.ones(6), 6.0),
        sphere=None,
        tip_mm=None,
        center_mm=None,
        points=None,
        curve=None,
        torch=None,
    )
    live = ProfilerLive(RunOptions(scenario="profiler_edge", out=OUT), run, outcome)
    page = live_report(live.summary(), outcome, cast(Any, state), run, first=live.first, recording=False)
    return live.first, page


def tablet() -> Made:
    """`tablet calibrate` with poses of the wrist."""
    n = 9
    covariance = COVARIANCE.tolist()
    result = TabletResult(
        model="wrist",
        parameters={"x": 0.1},
        covariance=covariance,
        residual_mm=[0.1] * n,
        leave_one_out_mm=[0.2 + 0.01 * k for k in range(n)],
        X_FC=X,
        X_FC_covariance=covariance,
        p_FP_m=[0.0, 0.0, 0.15],
        p_FP_covariance=(1e-9 * np.eye(3)).tolist(),
        data_sha256={"touches.csv": "ab" * 32},
    )
    grid = 0.05 * np.array([(i, j) for i in range(3) for j in range(3)], dtype=float)
    shown = Shown(grid, 1e-4 * random_poses(n, np.random.default_rng(1))[:, :2, 3], tuple(map(str, range(n))))
    first = tablet_screen(result, np.zeros(0), 0.5, NO_TOLERANCE)
    return first, tablet_report(result, shown, first, 0.1)


def camera_estimate() -> CameraEstimate:
    """A camera from pictures of a board that is nowhere quite flat, one picture without it."""
    world = seen(0, MadeBoard(arm="each", n=8))
    shots = [Picture(name=f"{k}.png", points=uv, size=SIZE, thumbnail=b"") for k, uv in enumerate(world.img)]
    lost = replace(shots[0], name="lost.png", why="The board was not found.")
    return camera_of([*shots, lost], parse_board("chessboard:9x6:20"))


def camera() -> Made:
    """`camera`."""
    from weldcal.tools.commands.camera import camera_page, camera_screen

    found = camera_estimate()
    first = camera_screen(found, Path("camera.yaml"))
    return first, camera_page(found, first, Path("pictures"))


def finger() -> Made:
    """`finger calibrate` with touches."""
    from weldcal.tools.commands.cell.finger import FingerReport, finger_page
    from weldcal.welding.finger.calibration import TipCalibration

    tip = TipCalibration(
        scale=1.0,
        scale_sigma=1e-3,
        rotation_deg=None,
        seat_m=np.array([0.0, 1e-4, np.nan]),
        stiffness_N_per_m={"x": 900.0},
        held_out_m=2e-5,
        unknown=("pressed along x only",),
    )
    report = FingerReport(
        camera=camera_estimate(), tip=tip, tag_size_mm=10.0, tag_at_rest_mm=(0.0, 1.0, 30.0), touches=8, limit_mm=0.05
    )
    return report.first, finger_page(report, Path("pictures"))


PAGES: dict[str, Callable[[], Made]] = {
    made.__name__: made
    for made in (
        calibrate,
        verify,
        motion,
        monitor,
        hand_eye,
        mounting,
        demo,
        held,
        unbegun,
        profiler,
        seam,
        bead,
        profiler_live,
        tablet,
        camera,
        finger,
    )
}
