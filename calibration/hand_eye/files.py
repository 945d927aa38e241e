"""Reads pose pairs from npz, CSV and JSON files and from the samples of easy_handeye2 and MoveIt."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.poses.names import mounting_name
from weldcal.calibration.data.poses.storage import is_storage
from weldcal.calibration.data.poses.two_lists import pairs_of_document, pairs_of_folder, pairs_of_tree
from weldcal.calibration.data.tables import read_rows
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.calibration.hand_eye.mountings import chain, get_mounting
from weldcal.calibration.hand_eye.solve import as_poses
from weldcal.models.array_files import read_npz
from weldcal.models.arrays import Array
from weldcal.models.documents import read_document
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, file_size

_NAMES = {
    "robot": ("A", "robot", "X_BF", "X_base_gripper"), "camera": ("B", "camera", "X_CM", "X_camera_target"),
    "robot2": ("C", "robot2", "X_DE"), "link": ("L", "link", "X_BL"),
}  # fmt: skip
_WHO = ("robot", "camera", "robot2", "link")
_JOINTS = tuple(f"q{i}" for i in range(1, 10))
LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
_LONGEST_TURN = 7.0  # rad: a whole turn and a little
_NEAR_M = 0.02  # nor are both this near: a file in metres that is said to be in millimetres
_FAR_M = 20.0  # no arm and no camera on one reach this far: the numbers are not metres


@dataclass(frozen=True, kw_only=True)
class PosePairs:
    """Pose pairs in metres: ``robot`` (n, 4, 4) = X_BF, ``camera`` (n, 4, 4) = X_CM, ``robot2`` (n, 4, 4) = X_DE
    of a second robot or None, ``link`` = X_BL of an eye on the arm or None, ``mode`` a mounting's name. ``X_true``: the
    published answer where there is one; ``img`` (n, m, 2), ``obj`` (m, 3), ``K``, ``dist``: corners of a board where
    given (NaN: not seen). ``q`` (n, joints) rad: joint angles of the robot that moved, where given."""

    source: str
    robot: Array
    camera: Array
    mode: str
    robot2: Array | None = None
    link: Array | None = None
    X_true: Array | None = None
    img: Array | None = None
    obj: Array | None = None
    K: Array | None = None
    dist: Array | None = None
    q: Array | None = None

    @property
    def has_corners(self) -> bool:
        """Whether the file holds the corners of a board, and the camera that saw them."""
        return self.img is not None and self.obj is not None and self.K is not None

    @property
    def F(self) -> Array:
        """F of F X G = Y H Z."""
        return chain(get_mounting(self.mode), self.robot, self.link, self.robot2)[0]

    @property
    def H(self) -> Array:
        """H of F X G = Y H Z."""
        return chain(get_mounting(self.mode), self.robot, self.link, self.robot2)[1]

    @property
    def G(self) -> Array:
        """G of F X G = Y H Z."""
        return self.camera


def read_pairs(path: Path, *, mounting: str | None = None, length: str | None = None) -> PosePairs:
    """Read a file of pose pairs; the kind is told by its ending and its contents.

    ``mounting`` says what the file does not (and must not contradict it); ``length`` is the unit of its positions (m, mm,
    cm; m where not said). Raises DatasetError with one sentence, InputError for poses that are no poses.
    """
    path = Path(path)
    if path.is_dir() and (path / "pairs.npz").exists():
        path = path / "pairs.npz"
    mounting = None if mounting is None else mounting_name(mounting)
    if length is not None and length not in LENGTHS:
        raise DatasetError(f"There is no unit '{length}'; use {', '.join(LENGTHS)}.")
    try:
        return _read(path, mounting, length)
    except DatasetError:
        raise
    except InputError as e:
        raise DatasetError(_named(path, str(e))) from e
    except MemoryError:
        raise DatasetError(f"'{path.name}' needs more memory than there is: give fewer pairs.") from None


def _named(path: Path, sentence: str) -> str:
    return sentence if path.name in sentence else f"'{path.name}': {sentence}"


def _read(path: Path, mounting: str | None, length: str | None) -> PosePairs:
    if path.is_dir():
        return _finished(path, pairs_of_folder(path), mounting, length)
    file_size(path)
    ending = path.suffix.lower()
    if ending == ".npz":
        raw = _npz(path)
    elif ending in (".bag", ".db3", ".mcap"):
        raise DatasetError(
            f"'{path.name}' is a ROS recording: write the robot's and the camera's poses as robot.csv and camera.csv into a folder "
            "(rostopic echo -p, or ros2 topic echo --csv) and give that folder."
        )
    elif ending in (".npy", ".mat", ".pkl"):
        raise DatasetError(f"'{path.name}' cannot be read: give npz, CSV, JSON, or samples of easy_handeye2 or MoveIt.")
    elif ending in (".csv", ".txt"):
        raw = _csv(path)
    else:
        raw = _document(path)
    return _finished(path, raw, mounting, length)


def _finished(path: Path, raw: dict[str, Any], mounting: str | None, length: str | None) -> PosePairs:
    said = _said(path, raw, "mode")
    said = mounting_name(said) if said else said  # other tools' words
    if said and mounting and said != mounting:
        raise DatasetError(
            f"'{path.name}' states the mounting {said}, and the command states {mounting}; correct one of them."
        )
    mode = mounting or said or ("co_manipulation" if raw.get("robot2") is not None else None)
    if mode is None:
        raise DatasetError(
            f"'{path.name}' does not say where the camera is; add --mounting eye_in_hand or eye_on_base."
        )
    get_mounting(mode)
    unit = _said(path, raw, "unit")
    if unit and length and unit != length:
        raise DatasetError(
            f"'{path.name}' states lengths in {unit}, and the command states {length}; correct one of them."
        )
    scale = LENGTHS.get(unit or length or "m")
    if scale is None:
        raise DatasetError(f"'{path.name}' states lengths in '{unit}'; use {', '.join(LENGTHS)}.")
    poses: dict[str, Array | None] = {}
    for key, name in (("robot", "robot"), ("camera", "camera"), ("robot2", "second robot"), ("link", "arm link")):
        if raw.get(key) is None:
            poses[key] = None
            continue
        X = as_poses(_array(path, name, raw[key]), name)
        if len(X) and float(np.abs(X[:, :3, 3]).max()) > LARGEST_NUMBER:
            raise DatasetError(f"A position of the {name} of '{path.name}' is beyond {LARGEST_NUMBER:g}.")
        X[:, :3, 3] *= scale
        poses[key] = X
    robot, camera = poses["robot"], poses["camera"]
    if robot is None or camera is None:
        raise DatasetError(f"'{path.name}' holds no pairs of robot and camera poses.")
    for listed, name in ((camera, "camera"), (poses["robot2"], "second robot"), (poses["link"], "arm link")):
        if listed is not None and len(listed) != len(robot) and (name != "arm link" or len(listed) != 1):
            raise DatasetError(f"'{path.name}' holds {len(robot)} robot poses and {len(listed)} {name} poses.")
    if len(robot) == 0:
        raise DatasetError(f"'{path.name}' holds no pairs of robot and camera poses.")
    far = {n: float(np.median(np.linalg.norm(X[:, :3, 3], axis=1))) for X, n in ((robot, "robot"), (camera, "camera"))}
    for name, distance in far.items():
        if distance > _FAR_M:
            other = min(far.values())
            action = f"the others {other:.2g} m: bring both to one unit"
            if other > 1e-2 * distance:
                action = "if they are millimetres, add --unit mm"
            raise DatasetError(f"The {name} positions of '{path.name}' are {distance:.0f} m away, as metres; {action}.")
    if scale != 1.0 and max(far.values()) < _NEAR_M:
        raise DatasetError(
            f"The positions of '{path.name}' are {1e3 * max(far.values()):.2g} mm away, as {unit or length}: they look like metres; "
            "correct the unit."
        )
    if raw.get("inverted") and mode == "eye_on_base":  # easy_handeye2 then stores the base in the hand
        robot = inverse(robot)
    X_true = raw.get("X_true")
    return PosePairs(
        source=path.name,
        robot=robot,
        camera=camera,
        mode=mode,
        robot2=poses["robot2"],
        link=poses["link"],
        X_true=None if X_true is None else _array(path, "X_true", X_true),
        **{k: None if raw.get(k) is None else _array(path, k, raw[k]) for k in ("img", "obj", "K", "dist", "q")},
    )


def _said(path: Path, raw: dict[str, Any], key: str) -> str | None:
    value = raw.get(key) or None
    if value is not None and not isinstance(value, str):
        raise DatasetError(f"'{path.name}' must name its {key} by a word.")
    return value


def _array(path: Path, name: str, value: Any) -> Array:
    try:
        out = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as e:
        raise DatasetError(
            f"'{name}' of '{path.name}' is not an array of numbers, each row as long as the others."
        ) from e
    if name != "img" and not np.isfinite(out).all():
        raise DatasetError(f"'{name}' of '{path.name}' holds numbers that are not finite.")
    if float(np.nanmax(np.abs(out), initial=0.0)) > LARGEST_NUMBER:
        raise DatasetError(f"'{name}' of '{path.name}' holds numbers beyond {LARGEST_NUMBER:g}.")
    return out


def _npz(path: Path) -> dict[str, Any]:
    raw = read_npz(path)
    out: dict[str, Any] = {k: raw[k] for k in ("X_true", "img", "obj", "K", "dist", "q") if k in raw}
    for key, known in _NAMES.items():
        out[key] = next((raw[name] for name in known if name in raw), None)
    out["mode"], out["unit"] = _word(raw, "mode", "configuration"), _word(raw, "unit")
    if "hand" in raw and "eye" in raw and out["robot"] is None:
        raise DatasetError(
            f"'{path.name}' holds two streams of poses, not pairs: bring them to one clock and write pairs, A and B (n, 4, 4)."
        )
    if out["robot"] is None or out["camera"] is None:
        two = pairs_of_tree({k: v.astype(float) for k, v in raw.items() if v.dtype.kind in "fiu"}, path.name)
        if two is not None:
            return out | two
        raise DatasetError(
            f"'{path.name}' has no arrays A and B (n, 4, 4): A = pose of the flange in the base, B = of the target in the camera."
        )
    return out


def _word(raw: dict[str, Array], *keys: str) -> str:
    """A word of an npz: a string, bytes, or an array that holds one of them."""
    value = next((raw[k] for k in keys if k in raw), None)
    if value is None or np.size(value) != 1:
        return ""
    word = np.ravel(value)[0]
    return word.decode("utf-8", "replace") if isinstance(word, bytes) else str(word)


def _csv(path: Path) -> dict[str, Any]:
    try:
        names, rows = read_rows(path)
    except InputError as e:
        raise DatasetError(str(e)) from e
    if not names:
        raise DatasetError(f"'{path.name}' is empty.")
    wanted = "robot_x,robot_y,robot_z,robot_qw,robot_qx,robot_qy,robot_qz,camera_x, ... camera_qz"
    if not any(n.startswith("robot_") for n in names):
        raise DatasetError(f"The first line of '{path.name}' must name its columns: {wanted} (or _rx,_ry,_rz).")
    if not rows:
        raise DatasetError(f"'{path.name}' has a header and no samples.")
    mine = [n for n in names if n.split("_")[0] in _WHO or n in _JOINTS]
    try:
        table = np.array([[float(row[n]) if row[n] else np.nan for n in mine] for row in rows])
    except ValueError as e:
        raise DatasetError(f"'{path.name}' holds something that is not a number: {e}.") from e
    names = mine
    out: dict[str, Any] = {}
    for who in _WHO:
        if f"{who}_x" in names:
            out[who] = _columns(path, names, table, who)
    joints = [names.index(q) for q in _JOINTS if q in names]
    if joints:
        out["q"] = table[:, joints]
    return out


def _columns(path: Path, names: list[str], table: Array, who: str) -> Array:
    def column(*suffixes: str) -> Array | None:
        keys = [f"{who}_{s}" for s in suffixes]
        return table[:, [names.index(k) for k in keys]] if all(k in names for k in keys) else None

    p = column("x", "y", "z")
    q, r = column("qw", "qx", "qy", "qz"), column("rx", "ry", "rz")
    if p is None or (q is None and r is None):
        raise DatasetError(
            f"'{path.name}' lacks {who}_x, _y, _z with {who}_qw, _qx, _qy, _qz or {who}_rx, _ry, _rz (rad)."
        )
    cells = np.hstack([v for v in (p, q if q is not None else r) if v is not None])
    if not np.isfinite(cells).all():
        bad = int(np.flatnonzero(~np.isfinite(cells).all(axis=1))[0])
        raise DatasetError(
            f"'{path.name}' has an empty or non-finite cell in the {who} columns, first in sample {bad}."
        )
    if q is None and np.linalg.norm(np.asarray(r), axis=1).max() > _LONGEST_TURN:
        raise DatasetError(
            f"The rotation vectors {who}_rx, _ry, _rz of '{path.name}' are up to {np.linalg.norm(np.asarray(r), axis=1).max():.0f} long, "
            "more than a whole turn: they look like degrees; write radians."
        )
    turned = _from_quaternions(path, q) if q is not None else exp_rotation(np.asarray(r))
    return pose(turned, p)


def _from_quaternions(path: Path, q: Array) -> Array:
    length = np.linalg.norm(q, axis=1)
    if not (np.abs(length - 1.0) <= 1e-2).all():
        raise DatasetError(
            f"A quaternion of '{path.name}' has length {float(length[np.argmax(np.abs(length - 1))]):.3f}, not 1."
        )
    return np.asarray(Rotation.from_quat(q, scalar_first=True).as_matrix())


def _document(path: Path) -> dict[str, Any]:
    if path.suffix.lower() == ".xml" or is_storage(path):
        two = pairs_of_document(path)
        if two is None:
            raise DatasetError(
                f"'{path.name}' holds no two lists of poses: name its nodes R_gripper2base, t_gripper2base, R_target2cam and t_target2cam, or "
                "A and B."
            )
        return two
    document = read_document(path)
    out: dict[str, Any] = {}
    samples: Any = document
    if isinstance(document, dict):
        parameters = document.get("parameters")
        parameters = parameters if isinstance(parameters, dict) else {}
        out["mode"] = document.get("configuration") or document.get("mode") or parameters.get("calibration_type") or ""
        out["unit"] = document.get("unit") or ""
        out["X_true"] = document.get("X_true")
        if "A" in document and "B" in document:
            more = {"robot2": document.get("C"), "q": document.get("q")}
            return out | {"robot": document["A"], "camera": document["B"]} | more
        samples = document.get("samples", document.get("poses"))
    if not isinstance(samples, list) or not samples:
        two = pairs_of_document(path)
        if two is not None:
            return out | two
        raise DatasetError(f"'{path.name}' holds no list of samples.")
    first = samples[0]
    if isinstance(first, list) and len(first) == 2:  # MoveIt's own test data: pairs without names
        samples = [{"robot": s[0], "camera": s[1]} if isinstance(s, list) and len(s) == 2 else s for s in samples]
        first = samples[0]
    if isinstance(first, dict) and "effector_wrt_world" in first:  # MoveIt: 16 numbers, row by row
        robot, camera = "effector_wrt_world", "object_wrt_sensor"
    elif isinstance(first, dict) and "robot" in first and "tracking" in first:  # easy_handeye2
        robot, camera = "robot", "tracking"
        out["inverted"] = True
    elif (
        isinstance(first, dict) and "robot" in first and "optical" in first
    ):  # easy_handeye2, as it keeps them in memory
        robot, camera = "robot", "optical"
        out["inverted"] = True
    else:
        robot, camera = "robot", "camera"
    for key, name in (("robot", robot), ("camera", camera), ("robot2", "robot2"), ("link", "link")):
        if isinstance(first, dict) and name in first:
            out[key] = np.array([_one(path, s, name, i) for i, s in enumerate(samples)])
    if isinstance(first, dict) and "q" in first:
        out["q"] = [_joints(path, s, i) for i, s in enumerate(samples)]
    return out


def _joints(path: Path, sample: Any, index: int) -> Any:
    if not isinstance(sample, dict) or "q" not in sample:
        raise DatasetError(f"Sample {index} of '{path.name}' has no joint angles 'q', and the first has.")
    return sample["q"]


def _one(path: Path, sample: Any, name: str, index: int) -> Array:
    """A pose in any of the ways people write one."""
    try:
        value = sample[name]
        if isinstance(value, dict):
            value = value.get("transform", value)
        if isinstance(value, dict):
            p = value.get("translation", value.get("position", value.get("xyz")))
            q = value.get("rotation", value.get("orientation", value.get("quaternion_wxyz", value.get("wxyz"))))
            p = [p[k] for k in "xyz"] if isinstance(p, dict) else p
            # a list without names is wxyz here only where its key says so
            if isinstance(q, dict):
                q = [q[k] for k in "wxyz"]
            elif "quaternion_wxyz" not in value and "wxyz" not in value:
                raise InputError("the order of its quaternion is not said (name it quaternion_wxyz)")
            at = np.array(p, dtype=float)
            if at.shape != (3,):
                raise InputError("its position is not three numbers")
            return pose(_from_quaternions(path, np.array([q], dtype=float))[0], at)
        return np.array(value, dtype=float).reshape(4, 4)
    except DatasetError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError, InputError) as e:
        why = f": {e}" if isinstance(e, InputError) else ""
        raise DatasetError(f"Sample {index} of '{path.name}' has no pose '{name}' that can be read{why}.") from e
