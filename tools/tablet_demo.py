"""weldcal tablet demo: the whole procedure in simulation, as files that weldcal tablet calibrate reads, held against the truth."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_dump
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.tablet.detection import find_landmarks
from weldcal.calibration.tablet.plane_depth import plane_depth
from weldcal.calibration.tablet.wrist import WristFit, fit_wrist, seen_point
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.systems.tablet_cell import TabletCell, TabletVisit, make_tablet_cell, run_tablet_cell, wrist_touches
from weldcal.systems.tablet_scenario import landmarks_m, load_tablet_scenario
from weldcal.tools.console import Progress
from weldcal.tools.report.render import write_atomic
from weldcal.tools.tablet_calibrate import TabletInputs, calibrate_tablet

Array = NDArray[np.float64]
UNSEEN = 50  # points of the tablet that are neither landmarks nor touched


def run_tablet_demo(
    scenario: Path | None, folder: Path, seed: int, progress: Progress, *, record: bool = False
) -> dict[str, object]:
    """Run the cell, write its files and the calibration from them; returns the summary for JSON.

    ``record`` also writes recording.html, the run in 3D.

    Raises InputError (the scenario), LandmarksNotFound (the picture); a procedure that was held is a summary too.
    """
    start = time.monotonic()
    progress("build", 0.0)
    meshcat = Meshcat(MeshcatParams(host="localhost", port=None)) if record else None
    cell = make_tablet_cell(load_tablet_scenario(scenario), seed, meshcat)
    progress("look and touch", 0.1)
    visit = run_tablet_cell(cell, meshcat)
    if meshcat is not None:
        write_atomic(folder / "recording.html", meshcat.StaticHtml())
    if visit.state.phase != "done":
        reason = visit.state.reason or "The procedure did not end in time; allow more with maximum_time_s."
        return {
            "state": "held",
            "reason": reason,
            "n_touches": len(visit.state.touches),
            "simulated_seconds": visit.seconds,
        }
    progress("calibrate", 0.95)
    write_visit(cell, visit, folder)
    pen_radius = 1e-3 * cell.scenario.rig.pen_radius_mm
    found = calibrate_tablet(
        TabletInputs(
            folder / "touches.csv",
            folder / "poses.csv",
            folder / "camera.yaml",
            folder / "picture.png",
            pen_radius_m=pen_radius,
        ),
        folder,
    )
    tablet = cell.scenario.tablet
    uv = find_landmarks(visit.picture.grey, tablet.columns, tablet.rows)
    fit = fit_wrist(wrist_touches(cell, visit, uv), leave_one_out=False)
    return {
        "state": "done",
        "n_touches": len(visit.state.touches),
        **compare(cell, visit, fit, seed),
        **depth_error(cell, visit, uv),
        "leave_one_out_mm": found["leave_one_out_mm"],
        "parameters": found["parameters"],
        "unobservable": found["unobservable"],
        "simulated_seconds": visit.seconds,
        "wall_seconds": time.monotonic() - start,
    }


def compare(cell: TabletCell, visit: TabletVisit, fit: WristFit, seed: int) -> dict[str, object]:
    """The fit against the truth that only the simulation knows: camera, pen, and touches of points never seen before.

    An unseen touch: the camera sees a point of the tablet from where the picture was taken, the hand is sent to where the
    fit puts the pen on it, in any turn; what counts is where the true pen then is, in the tablet's plane.
    """
    truth, rng = cell.truth, np.random.default_rng([seed, 1])
    X_BF = forward_kinematics(cell.arm, visit.state.q_look)
    points = rng.uniform([0.0, 0.0], landmarks_m(cell.scenario.tablet).max(axis=0), (UNSEEN, 2))
    R_T = truth.X_BT.rotation().matrix()[:, :2]
    misses = []
    for p in points:
        p_B = truth.X_BT.multiply(np.r_[p, 0.0])
        p_C = (X_BF @ truth.X_FC).inverse().multiply(p_B)
        R = RollPitchYaw(
            np.pi + rng.uniform(-0.15, 0.15), rng.uniform(-0.15, 0.15), rng.uniform(-np.pi, np.pi)
        ).ToRotationMatrix()
        tip = seen_point(fit, X_BF, p_C[:2] / p_C[2]) + R.multiply(truth.p_FP - fit.p_FP)
        misses.append(1e3 * float(np.linalg.norm(R_T.T @ (tip - p_B))))
    turn = (fit.X_FC.rotation().inverse() @ truth.X_FC.rotation()).ToAngleAxis().angle()
    return {
        "X_FC_error_mm": 1e3 * float(np.linalg.norm(fit.X_FC.translation() - truth.X_FC.translation())),
        "X_FC_error_deg": float(np.degrees(abs(turn))),
        "pen_error_mm": 1e3 * float(np.linalg.norm(fit.p_FP - truth.p_FP)),
        "unseen_touch_mm": {"mean": float(np.mean(misses)), "max": float(np.max(misses))},
    }


def depth_error(cell: TabletCell, visit: TabletVisit, uv: Array) -> dict[str, object]:
    """Depth of the landmarks off the truth, scale apart: by the tablet's plane, and by each landmark's own pixel (rms)."""
    K, truth = cell.camera_matrix, cell.truth
    X_CT = (forward_kinematics(cell.arm, visit.state.q_look) @ truth.X_FC).inverse() @ truth.X_BT
    page = landmarks_m(cell.scenario.tablet)
    true = cell.scenario.rig.depth_scale * X_CT.multiply(np.c_[page, np.zeros(len(page))].T)[2]
    by_plane = plane_depth(visit.picture.depth_m, uv, K[[0, 1], [0, 1]], K[:2, 2])
    u, v = np.round(uv).astype(int).T
    by_pixel = visit.picture.depth_m[v, u]
    return {
        "depth_by_plane_mm": 1e3 * float(np.sqrt(((by_plane - true) ** 2).mean())),
        "depth_by_pixel_mm": 1e3 * float(np.sqrt(((by_pixel - true) ** 2).mean())),
    }


def write_visit(cell: TabletCell, visit: TabletVisit, folder: Path) -> None:
    """Write touches.csv as the page does, poses.csv, camera.yaml and picture.png."""
    tablet, state = cell.scenario.tablet, visit.state
    shown = 1e3 * tablet.px_per_mm * landmarks_m(tablet)
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
    poses = [_pose_row(str(t.landmark), forward_kinematics(cell.arm, t.q)) for t in state.touches]
    poses.append(_pose_row("camera", forward_kinematics(cell.arm, state.q_look)))
    K = cell.camera_matrix
    intrinsics = {"fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    write_atomic(folder / "touches.csv", _csv(touches))
    write_atomic(folder / "poses.csv", _csv(poses))
    write_atomic(folder / "camera.yaml", yaml_dump(intrinsics))
    write_atomic(folder / "picture.png", cv2.imencode(".png", visit.picture.grey)[1].tobytes())


def _pose_row(name: str, X: RigidTransform) -> dict[str, object]:
    values = (*X.translation(), *X.rotation().ToQuaternion().wxyz())
    return {
        "landmark": name,
        **{c: f"{v:.9f}" for c, v in zip(("x", "y", "z", "qw", "qx", "qy", "qz"), values, strict=True)},
    }


def _csv(rows: Sequence[Mapping[str, object]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
