"""weldcal tablet demo: runs the tablet job, writes its files, calibrates from them and compares with the truth."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.tablet.detection import find_landmarks
from weldcal.calibration.tablet.plane_pose import plane_depth
from weldcal.calibration.tablet.wrist.fit import WristFit, measured_point
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.arrays import Array
from weldcal.systems.jobs.tablet.job import AddedVisit
from weldcal.systems.runner import Progress, Run
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import LIVE, Call, Outcome, RecordOption, ScenarioOption, command
from weldcal.tools.commands.run import run_job, run_options
from weldcal.tools.commands.tablet.calibrate import TabletCalibration, VisitFiles, calibrate_tablet
from weldcal.tools.report.first_screen import FirstScreen
from weldcal.tools.report.render import mappings_csv, write_atomic
from weldcal.tools.report.run import RunOptions, run_document
from weldcal.tools.report.tablet import NO_KEY, run_screen, visit_report

MOST_LEAN_RAD = 0.15  # tilt of the pen at the unseen points
UNSEEN = 50  # points of the tablet that are neither landmarks nor touched


@command(
    "tablet demo", short_help="Run the tablet calibration in a scenario.", options=LIVE, defaults={"browser": False}
)
def tablet_demo(call: Call, scenario: ScenarioOption = "tablet", record: RecordOption = False) -> Outcome:
    """Run the tablet calibration: look, touch each landmark, calibrate, compare with the truth."""
    options = run_options(call, "tablet", scenario, recording=record)
    found = run_tablet_demo(load_scenario(scenario), options, call.progress)
    return Outcome(found.summary(), first=found.first)


@dataclass(frozen=True, eq=False)
class TabletDemo:
    """The result of a tablet run; `found` are values of its JSON object."""

    options: RunOptions
    run: Run[AddedVisit]
    robot: str
    found: dict[str, object] = field(default_factory=dict)
    calibration: TabletCalibration | None = None

    @property
    def folder(self) -> Path:
        """The result folder."""
        return self.options.out

    @property
    def first(self) -> FirstScreen:
        """The first screen."""
        made = None if self.calibration is None else replace(self.calibration, no_tolerance=NO_KEY).first
        return run_screen(made, self.run.reason or "", self.found, self.run.ended_by_operator)

    def summary(self) -> dict[str, object]:
        """Return the JSON object of `tablet demo`."""
        said = run_document(self.run, self.options, self.robot)
        touches = len(self.run.cell.job.state(self.run.root).touches)
        return {**said, "n_touches": touches, **self.found, **self.run.timing()}


def run_tablet_demo(scenario: Scenario, options: RunOptions, progress: Progress) -> TabletDemo:
    """Run the job, write its files, the calibration from them and a report.

    Raises:
        InputError, RobotRefused: the scenario or the options cannot be run; nothing has been written or moved.
        LandmarksNotFound: the picture does not show the page. A held run also returns a result.
    """
    finished = run_job(scenario, options, progress, "tablet")
    run = finished.run
    progress("calibrate and write", finished.share(0.96))
    options.out.mkdir(parents=True, exist_ok=True)
    demo = TabletDemo(options, run, finished.robot)
    if not run.held:
        calibration, found = calibrate_visit(run, options)
        demo = TabletDemo(options, run, finished.robot, found, calibration)
    finished.write_recording(options.out)
    done = demo.calibration
    result, shown = (None, None) if done is None else (done.result, done.shown)
    page = visit_report(run, demo.summary(), result, shown, first=demo.first, recording=finished.meshcat is not None)
    write_atomic(options.out / "report.html", page)
    return demo


def calibrate_visit(run: Run[AddedVisit], options: RunOptions) -> tuple[TabletCalibration, dict[str, object]]:
    """Write the run's files, calibrate from them as `tablet calibrate` does, and compare with the truth."""
    folder, tablet = options.out, run.cell.job.tablet
    write_visit(run, folder)
    done = calibrate_tablet(
        VisitFiles(
            file=folder / "touches.csv",
            poses=folder / "poses.csv",
            camera=folder / "camera.yaml",
            image=folder / "picture.png",
            pen_radius_m=1e-3 * tablet.pen.radius_mm,
        ),
        folder,
    )
    if not isinstance(done, TabletCalibration) or done.wrist is None:
        raise RuntimeError("the files of a tablet run must contain full poses")
    uv = find_landmarks(run.cell.job.picture(run.root).grey, tablet.columns, tablet.rows)
    told, summary = ("leave_one_out_mm", "parameters", "X_FC", "p_FP_mm", "unobservable", "warnings"), done.summary()
    compared = {**compare(run, done.wrist, options.seed), **depth_error(run, uv)}
    return done, {**compared, **{key: summary[key] for key in told}}


def compare(run: Run[AddedVisit], fit: WristFit, seed: int) -> dict[str, object]:
    """Errors of the fit against the ground truth: camera, pen, and touches of points not used in the fit.

    An unseen touch: the camera observes a point of the tablet from the pose of the picture, and the flange moves to
    where the fit predicts that the pen touches it, with any rotation and no more tilt than the run's touches. The error
    is the true pen's distance from the point, in the tablet's plane.
    """
    job = run.cell.job
    lean = min(MOST_LEAN_RAD, float(np.deg2rad(job.tablet.tilt_deg)))
    truth, rng = job.truth, np.random.default_rng([seed, 1])
    X_BF = forward_kinematics(run.cell.station.arm, job.state(run.root).q_look)
    points = rng.uniform([0.0, 0.0], job.tablet.landmarks_m().max(axis=0), (UNSEEN, 2))
    R_T = truth.X_BT.rotation().matrix()[:, :2]
    misses = []
    for p in points:
        p_B = truth.X_BT.multiply(np.r_[p, 0.0])
        p_C = (X_BF @ truth.X_FC).inverse().multiply(p_B)
        R = RollPitchYaw(
            np.pi + rng.uniform(-lean, lean), rng.uniform(-lean, lean), rng.uniform(-np.pi, np.pi)
        ).ToRotationMatrix()
        tip = measured_point(fit, X_BF, p_C[:2] / p_C[2]) + R.multiply(truth.p_FP - fit.p_FP)
        misses.append(1e3 * float(np.linalg.norm(R_T.T @ (tip - p_B))))
    turn = (fit.X_FC.rotation().inverse() @ truth.X_FC.rotation()).ToAngleAxis().angle()
    return {
        "X_FC_error_mm": 1e3 * float(np.linalg.norm(fit.X_FC.translation() - truth.X_FC.translation())),
        "X_FC_error_deg": float(np.degrees(abs(turn))),
        "pen_error_mm": 1e3 * float(np.linalg.norm(fit.p_FP - truth.p_FP)),
        "unseen_touch_mm": {"mean": float(np.mean(misses)), "max": float(np.max(misses))},
    }


def depth_error(run: Run[AddedVisit], uv: Array) -> dict[str, object]:
    """Compute depth errors (rms) of the landmarks, apart from scale: from the page's plane, and from pixels."""
    job = run.cell.job
    K, truth, depth_m = job.camera.camera_matrix(), job.truth, job.picture(run.root).depth_m
    X_CT = (forward_kinematics(run.cell.station.arm, job.state(run.root).q_look) @ truth.X_FC).inverse() @ truth.X_BT
    page = job.tablet.landmarks_m()
    true = job.camera.depth_scale * X_CT.multiply(np.c_[page, np.zeros(len(page))].T)[2]
    by_plane = plane_depth(depth_m, uv, K[[0, 1], [0, 1]], K[:2, 2])
    u, v = np.round(uv).astype(int).T
    by_pixel = depth_m[v, u]
    return {
        "depth_by_plane_mm": 1e3 * float(np.sqrt(((by_plane - true) ** 2).mean())),
        "depth_by_pixel_mm": 1e3 * float(np.sqrt(((by_pixel - true) ** 2).mean())),
    }


def write_visit(run: Run[AddedVisit], folder: Path) -> None:
    """Write the four files, each atomically."""
    job, arm = run.cell.job, run.cell.station.arm
    tablet, state = job.tablet, job.state(run.root)
    shown = 1e3 * tablet.px_per_mm * tablet.landmarks_m()
    touches = [
        {
            "landmark": t.landmark,
            "landmark_x_px": f"{shown[t.landmark, 0]:.4f}",
            "landmark_y_px": f"{shown[t.landmark, 1]:.4f}",
            "touch_x_px": f"{t.position_px[0]:.1f}",
            "touch_y_px": f"{t.position_px[1]:.1f}",
            "mm_per_px": f"{1.0 / tablet.px_per_mm:.9f}",
            "size_checked": 1,
            "pointer": "pen",
        }
        for t in state.touches
    ]
    poses = [_pose_row(str(t.landmark), forward_kinematics(arm, t.q)) for t in state.touches]
    poses.append(_pose_row("camera", forward_kinematics(arm, state.q_look)))
    K = job.camera.camera_matrix()
    intrinsics = {"fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    write_atomic(folder / "touches.csv", mappings_csv(touches))
    write_atomic(folder / "poses.csv", mappings_csv(poses))
    write_atomic(folder / "camera.yaml", yaml_dump(intrinsics))
    write_atomic(folder / "picture.png", cv2.imencode(".png", job.picture(run.root).grey)[1].tobytes())


def _pose_row(name: str, X: RigidTransform) -> dict[str, object]:
    values = (*X.translation(), *X.rotation().ToQuaternion().wxyz())
    return {
        "landmark": name,
        **{c: f"{v:.9f}" for c, v in zip(("x", "y", "z", "qw", "qx", "qy", "qz"), values, strict=True)},
    }
