"""Finds the file or folder that holds the poses, reads it by its form, and gives flange poses X_BF in metres."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.columns import columns_of
from weldcal.calibration.data.poses.form import PoseList
from weldcal.calibration.data.poses.listing import Listing
from weldcal.calibration.data.poses.lists import ENDINGS as READ
from weldcal.calibration.data.poses.lists import lists_of_file, read_lists
from weldcal.calibration.data.poses.names import BASES, FLANGES, natural, number_of, whose
from weldcal.calibration.data.poses.readings import pick
from weldcal.calibration.data.poses.trees import stacked
from weldcal.calibration.data.tables import read_rows
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import require_few_lines

_STEMS = (
    "poses",
    "robot_poses",
    "robot",
    "tool_pose",
    "tcp_poses",
    "tcp_pose",
    "flange_poses",
    "pose",
    "tf",
    "transforms",
)
_FOLDERS = ("poses", "robot_poses", "robot", "pose")
_ONE = ("pos", "pose", "robot", "tcp", "flange", "tf", "transform", "t_base", "x_bf", "gripper", "base")
_FRAMES = ("flange_in_base", "base_in_flange")
_MILLIMETRES = 10.0  # a median distance above it is in millimetres, as no arm reaches that many metres


def find_poses(folder: Path) -> Path | tuple[Path, ...] | None:
    """The poses of a folder: a file, one file per pose in the natural order of their names, or None.

    Known are poses.* and the like, a folder poses/, and files such as pos01.yaml beside the clouds.
    """
    for stem in _STEMS:
        for path in _files(folder):
            if path.stem.lower() == stem:
                return path
    for name in _FOLDERS:
        inside = _files(folder / name) if (folder / name).is_dir() else []
        if inside:
            return tuple(inside) if len(inside) > 1 else inside[0]
    for path in _files(folder):
        if "pose" in path.stem.lower() and number_of(path.stem) is None:
            return path
    each = [p for p in _files(folder) if p.stem.lower().startswith(_ONE) and number_of(p.stem) is not None]
    kinds = {p.suffix.lower() for p in each}
    if len(each) > 1 and len(kinds) == 1:
        return tuple(each)
    return None


def is_plain(path: Path) -> bool:
    """Whether a table is in this package's own form: a header with id, x, y, z, qw, qx, qy, qz, without units."""
    if path.suffix.lower() != ".csv":
        return False
    try:
        require_few_lines(path)
        names, _ = read_rows(path)
    except InputError:
        return True  # its reader says what is wrong, and where
    columns, _ = columns_of(names)
    roles = {c.role for c in columns}
    own = {"x", "y", "z", "qw", "qx", "qy", "qz"}
    return "id" in names and roles <= own and not any(c.unit for c in columns) and not any("." in n for n in names)


def files_of_poses(folder: Path) -> tuple[Path, ...]:
    """The files of a folder that may hold poses, in the natural order of their names."""
    return tuple(_files(folder))


def _files(folder: Path) -> list[Path]:
    found = [
        p
        for p in folder.iterdir()
        if p.suffix.lower() in READ and p.name != "dataset.yaml" and not p.name.startswith((".", "_"))
    ]
    return sorted(found, key=lambda p: natural(p.name))


def read_poses(source: Path | tuple[Path, ...], form: PoseForm) -> PoseList:
    """The poses of a file, or of one file per pose. Raises DatasetError, one sentence that says what to change."""
    if isinstance(source, tuple):
        lists = [lists_of_file(path) for path in source]
        many = next((p for p, found in zip(source, lists, strict=True) if len(found) != 1 or len(found[0]) != 1), None)
        if many is not None:
            raise DatasetError(
                f"'{many.name}' holds more than one pose, and there are {len(source)} such files; give one or the"
                " other."
            )
        name = f"{source[0].name} ... {source[-1].name}"
        found = stacked([one[0] for one in lists], name, tuple(p.stem for p in source))
        found = replace(found, form=f"one file per pose, {found.form}")
    else:
        found = robot_list(read_lists(source), source.name, form)
    found = found.stated(replace(form, frame="flange_in_base"), "dataset.yaml: poses.rotation")
    good = found.good
    readings = tuple(pick(found.readings, np.flatnonzero(good)))
    ids = tuple(i for i, keep in zip(found.ids, good, strict=True) if keep) if found.ids else ()
    return PoseList(
        source=found.name,
        X=readings[0].X,
        ids=ids,
        times=None if found.times is None else found.times[good],
        unit=found.unit,
        read_as=found.form if len(readings) == 1 else f"{found.form}, {readings[0].words}",
        readings=readings,
        left_out=tuple((found.ids[k] if found.ids else f"row {k + 1}", why) for k, why in found.left_out),
    )


def robot_list(lists: list[Listing], name: str, form: PoseForm) -> Listing:
    """The list of the flange's poses among those of a file: the only one, the one of the flange's frame, or the one
    that names the robot."""
    if len(lists) == 1:
        return lists[0]
    frames = {tuple(one.name.rpartition(", ")[2].split(" to ")): one for one in lists if " to " in one.name}
    if frames:
        flanges = [form.flange_frame] if form.flange_frame else list(FLANGES)
        bases = (
            [form.base_frame]
            if form.base_frame
            else sorted({k[0] for k in frames}, key=lambda b: BASES.index(b) if b in BASES else 99)
        )
        for flange in flanges:
            for base in bases:
                if (base, flange) in frames:
                    return frames[base, flange]
        pairs = ", ".join(f"{a} to {b}" for a, b in list(frames)[:6])
        raise DatasetError(
            f"'{name}' holds the transforms {pairs}, none from the base to the flange; set poses.base_frame and"
            " poses.flange_frame in dataset.yaml, or record the pose topic of the driver."
        )
    mine = [one for one in lists if whose(one.name) == "robot"]
    if len(mine) == 1:
        return mine[0]
    known = ", ".join(repr(one.name) for one in lists[:6])
    raise DatasetError(f"'{name}' holds several lists of poses: {known}. Keep the one of the flange in the base.")


def metric_poses(found: PoseList, unit: str, form: PoseForm) -> tuple[Array, str]:
    """Flange poses X_BF (n, 4, 4) in metres, and the unit that was taken.

    ``unit`` m, mm, or auto: what the form fixes, else by their size. The poses are inverted where ``form.frame`` says
    base_in_flange, and a TCP (``form.tcp``, m and rad) is taken off.

    Raises:
        DatasetError: the unit contradicts what the file states; an unknown frame; a TCP that is not six numbers in
            metres and radians.
    """
    if found.unit and unit not in ("auto", found.unit):
        raise DatasetError(
            f"'{found.source}' is in {found.unit} ({found.read_as}), and dataset.yaml says poses: {unit}; correct units"
            " in dataset.yaml."
        )
    if form.frame not in _FRAMES:
        raise DatasetError(f"dataset.yaml names the frame '{form.frame[:40]}'; write {' or '.join(_FRAMES)}.")
    X = inverse(found.X) if form.frame == "base_in_flange" else found.X.copy()
    if unit == "auto":
        unit = found.unit or ("mm" if float(np.median(np.linalg.norm(X[:, :3, 3], axis=1))) > _MILLIMETRES else "m")
    X[:, :3, 3] *= {"m": 1.0, "mm": 1e-3}[unit]
    if form.tcp:
        tcp = np.asarray(form.tcp, dtype=float)
        if (
            tcp.shape != (6,)
            or not np.isfinite(tcp).all()
            or np.abs(tcp[:3]).max() > 2.0
            or np.abs(tcp[3:]).max() > 7.0
        ):
            raise DatasetError(
                "poses.tcp in dataset.yaml must be x, y, z, rx, ry, rz in metres and radians, as the controller shows"
                " them."
            )
        X = X @ inverse(pose(exp_rotation(tcp[3:]), tcp[:3]))
    return X, unit
