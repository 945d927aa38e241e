"""Reads, checks and writes a recording in motion: the robot's stream, the frames' times and their clouds."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform

from weldcal.calibration.data.checks import (
    IN_HAND,
    UNITS,
    Recorded,
    check_reach,
    digest,
    metric_cloud,
    read_header,
    read_rows,
    table_rows,
)
from weldcal.calibration.data.clouds import NO_NOTES, CloudError, cloud_id, ending_of, find_cloud, save_cloud
from weldcal.calibration.data.header import DatasetHeader, Units, without_cloud_form
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import pose
from weldcal.models.arms.chain import is_urdf
from weldcal.models.arms.kinematics import chain_poses
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, require_whole, sha256, whole_result, write_atomic
from weldcal.models.robots import ROBOTS, get_chain, get_robot

POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")
_RATE_S = (1e-4, 0.5)  # between two rows of a robot's stream
_FULL_TURN = 2.0 * np.pi
_FEWEST_ROWS = 10
_NEAR_S = 10.0  # arrivals so far from the stream are on another clock


@dataclass(frozen=True, eq=False)
class RobotStream:
    """Robot stream as recorded, in ascending order of ``time`` (n,) s, the robot's clock.

    ``poses`` X_BF (n, 4, 4) m, and the joint angles ``joints`` (n, J) rad that they were computed from, or None where
    the stream holds poses.
    """

    time: Array
    poses: Array
    joints: Array | None = None
    robot: str = ""


@dataclass(frozen=True)
class FrameTime:
    """Times of one frame, s.

    ``arrival`` on the robot's clock, ``device`` on the scanner's own clock (None without one).
    """

    id: str
    arrival: float
    device: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionDataset(Recorded):
    """A recording in motion, checked.

    ``frames`` ascend by arrival and have a cloud each (``clouds``: id to file); ``refused`` lists (id, reason);
    ``warnings`` are sentences for the user.
    """

    folder: Path
    header: DatasetHeader
    stream: RobotStream
    frames: tuple[FrameTime, ...]
    clouds: dict[str, Path]
    refused: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    hashes: dict[str, str]

    @property
    def in_hand(self) -> bool:
        """Whether the scanner is on the flange and sees a fixed target."""
        return self.header.configuration == IN_HAND

    def cloud(self, id: str) -> Array:
        """Points of one frame in metres, (N, 3) or organised (H, W, 3). Raises CloudError with the reason."""
        return metric_cloud(self.clouds[id], self.header, self.folder)


def load_motion_dataset(folder: Path, *, robot: str | None = None) -> MotionDataset:
    """Read and check a recording in motion: dataset.yaml (`mode: motion`), stream.csv, frames.csv and clouds/.

    ``robot`` overrides the header's; only a stream of joint angles needs one. Rows may come in any order; rows of the
    stream without values are left out, as is what repeats. A frame without a cloud, or that repeats another one, is
    refused by name; clouds themselves are read later. Raises DatasetError, one sentence, for what makes the recording
    unusable.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"'{folder}' is no folder; give the path of a folder that holds dataset.yaml.")
    require_whole(folder)
    header = read_header(folder / "dataset.yaml")
    if header.mode != "motion":
        raise DatasetError(f"'{folder.name}' is no recording in motion; its dataset.yaml does not say 'mode: motion'.")
    for name, columns in (("stream.csv", ",".join(("time", *POSE_COLUMNS))), ("frames.csv", "id,arrival[,device]")):
        if not (folder / name).is_file():
            raise DatasetError(f"'{folder.name}' has no {name}; add it with the columns {columns}.")
    if not (folder / "clouds").is_dir():
        raise DatasetError(f"'{folder.name}' has no folder clouds/; add one cloud for each frame.")
    stream, said = _read_stream(folder / "stream.csv", header, robot or header.robot)
    frames, refused = _read_frames(folder / "frames.csv", stream)
    files = _files(folder / "clouds")
    known = {f.id for f in frames} | {id for id, _ in refused}
    surplus = sum(ending_of(path) in NO_NOTES for id, paths in files.items() if id not in known for path in paths)
    if surplus:
        said.append(f"{surplus} clouds have no row in frames.csv; they are not used.")
    hashes = {name: digest(folder / name) for name in ("dataset.yaml", "stream.csv", "frames.csv")}
    kept, clouds = [], {}
    first: dict[str, str] = {}
    for f in frames:
        try:
            path = find_cloud(folder / "clouds", f.id) if len(files.get(f.id, ())) != 1 else files[f.id][0]
            content = sha256(path)
        except CloudError as e:
            refused.append((f.id, e.reason))
            continue
        except InputError as e:
            refused.append((f.id, str(e)))
            continue
        if (of := first.setdefault(content, f.id)) != f.id:
            refused.append((f.id, f"It repeats the cloud of {of} to the last digit; it counts once."))
            continue
        kept.append(f)
        clouds[f.id] = path
        hashes[f"clouds/{path.name}"] = content
    if not kept:
        raise DatasetError(
            f"No frame in '{folder.name}/frames.csv' has a cloud in clouds/; name the files after the ids."
        )
    return MotionDataset(
        folder=folder,
        header=header,
        stream=stream,
        frames=tuple(kept),
        clouds=clouds,
        refused=tuple(refused),
        warnings=tuple(said),
        hashes=hashes,
    )


def save_motion_dataset(
    folder: Path,
    header: DatasetHeader,
    stream: RobotStream,
    frames: Sequence[FrameTime],
    clouds: Iterable[tuple[str, Array]],
    *,
    intrinsics: tuple[float, float, float, float] | None = None,
) -> None:
    """Record a motion as a folder that load_motion_dataset reads back.

    ``clouds`` gives (id, points in metres (N, 3) or (H, W, 3)) one after the other, so that they need not be in memory
    together. ``intrinsics`` writes organised clouds as depth maps.

    The stream is written as joints where it has them. ``header.mode`` and ``header.units`` are written as motion and
    metres.
    """
    document = {**without_cloud_form(header), "schema": 1, "mode": "motion", "units": {"clouds": "m", "poses": "m"}}
    if header.scanner_guess is None:
        del document["scanner_guess"]
    if stream.joints is None:
        names: tuple[str, ...] = POSE_COLUMNS
        wxyz = [RigidTransform(X).rotation().ToQuaternion().wxyz() for X in stream.poses]
        values = np.column_stack([stream.poses[:, :3, 3], np.array(wxyz).reshape(-1, 4)])
    else:
        names = tuple(f"q{i + 1}" for i in range(stream.joints.shape[1]))
        values = stream.joints
    device = any(f.device is not None for f in frames)
    rows = [[f.id, f.arrival, *(["" if f.device is None else float(f.device)] if device else [])] for f in frames]
    with whole_result(folder):
        write_atomic(folder / "dataset.yaml", yaml_dump(document))
        _write_table(folder / "stream.csv", ("time", *names), np.column_stack([stream.time, values]).tolist())
        _write_table(folder / "frames.csv", ("id", "arrival", *(["device"] if device else [])), rows)
        (folder / "clouds").mkdir(exist_ok=True)
        for id, points in clouds:
            save_cloud(folder / "clouds" / f"{id}.npz", points, intrinsics)


def _write_table(path: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([v if isinstance(v, str) else repr(v) for v in row] for row in rows)
    write_atomic(path, table.getvalue())


def read_stream(path: Path, *, robot: str = "", unit: str = "m") -> tuple[RobotStream, list[str]]:
    """Read a robot's stream from a file alone, and sentences about rows that were left out.

    Poses are in ``unit`` (m or mm), or joint angles of ``robot``. Raises DatasetError, one sentence.
    """
    if unit not in UNITS:
        raise DatasetError(f"The unit '{unit}' is not known; write m or mm.")
    if not path.is_file():
        raise DatasetError(
            f"There is no '{path}'; give a table with the columns time,{','.join(POSE_COLUMNS)} or time,q1,...,q6."
        )
    return _read_stream(path, DatasetHeader(units=Units(poses=unit)), robot)


def _read_stream(path: Path, header: DatasetHeader, robot: str) -> tuple[RobotStream, list[str]]:
    """Return the stream, and sentences about rows that were left out."""
    try:
        names, rows = read_rows(path)
    except InputError as e:
        raise DatasetError(str(e)) from e
    joints = tuple(f"q{i + 1}" for i in range(16) if f"q{i + 1}" in names)
    columns = POSE_COLUMNS if set(POSE_COLUMNS) <= set(names) else joints
    if "time" not in names or not columns:
        raise DatasetError(
            f"'{path.name}' has the columns {','.join(names)[:80]}; it needs time,{','.join(POSE_COLUMNS)} or"
            " time,q1,...,q6."
        )
    table = _numbers(path, rows, ("time", *columns))
    whole = np.isfinite(table).all(axis=1)
    said = [f"{int((~whole).sum())} rows of {path.name} hold no numbers; they are left out."] if not whole.all() else []
    table = table[whole]
    if len(table) < _FEWEST_ROWS:
        raise DatasetError(f"'{path.name}' has {len(table)} rows with numbers; a stream needs {_FEWEST_ROWS} or more.")
    if (np.diff(table[:, 0]) < 0.0).any():
        said.append(f"The rows of {path.name} are not in the order of their times; they were sorted.")
    table = table[np.argsort(table[:, 0], kind="stable")]
    table = table[np.concatenate([[True], np.diff(table[:, 0]) > 0.0])]
    step = float(np.median(np.diff(table[:, 0]))) if len(table) > 1 else 0.0
    if not _RATE_S[0] <= step <= _RATE_S[1]:
        raise DatasetError(
            f"The rows of '{path.name}' are {step:.3g} apart in time; a robot's stream has {_RATE_S[0]:g} to"
            f" {_RATE_S[1]:g} s. Give the times in seconds."
        )
    if columns is POSE_COLUMNS:
        poses, q = _poses(path, table[:, 1:], header.units.poses), None
    else:
        q = table[:, 1:]
        if is_urdf(robot) and not Path(robot).is_file():
            robot = str(path.parent / robot)  # as dataset.yaml names it
        poses = _forward(path, q, robot)
    return RobotStream(table[:, 0], poses, q, robot), said


def _numbers(path: Path, rows: list[dict[str, str]], columns: tuple[str, ...]) -> Array:
    """Cells of columns as numbers (n, len(columns)), NaN where empty. Raises DatasetError for words."""
    try:
        table = np.array([[float(row[c] or "nan") for c in columns] for row in rows], dtype=float)
    except ValueError:
        for k, row in enumerate(rows):
            for c in columns:
                try:
                    float(row[c] or "nan")
                except ValueError:
                    raise DatasetError(
                        f"'{path.name}' has '{row[c][:40]}' in column {c} of its row {k + 1}; a number is needed."
                    ) from None
        raise
    table = table.reshape(-1, len(columns))
    values = table[:, 1:]
    if (np.abs(values[np.isfinite(values)]) > LARGEST_NUMBER).any():
        raise DatasetError(f"'{path.name}' holds numbers beyond {LARGEST_NUMBER:g}.")
    return table


def _poses(path: Path, values: Array, unit: str) -> Array:
    """Poses (n, 4, 4) m of positions and quaternions (n, 7).

    Raises DatasetError for a wrong unit or no unit quaternions.
    """
    w, x, y, z = values[:, 3:].T
    norm = np.sqrt(w * w + x * x + y * y + z * z)
    wrong = np.flatnonzero(np.abs(norm - 1.0) > 1e-2)  # four or five digits are enough
    if len(wrong):
        raise DatasetError(
            f"'{path.name}' has a quaternion of length {norm[wrong[0]]:.4f} in row {wrong[0] + 1}; a rotation needs"
            " length 1 (order qw, qx, qy, qz)."
        )
    w, x, y, z = values[:, 3:].T / norm
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    p = values[:, :3] * UNITS[unit]
    check_reach(p, path, unit)
    return pose(R.transpose(2, 0, 1), p)


def _forward(path: Path, q: Array, robot: str) -> Array:
    """Poses (n, 4, 4) of joint angles (n, J).

    Raises DatasetError where the robot is not known or the angles are none of it.
    """
    try:
        found = get_chain(robot)
    except InputError as error:
        if is_urdf(robot):
            raise DatasetError(str(error)) from None
        raise DatasetError(
            f"'{path.name}' holds joint angles, and the robot '{robot}' is not known; use poses (x,y,z,qw,qx,qy,qz), or"
            f" one of {', '.join(ROBOTS)}."
        ) from None
    if q.shape[1] != found.n:
        title = Path(robot).name if is_urdf(robot) else get_robot(robot).title
        raise DatasetError(f"'{path.name}' holds {q.shape[1]} joint angles; the {title} has {found.n} joints.")
    if float(np.abs(q).max()) > 2.0 * _FULL_TURN:
        raise DatasetError(f"'{path.name}' holds an angle of {np.abs(q).max():.4g}; give joint angles in radians.")
    return chain_poses(found, q)


def _read_frames(path: Path, stream: RobotStream) -> tuple[list[FrameTime], list[tuple[str, str]]]:
    """Frames in the order of arrival, and those without a usable time with the reason."""
    frames, refused = [], []
    for row in table_rows(path, ("id", "arrival")):
        arrival, device = (_time(row, column, path) for column in ("arrival", "device"))
        if arrival is None:
            refused.append((row["id"], "It has no arrival time."))
            continue
        frames.append(FrameTime(row["id"], arrival, device))
    if not frames:
        raise DatasetError(f"No frame of '{path.name}' has an arrival time.")
    frames.sort(key=lambda f: f.arrival)
    begin, end = stream.time[0] - _NEAR_S, stream.time[-1] + _NEAR_S
    if not any(begin <= f.arrival <= end for f in frames):
        raise DatasetError(
            f"The arrivals in '{path.name}' ({frames[0].arrival:.3f} to {frames[-1].arrival:.3f} s) do not overlap the"
            f" stream's times ({stream.time[0]:.3f} to {stream.time[-1]:.3f} s); give both on the robot's clock, in"
            " seconds."
        )
    return frames, refused


def _time(row: dict[str, str], column: str, path: Path) -> float | None:
    """Return a time of a frame, s; None where the cell is empty or no finite number. Raises DatasetError for a word."""
    cell = row.get(column) or "nan"
    try:
        value = float(cell)
    except ValueError:
        raise DatasetError(
            f"'{path.name}' has '{cell[:40]}' in column {column} of '{row['id']}'; a number is needed."
        ) from None
    return value if np.isfinite(value) else None


def _files(folder: Path) -> dict[str, list[Path]]:
    """Cloud files by id: one listing, since a lookup of each frame would list the folder each time."""
    found: dict[str, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if ending_of(path) in NO_NOTES and not path.name.startswith("."):
            found.setdefault(cloud_id(path), []).append(path)
    return found
