"""Joint angles of a dataset's poses: the columns q1, q2 ... (rad) of poses.csv or pairs.csv."""

from collections.abc import Sequence

import numpy as np

from weldcal.calibration.data.checks import row_numbers, table_rows
from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import log_rotation
from weldcal.calibration.hand_eye.joints import flange_poses
from weldcal.models.arms.chain import Chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

_SAME_M, _SAME_RAD = (
    1e-4,
    float(np.radians(0.01)),
)  # what a controller rounds, and less than a factory calibration changes


def joint_angles(data: Dataset, ids: Sequence[str], joints: int) -> Array | None:
    """Joint angles (n, joints) rad at the poses of these ids; None where poses.csv and pairs.csv have none. Raises DatasetError for bad numbers."""
    path = data.folder / ("pairs.csv" if data.pairs else "poses.csv")
    if not path.is_file():
        return None  # another form of poses
    names = tuple(f"q{i + 1}" for i in range(joints))
    rows = {row["id"]: row for row in table_rows(path, ("id",))}
    if not all(rows.get(id, {}).get(name) for id in ids for name in names):
        return None
    return np.array([row_numbers(rows[id], names, path) for id in ids])


def require_joint_angles(data: Dataset, ids: Sequence[str], arm: Chain, stated: Array) -> Array:
    """Joint angles (n, arm.n) rad that lead the arm to the stated flange poses (n, 4, 4).

    Raises DatasetError without angles, InputError where they lead elsewhere: to another arm, or to one whose controller has a factory
    calibration of its own.
    """
    q = joint_angles(data, ids, arm.n)
    if q is None:
        raise DatasetError(
            f"poses.csv or pairs.csv in '{data.folder.name}' has no joint angles: add the columns q1 to q{arm.n} (radians), or omit --refine."
        )
    reached = flange_poses(arm, q, np.zeros((arm.n, 6)))
    off_m = float(np.linalg.norm(stated[:, :3, 3] - reached[:, :3, 3], axis=1).max())
    turn = log_rotation(np.swapaxes(reached[:, :3, :3], 1, 2) @ stated[:, :3, :3])
    if off_m > _SAME_M or float(np.linalg.norm(turn, axis=1).max()) > _SAME_RAD:
        raise InputError(
            f"The joint angles lead this {arm.name} up to {1e3 * off_m:.2f} mm from the stated poses. A real controller computes with the "
            "factory calibration of its arm: give that file (--kinematics). Else check the robot's name, radians, and that the TCP is zero."
        )
    return q
