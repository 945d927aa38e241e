"""Finds the file or folder that holds the poses, reads it by its form, and gives flange poses X_BF in metres."""

from pathlib import Path

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.columns import plain_names
from weldcal.calibration.data.poses.form import PoseList, poses_from_array
from weldcal.calibration.data.poses.names import natural, number_of
from weldcal.calibration.data.poses.storage import ENDINGS, read_storage
from weldcal.calibration.data.poses.table import read_table
from weldcal.calibration.data.tables import read_rows
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.models.array_files import read_npy, read_npz
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

TABLES = (".csv", ".txt", ".tsv", ".script")
READ = (*TABLES, *ENDINGS, ".npy", ".npz")
"""Endings of files that may hold poses."""
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
    """Whether a table is in this package's own form: a header with id, x, y, z and no other notation than a quaternion's."""
    try:
        names, _ = read_rows(path)
    except InputError:
        return True  # its reader says what is wrong, and where
    plain, units = plain_names(names)
    other = {"rx", "roll", "q0", "q1", "a", "p", "m00", "r11"} & set(plain)
    return "id" in names and not units and not other and not any("." in n for n in names) and len(names) < 17


def files_of_poses(folder: Path) -> tuple[Path, ...]:
    """The files of a folder that may hold poses, in the natural order of their names."""
    return tuple(_files(folder))


def _files(folder: Path) -> list[Path]:
    found = [
        p for p in folder.iterdir()
        if p.suffix.lower() in READ and p.name != "dataset.yaml" and not p.name.startswith((".", "_"))
    ]  # fmt: skip
    return sorted(found, key=lambda p: natural(p.name))


def read_poses(source: Path | tuple[Path, ...], form: PoseForm) -> PoseList:
    """The poses of a file, or of one file per pose. Raises DatasetError, one sentence that says what to change."""
    if isinstance(source, tuple):
        lists = [read_poses(path, form) for path in source]
        many = next((p for p, found in zip(source, lists, strict=True) if len(found.X) != 1), None)
        if many is not None:
            raise DatasetError(
                f"'{many.name}' holds more than one pose, and there are {len(source)} such files; give one or the other."
            )
        units = {found.unit for found in lists}
        name = f"{source[0].name} ... {source[-1].name}"
        return PoseList(
            name, np.concatenate([found.X for found in lists]), tuple(p.stem for p in source), None,
            units.pop() if len(units) == 1 else "", f"one file per pose, {lists[0].read_as}",
        )  # fmt: skip
    ending = source.suffix.lower()
    try:
        if ending in TABLES:
            return read_table(source, form)
        if ending in ENDINGS:
            return read_storage(source, form)
        if ending == ".npy":
            X, said = poses_from_array(_numbers(source, read_npy(source)), form, source.name)
            return PoseList(source.name, X, (), None, "", said)
        if ending == ".npz":
            return _archive(source, form)
    except DatasetError:
        raise
    except InputError as e:
        raise DatasetError(str(e)) from e
    raise DatasetError(f"'{source.name}' is no file of poses that can be read; known are {', '.join(READ)}.")


def _numbers(path: Path, value: Array) -> Array:
    if value.dtype.kind not in "fiu":
        raise DatasetError(f"'{path.name}' holds words, not numbers.")
    return np.asarray(value, dtype=float)


def _archive(path: Path, form: PoseForm) -> PoseList:
    arrays = {k: np.asarray(v, dtype=float) for k, v in read_npz(path).items() if v.dtype.kind in "fiu"}
    names = ("X_BF", "poses", "robot", "A", "X_base_gripper", "T_base_flange", "base_T_flange")
    name = next((n for n in names if n in arrays), None)
    if name is None and {"R", "t"} <= set(arrays):
        R, t = arrays["R"], arrays["t"].reshape(-1, 3)
        if R.shape == (len(t), 3, 3):
            arrays, name = {"R": np.concatenate([R, t[:, :, None]], axis=2)}, "R"
    if name is None and len(arrays) == 1:
        name = next(iter(arrays))
    if name is None:
        raise DatasetError(
            f"'{path.name}' holds the arrays {', '.join(arrays) or 'none'}; call the one with the poses X_BF."
        )
    X, said = poses_from_array(arrays[name], form, path.name)
    return PoseList(path.name, X, (), None, "", said)


def metric_poses(found: PoseList, unit: str, form: PoseForm) -> tuple[Array, str]:
    """Flange poses X_BF (n, 4, 4) in metres, and the unit that was taken.

    ``unit`` m, mm, or auto: what the form fixes, else by their size. The poses are inverted where ``form.frame`` says
    base_in_flange, and a TCP (``form.tcp``, m and rad) is taken off.

    Raises:
        DatasetError: the unit contradicts what the file states; an unknown frame; a TCP that is not six numbers in metres and radians.
    """
    if found.unit and unit not in ("auto", found.unit):
        raise DatasetError(
            f"'{found.source}' is in {found.unit} ({found.read_as}), and dataset.yaml says poses: {unit}; correct units in dataset.yaml."
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
                "poses.tcp in dataset.yaml must be x, y, z, rx, ry, rz in metres and radians, as the controller shows them."
            )
        X = X @ inverse(pose(exp_rotation(tcp[3:]), tcp[:3]))
    return X, unit
