"""What a run leaves on disk: calibration.yaml, weld.csv and the scans as a dataset that `weldcal calibrate` reads again."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from weldcal.calibration.dataset import save_dataset
from weldcal.calibration.dataset_header import DatasetHeader, Feature, ScannerGuess
from weldcal.calibration.result import CalibrationResult, PoseRecord, export_all, save_result
from weldcal.calibration.solve import CalibrationEstimate
from weldcal.systems.cell import Cell, feature_standard
from weldcal.systems.drivers.rendered_scanner import RenderedScanner
from weldcal.systems.messages import CalibrationStatus
from weldcal.tools.outcome import WeldLog
from weldcal.tools.report.render import write_atomic
from weldcal.tools.simulation import Run
from weldcal.welding.servo_state import Phase

PHASE_NAMES = [str(phase) for phase in Phase]


def error_summary(values: np.ndarray) -> dict[str, float]:
    """Median, mean and 95th percentile of the finite values, in their own unit."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return {}
    return {"median": float(np.median(finite)), "mean": float(finite.mean()), "p95": float(np.percentile(finite, 95))}


def live_result(cell: Cell, status: CalibrationStatus, seed: int) -> CalibrationResult | None:
    """The live calibration in the form that `weldcal calibrate` writes; None before there is an estimate."""
    estimate = status.estimate
    if estimate is None:
        return None
    scanner = cell.scenario.scanner
    records = [_record(observation.id, estimate, k) for k, observation in enumerate(status.observations)]
    records += [PoseRecord(id=label, used=False, reason=reason) for label, reason in status.refused]
    return CalibrationResult(
        X_BC=estimate.X_BC,
        covariance=estimate.covariance,
        held_out_mm=error_summary(1e3 * estimate.held_out.position_m),
        tilt_deg={"median": error_summary(np.degrees(estimate.held_out.tilt_rad)).get("median")},
        poses=tuple(records),
        unobservable=estimate.unobservable,
        warnings=estimate.warnings,
        robot=cell.scenario.arm,
        flange=cell.scenario.calibration.feature,
        scanner=scanner.preset if isinstance(scanner, RenderedScanner) else "",
        sigma_position_mm=1e3 * estimate.sigma_position_m,
        sigma_normal_deg=float(np.degrees(estimate.sigma_normal_rad)),
        seed=seed,
    )


def _record(id: str, estimate: CalibrationEstimate, k: int) -> PoseRecord:
    used = bool(estimate.inliers[k])
    return PoseRecord(
        id=id,
        used=used,
        reason="" if used else "it disagrees with the other poses",
        residual_mm=float(1e3 * estimate.position_residuals_m[k]),
        held_out_mm=float(1e3 * estimate.held_out.position_m[k]),
        tilt_deg=float(np.degrees(estimate.tilt_residuals_rad[k])),
        held_out_tilt_deg=float(np.degrees(estimate.held_out.tilt_rad[k])),
    )


def write_calibration(cell: Cell, status: CalibrationStatus, seed: int, folder: Path) -> Path | None:
    """Write calibration.yaml and the forms that other tools read, where there is a calibration."""
    result = live_result(cell, status, seed)
    if result is None:
        return None
    export_all(result, folder)
    return save_result(result, folder)


def write_scans(run: Run, status: CalibrationStatus, folder: Path, robot: str = "simulated") -> Path | None:
    """Write the calibration scans as a dataset folder that `weldcal calibrate` reads again; None where there are none.

    `robot` is what moved the feature, for the dataset's note.
    """
    cell, scanner = run.cell, run.cell.scenario.scanner
    observed = {o.id: o.X_BR for o in status.observations if o.id in run.scans}
    if not observed or not isinstance(scanner, RenderedScanner):
        return None
    preset = scanner.scanner()
    c, X_RF = cell.scenario.calibration, cell.X_FR.inverse()
    guess = c.mounting_guess.pose()
    header = DatasetHeader(
        robot=cell.scenario.arm,
        flange=feature_standard(cell.scenario).designation,
        scanner=scanner.preset,
        configuration="eye_on_base",
        note=f"rendered scans of a run; robot: {robot}",
        feature_in_flange=Feature(
            _numbers(cell.X_FR.translation()), _numbers(cell.X_FR.rotation().ToQuaternion().wxyz())
        ),
        scanner_guess=ScannerGuess(
            _numbers(guess.translation()), _numbers(guess.rotation().ToQuaternion().wxyz()), 1e-3 * c.guess_radius_mm
        ),
    )
    save_dataset(
        folder,
        header,
        {id: X_BR @ X_RF for id, X_BR in observed.items()},
        {id: run.scans[id][0].points_C.astype(float) for id in observed},
        times={id: run.scans[id][0].capture_time for id in observed},
        intrinsics=(preset.fx, preset.fy, preset.cx, preset.cy),
    )
    return folder


def _numbers(values: np.ndarray) -> list[float]:
    return [float(v) for v in values]


def write_weld_csv(log: WeldLog, folder: Path) -> Path:
    """Write weld.csv: one row per log period; metres and seconds, positions in the base frame B."""
    names = ["time_s", "phase", "torch_on"]
    names += [f"{point}_{axis}_m" for point in ("tip", "torch", "robot") for axis in "xyz"]
    names += [f"deflection_{axis}_m" for axis in ("tangential", "normal", "axial")]
    extra = [name for name in log.telemetry if name not in ("phase", "torch_on")]
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow([*names, *extra, "sigma_min"])
    for k, time in enumerate(log.time):
        row: list[object] = [f"{time:.4f}", PHASE_NAMES[int(log.telemetry["phase"][k])], int(log.torch_on[k])]
        numbers = [*log.p_BTip[k], *log.p_BTorch[k], *log.p_BRobot[k], *log.deflection_T[k]]
        numbers += [log.telemetry[name][k] for name in extra] + [log.sigma_min[k]]
        writer.writerow(row + [f"{v:.7g}" for v in numbers])
    path = folder / "weld.csv"
    write_atomic(path, table.getvalue())
    return path
