"""Reads the two lists of poses that hand-eye calibration takes, from a folder or from one file with nodes for both."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.form import PoseList
from weldcal.calibration.data.poses.names import natural, number_of
from weldcal.calibration.data.poses.source import READ, read_poses
from weldcal.calibration.data.poses.storage import nodes, read_tree
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import inverse
from weldcal.models.arrays import Array

_ROBOT = re.compile(
    r"(?i)(^|[^a-z])(a|robot|hand|gripper2base|ee2base|base_gripper|base2gripper|base2ee|flange|tcp|tool|x_bf|pos|pose)"
)
_CAMERA = re.compile(r"(?i)(^|[^a-z])(b|target2cam|cam2target|camera|cam|target|board|marker|object|x_cm|eye)")
_INVERSE = re.compile(r"(?i)base2(gripper|ee|hand|tool|flange)|cam(era)?2(target|board|marker|object)")
_NEAR_S = 0.05  # stamps nearer than this are of one moment


def pairs_of_folder(folder: Path) -> dict[str, Any]:
    """The lists `robot` (n, 4, 4) and `camera` (n, 4, 4), and `unit` where the files fix it, of a folder with a file or files of each.

    Raises:
        DatasetError: one of the lists is missing, or they do not pair.
    """
    lists = {who: _source(folder, pattern) for who, pattern in (("robot", _ROBOT), ("camera", _CAMERA))}
    missing = [who for who, found in lists.items() if not found]
    if missing:
        closed = next((p.name for p in folder.iterdir() if p.suffix.lower() == ".zdf"), None)
        if closed is not None:
            raise DatasetError(
                f"'{folder.name}' holds Zivid captures ({closed}), a closed format: put the board's pose in each capture into "
                "camera01.yaml ... (4 x 4, from Zivid's detectCalibrationBoard), or scan the bare flange and use weldcal calibrate."
            )
        raise DatasetError(
            f"'{folder.name}' has no {' and no '.join(missing)} poses: give robot.csv and camera.csv, folders robot/ and camera/ with one "
            "file per pose, or pairs.npz. Scans of a flange with poses go to 'weldcal calibrate'."
        )
    robot, camera = (read_poses(lists[who], PoseForm()) for who in ("robot", "camera"))  # type: ignore[arg-type]
    A, B = _together(folder, robot, camera)
    units = {u for u in (robot.unit, camera.unit) if u}
    if len(units) > 1:
        raise DatasetError(
            f"The robot poses of '{folder.name}' are in {robot.unit}, the camera's in {camera.unit}; bring both to one unit."
        )
    return {"robot": A, "camera": B, "unit": units.pop() if units else ""}


def _source(folder: Path, pattern: re.Pattern[str]) -> Path | tuple[Path, ...] | None:
    for place in sorted(p for p in folder.iterdir() if p.is_dir() and pattern.search(p.name)):
        files = sorted((p for p in place.iterdir() if p.suffix.lower() in READ), key=lambda p: natural(p.name))
        if files:
            return tuple(files) if len(files) > 1 else files[0]
    files = [
        p for p in folder.iterdir() if p.suffix.lower() in READ and p.name != "dataset.yaml" and pattern.match(p.stem)
    ]
    files.sort(key=lambda p: natural(p.name))
    each = [p for p in files if number_of(p.stem) is not None]
    if len(each) > 1:
        return tuple(each)
    return files[0] if files else None


def _together(folder: Path, robot: PoseList, camera: PoseList) -> tuple[Array, Array]:
    """Both lists, pose by pose: by the numbers in their names, by their stamps, or in order."""
    numbers = [[number_of(i) for i in one.ids] for one in (robot, camera)]
    if all(numbers) and all(None not in one and len(set(one)) == len(one) for one in numbers):
        common = sorted(set(numbers[0]) & set(numbers[1]))  # type: ignore[type-var]
        if set(numbers[0]) != set(numbers[1]):
            alone = sorted(set(numbers[0]) ^ set(numbers[1]))[:5]  # type: ignore[type-var]
            raise DatasetError(
                f"In '{folder.name}' the poses {', '.join(map(str, alone))} have no partner of the same number; add or remove them."
            )
        order = [[one.index(k) for k in common] for one in numbers]
        return robot.X[order[0]], camera.X[order[1]]
    if len(robot.X) == len(camera.X):
        return robot.X, camera.X
    if robot.times is None or camera.times is None:
        raise DatasetError(
            f"'{folder.name}' holds {len(robot.X)} robot poses and {len(camera.X)} camera poses; without stamps or names they pair in order, "
            "one for one."
        )
    gap = np.abs(camera.times[:, None] - robot.times[None, :])
    nearest = gap.argmin(axis=1)
    keep = gap.min(axis=1) <= _NEAR_S
    if not keep.any():
        raise DatasetError(
            f"No robot pose of '{folder.name}' is within {_NEAR_S:g} s of a camera pose; bring both to one clock."
        )
    return robot.X[nearest[keep]], camera.X[keep]


def pairs_of_tree(tree: Any, name: str) -> dict[str, Any] | None:
    """The same from nodes such as R_gripper2base, t_gripper2base, R_target2cam, t_target2cam, or A and B; None where there are no two.

    A list that is named the other way round (base2gripper, cam2target) is inverted.
    """
    if not isinstance(tree, Mapping):
        return None
    found: dict[str, Array] = {}
    for at, X, _ in nodes(tree, PoseForm(), name):
        who = at.split("/")[-1] or at
        plain = re.sub(r"(?i)^(r|rot|rotation|rvecs?|t|x)_", "", who)
        key = (
            "robot"
            if (_INVERSE.search(plain) and "base" in plain.lower()) or _ROBOT.match(plain)
            else "camera"
            if _CAMERA.match(plain)
            else ""
        )
        if key:
            if key in found:
                found[key] = np.concatenate([found[key], inverse(X) if _INVERSE.search(plain) else X])
            else:
                found[key] = inverse(X) if _INVERSE.search(plain) else X
    return dict(found) if len(found) == 2 else None


def pairs_of_document(path: Path) -> dict[str, Any] | None:
    """The two lists of a YAML, JSON or XML file with a node for each; None where it has another form."""
    return pairs_of_tree(read_tree(path), path.name)
