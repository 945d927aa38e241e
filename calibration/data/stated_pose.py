"""Read the pose that another program, or weldcal, calibrated.

Matrices, quaternions, URDF origins, static transforms and result files.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from weldcal.calibration.data.poses.formats import format_of
from weldcal.calibration.data.poses.listing import Listing, listing_of, listing_of_array
from weldcal.calibration.data.poses.lists import lists_of_file, read_lists
from weldcal.calibration.data.poses.names import MOUNTINGS, TEXT, TREES, last_key, mounting_name
from weldcal.calibration.data.poses.readings import PoseReading
from weldcal.calibration.data.poses.storage import read_tree
from weldcal.calibration.data.poses.trees import lists_of_tree
from weldcal.calibration.data.results import RESULT_FILE as CALIBRATION_FILE
from weldcal.calibration.data.results import pose_of_document
from weldcal.calibration.data.scanner_correction import TERMS, ScannerCorrection, correction_from_document
from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.documents import DocumentSection
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, read_text

HAND_EYE_FILE, PROFILER_FILE = "hand_eye.yaml", "profiler.yaml"
SYMBOLS = {"eye_in_hand": "X_FC", "eye_on_base": "X_BC"}
"""The camera's pose by the mounting."""
UNITS = {"m": 1.0, "mm": 1e-3}
_MILLIMETRES_FROM = 10.0  # no camera is 10 m from the flange or the base that carries it
_MOST_CAMERAS = 20  # a choice: more poses under numbered keys are those of a motion
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_TOKEN = re.compile(rf"--[a-z][\w-]*|(?<![\w.]){_NUMBER}(?![\w.])|[A-Za-z_/][\w/.-]*")
_NAMED = re.compile(
    r"(?i)(hand_?eye|cam(era)?2|2cam|cam(era)?_(to|in)|(to|in)_cam|t_?cam|x_?f?c$|x_?bc$|^x$|emc|fmc|bmc"
    r"|rmc|t_.*cam|cam.*_t|calib|result)"
)
_CAMERA_LINK = re.compile(r"(?i)(cam|scanner|sensor|optical|eye|zivid|realsense|phoxi|kinect)")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Own:
    """What a file says of its pose beside the pose itself, as StatedPose explains it."""

    mounting: str | None = None
    covariance: Array | None = None
    data: frozenset[str] = frozenset()
    symbol: str = ""
    freedom: float = np.inf
    correction: ScannerCorrection | None = None
    joint: Array | None = None
    work_C: Array | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class StatedPose(_Own):
    """The pose of a calibrated camera as a file states it.

    Attributes:
        name: the file, with the key where it holds more than one pose.
        form: a phrase for the reader.
        readings: every reading that the numbers allow, the usual one first; each X (4, 4) in metres.
        unit: the unit of length that was taken, m or mm.
        mounting: the mounting that the file names, or None.
        covariance: (6, 6) [rotation rad; translation m] on the parent's side about the camera's origin, where the file
            states it.
        data: SHA-256 of the scans or pairs that the file names as its source.
        symbol: X_BC, X_FC or X_FS of a result of weldcal; empty for others.
        freedom: residuals that the covariance was estimated from; infinite where the file allows for them or has none.
        correction: of a scanner's points; joint (6 + K, 6 + K): covariance of pose and correction.
        work_C: middle (3,) m of what the scans show, in the camera's frame.
    """

    name: str
    form: str
    readings: tuple[PoseReading, ...]
    unit: str


def read_stated_pose(path: Path, pose: str | None = None) -> StatedPose:
    """Read the pose of a file in any form of docs/hand_eye.md, "Judge a result".

    Args:
        path: the file, or a folder that weldcal wrote.
        pose: the key, joint or frame that names the pose, where the file holds several.

    Raises:
        DatasetError: the file cannot be read, holds no pose, or several and none is named.
    """
    path = Path(path)
    if path.is_dir():
        files = (HAND_EYE_FILE, CALIBRATION_FILE, PROFILER_FILE)
        inside = [path / name for name in files if (path / name).is_file()]
        if not inside:
            raise DatasetError(f"'{path.name}' holds none of {', '.join(files)}; name the file of the result.")
        path = inside[0]
    try:
        lists, own = _contents(path)
    except DatasetError:
        raise
    except InputError as problem:
        raise DatasetError(str(problem)) from problem
    one = _chosen(lists, path.name, pose)
    if one.left_out:
        raise DatasetError(
            f"'{one.name}' holds no calibrated pose: it is zero or the identity. Give the file of a finished"
            " calibration."
        )
    far = float(np.abs(one.numbers[0].p).max())
    unit = one.unit or ("mm" if far > _MILLIMETRES_FROM else "m")
    readings = []
    for reading in (reading for reading in one.readings if not reading.doubted):
        X = reading.X[0].copy()
        X[:3, 3] *= UNITS.get(unit, 1.0)
        readings.append(replace(reading, X=X))
    return StatedPose(
        name=one.name,
        form=one.form.replace("4 x 4 matrices", "a 4 x 4 matrix") or "a pose",
        readings=tuple(readings),
        unit=unit,
        **vars(own),
    )


def _chosen(lists: list[Listing], name: str, pose: str | None) -> Listing:
    single = [one for one in lists if len(one) == 1] or [
        one.row(k) for one in lists if one.ids and len(one) <= _MOST_CAMERAS for k in range(len(one))
    ]
    if not single:
        if lists:
            raise DatasetError(
                f"'{name}' holds lists of poses and no single one. Give the file of the result first and the file of"
                " the pairs second."
            )
        raise DatasetError(
            f"'{name}' holds no pose that can be read: give a 4 x 4 matrix, x y z with a quaternion, a URDF origin or"
            " the result file of a calibration."
        )
    known = ", ".join(one.name.removeprefix(f"{name}, ") for one in single[:8])
    if pose is not None:
        match = [one for one in single if pose == last_key(one.name)] or [one for one in single if pose in one.name]
        if len(match) != 1:
            raise DatasetError(f"--pose {pose} names {len(match)} of the poses of '{name}': {known}.")
        return match[0]
    if len(single) > 1:
        named = [one for one in single if _NAMED.search(last_key(one.name))]
        if len(named) != 1:
            raise DatasetError(f"'{name}' holds {len(single)} poses: {known}. Name the camera's with --pose.")
        return named[0]
    return single[0]


def _contents(path: Path) -> tuple[list[Listing], _Own]:
    ending = path.suffix.lower()
    if format_of(path).endings not in (TEXT, TREES):
        return read_lists(path), _Own()
    if ending in TREES and ending != ".xml":
        return _of_tree(read_tree(path), path.name)
    text = read_text(path, LARGEST_DOCUMENT)
    name = path.name
    transforms = list(_static_transforms(text, name))
    if transforms:
        return transforms, _Own(mounting=_said_mounting(text))
    if "<origin" in text:
        return list(_origins(text, name)), _Own()
    if ending == ".xml":
        return _of_tree(read_tree(path), name)
    return lists_of_file(path), _Own()


def _of_tree(tree: Any, name: str) -> tuple[list[Listing], _Own]:
    if not isinstance(tree, Mapping):
        return lists_of_tree(tree, name), _Own()
    own = _own_result(tree, name)
    if own is not None:
        return own
    parameters = tree.get("parameters")
    said = parameters if isinstance(parameters, Mapping) else tree
    mounting = None
    for key in ("eye_on_hand", "eye_in_hand"):
        if isinstance(said.get(key), bool):
            mounting = "eye_in_hand" if said[key] else "eye_on_base"
    for key in ("calibration_type", "configuration", "mounting", "mode"):
        if isinstance(said.get(key), str) and mounting_name(said[key]) in MOUNTINGS:
            mounting = mounting_name(said[key])
    return lists_of_tree(tree, name), _Own(mounting=mounting)


def _own_result(tree: Mapping[Any, Any], name: str) -> tuple[list[Listing], _Own] | None:
    """The sensor's pose in weldcal's files: hand_eye, calibration or profiler.yaml, X_BC.json and what --json prints.

    None for others.
    """
    configuration = tree.get("configuration")
    mounting = configuration if configuration in MOUNTINGS else None
    poses = tree.get("poses")
    sha: list[Any] = []
    found: Any = None
    if mounting is not None and isinstance(poses, Mapping):
        symbol = SYMBOLS[mounting]
        found = poses.get(symbol)
        data = tree.get("data")
        sha = [data.get("sha256"), *(data.get("together_sha256") or [])] if isinstance(data, Mapping) else []
    else:
        symbol = next((key for key in ("X_BC", "X_FC", "X_FS", "X") if key in tree), "")
        found = tree.get(symbol)
        hashes = tree.get("data_sha256")
        # two datasets may have one header and one list of poses
        named = hashes if isinstance(hashes, Mapping) else {"": hashes}
        sha = [value for name_of, value in named.items() if name_of not in ("dataset.yaml", "poses.csv")]
        sha = [one for value in sha if value for one in str(value).split("+")]
        mounting = mounting or {symbol: name for name, symbol in SYMBOLS.items()}.get(symbol)
    covariance = tree.get("covariance", tree.get("covariance_X", tree.get("covariance_rotation_translation")))
    if isinstance(found, Mapping):
        covariance = found.get("covariance", covariance)
        if "matrix" in found:
            pose_of_document(DocumentSection.of(name, found, symbol), f"'{name}': {symbol}.matrix is no rigid pose.")
        found = found.get("matrix")
    if found is None:
        return None
    matrix = _array(found, (4, 4))
    if matrix is None:
        return None
    listing = replace(listing_of_array(f"{name}, {symbol}", matrix), unit="m", form="a 4 x 4 matrix of weldcal")
    freedom, observed, joint = tree.get("degrees_of_freedom"), tree.get("observed"), None
    correction = correction_from_document(tree.get("scanner_correction"), name)
    if correction is not None:
        joint = _array(_matrix(tree.get("joint_covariance")), (6 + TERMS[correction.order],) * 2)
    seen = observed.get("camera") if isinstance(observed, Mapping) else None
    points = _array(seen, (len(seen), 3)) if isinstance(seen, list) and seen else None
    sensor = tree.get("sensor")
    middle = _array(sensor.get("origin"), (2,)) if symbol == "X_FS" and isinstance(sensor, Mapping) else None
    if middle is not None and middle.any():
        points = np.array([[middle[0], 0.0, middle[1]]])
    return [listing], _Own(
        mounting=mounting,
        covariance=_array(_matrix(covariance), (6, 6)),
        data=frozenset(str(one) for one in sha if one),
        symbol=SYMBOLS.get(mounting or "", symbol),
        freedom=float(freedom) if isinstance(freedom, int | float) else np.inf,
        correction=correction,
        joint=joint,
        work_C=None if points is None else points.mean(axis=0),
    )


def _matrix(value: Any) -> Any:
    return value.get("matrix") if isinstance(value, Mapping) else value


def _array(value: Any, shape: tuple[int, ...]) -> Array | None:
    try:
        found = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return None
    return found if found.shape == shape and np.isfinite(found).all() else None


def _said_mounting(text: str) -> str | None:
    """Return the mounting that the text of a launch file names, such as EYE-IN-HAND."""
    if re.search(r"(?i)eye[-_ ](in|on)[-_ ]hand", text):
        return "eye_in_hand"
    return "eye_on_base" if re.search(r"(?i)eye[-_ ](to[-_ ]hand|on[-_ ]base)", text) else None


def _static_transforms(text: str, name: str) -> Iterator[Listing]:
    """The transforms of static_transform_publisher: named arguments, or x y z with yaw pitch roll or a quaternion."""
    plain = re.sub(r"<!--.*?-->", " ", text, flags=re.DOTALL)
    plain = "\n".join(line for line in plain.splitlines() if not line.lstrip().startswith(("#", "//")))
    parts = re.split(r"static_transform_publisher", plain)[1:]
    for k, part in enumerate(parts):
        label = name if len(parts) == 1 else f"{name}, {k + 1}"
        tokens = _TOKEN.findall(part)
        found = _named_transform(tokens, label) or _ordered_transform(tokens, label)
        if found is not None:
            yield found


def _named_transform(tokens: list[str], name: str) -> Listing | None:
    given: dict[str, float] = {}
    words: dict[str, str] = {}
    for key, value in pairwise(tokens):
        if not key.startswith("--"):
            continue
        if re.fullmatch(_NUMBER, value):
            given.setdefault(key[2:], float(value))
        else:
            words.setdefault(key[2:], value)
    if not {"x", "y", "z"} & set(given):
        return None
    child = words.get("child-frame-id")
    name = f"{name}, {child}" if child else name
    p = np.array([[given.get(a, 0.0) for a in "xyz"]])
    if {"qx", "qy", "qz", "qw"} & set(given):
        q = np.array([[given.get("qw", 1.0), *(given.get(f"q{a}", 0.0) for a in "xyz")]])
        return listing_of(name, p, q, rotation="quaternion_wxyz", unit="m", form="a static transform")
    angles = np.array([[given.get(a, 0.0) for a in ("roll", "pitch", "yaw")]])
    return listing_of(
        name, p, angles, rotation="euler_xyz", angles="rad", unit="m", form="a static transform with roll, pitch, yaw"
    )


def _ordered_transform(tokens: list[str], name: str) -> Listing | None:
    begin = next((k for k in range(len(tokens) - 5) if all(re.fullmatch(_NUMBER, t) for t in tokens[k : k + 6])), None)
    if begin is None:
        return None
    end = next((k for k in range(begin, len(tokens)) if not re.fullmatch(_NUMBER, tokens[k])), len(tokens))
    numbers = np.array([[float(t) for t in tokens[begin:end]]])
    if numbers.shape[1] == 7:
        return listing_of(
            name,
            numbers[:, :3],
            numbers[:, 3:],
            rotation="quaternion_xyzw",
            unit="m",
            form="a static transform, x y z qx qy qz qw",
        )
    if numbers.shape[1] == 6:
        return listing_of(
            name,
            numbers[:, :3],
            numbers[:, 3:],
            rotation="euler_ZYX",
            angles="rad",
            unit="m",
            form="a static transform, x y z yaw pitch roll",
        )
    return None


def _origins(text: str, name: str) -> Iterator[Listing]:
    """The origins of the joints of a URDF, those of a camera's link if there are such; or of an excerpt."""
    found = []
    try:
        root = ElementTree.fromstring(text) if "<!DOCTYPE" not in text and "<!ENTITY" not in text else None
    except ElementTree.ParseError:
        root = None
    joints = [] if root is None else [j for j in root.iter("joint") if j.find("origin") is not None]
    if joints:
        for joint in joints:
            child, origin = joint.find("child"), joint.find("origin")
            link = "" if child is None else child.get("link", "")
            assert origin is not None
            found.append((link or joint.get("name", ""), origin.get("xyz", ""), origin.get("rpy", "")))
        cameras = [one for one in found if _CAMERA_LINK.search(one[0])]
        found = cameras or found
    else:
        for tag in re.findall(r"<origin\b[^>]*>", text):
            xyz, rpy = (re.search(rf"\b{key}\s*=\s*[\"']([^\"']*)[\"']", tag) for key in ("xyz", "rpy"))
            found.append(("", "" if xyz is None else xyz[1], "" if rpy is None else rpy[1]))
    for link, *written in found:
        label = f"{name}, {link}" if link and len(found) > 1 else name
        rows = [_three(words, label) for words in written]
        if not np.any(rows):
            continue  # the joint of a frame in the same place
        yield listing_of(
            label,
            rows[0][None],
            rows[1][None],
            rotation="euler_xyz",
            angles="rad",
            unit="m",
            form="a URDF origin, xyz and rpy",
        )


def _three(words: str, name: str) -> Array:
    parts = words.split() or ["0", "0", "0"]
    if len(parts) != 3 or not all(re.fullmatch(_NUMBER, part) for part in parts):
        raise DatasetError(
            f"An origin of '{name}' has '{words[:40]}' where three numbers are needed: write the numbers themselves."
        )
    return np.array([float(part) for part in parts])
