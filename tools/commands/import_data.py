"""Write poses, pairs or scans of any form as a dataset in weldcal's own form: `weldcal import`."""

import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydrake.common.yaml import yaml_dump
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.clouds import save_cloud
from weldcal.calibration.data.dataset import Dataset, joint_angles, load_dataset
from weldcal.calibration.data.header import Units
from weldcal.calibration.data.poses.lists import folder_lists, read_lists, two_lists
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.eye_on_base.observations import fit_flanges
from weldcal.calibration.hand_eye.pairs.files import PosePairs, pairs_of_lists
from weldcal.calibration.hand_eye.pairs.importing import StatedForms
from weldcal.calibration.recorded_hand_eye import pairs_or_streams
from weldcal.calibration.verified_pairs import holds_scans
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import write_atomic, write_npz
from weldcal.models.flanges import get_flange
from weldcal.tools.cli.options import Call, FlangeOption, Outcome, command
from weldcal.tools.cli.result_folder import RUNNING
from weldcal.tools.commands.hand_eye import (
    CameraPosesOption,
    JointsOfOption,
    MountingOption,
    RobotPosesOption,
    UnitOption,
    stated_lists,
)
from weldcal.tools.report.render import csv_text

PAIRS_FILE, TABLE_FILE = "pairs.npz", "table.csv"
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Imported:
    """What was written: `kind` (pairs or scans), `count`, the four lines, the files, how each list was read."""

    kind: str
    count: int
    lines: dict[str, str]
    files: tuple[Path, ...]
    reading: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def summary(self) -> dict[str, object]:
        """Return the JSON object of the command."""
        return {
            "state": "done",
            "kind": self.kind,
            "count": self.count,
            "lines": dict(self.lines),
            "reading": {who: dict(found) for who, found in self.reading.items()},
            "notes": list(self.notes),
            "files": [str(one) for one in self.files],
        }


@command(
    "import", keys=("robot-form", "camera-form"), short_help="Write poses, pairs or scans of any form as a dataset."
)
def import_(
    call: Call,
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help=(
                "A file or folder with both lists of poses, two files (robot's and camera's), or a folder with scans"
                " (docs/datasets.md)."
            ),
            show_default=False,
        ),
    ],
    mounting: MountingOption = None,
    unit: UnitOption = None,
    robot_poses: RobotPosesOption = None,
    camera_poses: CameraPosesOption = None,
    flange: FlangeOption = None,
    robot: JointsOfOption = None,
) -> Outcome:
    """Write poses, pairs or scans of any form as a dataset in weldcal's own form, and print how they were understood.

    Pairs become pairs.npz (A, B in m) and table.csv. Scans become poses.csv, clouds/ and dataset.yaml.
    """
    stated = replace(stated_lists(call, robot_poses, camera_poses), arm=robot)
    folder = call.folder("import", sources[0].resolve().stem)
    if folder.is_dir() and any(one.name not in ("UNFINISHED", RUNNING) for one in folder.iterdir()):
        raise InputError(f"'{folder}' is not empty: choose another folder with --out.")
    if len(sources) == 1 and holds_scans(sources[0]):
        found = import_scans(sources[0], folder, flange=flange, mounting=mounting, robot=robot)
    else:
        found = import_pose_pairs(sources, folder, mounting=mounting, unit=unit, stated=stated)
    return Outcome(found.summary(), values={}, rows=found.lines)


def import_pose_pairs(
    sources: list[Path],
    out: Path,
    *,
    mounting: str | None = None,
    unit: str | None = None,
    stated: StatedForms | None = None,
) -> Imported:
    """Write the pairs of one source, or of a robot's and a camera's file, as pairs.npz and table.csv.

    Raises:
        InputError: they cannot be read, or do not select one reading.
    """
    if len(sources) > 2:
        raise InputError(
            f"{len(sources)} sources were given. Give one that holds both lists, or the robot's and the camera's."
        )
    pairs, known = _read(sources, mounting, unit, stated or StatedForms())
    arrays: dict[str, Array] = {"A": pairs.robot, "B": pairs.camera}
    arrays |= {key: value for key, value in (("robot2", pairs.robot2), ("link", pairs.link)) if value is not None}
    for key in ("X_true", "img", "obj", "K", "dist", "q"):
        value = getattr(pairs, key)
        if value is not None:
            arrays[key] = value
    words = {"unit": np.array("m")} | ({"mode": np.array(pairs.mode)} if known else {})
    write_npz(out / PAIRS_FILE, **arrays, **words)
    ids = pairs.ids or tuple(str(k + 1) for k in range(len(pairs.robot)))
    columns = ("id", *(f"{who}_{name}" for who in ("robot", "camera") for name in _POSE))
    rows = [[i, *a, *b] for i, a, b in zip(ids, _numbers(pairs.robot), _numbers(pairs.camera), strict=True)]
    write_atomic(out / TABLE_FILE, csv_text(columns, rows))
    lines = {
        who: f"{found['file']}: {found['form']}, {found['rows']} poses in {found['unit']}, read as {found['reading']}"
        for who, found in pairs.reading.items()
    }
    readings = pairs.reading.items()
    left = [f"{who} {why}" for who, found in readings for why in found["left_out"]]  # type: ignore[attr-defined]
    lines["pairs"] = f"{len(ids)}, {pairs.mode if known else 'mounting not stated'}"
    lines["left out"] = _some(left)
    if pairs.notes:
        lines["notes"] = "\n".join(pairs.notes)
    return Imported("pairs", len(ids), lines, (out / PAIRS_FILE, out / TABLE_FILE), pairs.reading, pairs.notes)


def _read(sources: list[Path], mounting: str | None, unit: str | None, stated: StatedForms) -> tuple[PosePairs, bool]:
    """Read the pairs, and whether their mounting is known.

    Without one the reading must be the same in both mountings that agree.
    """

    def read(mode: str | None) -> PosePairs:
        if len(sources) == 1:
            return pairs_or_streams(sources[0], mounting=mode, unit=unit, stated=stated)[0]
        lists = [folder_lists(one) if one.is_dir() else read_lists(one) for one in sources]
        names = " and ".join(one.name for one in sources)
        forms = stated
        if all(len(one) == 1 for one in lists) and stated.robot_poses is None and stated.camera_poses is None:
            try:
                two_lists([*lists[0], *lists[1]], names)
            except DatasetError:  # the names say nothing: the robot's comes first
                forms = replace(stated, robot_poses=lists[0][0].name, camera_poses=lists[1][0].name)
        return pairs_of_lists(
            [one for found in lists for one in found], names, mounting=mode, length=unit, stated=forms
        )

    try:
        return read(mounting), True
    except DatasetError as problem:
        if mounting is not None or "--mounting" not in str(problem):
            raise
    found: list[PosePairs] = []
    refused: list[InputError] = []
    for mode in ("eye_in_hand", "eye_on_base"):
        try:
            found.append(read(mode))
        except (InconsistentPoses, DatasetError) as problem:
            refused.append(problem)
    if not found:
        raise refused[0]
    first = found[0]
    same = all(
        np.allclose(one.robot, first.robot) and np.allclose(one.camera, first.camera)
        for one in found
        if len(one.robot) == len(first.robot)
    )
    if not same:
        raise InconsistentPoses(
            "How the poses are to be read depends on the mounting: add --mounting eye_in_hand or eye_on_base."
        )
    return first, False


def import_scans(
    source: Path, out: Path, *, flange: str | None = None, mounting: str | None = None, robot: str | None = None
) -> Imported:
    """Write scans of a flange with their poses as dataset.yaml, poses.csv and clouds/ (linked, else copied).

    Raises:
        InputError: they cannot be read; with poses in several possible readings, the flange is not known.
    """
    data = load_dataset(source, robot=robot or "")
    if mounting is not None and mounting != data.header.configuration:
        raise InputError(
            f"'{source.name}' is {data.header.configuration}, and the command states {mounting}. Correct one of them."
        )
    name = flange or data.header.flange
    if sum(not one.doubted for one in data.readings) > 1 or (name and len(data.readings) > 1):
        if not name:
            raise InputError(
                "The poses fit several conventions, and only the scans can decide. Name the flange, for example"
                " --flange"
                " iso9409-1-50-4-m6."
            )
        data = fit_flanges(data, get_flange(name), holes=False).data or data
    header = replace(
        data.header, schema=1, flange=name, poses=None, units=Units(clouds=data.header.units.clouds, poses="m")
    )
    if data.recorded:
        header.units.clouds = "m"
    files = [out / "dataset.yaml"]
    if data.pairs:
        header.units.clouds = "m"
        files.append(_write_centres(data, out))
    else:
        files += _write_scans(data, out)
    write_atomic(out / "dataset.yaml", yaml_dump(asdict(header)))
    count = len(data.pairs) or len(data.clouds)
    written = "pairs.csv" if data.pairs else "poses.csv, x, y, z, quaternion"
    unit = "m or mm by their size" if header.units.clouds == "auto" else header.units.clouds
    left = [f"{id}: {why}" for id, why in data.refused]
    lines = {
        "poses": " ".join(data.notes) or f"{source.name}: {written}, in {data.header.units.poses}",
        "clouds": "none, centres" if data.pairs else f"{count}, in {unit}",
        "scans": f"{count}, {header.configuration}",
        "left out": _some(left),
    }
    return Imported("scans", count, lines, tuple(files), {}, data.notes)


def _write_centres(data: Dataset, out: Path) -> Path:
    columns = (
        "id",
        "base_x",
        "base_y",
        "base_z",
        "camera_x",
        "camera_y",
        "camera_z",
        "base_qw",
        "base_qx",
        "base_qy",
        "base_qz",
    )
    rows = []
    for p in data.pairs:
        q = p.X_BR.rotation().ToQuaternion().wxyz() if p.has_orientation else [""] * 4
        rows.append([p.id, *map(float, p.X_BR.translation()), *map(float, p.p_CR), *q])
    write_atomic(out / "pairs.csv", csv_text(columns, rows))
    return out / "pairs.csv"


def _write_scans(data: Dataset, out: Path) -> list[Path]:
    (out / "clouds").mkdir(parents=True, exist_ok=True)
    files = []
    for id, path in data.clouds.items():
        if id in data.recorded:
            files.append(out / "clouds" / f"{id}.npz")
            save_cloud(files[-1], data.cloud(id))
        else:
            ending = path.name.removeprefix(path.stem.partition(".")[0]) if path.suffix == ".gz" else path.suffix
            files.append(out / "clouds" / f"{id}{ending}")
            _link(path, files[-1])
    ids = list(data.clouds)
    q = joint_angles(data, ids, 6)
    joints = [] if q is None else [f"q{k}" for k in range(1, 7)]
    X = np.array([data.poses[id].GetAsMatrix4() for id in ids])
    rows = [
        [id, *row, *([] if q is None else map(float, q[k]))]
        for k, (id, row) in enumerate(zip(ids, _numbers(X), strict=True))
    ]
    write_atomic(out / "poses.csv", csv_text(("id", *_POSE, *joints), rows))
    return [*files, out / "poses.csv"]


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another disk, or a file system without links
        shutil.copyfile(source, target)


def _numbers(X: Array) -> list[list[float]]:
    """Positions and quaternions w, x, y, z of poses (n, 4, 4)."""
    q = Rotation.from_matrix(X[:, :3, :3]).as_quat(scalar_first=True)
    return [[float(v) for v in (*p, *r)] for p, r in zip(X[:, :3, 3], q, strict=True)]


def _some(left: list[str]) -> str:
    more = f"; {len(left) - 6} more" if len(left) > 6 else ""
    return "; ".join(left[:6]) + more or "nothing"
