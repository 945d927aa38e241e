"""Every reader of a file that a person can write, with an example of its file, the grammar of it, and what it read."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_dump_typed

from weldcal.calibration.data.clouds import read_cloud
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.results import load_result
from weldcal.calibration.hand_eye.files import read_pairs
from weldcal.calibration.profiler.record import load_record
from weldcal.calibration.tablet.planar.files import load_planar
from weldcal.calibration.tablet.result import load_tablet_result
from weldcal.calibration.tablet.wrist.files import load_visit
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.array_files import read_grey_image
from weldcal.systems.scenario.loading import load_scenario, scenario_class
from weldcal.tools.commands.profiler.files import read_profiler_file
from weldcal.tools.studies.files import examples
from weldcal.tools.studies.files.examples import Files, Rng
from weldcal.welding.record.weld_log import load_weld_log

Values = Sequence[Any]


@dataclass(frozen=True)
class Reader:
    """A reader: ``target`` is the file of the example that is damaged, by the grammar ``kind``; ``read`` takes the folder and
    returns what was read, all numbers of which must be finite where ``finite``."""

    name: str
    kind: str
    target: str
    example: Callable[[Rng], Files]
    read: Callable[[Path], Values]
    finite: bool = True


def _dataset(folder: Path) -> Values:
    data = load_dataset(folder)
    if data.refused:
        raise _refusal(data.refused[0][1])
    poses = [X.GetAsMatrix34() for X in data.poses.values()]
    guesses = [None if (X := data.guess(id)) is None else X.GetAsMatrix34() for id in data.poses]
    centres = [v for p in data.pairs for v in (p.X_BR.GetAsMatrix34(), p.p_CR)]
    return [asdict(data.header), *poses, *guesses, *centres, *(data.cloud(id) for id in data.clouds)]


def _refusal(reason: str) -> Exception:
    from weldcal.models.errors import InputError

    return InputError(reason)


def _pairs(name: str) -> Callable[[Path], Values]:
    def read(folder: Path) -> Values:
        p = read_pairs(folder / name, mounting="eye_in_hand")
        return [p.robot, p.camera, p.robot2, p.link, p.mode, p.X_true, p.q]

    return read


def _cloud(name: str) -> Callable[[Path], Values]:
    return lambda folder: [read_cloud(folder / name)]


def _profiler(name: str) -> Callable[[Path], Values]:
    def read(folder: Path) -> Values:
        file = read_profiler_file(folder / name)
        X = file.poses()
        return [file.arrays, *(file.profiles or ()), None if X is None else (X.rotation, X.translation)]

    return read


def _calibration(folder: Path) -> Values:
    r = load_result(folder)
    return [r.X_BC.GetAsMatrix34(), {**vars(r), "X_BC": None, "held_out_mm": None}, list(r.held_out_mm)]


def _record(folder: Path) -> Values:
    r = load_record(folder)
    return [{**vars(r), "arm": None if r.arm is None else r.arm.rows, "figures": str(r.figures)}]


def _tablet_record(folder: Path) -> Values:
    r = load_tablet_result(folder)
    return [None if r.X_FC is None else r.X_FC.GetAsMatrix34(), {**vars(r), "X_FC": None}]


def _visit(folder: Path) -> Values:
    v = load_visit(folder / "touches.csv", folder / "poses.csv", folder / "camera.yaml", seen=folder / "seen.csv")
    poses = [X.GetAsMatrix34() for X in (*v.data.X_BF, v.data.views[0][0])]
    return [*poses, v.data.touched_m, v.data.landmark_m, v.data.views[0][1], v.names]


def _planar(folder: Path) -> Values:
    return [value for v in load_planar(folder / "a.npz").visits for value in (vars(v.touches), v.rows)]


def _scenario(folder: Path) -> Values:
    return [yaml_dump_typed(load_scenario(str(folder / "cell.yaml")), schema=scenario_class())]


def _weld_log(folder: Path) -> Values:
    log = load_weld_log(folder)
    return [dict(log.columns), list(log.phase), vars(log.process)]


READERS = (
    Reader("ply", "cloud", "a.ply", examples.ply, _cloud("a.ply")),
    Reader("pcd", "cloud", "a.pcd", examples.pcd, _cloud("a.pcd"), finite=False),
    Reader("text-cloud", "table", "a.csv", examples.text_cloud, _cloud("a.csv")),
    Reader("npz-cloud", "npz", "a.npz", examples.npz_cloud, _cloud("a.npz"), finite=False),
    Reader("npy-cloud", "npy", "a.npy", examples.npy_cloud, _cloud("a.npy")),
    Reader("dataset", "yaml", "dataset.yaml", examples.dataset, _dataset),
    Reader("poses", "table", "poses.csv", examples.dataset, _dataset),
    Reader("pairs", "table", "pairs.csv", examples.pairs, _dataset),
    Reader("calibration", "yaml", "calibration.yaml", examples.calibration, _calibration),
    Reader("hand-eye-npz", "npz", "pairs.npz", examples.hand_eye_npz, _pairs("pairs.npz")),
    Reader("hand-eye-csv", "table", "pairs.csv", examples.hand_eye_csv, _pairs("pairs.csv")),
    Reader("hand-eye-json", "json", "pairs.json", examples.hand_eye_json, _pairs("pairs.json")),
    Reader("hand-eye-yaml", "yaml", "pairs.yaml", examples.hand_eye_yaml, _pairs("pairs.yaml")),
    Reader("profiler-npz", "npz", "a.npz", examples.profiler_npz, _profiler("a.npz"), finite=False),
    Reader("profiler-csv", "table", "a.csv", examples.profiler_csv, _profiler("a.csv"), finite=False),
    Reader("profiler-record", "yaml", "profiler.yaml", examples.profiler_record, _record),
    Reader("touches", "table", "touches.csv", examples.tablet, _visit),
    Reader("tablet-poses", "table", "poses.csv", examples.tablet, _visit),
    Reader("seen", "table", "seen.csv", examples.tablet, _visit),
    Reader("camera", "yaml", "camera.yaml", examples.tablet, _visit),
    Reader("planar", "npz", "a.npz", examples.planar, _planar),
    Reader("tablet-record", "yaml", "tablet.yaml", examples.tablet_record, _tablet_record),
    Reader("scenario", "yaml", "cell.yaml", examples.scenario, _scenario),
    Reader(
        "kinematics",
        "yaml",
        "kinematics.yaml",
        examples.kinematics,
        lambda f: [load_arm(kinematics=f / "kinematics.yaml").stack],
    ),
    Reader("weld-table", "table", "weld.csv", examples.weld_log, _weld_log, finite=False),
    Reader("weld-header", "json", "weld.json", examples.weld_log, _weld_log, finite=False),
    Reader("image", "image", "a.png", examples.image, lambda f: [read_grey_image(f / "a.png")]),
)


def all_finite(value: Any) -> bool:
    """Whether all numbers of what was read are finite."""
    if isinstance(value, dict):
        return all(all_finite(v) for v in value.values())
    if isinstance(value, list | tuple):
        return all(all_finite(v) for v in value)
    if isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f"):
        return bool(np.isfinite(value).all())
    return True
