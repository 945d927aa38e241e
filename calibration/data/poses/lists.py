"""Read every list of poses of a file or folder, whatever its form, and find the robot's and the camera's among them."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from weldcal.calibration.data.poses.formats import may_hold_poses, read_recording
from weldcal.calibration.data.poses.listing import Listing, require_pose
from weldcal.calibration.data.poses.names import last_key, natural, number_of, whose
from weldcal.calibration.data.poses.trees import stacked
from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array

_OWN = ("dataset.yaml", "readme.txt", "notes.txt", "requirements.txt")
_CLOUDS = ("clouds", "pointclouds", "point_clouds", "scans", "ply", "pcd")
_NOT_ONE = "'{}' does not hold one pose, as the {} files beside it do; give one pose a file."
_COPIED = 1e-3  # a choice: copies with three decimals or more
_INVERSE = re.compile(r"(?i)base2(gripper|ee|hand|tool|flange)|cam(era)?2(target|board|marker|object|chess\w*)")


def read_lists(path: Path) -> list[Listing]:
    """Return every list of poses of one file.

    Raises:
        DatasetError: the file cannot be read, or holds no poses; the sentence says what to change.
    """
    return require_pose(lists_of_file(path))


def lists_of_file(path: Path) -> list[Listing]:
    """Return every list of poses of one of many files: a single pose may be missing there, and is left out.

    Raises:
        DatasetError: the file cannot be read, or holds no poses; the sentence says what to change.
    """
    return read_recording(path).lists


def pose_a_file(files: Sequence[Path], name: str) -> Listing:
    """Return the list of files that hold one pose each, its rows named after the files.

    Raises:
        DatasetError: a file cannot be read, or holds no pose or several.
    """
    lists = [lists_of_file(path) for path in files]
    for path, found in zip(files, lists, strict=True):
        if len(found) != 1 or len(found[0]) != 1:
            raise DatasetError(_NOT_ONE.format(path.name, len(files) - 1))
    return stacked([one for (one,) in lists], name, tuple(p.stem for p in files))


def folder_lists(folder: Path, needed: int = 2, skip: frozenset[Path] = frozenset()) -> list[Listing]:
    """Return every list of poses of a folder.

    Of its files, and of files with one pose each (pos01.yaml, pos02.yaml ...), one level deep.

    Args:
        folder: the folder.
        needed: lists without which a file that cannot be read is refused.
        skip: files that hold something else.

    Raises:
        DatasetError: a file that should hold poses cannot be read.
    """
    groups: dict[tuple[str, str], list[Path]] = {}
    numbered = _numbered_folders(folder)
    for place in (folder, *sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith((".", "_")))):
        label = "" if place == folder else place.name
        if place in numbered:
            label = re.sub(r"\d+", "", label)
        for path in sorted(
            (p for p in place.iterdir() if p not in skip and _may_hold_poses(p)), key=lambda p: natural(p.name)
        ):
            stem = (
                re.sub(r"\d+$", "", path.stem)
                if number_of(path.stem) is not None and place not in numbered
                else path.stem
            )
            groups.setdefault((label, f"{stem}{path.suffix.lower()}"), []).append(path)
    found: list[Listing] = []
    problem: DatasetError | None = None
    for (label, _), files in groups.items():
        if label.lower() in _CLOUDS:
            continue
        try:
            found += _group(files, label)
        except DatasetError as why:
            problem = problem or why
    if len(found) < needed and problem is not None:
        raise problem
    return found


def _numbered_folders(folder: Path) -> frozenset[Path]:
    """Folders of one pose each, such as pose_1, pose_2 ...: three or more that differ in a number."""
    stems: dict[str, list[Path]] = {}
    for place in folder.iterdir():
        if place.is_dir() and number_of(place.name) is not None:
            stems.setdefault(re.sub(r"\d+", "", place.name), []).append(place)
    return frozenset(p for places in stems.values() if len(places) > 2 for p in places)


def _may_hold_poses(path: Path) -> bool:
    """Return whether a file's name is that of poses.

    Raises DatasetError where another thing than a file or a folder has such a name.
    """
    named = may_hold_poses(path) and path.name.lower() not in _OWN and not path.name.startswith((".", "_"))
    if named and not path.is_file() and (not path.is_dir() or _one_of_files(path)):
        raise DatasetError(f"'{path.name}' is no file that can be read; replace it by a file, or remove it.")
    return named and path.is_file()


def _one_of_files(folder: Path) -> bool:
    """Return whether a folder has the name of one of several numbered files beside it."""
    stem = re.sub(r"\d+$", "", folder.stem)
    alike = (p for p in folder.parent.glob(f"*{folder.suffix}") if re.sub(r"\d+$", "", p.stem) == stem and p.is_file())
    return stem != folder.stem and next(alike, None) is not None


def _group(files: list[Path], label: str) -> list[Listing]:
    """Return the lists of one file, or one list of many files with a pose each."""
    prefix = f"{label}/" if label else ""
    if len(files) == 1:
        return [_renamed(one, prefix) for one in read_lists(files[0])]
    lists = [lists_of_file(path) for path in files]
    many = next((p for p, found in zip(files, lists, strict=True) if len(found) != 1 or len(found[0]) != 1), None)
    alike = len({p.name for p in files}) == 1 and len(files) > 1  # the same file in each of several folders
    ids = tuple((p.parent.name if alike else p.stem) for p in files)
    order = sorted(range(len(files)), key=lambda k: natural(ids[k]))
    if many is not None:
        if all(len(found) == 1 for found in lists):
            return [_renamed(found[0], prefix) for found in lists]
        each = len(lists[0])
        if each > 1 and all(len(found) == each and all(len(one) == 1 for one in found) for found in lists):
            return [
                stacked(
                    [lists[k][j] for k in order],
                    f"{prefix}{files[0].name} ..., {lists[0][j].name.rpartition(', ')[2]}",
                    tuple(ids[k] for k in order),
                )
                for j in range(each)
            ]
        raise DatasetError(_NOT_ONE.format(many.name, len(files) - 1))
    name = f"{prefix}{files[0].name}" if alike else f"{prefix}{files[0].name} ... {files[-1].name}"
    return [stacked([lists[k][0] for k in order], name, tuple(ids[k] for k in order))]


def _renamed(listing: Listing, prefix: str) -> Listing:
    return replace(listing, name=prefix + listing.name) if prefix else listing


def two_lists(
    lists: list[Listing], source: str, robot: str | None = None, camera: str | None = None
) -> tuple[Listing, Listing]:
    """Return the robot's and the camera's list among those of a source.

    Args:
        robot, camera: part of the name of the list that holds them, as the user states it.

    Raises:
        DatasetError: a stated name is in none or several lists, or the names do not tell which list is whose.
    """
    if any(one.numbers and whose(one.name) == "robot" for one in lists):
        lists = [one for one in lists if one.numbers]  # joint angles beside the robot's poses
    many = [one for one in lists if len(one) > 1]
    if robot is None and camera is None and len(many) > 1:
        lists = many  # a pose alone beside lists is a result
    if len(lists) == 1 and lists[0].numbers and lists[0].joints is not None:
        return lists[0].of_joints(), replace(lists[0], joints=None)
    known = ", ".join(repr(one.name) for one in lists[:8]) or "none"
    chosen: dict[str, Listing] = {}
    for who, key in (("robot", robot), ("camera", camera)):
        if key is None:
            continue
        match = [one for one in lists if last_key(one.name) == key] or [one for one in lists if key in one.name]
        if len(match) != 1:
            raise DatasetError(f"--{who}-poses {key} names {len(match)} of the lists of '{source}': {known}.")
        chosen[who] = match[0]
    rest = [one for one in lists if one not in chosen.values()]
    for who in ("robot", "camera"):
        if who not in chosen:
            mine = [one for one in rest if (whose(one.name) if one.numbers else "robot") == who]
            mine = without_copies(mine) if len(mine) > 1 else mine
            if len(mine) == 1:
                chosen[who] = mine[0]
    rest = [one for one in lists if one not in chosen.values()]
    if len(chosen) == 1 and len(rest) > 1:
        rest = without_copies(rest)
    if len(chosen) == 1 and len(rest) == 1:
        chosen["robot" if "camera" in chosen else "camera"] = rest[0]
    if len(chosen) == 2:
        return chosen["robot"], chosen["camera"]
    missing = " and ".join(f"the {who}'s" for who in ("robot", "camera") if who not in chosen)
    if not lists:
        raise DatasetError(
            f"'{source}' holds no poses that can be read: give one list of the robot's and one of the camera's poses."
        )
    if len(lists) == 1:
        raise DatasetError(
            f"'{source}' holds one list of poses, {known}, and two are needed: the robot's and the camera's. Put both"
            " into one folder as robot.csv and camera.csv, or name them."
        )
    raise DatasetError(
        f"The names of the lists in '{source}' do not show which one has {missing} poses: {known}. Name them with"
        " --robot-poses and --camera-poses."
    )


def without_copies(lists: list[Listing]) -> list[Listing]:
    """Return the lists of poses without those that hold the numbers of another one, in any form."""
    kept: list[Listing] = []
    if len(lists) < 2:
        return lists
    for one in sorted((one for one in lists if one.numbers), key=lambda one: len(one.readings)):
        if not any(len(other) == len(one) and _alike(other, one) for other in kept):
            kept.append(one)
    return [one for one in lists if one in kept]


def _alike(other: Listing, one: Listing) -> bool:
    return any(np.abs(_unscaled(r.X) - _unscaled(other.readings[0].X)).max() < _COPIED for r in one.readings)


def _unscaled(X: Array) -> Array:
    """Poses with positions in units of their rms distance."""
    X = X.copy()
    X[:, :3, 3] /= np.sqrt((X[:, :3, 3] ** 2).sum(axis=1).mean()) + 1e-12
    return X


def named_inverse(listing: Listing) -> bool:
    """Return whether a list's name says that it holds the inverse poses, such as R_base2gripper."""
    return _INVERSE.search(last_key(listing.name)) is not None


def together(robot: Listing, camera: Listing, near_s: float = 0.05) -> tuple[np.ndarray, np.ndarray, str]:
    """Rows of both lists that belong together, and how: by numbers in their names, in order, or by time.

    Raises:
        DatasetError: they do not pair.
    """
    numbers = [[number_of(i) for i in one.ids] for one in (robot, camera)]
    if all(numbers) and all(None not in one and len(set(one)) == len(one) for one in numbers):
        common = sorted(set(numbers[0]) & set(numbers[1]))  # type: ignore[type-var]
        if len(common) < min(len(robot), len(camera)) and not common:
            raise DatasetError(
                f"No row of '{robot.name}' has the number of a row of '{camera.name}'; number both alike."
            )
        if set(numbers[0]) != set(numbers[1]) and len(common) < 3:
            alone = sorted(set(numbers[0]) ^ set(numbers[1]))[:5]  # type: ignore[type-var]
            raise DatasetError(
                f"The poses {', '.join(map(str, alone))} have no partner of the same number; add or remove them."
            )
        if common:
            places = [{k: row for row, k in enumerate(one)} for one in numbers]
            rows = [np.array([one[k] for k in common]) for one in places]
            return rows[0], rows[1], "by the numbers in their names"
    if len(robot) == len(camera):
        return np.arange(len(robot)), np.arange(len(camera)), "in order"
    if robot.times is None or camera.times is None:
        raise DatasetError(
            f"'{robot.name}' holds {len(robot)} poses and '{camera.name}' holds {len(camera)}; without times or numbers"
            " they pair in order, one for one: remove what has no partner."
        )
    order = np.argsort(robot.times, kind="stable")
    after = np.clip(np.searchsorted(robot.times[order], camera.times), 0, len(order) - 1)
    either = np.stack([order[np.maximum(after - 1, 0)], order[after]])
    gap = np.abs(camera.times - robot.times[either])
    nearest, keep = either[gap.argmin(axis=0), np.arange(len(camera))], gap.min(axis=0) <= near_s
    if not keep.any():
        raise DatasetError(
            f"No pose of '{robot.name}' is within {near_s:g} s of a pose of '{camera.name}'; bring both to one clock."
        )
    return nearest[keep], np.flatnonzero(keep), "by time"
