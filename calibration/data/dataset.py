"""Reads and checks a calibration dataset folder: poses, clouds and pairs."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.checks import (
    AUTO,
    CONFIGURATIONS,
    REACH_M,
    UNITS,
    Angles,
    Recorded,
    check_reach,
    cloud_form,
    digest,
    metric_cloud,
    read_header,
    row_angles,
    row_numbers,
    table_rows,
    to_metres,
    unit_quaternion,
)
from weldcal.calibration.data.cloud_files.depth import camera_of, is_depth
from weldcal.calibration.data.clouds import NO_NOTES, CloudError, cloud_id, ending_of, find_cloud
from weldcal.calibration.data.header import DatasetHeader, PoseForm, Units
from weldcal.calibration.data.poses.bag import ENDINGS as RECORDINGS
from weldcal.calibration.data.poses.bag import find_bag, read_bag
from weldcal.calibration.data.poses.readings import PoseReading
from weldcal.calibration.data.poses.source import (
    PoseList,
    files_of_poses,
    find_clouds,
    find_poses,
    is_plain,
    metric_poses,
    pair,
    read_poses,
)
from weldcal.calibration.data.writing import JOINTS
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import require_whole, sha256


@dataclass(frozen=True)
class Pair:
    """A centre (3,) m of C found by other means, and the feature's pose (rotation identity where not given)."""

    id: str
    X_BR: RigidTransform
    p_CR: Array
    has_orientation: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Dataset(Recorded):
    """A dataset, checked.

    ``poses`` maps id to X_BF; ``clouds`` maps id to file; ``refused`` lists (id, reason). ``recorded`` holds the
    clouds, in metres, that stand in no file of their own; ``notes`` say what was recognised.
    """

    folder: Path
    header: DatasetHeader
    poses: dict[str, RigidTransform]
    clouds: dict[str, Path]
    pairs: tuple[Pair, ...]
    refused: tuple[tuple[str, str], ...]
    hashes: dict[str, str]
    recorded: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    readings: tuple[PoseReading, ...] = ()
    """Readings of the poses, in metres and in the order of ``poses``, where their file allows more than one; the used
    one first."""
    angles: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Joint angles, rad, by id and name (q1 ..., second_q1 ...), where the table of poses or pairs has them."""
    in_order: bool = False
    """Whether nothing but their order pairs the poses with the clouds."""

    def read_as(self, reading: PoseReading, note: str) -> Self:
        """Return the dataset with its poses in another of its readings."""
        poses = {id: as_transform(X) for id, X in zip(self.poses, reading.X, strict=True)}
        others = tuple(one for one in self.readings if one.form != reading.form)
        return replace(self, poses=poses, readings=(reading, *others), notes=(*self.notes, note))

    def between(self, ids: str) -> Self:
        """Return the dataset from the scan FROM to the scan TO of "FROM:TO", ids of which either may be left out.

        Raises DatasetError where there is no colon, an id is not in the dataset, or FROM comes after TO.
        """
        first, colon, last = (part.strip() for part in ids.partition(":"))
        known = [p.id for p in self.pairs] or list(self.clouds)
        if not colon:
            raise DatasetError(f"The poses '{ids}' are no range: write FROM:TO, FROM: or :TO with ids of the dataset.")
        for id in filter(None, (first, last)):
            if id not in known:
                raise DatasetError(
                    f"'{self.folder.name}' has no usable pose '{id}'; its poses go from {known[0]} to {known[-1]}."
                )
        begin, end = known.index(first) if first else 0, known.index(last) if last else len(known) - 1
        if begin > end:
            raise DatasetError(f"'{first}' comes after '{last}' in '{self.folder.name}'; write --poses {last}:{first}.")
        kept = set(known[begin : end + 1])
        return replace(
            self,
            clouds={id: path for id, path in self.clouds.items() if id in kept},
            pairs=tuple(p for p in self.pairs if p.id in kept),
        )

    def guess(self, id: str) -> RigidTransform | None:
        """Pose X_CR of the feature in the camera frame from the header's guess of X_BC; None without a guess."""
        X_BC = self.X_BC_guess
        return None if X_BC is None else X_BC.InvertAndCompose(self.poses[id] @ self.X_FR)

    def joints(self, names: tuple[str, ...] = JOINTS) -> dict[str, Array]:
        """Joint angles (6,) rad by id; empty where the table of the poses has none.

        Raises DatasetError for missing numbers.
        """
        missing = [(id, name) for id, q in self.angles.items() for name in names if name not in q]
        if missing and len(missing) < len(self.angles) * len(names):
            raise DatasetError(
                f"'{self.folder.name}' has no {missing[0][1]} of '{missing[0][0]}', although it has other joint angles."
                f" Add it, or remove the columns {names[0]} to {names[-1]}."
            )
        return {} if missing else {id: np.array([q[name] for name in names]) for id, q in self.angles.items()}

    def cloud(self, id: str) -> Array:
        """Points of one cloud in metres, (N, 3) or organised (H, W, 3). Raises CloudError with the reason."""
        if id in self.recorded:
            return to_metres(self.recorded[id].astype(float), self.header.units.clouds, id)
        return metric_cloud(self.clouds[id], self.header, self.folder)


def load_dataset(folder: Path, *, robot: str = "", carried: bool = False) -> Dataset:
    """Read and check a dataset: dataset.yaml with poses.csv and clouds/, or pairs.csv.

    Or the poses in any form of docs/datasets.md.

    Without dataset.yaml the scanner is taken as fixed beside the robot, and the units follow from the size of the
    numbers. ``robot`` gives the kinematics of a recording that holds joint angles. ``carried``: the scanner may be
    carried by an arm.

    Raises DatasetError, one sentence, for what makes the whole folder unusable. That is a missing or wrong file, an
    unknown unit or configuration, or a cell that is not a number. It is also a quaternion that is not a unit one, an
    id given twice, or poses whose size shows the wrong unit. A cloud without a pose is an error. A pose without a cloud
    is refused by name. Clouds themselves are read later. A scan that repeats another one to the last digit is refused
    by name.
    """
    folder = Path(folder)
    if folder.is_file() and find_bag(folder) is None:
        raise DatasetError(
            f"'{folder.name}' is a file; give the folder that holds it and dataset.yaml. Pairs of robot and camera"
            " poses go to 'weldcal hand-eye ax-yb'."
        )
    if not folder.exists():
        raise DatasetError(
            f"The dataset folder '{folder}' does not exist; give the path of a folder that holds dataset.yaml."
        )
    require_whole(folder)
    description = folder / "dataset.yaml"
    bare = folder.is_file() or not (description.exists() or description.is_symlink())
    source = None if folder.is_file() else find_poses(folder)
    bag = find_bag(folder) if source is None else None
    if bare and (source is not None or bag is not None) and not (folder / "pairs.csv").exists():
        header = DatasetHeader(schema=1, configuration="eye_on_base", units=Units(AUTO, AUTO), poses=PoseForm())
    else:
        header = read_header(description)
    if header.mode == "motion":
        raise DatasetError(
            f"'{folder.name}' is a recording in motion (mode: motion), and this command needs scans at rest, with"
            " poses.csv. Give the recording to 'weldcal calibrate' or 'weldcal monitor'."
        )
    if header.configuration != CONFIGURATIONS[0] and not carried:
        raise DatasetError(
            f"'{folder.name}' has scans of a scanner on an arm ({header.configuration}), and this command needs a"
            " scanner beside the robot (eye_on_base). Give the folder to 'weldcal calibrate'."
        )
    hashes = {} if bare else {"dataset.yaml": digest(description)}
    if header.poses is not None and header.poses.file:
        source = _stated(folder, header.poses.file)
        bag = None if source is not None else find_bag(folder / header.poses.file)
    table = folder / "poses.csv"
    if source == table and header.poses is None and is_plain(table) and (folder / "clouds").is_dir():
        return _plain(folder, header, hashes)
    if source is None and (folder / "pairs.csv").is_file():
        hashes["pairs.csv"] = digest(folder / "pairs.csv")
        scales = (UNITS.get(header.units.poses, 1.0), UNITS.get(header.units.clouds, 1.0))
        pairs, angles = _pairs(folder / "pairs.csv", *scales)
        again = _repeated({p.id: (*p.X_BR.GetAsMatrix34().ravel(), *p.p_CR) for p in pairs})
        pairs = tuple(p for p in pairs if p.id not in dict(again))
        bare_set = Dataset(folder=folder, header=header, poses={}, clouds={}, pairs=pairs, refused=again, hashes=hashes)
        return replace(bare_set, angles=angles)
    if source is not None:
        return _recognised(folder, header, source, hashes, robot or header.robot)
    if bag is not None:
        return _recording(folder, header, bag, hashes, robot)
    if (folder / "stream.csv").is_file():
        raise DatasetError(
            f"'{folder.name}' holds stream.csv and no poses.csv; for a recording in motion add 'mode: motion' to"
            " dataset.yaml."
        )
    raise DatasetError(
        f"'{folder.name}' holds neither poses.csv nor pairs.csv; add poses.csv with the columns id,x,y,z,qw,qx,qy,qz,"
        " or poses in another form of docs/datasets.md."
    )


def joint_angles(data: Dataset, ids: Sequence[str], joints: int) -> Array | None:
    """Joint angles (n, joints) rad at the poses of these ids; None where their table has none."""
    names = tuple(f"q{i + 1}" for i in range(joints))
    rows = [data.angles.get(id, {}) for id in ids]
    return np.array([[q[name] for name in names] for q in rows]) if all(set(names) <= set(q) for q in rows) else None


def _stated(folder: Path, name: str) -> Path | tuple[Path, ...] | None:
    """Return the source of poses that dataset.yaml names; None where it is a ROS recording."""
    path = folder / name
    if not path.exists():
        raise DatasetError(
            f"dataset.yaml names the poses '{name[:60]}', and '{folder.name}' has no such file or folder."
        )
    if path.is_dir():
        return tuple(files_of_poses(path)) or None
    return None if path.suffix.lower() in RECORDINGS else path


def _plain(folder: Path, header: DatasetHeader, hashes: dict[str, str]) -> Dataset:
    """Return a dataset in this package's own form: poses.csv with quaternions, and clouds/."""
    hashes["poses.csv"] = digest(folder / "poses.csv")
    poses, angles = _poses(folder / "poses.csv", header.units.poses)
    clouds, refused = _match(folder / "clouds", poses)
    return replace(_finished(folder, header, poses, clouds, refused, hashes, ()), angles=angles)


def _recognised(
    folder: Path, header: DatasetHeader, source: Path | tuple[Path, ...], hashes: dict[str, str], arm: str
) -> Dataset:
    """Return a dataset whose poses are in another form."""
    form = header.poses or PoseForm()
    found = read_poses(source, form, arm)
    X, unit = metric_poses(found, header.units.poses, form)
    ids, files, how = pair(found.ids, len(X), find_clouds(folder, source), found.source)
    check_reach(X[:, :3, 3], Path(found.source), unit)
    poses = {id: as_transform(pose) for id, pose in zip(ids, X, strict=True)}
    for path in source if isinstance(source, tuple) else (source,):
        hashes[path.relative_to(folder).as_posix()] = digest(path)
    clouds = {id: path for id, path in zip(ids, files, strict=True) if path is not None}
    refused = tuple((id, "There is no cloud for this pose.") for id in ids if id not in clouds)
    refused += tuple((name, f"Its pose was left out: {why}") for name, why in found.left_out)
    note = f"{found.source}: {len(X)} poses, {found.read_as}, in {unit}; clouds {how}."
    readings = tuple(
        replace(one, X=metric_poses(replace(found, X=one.X), header.units.poses, form)[0]) for one in found.readings
    )
    data = _finished(folder, header, poses, clouds, refused, hashes, (note,))
    rows = {} if found.joints is None else dict(zip(ids, found.joints, strict=True))
    angles = {id: {f"q{k + 1}": float(v) for k, v in enumerate(q)} for id, q in rows.items() if np.isfinite(q).all()}
    return replace(data, readings=readings, angles=angles, in_order=how.startswith("paired in order"))


def _recording(folder: Path, header: DatasetHeader, bag: Path, hashes: dict[str, str], robot: str) -> Dataset:
    """Return a dataset from a ROS recording; its clouds stay in memory."""
    form = header.poses or PoseForm()
    found = read_bag(bag, form, robot or header.robot)
    listed = PoseList(source=bag.name, X=found.X, ids=found.ids, times=found.times, unit="m", read_as="a ROS recording")
    X, unit = metric_poses(listed, "m" if header.units.poses == AUTO else header.units.poses, form)
    check_reach(X[:, :3, 3], bag, unit)
    recorded = dict(zip(found.ids, found.clouds, strict=True))
    for path in sorted(p for p in (bag.iterdir() if bag.is_dir() else (bag,)) if p.is_file()):
        hashes[path.name] = digest(path)
    for id, points in recorded.items():
        hashes[f"clouds/{id}"] = hashlib.sha256(np.ascontiguousarray(points).tobytes()).hexdigest()
    poses = {id: as_transform(pose) for id, pose in zip(found.ids, X, strict=True)}
    clouds = {id: bag / id for id in found.ids}
    return Dataset(
        folder=folder,
        header=header,
        poses=poses,
        clouds=clouds,
        pairs=(),
        refused=found.refused,
        hashes=hashes,
        recorded=recorded,
        notes=(f"{bag.name}: {len(X)} scans at rest, {found.read_as}.",),
    )


def _finished(
    folder: Path,
    header: DatasetHeader,
    poses: dict[str, RigidTransform],
    clouds: dict[str, Path],
    refused: tuple[tuple[str, str], ...],
    hashes: dict[str, str],
    notes: tuple[str, ...],
) -> Dataset:
    """Return the dataset without unreadable clouds and scans that repeat another one."""
    content, unreadable = _contents(clouds)
    clouds = {id: cloud for id, cloud in clouds.items() if id in content}
    refused += unreadable
    again = _repeated({id: (content[id], *poses[id].GetAsMatrix34().ravel()) for id in clouds})
    clouds = {id: cloud for id, cloud in clouds.items() if id not in dict(again)}
    if not clouds:
        raise DatasetError(
            f"No pose in '{folder.name}/poses.csv' has a cloud in clouds/; name the files after the ids, for "
            f"example {next(iter(poses), 'pose01')}.pcd."
        )
    hashes.update({f"clouds/{path.name}": content[id] for id, path in clouds.items()})
    notes += _camera_note(folder, header, next(iter(clouds.values())), hashes)
    return Dataset(
        folder=folder,
        header=header,
        poses=poses,
        clouds=clouds,
        pairs=(),
        refused=refused + again,
        hashes=hashes,
        notes=notes,
    )


def _camera_note(folder: Path, header: DatasetHeader, cloud: Path, hashes: dict[str, str]) -> tuple[str, ...]:
    """Where the intrinsics of depth images come from, a sentence; the file is hashed.

    The cloud's reader says what is wrong.
    """
    if not is_depth(cloud):
        return ()
    try:
        camera = camera_of(cloud, cloud_form(header, folder))
    except CloudError:
        return ()
    if camera is None:
        return ()
    if camera.source.is_file():
        hashes[camera.source.relative_to(folder).as_posix()] = digest(camera.source)
    fx, fy, cx, cy = camera.values
    return (
        f"Depth images with the intrinsics of {camera.source.name}: fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} pixels.",
    )


def _poses(path: Path, unit: str) -> tuple[dict[str, RigidTransform], Angles]:
    columns = ("x", "y", "z", "qw", "qx", "qy", "qz")
    table = table_rows(path, ("id", *columns))
    rows = {row["id"]: row_numbers(row, columns, path) for row in table}
    p = np.array([v[:3] for v in rows.values()])
    if unit == AUTO:
        unit = "mm" if float(np.median(np.linalg.norm(p, axis=1))) > REACH_M[1] else "m"
    scale = UNITS[unit]
    check_reach(scale * p, path, unit)
    poses = {id: RigidTransform(unit_quaternion(v[3:], id), scale * np.array(v[:3])) for id, v in rows.items()}
    return poses, row_angles(table, path)


def _pairs(path: Path, scale_base: float, scale_camera: float) -> tuple[tuple[Pair, ...], Angles]:
    base, camera, turn = (
        tuple(f"base_{c}" for c in "xyz"),
        tuple(f"camera_{c}" for c in "xyz"),
        tuple(f"base_q{c}" for c in "wxyz"),
    )
    pairs = []
    table = table_rows(path, ("id", *base, *camera))
    for row in table:
        v = row_numbers(row, base + camera, path)
        given = [c for c in turn if row.get(c)]
        if given and len(given) < len(turn):
            missing = next(c for c in turn if c not in given)
            raise DatasetError(
                f"'{path.name}' lacks {missing} of '{row['id']}'; give all of {', '.join(turn)}, or none."
            )
        has = bool(given)
        R = unit_quaternion(row_numbers(row, turn, path), row["id"]) if has else RotationMatrix()
        pairs.append(
            Pair(row["id"], RigidTransform(R, scale_base * np.array(v[:3])), scale_camera * np.array(v[3:]), has)
        )
    check_reach(np.array([p.X_BR.translation() for p in pairs]), path, "m" if scale_base == 1.0 else "mm")
    spread_B = np.array([p.X_BR.translation() for p in pairs])
    spread_C = np.array([p.p_CR for p in pairs])
    a, b = (float(np.median(np.linalg.norm(s - np.median(s, axis=0), axis=1))) for s in (spread_B, spread_C))
    if min(a, b) > 0.0 and not 0.02 < a / b < 50.0:
        robot_too_large, metres = a > b, (scale_base == 1.0, scale_camera == 1.0)
        cure = (
            ("poses: mm" if metres[0] else "clouds: m")
            if robot_too_large
            else ("clouds: mm" if metres[1] else "poses: m")
        )
        raise DatasetError(
            f"The robot positions in '{path.name}' spread {a / b:.3g} times as far as the camera's. One of the two is "
            f"in millimetres: correct units in dataset.yaml to '{cure}'."
        )
    check_reach(spread_C, path, "m" if scale_camera == 1.0 else "mm", "camera")
    return tuple(pairs), row_angles(table, path)


def _match(folder: Path, poses: dict[str, RigidTransform]) -> tuple[dict[str, Path], tuple[tuple[str, str], ...]]:
    if not folder.is_dir():
        raise DatasetError(f"'{folder.parent.name}' has poses but no folder clouds/; add one cloud for each pose.")
    clouds: dict[str, Path] = {}
    refused: list[tuple[str, str]] = []
    for id in poses:
        try:
            clouds[id] = find_cloud(folder, id)
        except CloudError as e:
            refused.append((id, e.reason))
    orphans = [
        p
        for p in sorted(folder.iterdir())
        if ending_of(p) in NO_NOTES and cloud_id(p) not in poses and not p.name.startswith(".")
    ]
    if orphans:
        names = ", ".join(p.name for p in orphans[:5]) + (f" and {len(orphans) - 5} more" if len(orphans) > 5 else "")
        raise DatasetError(
            f"'poses.csv' has no pose for {names}; add the missing row{'s' if len(orphans) > 1 else ''} or remove the "
            "cloud."
        )
    return clouds, tuple(refused)


def _repeated(scans: Mapping[str, tuple[object, ...]]) -> tuple[tuple[str, str], ...]:
    """Scans identical to another one, with the reason.

    A copy would count twice and predict itself in cross-validation.
    """
    first: dict[tuple[object, ...], str] = {}
    again = []
    for id, scan in scans.items():
        if (of := first.setdefault(scan, id)) != id:
            again.append((id, f"It repeats {of} to the last digit; it counts once."))
    return tuple(again)


def _contents(clouds: Mapping[str, Path]) -> tuple[dict[str, str], tuple[tuple[str, str], ...]]:
    """SHA-256 of each cloud, and those that are not regular files, with the reason."""
    found, refused = {}, []
    for id, cloud in clouds.items():
        try:
            found[id] = sha256(cloud)
        except InputError as e:
            refused.append((id, str(e)))
    return found, tuple(refused)
