"""Read pose pairs.

Npz, tables, documents and samples of other tools, with corners and joint angles where a file has them.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.bag import FEWEST_RESTS, at_rest, find_bag, lists_of_recording
from weldcal.calibration.data.poses.formats import EXTRAS, format_of, known_forms, may_hold_poses, read_recording
from weldcal.calibration.data.poses.listing import Listing, require_pose
from weldcal.calibration.data.poses.lists import folder_lists, two_lists
from weldcal.calibration.data.poses.names import TREES, mounting_name
from weldcal.calibration.data.poses.storage import read_tree
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.hand_eye.mountings import chain, get_mounting
from weldcal.calibration.hand_eye.pairs.conventions import UNITS
from weldcal.calibration.hand_eye.pairs.importing import FARTHEST_M, NEAREST_M, StatedForms, import_pairs
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER

_MORE = {"robot2": ("C", "robot2", "X_DE"), "link": ("L", "link", "X_BL")}
LENGTHS = UNITS
NO_MOUNTING = "'{}' does not say where the camera is; add --mounting eye_in_hand or eye_on_base."


@dataclass(frozen=True, kw_only=True)
class PosePairs:
    """Pose pairs in metres.

    ``robot`` (n, 4, 4) = X_BF, ``camera`` (n, 4, 4) = X_CM, ``robot2`` (n, 4, 4) = X_DE of a second robot or None,
    ``link`` = X_BL of an eye on the arm or None, ``mode`` a mounting's name. ``X_true``: the published answer where
    there is one; ``img`` (n, m, 2), ``obj`` (m, 3), ``K``, ``dist``: corners of a board where given (NaN: not seen).
    ``q`` (n, joints) rad: joint angles of the robot that moved, where given. ``reading``: how each list was understood;
    ``notes``: sentences about it; ``ids``: names of the rows, or empty.
    """

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
    reading: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    ids: tuple[str, ...] = ()

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


def read_pairs(
    path: Path, *, mounting: str | None = None, length: str | None = None, stated: StatedForms | None = None
) -> PosePairs:
    """Read pose pairs from a file or folder of any form of docs/datasets.md.

    Args:
        path: the file or folder.
        mounting: what the file does not state (and must not contradict).
        length: the unit of all positions (m, mm, cm, inch) where the file does not state it; else the robot's follows
            from its reach and the camera's from the ratio of the motions.
        stated: forms and names of the two lists, where the user states them.

    Raises:
        DatasetError: the file cannot be read; InconsistentPoses: the data do not select one reading.
    """
    path, stated = Path(path), stated or StatedForms()
    if path.is_dir() and (path / "pairs.npz").exists():
        path = path / "pairs.npz"
    mounting = None if mounting is None else mounting_name(mounting)
    if length is not None and (length.count(",") > 1 or not set(length.split(",")) <= set(LENGTHS)):
        raise DatasetError(f"There is no unit '{length}'; use {', '.join(LENGTHS)}, or inch,mm for robot and camera.")
    try:
        return _pairs(path, *_contents(path, stated), mounting, length, stated)
    except (DatasetError, InconsistentPoses):
        raise
    except InputError as e:
        raise DatasetError(str(e) if path.name in str(e) else f"'{path.name}': {e}") from e
    except MemoryError:
        raise DatasetError(f"'{path.name}' needs more memory than there is: give fewer pairs.") from None


def pairs_of_lists(
    lists: list[Listing], names: str, *, mounting: str | None, length: str | None, stated: StatedForms
) -> PosePairs:
    """Return the pairs of lists from several files, as `read_pairs`; ``names`` of the files go into messages."""
    mounting = None if mounting is None else mounting_name(mounting)
    return _pairs(Path(names), lists, {}, mounting, length, stated)


def _pairs(
    path: Path,
    lists: list[Listing],
    raw: Mapping[str, Any],
    mounting: str | None,
    length: str | None,
    stated: StatedForms,
) -> PosePairs:
    more: dict[str, Listing] = {}
    for who, names in _MORE.items():
        found = next((one for one in lists if re.split(r"[/,\s]+", one.name)[-1] in names), None)
        if found is not None:
            more[who] = found
            lists = [one for one in lists if one is not found]
    mode = _mode(path, raw, mounting, "robot2" in more)
    unit = _word(path, raw, "unit")
    if unit and length and unit != length:
        raise DatasetError(
            f"'{path.name}' states lengths in {unit}, and the command states {length}; correct one of them."
        )
    if unit and unit not in LENGTHS:
        raise DatasetError(f"'{path.name}' states lengths in '{unit}'; use {', '.join(LENGTHS)}.")
    if mode == "eye_on_base" and any(re.search(r"(tracking|optical)$", one.name) for one in lists):
        stated = replace(
            stated, robot=replace(stated.robot, frame="base_in_flange")
        )  # easy_handeye then stores the base in the hand
    arm = stated.arm or _word(path, raw, "robot")
    by = f"the unit in '{path.name}'" if unit else stated.unit_by
    stated = _stated_in(path, raw, replace(stated, unit=unit or length or stated.unit, unit_by=by, arm=arm))
    found_pairs = import_pairs(lists, path.name, mode, stated)
    rows_r, rows_c = found_pairs.rows
    arrays: dict[str, Array | None] = {}
    for key in EXTRAS:
        value = raw.get(key)
        arrays[key] = None if value is None else _array(path, key, value)
    if arrays["q"] is None and found_pairs.joints is not None and np.isfinite(found_pairs.joints).all():
        arrays["q"] = found_pairs.joints
    for key, rows, count in (("q", rows_r, found_pairs.counts[0]), ("img", rows_c, found_pairs.counts[1])):
        listed = arrays[key]
        if listed is not None:
            if key == "img" and len(listed) != count:
                continue  # who uses the corners says so
            if len(listed) != count:
                raise DatasetError(f"'{path.name}' holds {len(listed)} rows of {key} for {count} poses.")
            arrays[key] = listed[rows]
    others: dict[str, Array] = {}
    for who, one in more.items():
        X = one.readings[0].X.copy()
        X[:, :3, 3] *= found_pairs.metres
        if who == "robot2":
            _require_reach(X, found_pairs.reading["robot"]["unit"], path.name)
        if len(X) != found_pairs.counts[0] and (who != "link" or len(X) != 1):
            raise DatasetError(f"'{path.name}' holds {found_pairs.counts[0]} robot poses and {len(X)} {who} poses.")
        others[who] = X if len(X) == 1 and who == "link" else X[rows_r]
    return PosePairs(
        source=path.name,
        robot=found_pairs.robot,
        camera=found_pairs.camera,
        mode=mode,
        robot2=others.get("robot2"),
        link=others.get("link"),
        reading=found_pairs.reading,
        notes=found_pairs.notes,
        ids=found_pairs.ids,
        **arrays,
    )


def recorded_lists(path: Path, stated: StatedForms) -> tuple[Listing, Listing] | None:
    """Return the robot's and the camera's stamped poses of a ROS recording; None where there are others or none."""
    beside = path.iterdir() if path.is_dir() else ()
    if any(may_hold_poses(p) and p.name not in ("dataset.yaml", "metadata.yaml") for p in beside):
        return None
    bag = find_bag(path) if path.exists() else None
    if bag is None:
        return None
    lists = lists_of_recording(bag, stated.arm or "")
    return two_lists(lists, path.name, stated.robot_poses, stated.camera_poses)


def _contents(path: Path, stated: StatedForms) -> tuple[list[Listing], Mapping[str, Any]]:
    """Return the lists of poses of a file or folder, and what else it states: mode, unit, corners, joint angles."""
    recorded = recorded_lists(path, stated)
    if recorded is not None:
        if (lists := at_rest(*recorded)) is None:
            raise DatasetError(
                f"'{path.name}' has fewer than {FEWEST_RESTS} poses at which the arm rested and the camera saw the"
                " board, and no motion of 3 s. Let it rest for a second at each pose, and record again."
            )
        return lists, {}
    if path.is_dir():
        description = path / "dataset.yaml"
        raw = read_tree(description) if description.is_file() else {}
        raw = raw if isinstance(raw, dict) else {}
        units = raw.get("units")
        lists = folder_lists(path)
        pictures = sum(p.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp") for p in path.rglob("*"))
        if len(lists) == 1 and pictures:
            raise DatasetError(_pictures(path, pictures))
        if not lists:
            raise DatasetError(_no_lists(path))
        return lists, {
            "mode": raw.get("configuration"),
            "unit": units.get("poses") if isinstance(units, dict) else None,
            "poses": raw.get("poses"),
            "robot": raw.get("robot"),
        }
    found = read_recording(path)
    if format_of(path).endings == TREES and len(found.lists) == 1 == len(found.lists[0]):
        raise DatasetError(
            f"'{path.name}' has only one pose, so it seems to be the result of a calibration. Give the file of the"
            " samples instead. To test this result on the samples, use 'weldcal verify'."
        )
    return require_pose(found.lists), found.stated


def _pictures(folder: Path, n: int) -> str:
    return (
        f"'{folder.name}' holds {n} pictures and no camera poses: name the board in them, for example --board"
        " chessboard:9x6:25 (inner corners and the side of a square in mm)."
    )


def _require_reach(X: Array, unit: object, source: str) -> None:
    """Raise DatasetError where the second robot's poses (n, 4, 4), in the first one's unit, are out of any reach."""
    far = float(np.median(np.linalg.norm(X[:, :3, 3], axis=1)))
    if not NEAREST_M < far < FARTHEST_M:
        raise DatasetError(
            f"The second robot's positions of '{source}' have a median of {far:.3g} m from its base, in {unit} as the"
            " first robot's: write the positions of both robots in one unit."
        )


def _no_lists(folder: Path) -> str:
    names = sorted(p.name for p in folder.rglob("*") if p.is_file())
    pictures = [n for n in names if n.lower().endswith((".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"))]
    if pictures:
        return _pictures(folder, len(pictures))
    closed = next((n for n in names if n.lower().endswith(".zdf")), None)
    if closed is not None:
        return (
            f"'{folder.name}' holds Zivid captures ({closed}), a closed format: put the board's pose in each capture"
            " into camera01.yaml ... (4 x 4, from Zivid's detectCalibrationBoard), or scan the bare flange and use"
            " weldcal calibrate."
        )
    unknown = sorted({Path(n).suffix for n in names if not may_hold_poses(Path(n))})
    also = f" Files {', '.join(unknown[:4])} are not read, but {known_forms()}." if unknown else ""
    return (
        f"'{folder.name}' holds no poses.{also} Give robot.csv and camera.csv, folders robot/ and camera/ with one file"
        " per pose, or one file with both lists. Scans of a flange with poses go to 'weldcal calibrate'."
    )


def _mode(path: Path, raw: Mapping[str, Any], mounting: str | None, two_robots: bool) -> str:
    found = _word(path, raw, "mode")
    found = mounting_name(found) if found else found  # other tools' words
    if found and mounting and found != mounting:
        raise DatasetError(
            f"'{path.name}' states the mounting {found}, and the command states {mounting}; correct one of them."
        )
    mode = mounting or found or ("co_manipulation" if two_robots else None)
    if mode is None:
        raise DatasetError(NO_MOUNTING.format(path.name))
    get_mounting(mode)
    return mode


def _word(path: Path, raw: Mapping[str, Any], key: str) -> str | None:
    value = raw.get(key) or None
    if value is not None and not isinstance(value, str):
        raise DatasetError(f"'{path.name}' must name its {key} by a word.")
    return value


def _stated_in(path: Path, raw: Mapping[str, Any], stated: StatedForms) -> StatedForms:
    """What dataset.yaml states of the two lists, below what the command states."""
    forms = raw.get("poses")
    if not isinstance(forms, dict):
        return stated
    for who in ("robot", "camera"):
        given = forms.get(who)
        if not isinstance(given, dict):
            continue
        known = ("rotation", "angles", "frame", "file")
        wrong = next((k for k in given if k not in known), None)
        if wrong is not None:
            raise DatasetError(
                f"'{path.name}/dataset.yaml': poses.{who} has no key '{str(wrong)[:40]}'; use {', '.join(known)}."
            )
        words: dict[str, Any] = {k: str(v) for k, v in given.items()}
        more: dict[str, Any] = {}
        own = getattr(stated, who)
        if own == PoseForm():
            more[who] = PoseForm(**words)
        if words.get("file"):
            more[f"{who}_poses"] = words["file"]
        stated = replace(stated, **more)
    return stated


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
