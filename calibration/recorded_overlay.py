"""Compare a recorded scan with the shape of the robot: the distance of each point from its surface, in the base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.checks import CONFIGURATIONS, IN_HAND, read_header
from weldcal.calibration.data.dataset import Dataset, joint_angles, load_dataset
from weldcal.calibration.data.motion_dataset import MotionDataset, load_motion_dataset
from weldcal.calibration.data.results import RESULT_FILE
from weldcal.calibration.data.scanner_correction import clock_from_document, correction_from_document
from weldcal.calibration.data.stated_pose import HAND_EYE_FILE, read_stated_pose
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arms.chain import chain_forward, is_urdf, load_chain
from weldcal.models.arms.kinematics import known_arms, load_arm
from weldcal.models.arms.shape import BodyShape, arm_shape, urdf_shape
from weldcal.models.arrays import Array
from weldcal.models.documents import did_you_mean, read_document
from weldcal.models.errors import InputError
from weldcal.models.flanges import flange_mesh
from weldcal.models.robots import get_robot, stated_flange

BAND_M = 0.02
"""A point so near to the robot's surface belongs to the robot: a choice, twice a calibration by a tape measure."""
_NO_JOINTS = "The scans have no joint angles (q1, q2 ...)"
_SCALES_MM = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 1e3 * BAND_M)  # a choice: read at once
_OFF_MM = 1.0  # of the flange by joints from its recorded pose: a choice, above what a factory calibration leaves


@dataclass(frozen=True, eq=False, kw_only=True)
class Overlay:
    """A scan in the base beside the robot.

    Attributes:
        scan: its id.
        X_BC: pose of the scanner when it was taken.
        points_C, points_B: its measured points (N, 3) m, in the camera and in the base.
        distance: (N,) m from the nearest body, negative inside a closed mesh; NaN where it is above BAND_M.
        body: (N,) index of that body, -1 for none.
        bodies: the links, and the flange.
        notes: sentences for the user.
    """

    scan: str
    X_BC: RigidTransform
    points_C: Array
    points_B: Array
    distance: Array
    body: NDArray[np.intp]
    bodies: tuple[BodyShape, ...]
    notes: tuple[str, ...] = ()

    @property
    def on_robot(self) -> NDArray[np.bool_]:
        """(N,) whether a point belongs to the robot."""
        return self.body >= 0

    @property
    def scale_mm(self) -> float:
        """The end of a scale of colours: 95 % of the distances lie within."""
        return next(s for s in _SCALES_MM if s >= min(self.rows["robot"]["p95_mm"], _SCALES_MM[-1]))

    @cached_property
    def rows(self) -> dict[str, dict[str, float]]:
        """Statistics of the whole robot and of each body with points: how many, |distance| and the signed median, mm."""
        chosen = {"robot": self.on_robot} | {body.name: self.body == k for k, body in enumerate(self.bodies)}
        return {name: _row(1e3 * self.distance[mask]) for name, mask in chosen.items() if mask.any()}


def _row(mm: Array) -> dict[str, float]:
    median, p95 = np.percentile(np.abs(mm), [50, 95])
    return {"points": len(mm), "median_mm": float(median), "p95_mm": float(p95), "signed_mm": float(np.median(mm))}


def compare(points_B: Array, bodies: Sequence[BodyShape]) -> tuple[Array, NDArray[np.intp]]:
    """Distance (N,) m of points (N, 3) m of B from the nearest body, NaN above BAND_M, and its index, -1 for none.

    Where bodies overlap, the surface is that of their union.
    """
    every = np.array([body.distances(points_B, BAND_M) for body in bodies])
    body = np.argmin(every, axis=0)
    distance = every[body, np.arange(len(points_B))]
    near = np.abs(distance) <= BAND_M
    return np.where(near, distance, np.nan), np.where(near, body, -1)


def overlay(result: Path, dataset: Path, scan: str | None = None, robot: str | None = None) -> Overlay:
    """Compare a scan (by its id; None: the first) of a dataset or a recording in motion with the robot's shape.

    ``result`` has X_BC, or X_FC of a scanner on the flange. ``robot`` is a known arm or a URDF file, in place of the
    dataset's. Without joint angles or the shape of the links, only the flange is compared; a note says so.

    Raises:
        InputError: a file cannot be used, no such scan, or no point of it belongs to the robot.
    """
    X, in_hand, own = _camera(result, dataset)
    header = dataset / "dataset.yaml"
    moving = header.is_file() and read_header(header).mode == "motion"
    data = load_motion_dataset(dataset, robot=robot) if moving else load_dataset(dataset, carried=True)
    mounting, pose = data.header.configuration, "X_FC" if in_hand else "X_BC"
    if mounting not in CONFIGURATIONS or in_hand != (mounting == IN_HAND):
        raise InputError(f"'{dataset.name}' has scans of {mounting}, and '{result}' holds {pose}: give its own result.")
    if not data.clouds:
        raise InputError(f"'{dataset.name}' has no scans, only centres: give a dataset with clouds/.")
    ids = list(data.clouds)
    id = scan or ids[0]
    if id not in data.clouds:
        listed = f"its scans go from {ids[0]} to {ids[-1]}."
        raise InputError(f"'{dataset.name}' has no scan '{id}': {did_you_mean(id, ids, listed)}")
    name = robot or data.header.robot or str(own.get("robot") or "")
    name = name if is_urdf(name) else get_robot(name).name
    file = own.get("kinematics_file")
    kinematics = (result if result.is_dir() else result.parent) / file if file else None
    X_BF, q = _in_motion(data, id, own) if isinstance(data, MotionDataset) else _at_rest(data, id, name)
    links, notes = _links(name, q, kinematics)
    if q is None and robot is not None:
        raise InputError(f"{_NO_JOINTS}, by which --robot places the links: add them, or omit --robot.")
    if q is not None:
        by_joints = chain_forward(load_chain(name, kinematics), q)
        off = 1e3 * float(np.linalg.norm(by_joints.translation() - X_BF.translation()))
        X_BF = X_BF if kinematics is None else by_joints  # as in that calibration
        if kinematics is None and off > _OFF_MM:
            notes.append(f"The joint angles put the flange {off:.1f} mm from its recorded pose.")
    standard = stated_flange(data.header.flange, name)
    ring = flange_mesh(standard)
    bodies = [*links, BodyShape("flange", X_BF if in_hand else X_BF @ data.X_FR, (ring,))]
    if isinstance(seen := own.get("target"), dict):
        R = RotationMatrix.MakeFromOneVector(np.array(seen["normal"], dtype=float), 2)
        bodies.append(BodyShape("target", RigidTransform(R, seen["xyz"]), (flange_mesh(standard, holes=False),)))
    opened = ", ".join(body.name for body in bodies if not body.closed)
    if opened:
        notes.append(f"The meshes of {opened} are not closed: their distances have no sign.")
    correction = correction_from_document(own.get("scanner_correction"))
    points_C = data.cloud(id).reshape(-1, 3)
    points_C = points_C[np.isfinite(points_C).all(axis=1)]
    points_C = points_C if correction is None else correction.points(points_C)
    X_BC = X_BF @ X if in_hand else X
    points_B = X_BC.multiply(points_C.T).T
    distance, body = compare(points_B, bodies)
    if (body < 0).all():
        raise InputError(
            f"No point of scan '{id}' lies within {1e3 * BAND_M:.0f} mm of the robot: check that '{result}' belongs to"
            " this dataset, or take a scan that shows the robot."
        )
    return Overlay(
        scan=id,
        X_BC=X_BC,
        points_C=points_C,
        points_B=points_B,
        distance=distance,
        body=body,
        bodies=tuple(bodies),
        notes=tuple(notes),
    )


def _camera(result: Path, dataset: Path) -> tuple[RigidTransform, bool, Mapping[str, Any]]:
    """Return the camera's pose, whether it is on the flange, and what calibration.yaml states beside it."""
    files = [result / name for name in (HAND_EYE_FILE, RESULT_FILE)] if result.is_dir() else [result]
    file = next((one for one in files if one.is_file()), None)
    if file is None:
        raise InputError(
            f"There is no calibration in '{result}': run 'weldcal calibrate {dataset} --out {result}' first."
        )
    given = read_stated_pose(file)
    own = read_document(file) if file.name == RESULT_FILE else {}
    own = own if isinstance(own, Mapping) else {}
    return as_transform(given.readings[0].X), given.mounting == IN_HAND, own


def _at_rest(data: Dataset, id: str, name: str) -> tuple[RigidTransform, Array | None]:
    """Return X_BF of a scan at rest, and its joint angles, None where none are recorded."""
    q = joint_angles(data, [id], load_chain(name).n)
    return data.poses[id], None if q is None else q[0]


def _in_motion(data: MotionDataset, id: str, own: Mapping[str, Any]) -> tuple[RigidTransform, Array | None]:
    """Return X_BF at the capture of a frame by the calibration's clock, and the joint angles then."""
    clock = clock_from_document(own.get("clock"), RESULT_FILE)
    frame = next(one for one in data.frames if one.id == id)
    time = None if clock is None else clock.capture(frame.arrival, frame.device)
    pose = ContinuousMotion(data.stream).poses(np.array([np.nan if time is None else time]))[0]
    if time is None or not np.isfinite(pose).all():
        why = "the result states no clock" if time is None else "the robot's stream has no data at its capture"
        raise InputError(f"Where the robot was at scan '{id}' is not known: {why}. Calibrate '{data.folder}' first.")
    q = data.stream.joints
    return as_transform(pose), None if q is None else np.array([np.interp(time, data.stream.time, c) for c in q.T])


def _links(name: str, q: Array | None, kinematics: Path | None) -> tuple[list[BodyShape], list[str]]:
    """Return the links of a robot as far as its shape and joints are known, with a sentence on their shape."""
    if q is None:
        return [], [f"{_NO_JOINTS}: only the flange is compared."]
    if is_urdf(name):
        return urdf_shape(Path(name), q), []
    if name not in known_arms():
        return [], [f"The shape of the {name} is not known, so only the flange is compared: give --robot FILE.urdf."]
    note = "The links are cylinders of the published radii: give --robot FILE.urdf for the maker's meshes."
    return arm_shape(load_arm(name, kinematics), q), [note]
