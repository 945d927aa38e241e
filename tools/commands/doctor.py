"""Name what disturbs a calibration or a weld, with evidence and next step: `weldcal doctor`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.dataset import Dataset, load_dataset
from weldcal.calibration.data.stated_pose import HAND_EYE_FILE
from weldcal.calibration.doctor.case import NAME, DoctorCase, case_of, dataset_case, read_case
from weldcal.calibration.doctor.diagnose import WORN, Cause, Diagnosis, diagnose
from weldcal.calibration.errors import DatasetError, FlangeNotFound
from weldcal.calibration.eye_on_base.observations import fit_flanges, require_flange
from weldcal.calibration.flange.fit import fit_flange
from weldcal.models.errors import InputError
from weldcal.models.files import require_whole
from weldcal.models.flanges import STANDARDS, FlangeStandard, get_flange
from weldcal.tools.cli.options import LOOK, Call, FlangeOption, Outcome, command
from weldcal.tools.cli.result_folder import MEASURED_TOOL, RECORDING, SCANS, SUMMARY
from weldcal.tools.console import Progress
from weldcal.tools.report.doctor import CALIBRATION, DoctorReport, worded
from weldcal.welding.record.weld_log import CSV_NAME, PICTURE_S, WeldRecord, blind_s, gain_off, load_weld_log

if TYPE_CHECKING:
    from pydrake.systems.framework import Context

    from weldcal.systems.cell import Cell

_LOOKED_AT = 3  # scans in which other flanges are tried
_SEEN = 0.8  # of the edge
_SURE, _LIKELY, _SAID = 1e4, 1e3, 1.0  # log odds of a cause


@command("doctor", common=("seed", *LOOK), short_help="Name what disturbs a calibration or a weld.")
def doctor(
    call: Call,
    path: Annotated[Path, typer.Argument(help="A result folder, a recording.mcap, or a dataset folder.")],
    flange: FlangeOption = None,
) -> Outcome:
    """Name the causes that disturb a calibration or a weld, likeliest first, each with its evidence and the next step.

    Each cause is a test on the residuals; docs/doctor.md says from which size on it is named.
    """

    report = examine(path, flange=flange, seed=call.seed, progress=call.progress)
    return Outcome(report.summary(), text=report.text())


def examine(
    path: Path, *, flange: str | None = None, seed: int = 0, progress: Progress = lambda *_: None
) -> DoctorReport:
    """Name the causes in a result folder (or calibration.yaml), a recording.mcap or a dataset; write nothing.

    Raises:
        InputError: nothing there can be examined.
    """
    if not path.exists():
        raise InputError(f"There is no '{path}': give a result folder, a recording or a dataset folder.")
    if path.suffix == ".mcap":
        return worded("recording", _recorded(path, progress))
    folder = path if path.is_dir() else path.parent
    if (path.is_file() and path.name != CALIBRATION) or (folder / HAND_EYE_FILE).is_file():
        raise InputError(
            f"'{path}' is nothing that the doctor reads: give a flange calibration's result, its dataset, or a"
            " recording.mcap of a run. `weldcal verify` judges a hand-eye result."
        )
    require_whole(folder)
    of_weld = _of_weld(folder)
    if (folder / NAME).is_file():
        return worded("result", _both(diagnose(read_case(folder / NAME)), of_weld))
    if (folder / SCANS / "dataset.yaml").is_file():
        return worded("scans of the run", _both(diagnose_dataset(folder / SCANS, flange, seed, progress), of_weld))
    if (folder / RECORDING).is_file():
        return worded("recording", _both(_recorded(folder / RECORDING, progress), of_weld))
    if (folder / CSV_NAME).is_file():
        return worded("weld log", Diagnosis(of_weld, 0, float("nan")))
    if (folder / MEASURED_TOOL).is_file():
        said = json.loads((folder / MEASURED_TOOL).read_text(encoding="utf-8"))
        words = f"{said['reason']} {said['cause']}"
        bent = (Cause("torch bent or moved", 0.95, _SURE, {}, (), words),) if said["cause"] else ()
        return worded("measurement of the tool", Diagnosis(bent, said["nozzle"]["scans"], float("nan")))
    if of_weld:  # held before anything was seen
        return worded("result", Diagnosis(of_weld, 0, float("nan")))
    if (folder / CALIBRATION).is_file():
        raise InputError(
            f"'{folder}' holds a pose without the scans that it came from (no {NAME}). Give the folder of the"
            " calibration, or that of the dataset."
        )
    return worded("dataset", diagnose_dataset(folder, flange, seed, progress))


def diagnose_dataset(folder: Path, flange: str | None, seed: int, progress: Progress = lambda *_: None) -> Diagnosis:
    """Fit the flange in every scan of a dataset and name what disturbs them.

    Raises:
        InputError: the dataset cannot be read, and not because of its units.
    """
    require_flange(folder, flange)
    try:
        data = load_dataset(folder)
    except DatasetError as refusal:
        if not any(words in str(refusal) for words in ("millimetres", "correct units", "10 mm to 10 m")):
            raise
        return Diagnosis((Cause("unit mix", 0.9, 1e9, {}, (), str(refusal)),), 0, float("nan"))
    standard = get_flange(flange or data.header.flange)
    found = standard if data.pairs else _other_flange(data, standard)
    anywhere = replace(data, header=replace(data.header, scanner_guess=None))  # a wrong pose leads the search astray
    seen = fit_flanges(anywhere, found, holes=False, seed=seed, tell=lambda share: progress("fit flanges", 0.9 * share))
    return diagnose(dataset_case(data, seen, standard, found))


def _other_flange(data: Dataset, stated: FlangeStandard) -> FlangeStandard:
    """Return the standard flange that a few scans show where they do not show the stated one; else the stated one."""
    ids = list(data.clouds)
    some = [ids[k] for k in np.unique(np.linspace(0, len(ids) - 1, min(_LOOKED_AT, len(ids))).astype(int))]
    if len(_found_in(data, some, stated)) > len(some) // 2:
        return stated
    best, least = stated, np.inf
    for standard in STANDARDS.values():
        rims = _found_in(data, some, standard)
        if standard.designation != stated.designation and len(rims) > len(some) // 2 and np.median(rims) < least:
            best, least = standard, float(np.median(rims))
    return best


def _found_in(data: Dataset, ids: Sequence[str], standard: FlangeStandard) -> list[float]:
    """Residuals of the edges (m) in the scans that show this flange whole."""
    rims = []
    for id in ids:
        try:
            fit = fit_flange(data.cloud(id), standard)
        except (CloudError, FlangeNotFound):
            continue
        if fit.coverage > _SEEN and fit.bore_radius_m is not None:
            rims.append(fit.rim_rms_m)
    return rims


def live_case(cell: Cell[Any], root: Context) -> DoctorCase | None:
    """Make the doctor's case of a live calibration; None where the job does not calibrate by a feature."""
    status = getattr(cell.job, "calibration_status", None)
    seen = None if status is None else status(root)
    if seen is None or not seen.observations:
        return None
    c, scanner = cell.scenario.calibration, cell.scenario.scanner_config()
    preset = None if scanner is None else scanner.scanner()
    return case_of(
        seen.observations,
        {},
        cell.job.X_FR.GetAsMatrix4(),
        robot=cell.scenario.arm,
        flange=cell.scenario.feature_standard().designation,
        refused=seen.refused,
        guess=c.mounting_guess.pose().GetAsMatrix4(),
        guess_radius=1e-3 * c.guess_radius_mm,
        near_far=None if preset is None else (preset.near_m, preset.far_m),
    )


def _recorded(path: Path, progress: Progress) -> Diagnosis:
    """Replay a recording, and examine what its calibration saw and its weld felt."""
    from weldcal.tools.commands.replay import replay_recording  # only here: it loads a whole cell

    cases: list[DoctorCase] = []
    reasons: list[str] = []

    def look(cell: Cell[Any], root: Context) -> None:
        case = live_case(cell, root)
        if case is not None:
            cases.append(case)
        reasons.append(cell.job.command(root).reason or "")

    replay_recording(path, progress, look)
    found = diagnose(cases[0]) if cases else Diagnosis((), 0, float("nan"))
    return _both(found, weld_causes(None, reasons[0]))


def _of_weld(folder: Path) -> tuple[Cause, ...]:
    """Causes that the weld log of a result shows, and the reason for which its run was held."""
    log = load_weld_log(folder) if (folder / CSV_NAME).is_file() else None
    summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8")) if (folder / SUMMARY).is_file() else {}
    return weld_causes(log, str(summary.get("reason") or ""))


def _both(found: Diagnosis, more: tuple[Cause, ...]) -> Diagnosis:
    return replace(found, causes=tuple(sorted((*found.causes, *more), key=lambda c: -c.score)))


def weld_causes(record: WeldRecord | None, reason: str) -> tuple[Cause, ...]:
    """Find a hidden tag and a worn tip in the log, or another reason of a hold ("": the run was not held)."""
    causes = []
    blind = 0.0 if record is None else blind_s(record)
    if "Tag hidden" in reason or (not reason and blind > PICTURE_S):
        causes.append(Cause("hidden tag", 0.99 if reason else 0.8, _SURE, {"blind_s": blind}, (), reason))
    elif reason:
        causes.append(Cause("the run was held", 0.5, _SAID, {}, (), reason))
    off = None if record is None else gain_off(record)
    if off is not None and abs(off) > WORN:
        causes.append(Cause("soft tip worn", 0.9, _LIKELY, {"gain": 1.0 + off}, ()))
    return tuple(causes)
