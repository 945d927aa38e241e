"""Writes and reads the weld log.

A CSV with one row per servo tick and a JSON header with the meaning and unit of each column.
"""

import csv
import hashlib
import io
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.documents import as_number, parse_document, shown
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_TEXT, read_text, require_whole
from weldcal.welding.numerics import Array
from weldcal.welding.record.process import WeldProcess

SCHEMA, VERSION = "weldcal weld log", 1
CSV_NAME, HEADER_NAME = "weld.csv", "weld.json"


class WeldLogError(InputError):
    """A weld log that cannot be read."""


class LogColumn(NamedTuple):
    """A column of the CSV: its name (unit included), unit, frame ("" for a scalar) and meaning."""

    name: str
    unit: str
    frame: str
    meaning: str


def _vector(name: str, axes: str, unit: str, frame: str, meaning: str, suffix: str) -> tuple[LogColumn, ...]:
    return tuple(LogColumn(f"{name}_{axis}{suffix}", unit, frame, meaning) for axis in axes)


COLUMNS: tuple[LogColumn, ...] = (
    LogColumn("time_s", "s", "", "servo tick, on the robot's clock"),
    LogColumn(
        "phase",
        "",
        "",
        "phase of the servo: TOUCH, TRACK, COAST, FINISH or FAULT; HELD while an operator holds the weld, BACK on the"
        " way back after that",
    ),
    LogColumn("torch_on", "", "", "process output, 1 or 0: servo, job, robot, guard and operator all agree"),
    LogColumn("s_tip_m", "m", "planned seam", "arc length beside the tip"),
    LogColumn("s_torch_m", "m", "planned seam", "arc length beside the torch; negative before the seam"),
    *_vector("p_BW", "xyz", "m", "B", "torch (wire) point, from the measured joints", "_m"),
    *_vector("q_BW", "wxyz", "", "B", "orientation of the torch frame W, whose axes are those of T", ""),
    *_vector("p_BT", "xyz", "m", "B", "origin of T, the tip's rest point: the robot end effector of the paper", "_m"),
    *_vector("q_BT", "wxyz", "", "B", "orientation of T: x from torch to tip, z up from the work", ""),
    *_vector("deflection", "xyz", "m", "T", "the tip's displacement from rest, as the tag shows it", "_m"),
    LogColumn("delta_n_m", "m", "seam", "lateral deflection that the servo acts on, gain corrected"),
    LogColumn("delta_axial_m", "m", "seam", "axial deflection that the servo acts on, gain corrected"),
    *_vector("p_BTip", "xyz", "m", "B", "newest felt point of the tip, at its picture's own time", "_m"),
    *_vector("p_BSeam", "xyz", "m", "B", "point of the refined seam beside the torch, which the torch is led to", "_m"),
    LogColumn("e_t_m", "m", "seam", "torch off the refined seam, positive to the left of travel"),
    LogColumn("e_height_m", "m", "seam", "torch off the refined seam, positive upwards"),
    LogColumn("torch_speed_m_s", "m/s", "B", "speed of the torch point, its path over 50 ms"),
    LogColumn("torch_speed_commanded_m_s", "m/s", "B", "torch speed that the servo asked for"),
    LogColumn("tip_speed_m_s", "m/s", "B", "speed along the seam that the servo asked of the tip"),
    LogColumn("omega_rad_s", "rad/s", "T", "commanded turning rate about the tool's up axis"),
    LogColumn("n_d_dot_n_t", "", "", "the measure by which the published law divides"),
    LogColumn("conditioning", "", "", "of the guarded law's equations, 0 to sqrt 2"),
    LogColumn(
        "work_angle_rad",
        "rad",
        "planned seam",
        "of the wire across the seam, from the bisector, positive: left side up",
    ),
    LogColumn("travel_angle_rad", "rad", "planned seam", "of the wire along the seam, positive: push"),
    LogColumn("heat_input_J_m", "J/m", "", "k U I / v while the arc burns (1 kJ/mm = 1e6 J/m); nan where not known"),
    LogColumn("gain", "", "", "gain of the tag in use, from the touch-on calibration"),
    LogColumn("n_points", "", "", "committed tactile points so far"),
    LogColumn("sigma_min", "", "", "least singular value of the arm's length-scaled Jacobian"),
    LogColumn("arc", "", "", "1: the power source reports an arc, 0: none; nan where its signal is not wired"),
    LogColumn("current_A", "A", "", "welding current as the power source measures it; nan where it gives none"),
    LogColumn("voltage_V", "V", "", "arc voltage as the power source measures it; nan where it gives none"),
    LogColumn("set_wire_feed_m_min", "m/min", "", "wire feed that the schedule sets; nan where it sets none"),
    LogColumn("set_voltage_V", "V", "", "voltage that the schedule sets; nan where it sets none"),
    LogColumn("set_current_A", "A", "", "current that the schedule sets; nan where it sets none"),
    LogColumn("gap_m", "m", "planned seam", "measured gap that the schedule follows; nan where it follows none"),
    LogColumn(
        "s_seam_m", "m", "whole seam", "place of the torch along the whole seam, from its start; nan before it touches"
    ),
    LogColumn(
        "travel_speed_m_s", "m/s", "planned seam", "speed of the torch along the seam, without the swings of a weave"
    ),
    LogColumn("left_m", "m", "planned seam", "torch off the planned line of the tip, to the left of travel"),
    LogColumn("up_m", "m", "planned seam", "torch off the planned line of the tip, upwards"),
)
BETWEEN_RUNS_S = 1.0  # a choice: longer than any hold counts as time of welding; the true time is in record.json
_LATER = (
    *("arc", "current_A", "voltage_V"),
    *(
        "set_wire_feed_m_min",
        "set_voltage_V",
        "set_current_A",
        "gap_m",
        "s_seam_m",
        "travel_speed_m_s",
        "left_m",
        "up_m",
    ),
)  # columns that logs of before do not have
NAMES = tuple(c.name for c in COLUMNS)
_NUMBERS = tuple(name for name in NAMES if name != "phase")


@dataclass(frozen=True, eq=False)
class WeldRecord:
    """The columns of one weld, its process and its settings.

    Attributes:
        columns: (N,) arrays by the names in COLUMNS, SI units; NaN where a phase has no such thing.
        phase: (N,) words.
        process: the arc's nominal values.
        settings: commanded values (weld_speed_m_s, delta_d_m ...) and origin (scenario, seed, robot ...).
    """

    columns: Mapping[str, Array]
    phase: NDArray[np.str_]
    process: WeldProcess = field(default_factory=WeldProcess)
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.phase)

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    @property
    def torch_on(self) -> NDArray[np.bool_]:
        """Where the torch was on, (N,)."""
        return np.asarray(self.columns["torch_on"] > 0.5)

    @property
    def arc(self) -> NDArray[np.bool_]:
        """Where the arc burned, (N,): as the power source reports it, else while the torch was on."""
        return np.asarray(self.torch_on & (np.nan_to_num(self.columns["arc"], nan=1.0) > 0.5))

    def after(self, earlier: "WeldRecord") -> "WeldRecord":
        """This record behind that of an earlier run of the same weld; its times follow those.

        What that run touched last, without an arc, is left out.
        """
        plans = list(earlier.settings.get("plans", ()))
        welded = np.flatnonzero(earlier.phase != "TOUCH")
        n = int(welded[-1]) + 1 if len(welded) else 0
        plans = plans[: int(np.sum(np.diff(np.flatnonzero(earlier.phase[:n] == "TOUCH"), prepend=-2) > 1))]
        then = float(earlier["time_s"][n - 1]) + BETWEEN_RUNS_S if n else 0.0
        table = {name: np.concatenate([earlier[name][:n], self[name]]) for name in self.columns}
        table["time_s"] = np.concatenate([earlier["time_s"][:n], self["time_s"] - self["time_s"][0] + then])
        settings = {**self.settings, "plans": [*plans, *self.settings.get("plans", ())]}
        settings["arcs"] = [*earlier.settings.get("arcs", ()), *self.settings.get("arcs", ())]
        return replace(self, columns=table, phase=np.concatenate([earlier.phase[:n], self.phase]), settings=settings)

    def points(self, name: str) -> Array:
        """A point or displacement (N,3) m: "p_BW", "p_BT", "p_BTip", "p_BSeam" or "deflection"."""
        return np.column_stack([self.columns[f"{name}_{axis}_m"] for axis in "xyz"])

    def pose(self, name: str, row: int) -> RigidTransform:
        """X_BW ("BW") or X_BT ("BT") at a row."""
        q = np.array([self.columns[f"q_{name}_{axis}"][row] for axis in "wxyz"])
        return RigidTransform(RotationMatrix(Quaternion(q / np.linalg.norm(q))), self.points(f"p_{name}")[row])


NO_LOG = WeldRecord({name: np.empty(0) for name in _NUMBERS}, np.empty(0, dtype=np.str_))
"""Of runs whose logs are all lost."""


def weld_log_texts(record: WeldRecord) -> tuple[str, str]:
    """The record as (CSV, JSON header), to be written side by side as weld.csv and weld.json.

    Raises:
        WeldLogError: a column is missing or has another length.
    """
    for name in _NUMBERS:
        if name not in record.columns or len(record.columns[name]) != len(record):
            raise WeldLogError(f"The weld log lacks the column '{name}', or it has not {len(record)} rows.")
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(NAMES)
    for k in range(len(record)):
        writer.writerow(
            str(record.phase[k]) if name == "phase" else f"{float(record.columns[name][k]):.8g}" for name in NAMES
        )
    text = table.getvalue()
    header = {
        "schema": SCHEMA,
        "version": VERSION,
        "units": "SI; each column names its own",
        "rows": len(record),
        "sha256": hashlib.sha256(text.encode()).hexdigest(),
        "settings": dict(record.settings),
        "process": {
            **asdict(record.process),
            "efficiency_in_use": record.process.k,
            "values": "as set; the columns current_A and voltage_V are measured, where they are numbers",
            "heat_input": record.process.missing or "k U I / v, EN 1011-1",
        },
        "columns": [c._asdict() for c in COLUMNS],
    }
    return text, json.dumps(header, indent=1, allow_nan=False) + "\n"


def load_weld_log(path: Path | str, whole: bool = True) -> WeldRecord:
    """Read a weld log back.

    Args:
        path: the folder, its weld.csv or its weld.json.
        whole: refuse it in a folder whose result is not finished.

    Raises:
        WeldLogError: one sentence that says what is missing, damaged or of another version.
    """
    given = Path(path)
    folder = given if given.is_dir() else given.parent
    if whole:
        require_whole(folder)
    stem = CSV_NAME.removesuffix(".csv") if given.is_dir() else given.stem
    header_path, csv_path = folder / f"{stem}.json", folder / f"{stem}.csv"
    header = _header(_text(header_path), header_path)
    text = _text(csv_path)
    if hashlib.sha256(text.encode()).hexdigest() != header["sha256"]:
        raise WeldLogError(
            f"{csv_path} is not the table that {header_path.name} describes: it was cut off or changed; use the"
            " original."
        )
    try:
        rows = list(csv.reader(io.StringIO(text)))
    except csv.Error as problem:
        raise WeldLogError(f"{csv_path} cannot be read as CSV ({problem}); use the original.") from None
    if not rows or len(rows) != header["rows"] + 1:
        raise WeldLogError(f"{csv_path} has {len(rows) - 1} rows, and {header_path.name} says {header['rows']}.")
    names = rows[0]
    missing = [name for name in NAMES if name not in (*names, *_LATER)]
    if missing:
        raise WeldLogError(f"{csv_path} lacks the column '{missing[0]}'.")
    columns = {name: np.full(len(rows) - 1, math.nan) for name in _NUMBERS}
    there = [name for name in _NUMBERS if name in names]
    for k, row in enumerate(rows[1:]):
        for name in there:
            try:
                columns[name][k] = float(row[names.index(name)])
            except (ValueError, IndexError):
                raise WeldLogError(f"{csv_path}: line {k + 2} has no number in the column '{name}'.") from None
    phase = np.array([row[names.index("phase")] for row in rows[1:]], dtype=np.str_)
    keys = ("name", "current_A", "voltage_V", "efficiency", "wire_feed_m_min")
    process = WeldProcess(**{key: _nominal(header_path, key, header["process"].get(key)) for key in keys})
    return WeldRecord(columns, phase, process, header["settings"])


def _nominal(path: Path, key: str, value: Any) -> Any:
    """A value of the process: a word for its name, else a number; None where there is none."""
    if value is not None and (not isinstance(value, str) if key == "name" else not math.isfinite(as_number(value))):
        raise WeldLogError(f"{path} has no usable 'process': its {key} is {shown(value)}.")
    return value if value is None or key == "name" else as_number(value)


def _text(path: Path) -> str:
    if not path.exists():
        raise WeldLogError(f"There is no {path}: a weld log is {CSV_NAME} and {HEADER_NAME} side by side.")
    try:
        return read_text(path, LARGEST_TEXT).replace("\r\n", "\n")
    except InputError as problem:
        raise WeldLogError(str(problem)) from None


def _header(text: str, path: Path) -> dict[str, Any]:
    try:
        header = parse_document(path.name, text, "JSON")
    except InputError as problem:
        raise WeldLogError(f"{path} is not complete JSON: {problem} Use the original.") from None
    if not isinstance(header, dict) or header.get("schema") != SCHEMA:
        raise WeldLogError(f"{path} is not the header of a weld log: its schema is not '{SCHEMA}'.")
    if header.get("version") != VERSION:
        raise WeldLogError(f"{path} has version {header.get('version')}; this weldcal reads version {VERSION}.")
    wanted = {"rows": int, "sha256": str, "settings": dict, "process": dict}
    for key, kind in wanted.items():
        if not isinstance(header.get(key), kind):
            raise WeldLogError(f"{path} has no usable '{key}'; use the original.")
    return header


def heat_summary(record: WeldRecord) -> tuple[float, float] | None:
    """Heat input in kJ/mm of the whole weld, and its largest value; None where it is not known."""
    heat = record["heat_input_J_m"][record.torch_on]
    speed = np.abs(record["torch_speed_m_s"][record.torch_on])
    known = np.isfinite(heat) & np.isfinite(speed)
    good = heat[np.isfinite(heat)]
    if not len(good) or not speed[known].any():
        return None
    mean = float((heat[known] * speed[known]).sum() / speed[known].sum())  # energy over length: a stand counts too
    return 1e-6 * mean, 1e-6 * float(good.max()) if len(good) == len(heat) else math.inf


# A finger camera sends pictures far more often: a deflection that is constant for longer belongs to none of them.
PICTURE_S = 0.1


def blind_s(record: WeldRecord) -> float:
    """How long (s) before its end the log repeats one deflection to the last bit, if it ends with a fault; else 0."""
    if len(record) < 2 or record.phase[-1] != "FAULT":
        return 0.0
    deflection = record.points("deflection")
    last = deflection[-1]
    same = ((deflection == last) | (np.isnan(deflection) & np.isnan(last))).all(axis=1)
    changed = np.flatnonzero(~same)
    begin = 0 if len(changed) == 0 else int(changed[-1]) + 1
    return float(record["time_s"][-1] - record["time_s"][begin])


def gain_off(record: WeldRecord) -> float | None:
    """How far the gain from touch-on is from 1 (-: the tag moves less than the tip); None where it was not measured."""
    gain = record["gain"]
    known = gain[np.isfinite(gain) & (gain != 1.0)]
    return float(known[-1] - 1.0) if len(known) else None
