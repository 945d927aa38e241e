"""Find the file that holds the poses, read it as flange poses X_BF in metres, and pair them with the clouds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from weldcal.calibration.data.checks import JOINT_NAME, read_rows
from weldcal.calibration.data.cloud_files.depth import IMAGES, is_camera_file, may_be_depth
from weldcal.calibration.data.clouds import NO_NOTES, SUFFIXES, cloud_id, ending_of
from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.formats import may_hold_poses
from weldcal.calibration.data.poses.names import BASES, FLANGES, columns_of, joint_columns, natural, number_of, whose
from weldcal.calibration.data.poses.readings import PoseReading, pick
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import require_few_lines

if TYPE_CHECKING:
    from weldcal.calibration.data.poses.listing import Listing

FOLDERS = ("clouds", "pointclouds", "point_clouds", "scans", "ply", "pcd", "points", "depth", "depth_images", "images")
_NOTES = ("readme", "notes")
_CLOSED = {".zdf": "Zivid", ".praw": "Photoneo", ".pmraw": "Photoneo", ".dat": "the scanner's maker"}

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


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseList:
    """Poses of a file, read.

    Attributes:
        source: the file's name.
        X: poses (n, 4, 4), positions in the file's own unit.
        ids: names of the rows (n), or empty.
        times: times of the rows (n) s, or None.
        unit: the unit that the form fixes, m or mm, or empty.
        read_as: a phrase for the user.
        readings: all readings that the numbers allow, the used one first; empty where there is one.
        left_out: rows without a pose: name and reason.
        joints: joint angles (n, joints) rad of the rows, or None.
        computed: whether the poses are those of the flange at these angles.
    """

    source: str
    X: Array
    ids: tuple[str, ...] = ()
    times: Array | None = None
    unit: str = ""
    read_as: str = ""
    readings: tuple[PoseReading, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    joints: Array | None = None
    computed: bool = False


def find_clouds(folder: Path, poses: Path | tuple[Path, ...]) -> list[Path]:
    """The clouds of a dataset folder in the natural order of their names; files of poses are none.

    Raises:
        DatasetError: there are none, or only in a maker's closed format.
    """
    taken = set(poses) if isinstance(poses, tuple) else {poses}
    places = [folder / name for name in FOLDERS if (folder / name).is_dir()] + [folder]
    for of_place in (_points, _depths):  # depth images only where no place holds points
        for place in places:
            files = [p for p in place.iterdir() if not p.name.startswith((".", "_")) and p not in taken]
            ours = of_place(files)
            if ours:
                # a folder that was copied twice: one ending is enough
                first = next(e for e in SUFFIXES if any(ending_of(p) == e for p in ours))
                return sorted((p for p in ours if ending_of(p) == first), key=lambda p: natural(p.name))
    for place in places:
        closed = sorted(p.name for p in place.iterdir() if p.suffix.lower() in _CLOSED)
        if closed:
            ending = Path(closed[0]).suffix.lower()
            raise DatasetError(
                f"The clouds of '{folder.name}' are {ending} files ({closed[0]}), which only software of"
                f" {_CLOSED[ending]} can read. Export each as .ply or .pcd, or its points as .npy, beside the poses."
            )
    raise DatasetError(
        f"'{folder.name}' has poses but no clouds; put one for each pose into clouds/: .ply, .pcd, .npy, .npz, .xyz,"
        " .pts or .csv, or depth images (.png of 16 bits, .tif, .npy)."
    )


def _points(files: list[Path]) -> list[Path]:
    ours = [p for p in files if ending_of(p) in NO_NOTES]
    return ours or [
        p
        for p in files
        if ending_of(p) in SUFFIXES
        and ending_of(p) not in IMAGES
        and cloud_id(p).lower() not in _NOTES
        and not is_camera_file(p)
    ]


def _depths(files: list[Path]) -> list[Path]:
    return [p for p in files if may_be_depth(p)]


def pair(ids: Sequence[str], n: int, clouds: Sequence[Path], source: str) -> tuple[list[str], list[Path | None], str]:
    """Ids of n poses, the cloud of each (None: it has none) and how they were paired, a phrase.

    ``ids`` is empty where the poses have no names; ``clouds`` are in their natural order.

    Raises:
        DatasetError: names or counts do not go together; the sentence names those without a partner.
    """
    stems = {cloud_id(p): p for p in clouds}
    if len(stems) < len(clouds):
        again = next(p for p in clouds if stems[cloud_id(p)] is not p)
        raise DatasetError(f"Two clouds are called '{cloud_id(again)}'; keep one.")
    if ids and set(ids) & set(stems):
        _no_orphans([p.name for p in clouds if cloud_id(p) not in ids], source)
        return list(ids), [stems.get(i) for i in ids], "paired by name"
    if ids:
        numbers = [number_of(i) for i in ids]
        of = [number_of(cloud_id(p)) for p in clouds]
        if None not in numbers and None not in of and len(set(numbers)) == n and len(set(of)) == len(of):
            by_number = dict(zip(of, clouds, strict=True))
            same = set(numbers) == set(of)
            if same or (len(clouds) != n and set(numbers) & set(of)):
                _no_orphans([p.name for k, p in by_number.items() if k not in numbers], source)
                return list(ids), [by_number.get(k) for k in numbers], "paired by the numbers in their names"
        raise _apart(ids, clouds, source)
    if len(clouds) != n:
        raise DatasetError(
            f"'{source}' has {n} poses, but there are {len(clouds)} clouds ({clouds[0].name} to {clouds[-1].name})."
            " Without names, each pose needs one cloud, in the same order. Remove what has no partner, or add a column"
            " 'id' with the clouds' names."
        )
    return [cloud_id(p) for p in clouds], list(clouds), f"paired in order, {clouds[0].name} with the first pose"


def _no_orphans(orphans: list[str], source: str) -> None:
    if orphans:
        names = ", ".join(orphans[:5]) + (f" and {len(orphans) - 5} more" if len(orphans) > 5 else "")
        raise DatasetError(
            f"'{source}' has no pose for {names}; add the missing row{'s' if len(orphans) > 1 else ''} or remove the"
            " cloud."
        )


def _apart(ids: Sequence[str], clouds: Sequence[Path], source: str) -> DatasetError:
    return DatasetError(
        f"The names do not go together: '{source}' has {len(ids)} poses, {ids[0]} to {ids[-1]}, and there are"
        f" {len(clouds)} clouds, {clouds[0].name} to {clouds[-1].name}; give each cloud the name, or the number, of its"
        " pose."
    )


def find_poses(folder: Path) -> Path | tuple[Path, ...] | None:
    """Return the poses of a folder: a file, one file per pose in the natural order of their names, or None.

    Known are poses.* and the like, a folder poses/, and files such as pos01.yaml beside the clouds.
    """
    for stem in _STEMS:
        for path in files_of_poses(folder):
            if path.stem.lower() == stem:
                return path
    for name in _FOLDERS:
        inside = files_of_poses(folder / name) if (folder / name).is_dir() else []
        if inside:
            return tuple(inside) if len(inside) > 1 else inside[0]
    for path in files_of_poses(folder):
        if "pose" in path.stem.lower() and number_of(path.stem) is None:
            return path
    each = [p for p in files_of_poses(folder) if p.stem.lower().startswith(_ONE) and number_of(p.stem) is not None]
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
    joints = [names[k] for one in joint_columns(names) for k in one.indices]
    if joints and not (roles and all(map(JOINT_NAME.fullmatch, joints))):
        return False
    return "id" in names and roles <= own and not any(c.unit for c in columns) and not any("." in n for n in names)


def files_of_poses(folder: Path) -> list[Path]:
    """Return the files of a folder that may hold poses, in the natural order of their names."""
    found = [
        p
        for p in folder.iterdir()
        if may_hold_poses(p) and p.name != "dataset.yaml" and not p.name.startswith((".", "_"))
    ]
    return sorted(found, key=lambda p: natural(p.name))


def read_poses(source: Path | tuple[Path, ...], form: PoseForm, arm: str = "") -> PoseList:
    """The poses of a file, or of one file per pose; ``arm``: the kinematics of joint angles that stand for poses.

    Raises DatasetError, one sentence that says what to change.
    """
    from weldcal.calibration.data.poses.lists import pose_a_file, read_lists  # poses.csv needs none of these readers

    if isinstance(source, tuple):
        found = pose_a_file(source, f"{source[0].name} ... {source[-1].name}")
        found = replace(found, form=f"one file per pose, {found.form}")
    else:
        found = robot_list(read_lists(source), source.name, form)
    computed = not found.numbers
    found = found.of_arm(arm).stated(replace(form, frame="flange_in_base"), "dataset.yaml: poses.rotation")
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
        joints=None if found.joints is None else found.joints[good],
        computed=computed,
    )


def robot_list(lists: "list[Listing]", name: str, form: PoseForm) -> "Listing":
    """Return the list of the flange's poses among those of a file.

    The only one, the one of the flange's frame, or the one that names the robot.
    """
    if len(lists) == 1:
        return lists[0]
    if not lists:
        raise DatasetError(f"'{name}' holds no poses. Give a row for each pose, such as x_mm,y_mm,z_mm,qw,qx,qy,qz.")
    labels = {tuple(one.name.rpartition(", ")[2].split(" to ")): one for one in lists}
    frames = {pair: one for pair, one in labels.items() if len(pair) == 2}
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
    from weldcal.calibration.data.poses.lists import without_copies  # as in read_poses

    mine = without_copies([one for one in lists if whose(one.name) == "robot"])
    if len(mine) == 1:
        return mine[0]
    known = ", ".join(repr(one.name) for one in lists[:6])
    raise DatasetError(f"'{name}' holds several lists of poses: {known}. Keep the one of the flange in the base.")


def unit_by_size(p: Array) -> str:
    """Return the unit of the positions (n, 3) of an arm's flange or of a board by their median distance: m or mm."""
    return "mm" if float(np.median(np.linalg.norm(p, axis=1))) > _MILLIMETRES else "m"


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
            f" in dataset.yaml to 'poses: {found.unit}'."
        )
    if form.frame not in _FRAMES:
        raise DatasetError(f"dataset.yaml names the frame '{form.frame[:40]}'; write {' or '.join(_FRAMES)}.")
    if found.computed:
        form = PoseForm()
    X = inverse(found.X) if form.frame == "base_in_flange" else found.X.copy()
    if unit == "auto":
        unit = found.unit or unit_by_size(X[:, :3, 3])
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
