"""Writes a simulated tablet run in the files of a real one: touches.csv, poses.csv, camera.yaml and picture.png."""

from pathlib import Path

import cv2
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform

from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.systems.jobs.tablet.job import AddedVisit
from weldcal.systems.runner import Run
from weldcal.tools.report.files import mappings_csv
from weldcal.tools.report.render import write_atomic


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
