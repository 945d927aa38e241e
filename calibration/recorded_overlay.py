"""Compare a recorded scan with the shape of the robot: the distance of each point from its surface, in the base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.checks import IN_HAND, read_header
from weldcal.calibration.data.dataset import joint_angles, load_dataset
from weldcal.calibration.data.motion_dataset import MotionDataset, load_motion_dataset
from weldcal.calibration.data.results import ON_BASE, RESULT_FILE
from weldcal.calibration.data.scanner_correction import clock_from_document, correction_from_document
from weldcal.calibration.data.stated_pose import HAND_EYE_FILE, read_stated_pose
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arms.chain import is_urdf, load_chain
from weldcal.models.arms.kinematics import forward_kinematics, known_arms, load_arm
from weldcal.models.arms.shape import BodyShape, arm_shape, urdf_shape
from weldcal.models.arrays import Array
from weldcal.models.documents import did_you_mean, read_document
from weldcal.models.errors import InputError
from weldcal.models.flanges import flange_mesh
from weldcal.models.robots import get_robot, stated_flange

BAND_M = 0.02  # a choice, twice what a calibration by a tape measure leaves
"""A point so near to the robot's surface belongs to the robot."""
_SCALES_MM = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 1e3 * BAND_M)  # a choice: read at once
_FACE = 0.97  # of the flange's radius, a choice: farther out a point may be of what stands behind it
_SAME_M = 5e-3  # a factory calibration moves the flange by no more
_NO_JOINTS = "The scans have no joint angles (q1, q2 ...)"


@dataclass(frozen=True, eq=False, kw_only=True)
class Overlay:
    """A scan in the base beside the robot.

    Attributes:
        scan: its id.
        X_BC: pose of the scanner when it was taken.
        points_B: its measured points (N, 3) m in the base.
        distance: (N,) m from the nearest body, negative inside a closed mesh; NaN where it is above BAND_M.
        body: (N,) index of that body, -1 for none.
        bodies: the links, the flange, and the target of a scanner on the flange.
        note: a sentence for the user on what is compared.
    """

    scan: str
    X_BC: RigidTransform
    points_B: Array
    distance: Array
    body: NDArray[np.intp]
    bodies: Sequence[BodyShape]
    note: str = ""

    @property
    def scale_mm(self) -> float:
        """The end of a scale of colours: 95 % of the distances lie within."""
        return next(s for s in _SCALES_MM if s >= min(self.rows["robot"]["p95_mm"], _SCALES_MM[-1]))

    @cached_property
    def rows(self) -> dict[str, dict[str, float]]:
        """Statistics of all bodies ("robot") and of each: points, median and 95 % of |distance|, signed median; mm."""
        found = {}
        masks = {"robot": self.body >= 0} | {body.name: self.body == k for k, body in enumerate(self.bodies)}
        for name, mm in ((name, 1e3 * self.distance[mask]) for name, mask in masks.items() if mask.any()):
            values = (len(mm), *np.percentile(np.abs(mm), [50, 95]).tolist(), float(np.median(mm)))
            found[name] = dict(zip(("points", "median_mm", "p95_mm", "signed_mm"), values, strict=True))
        return found


def compare(points_B: Array, bodies: Sequence[BodyShape]) -> tuple[Array, NDArray[np.intp]]:
    """Distance (N,) m of points (N, 3) m of B from the nearest body, NaN above BAND_M, and its index, -1 for none.

    Where bodies overlap, the surface is that of their union.
    """
    every = np.array([body.distances(points_B, BAND_M) for body in bodies])
    near = np.abs(every.min(axis=0)) <= BAND_M
    return np.where(near, every.min(axis=0), np.nan), np.where(near, np.argmin(every, axis=0), -1)


def overlay(result: Path, dataset: Path, scan: str | None = None, robot: str | None = None) -> Overlay:
    """Compare a scan (by its id; None: the first) of a dataset or a recording in motion with the robot's shape.

    ``result`` has X_BC, or X_FC of a scanner on the flange. ``robot`` is a known arm or a URDF file, in place of the
    dataset's. Without joint angles or the shape of the links, only the flange is compared; a note says so.

    Raises:
        InputError: a file cannot be used, no such scan, or no point of it belongs to the robot.
    """
    file = result / RESULT_FILE if result.is_dir() else result
    if not file.is_file() and not (result / HAND_EYE_FILE).is_file():
        raise InputError(
            f"There is no calibration in '{result}': run 'weldcal calibrate {dataset} --out {result}' first."
        )
    given, own = read_stated_pose(result), read_document(file) if file.name == RESULT_FILE and file.is_file() else {}
    X, header = as_transform(given.readings[0].X), dataset / "dataset.yaml"
    moving = header.is_file() and read_header(header).mode == "motion"
    data = load_motion_dataset(dataset, robot=robot) if moving else load_dataset(dataset, carried=True)
    if data.header.configuration not in {given.mounting or ON_BASE} & {ON_BASE, IN_HAND}:
        mountings = f"of {data.header.configuration}, and '{result}' is of {given.mounting or ON_BASE}"
        raise InputError(f"'{dataset.name}' has scans {mountings}: give the result of this dataset.")
    if (id := scan or next(iter(data.clouds), "")) not in data.clouds:
        listed = f"it has {', '.join(list(data.clouds)[:8])}{' ...' if len(data.clouds) > 8 else ''}."
        raise InputError(f"'{dataset.name}' has no scan '{id}': {did_you_mean(id, data.clouds, listed)}")
    name = robot or data.header.robot or str(own.get("robot") or "")
    name = name if is_urdf(name) else get_robot(name).name
    kinematics = file.parent / own["kinematics_file"] if own.get("kinematics_file") else None
    if isinstance(data, MotionDataset):
        X_BF, q = _in_motion(data, id, own)
    else:
        angles = joint_angles(data, [id], load_chain(name).n)
        X_BF, q = data.poses[id], None if angles is None else angles[0]
    if q is None and robot is not None:
        raise InputError(f"{_NO_JOINTS}, by which --robot places the links: add them, or omit --robot.")
    reached = X_BF if q is None else forward_kinematics(load_chain(name, kinematics), q)
    if (off := float(np.linalg.norm(reached.translation() - X_BF.translation()))) > _SAME_M:
        raise InputError(
            f"The joint angles of scan '{id}' put the flange of '{Path(name).name}' {1e3 * off:.0f} mm from its"
            " recorded pose: give them in rad, and name the arm that was moved by --robot."
        )
    bodies, note = _links(name, q, kinematics)
    if kinematics is not None:
        X_BF = reached  # as in that calibration
    standard, in_hand = stated_flange(data.header.flange, name), data.header.configuration == IN_HAND
    bodies.append(BodyShape("flange", X_BF if in_hand else X_BF @ data.X_FR, [flange_mesh(standard)]))
    if isinstance(seen := own.get("target"), Mapping):
        X_BT = RigidTransform(RotationMatrix.MakeFromOneVector(np.array(seen["normal"]), 2), seen["xyz"])
        bodies.append(BodyShape("target", X_BT, [flange_mesh(standard, holes=False)]))
    correction, points = correction_from_document(own.get("scanner_correction")), data.cloud(id).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    X_BC = X_BF @ X if in_hand else X
    points_B = X_BC.multiply((points if correction is None else correction.points(points)).T).T
    distance, body = compare(points_B, bodies)
    if q is None:  # the wrist behind the flange has no shape here
        aside = (bodies[0].X_BL.inverse().multiply(points_B.T))[:2]
        other = (body == 0) & (np.linalg.norm(aside, axis=0) > _FACE * 0.5 * standard.outer_m)
        distance[other], body[other] = np.nan, -1
    if (body < 0).all():
        where = f"within {1e3 * BAND_M:.0f} mm of the robot"
        raise InputError(f"No point of scan '{id}' lies {where}: check that '{result}' belongs to '{dataset}'.")
    return Overlay(scan=id, X_BC=X_BC, points_B=points_B, distance=distance, body=body, bodies=bodies, note=note)


def _in_motion(data: MotionDataset, id: str, own: Mapping[str, Any]) -> tuple[RigidTransform, Array | None]:
    """Return X_BF at the capture of a frame by the calibration's clock, and the joint angles then."""
    clock, frame = clock_from_document(own.get("clock"), RESULT_FILE), next(one for one in data.frames if one.id == id)
    time = None if clock is None else clock.capture(frame.arrival, frame.device)
    pose = ContinuousMotion(data.stream).poses(np.array([np.nan if time is None else time]))[0]
    if time is None or not np.isfinite(pose).all():
        raise InputError(
            f"The result states no capture time of scan '{id}': run 'weldcal calibrate {data.folder}' first."
        )
    q = data.stream.joints
    return as_transform(pose), None if q is None else np.array([np.interp(time, data.stream.time, c) for c in q.T])


def _links(name: str, q: Array | None, kinematics: Path | None) -> tuple[list[BodyShape], str]:
    """Return the links of a robot as far as its shape and joints are known, with a sentence on their shape."""
    if q is None:
        return [], f"{_NO_JOINTS}: only the flange's face is compared."
    if is_urdf(name):
        return urdf_shape(Path(name), q), ""
    if name not in known_arms():
        return [], f"The shape of the {name} is not known, so only the flange is compared: give --robot FILE.urdf."
    note = "The links are cylinders of the published radii: give --robot FILE.urdf for the maker's meshes."
    return arm_shape(load_arm(name, kinematics), q), note
