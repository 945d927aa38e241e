"""weldcal hand-eye live: a calibration in any mounting in simulation, from the first pose to the report, against the truth."""

from __future__ import annotations

import csv
import io
import json
import time
from contextlib import closing
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_dump_typed
from pydrake.geometry import Meshcat, MeshcatParams

from weldcal.calibration.hand_eye.exports import Provenance, export_hand_eye
from weldcal.calibration.hand_eye.mountings import Mounting
from weldcal.calibration.hand_eye.solve import HandEyeResult, pose_difference
from weldcal.calibration.planning.mounting_poses import work_point
from weldcal.models.errors import InputError
from weldcal.systems.drivers.no_device import NoDevice
from weldcal.systems.jobs.mounting.calibrator import solve_mounting
from weldcal.systems.jobs.mounting.cell import FOOT, MountingRun, make_mounting_cell, run_mounting_cell
from weldcal.systems.scenario.schema import Scenario, check_scenario
from weldcal.tools.commands.demo import DemoOptions
from weldcal.tools.commands.hand_eye import HandEyeReport
from weldcal.tools.console import Progress
from weldcal.tools.report.render import write_atomic

Array = NDArray[np.float64]
HANDS_ON = (
    "--robot, --dry-run and --pace belong to the job of the cell: a mounting job runs on the arms of its scenario."
)


@dataclass(frozen=True)
class TruthError:
    """How far an unknown pose is from what only the simulation knows: mm, deg, squared error in units of its covariance, and
    the bound on it that holds the truth with 99.7 %."""

    mm: float
    deg: float
    nees: float
    bound: float


@dataclass(frozen=True, eq=False)
class MountingReport:
    """What a live calibration came to, and where it was written."""

    run: MountingRun
    result: HandEyeResult | None
    folder: Path
    seconds: float

    @property
    def mounting(self) -> Mounting:
        """The configuration."""
        return self.run.cell.scene.mounting

    @property
    def state(self) -> str:
        """`done`, or `held` with a reason."""
        return "done" if self.run.state.phase == "done" and self.result is not None else "held"

    @property
    def reason(self) -> str:
        """Why it is held; empty where it is done."""
        if self.state == "done":
            return ""
        found = self.run.state.reason or self.run.status.message
        return found or "The procedure did not end in time; allow more with job.maximum_time_s."

    def truth_errors(self) -> dict[str, TruthError]:
        """Symbol (X_FC ...) -> error against the truth."""
        out = {}
        for letter, X in self.run.cell.truth.items():
            if self.result is None or letter not in self.result.poses:
                continue
            e = pose_difference(self.result.poses[letter], X)
            out[self.mounting.unknowns[letter].symbol] = TruthError(
                1e3 * float(np.linalg.norm(e[3:])),
                float(np.degrees(np.linalg.norm(e[:3]))),
                self.result.normalised_error(letter, X),
                self.result.region(0.997),
            )
        return out

    def work_error_mm(self) -> float | None:
        """True error of a point at the scanner's best distance, mm."""
        truth = self.run.cell.truth.get("X")
        if self.result is None or truth is None:
            return None
        p = work_point(self.run.cell.scene)
        return 1e3 * float(np.linalg.norm(self.result.X @ p - truth @ p))

    def summary(self) -> dict[str, object]:
        """The JSON object: the keys of hand-eye, beside those of the run."""
        status, result = self.run.status, self.result
        out: dict[str, object] = {"state": self.state, "configuration": self.mounting.name}
        if self.reason:
            out["reason"] = self.reason
        out |= {
            "n_scans": status.sequence,
            "n_used": len(status.seen),
            "refused": [{"id": id, "reason": why} for id, why in status.refused],
        }
        if result is not None:
            for k, X in result.poses.items():
                out |= {k: X, f"{k}_is": self.mounting.unknowns[k].sentence, f"covariance_{k}": result.covariance[k]}
            out |= {
                "held_out_deg": result.held_out.rms_deg,
                "held_out_mm": 1e3 * result.held_out.rms_translation,
                "kept_aside_mm": [1e3 * k.error_m for k in status.kept_aside],
                "kept_aside_deg": [float(np.degrees(k.tilt_rad)) for k in status.kept_aside],
                "expected_error_mm": 1e3 * status.sigma_work_m,
                "work_error_mm": self.work_error_mm(),
                "truth": {s: vars(e) for s, e in self.truth_errors().items()},
                "inliers": result.inliers,
                "unobservable": list(result.unobservable),
                "warnings": list(result.warnings),
                "method": result.method,
                "next_pose": None if status.next_best is None else status.next_best.sentence(),
            }
        return out | {"simulated_seconds": self.run.seconds, "seconds": self.seconds}

    def given(self) -> tuple[str, ...]:
        """What was not sought: where the circle sits, and which link carries the scanner."""
        scene, scenario = self.run.cell.scene, self.run.cell.scenario
        out = []
        for letter in scene.known:
            u = self.mounting.unknowns[letter]
            circle = (
                "the circle of the base mounting" if scenario.calibration.configuration in FOOT else "the flange itself"
            )
            out.append(f"{u.symbol} is known: the target M is {circle}, where the robot's drawing puts it.")
        if "arm" in scene.configuration and not isinstance(scenario.scanner, NoDevice):
            out.append(f"The arm link L is the {scenario.scanner.mounted_on.replace('_', ' ')}.")
        return tuple(out)

    def text(self) -> str:
        """What a person reads: the direction in words, the sketch, numbers, and what was never seen."""
        status = self.run.status
        if self.result is None:
            return f"{self.mounting.name}: {self.state}. {self.reason}"
        lines = [HandEyeReport(self.result, self.mounting, (), None, (), self.seconds).text(), ""]
        lines += [f"given        {sentence}" for sentence in self.given()]
        aside = "  ".join(f"{1e3 * k.error_m:.3f}" for k in status.kept_aside)
        if aside:
            lines.append(f"kept aside   {aside} mm at poses the calibration never saw")
        lines.append(
            f"expected     {1e3 * status.sigma_work_m:.3f} mm (1 sigma) of a point at the scanner's best distance"
        )
        for symbol, e in self.truth_errors().items():
            lines.append(
                f"truth        {symbol} is off by {e.mm:.3f} mm, {e.deg:.4f} deg (simulation; squared error in units of its "
                f"covariance {e.nees:.1f}, 99.7 % of the time below {e.bound:.1f})"
            )
        lines += [f"refused      {id}: {why}" for id, why in status.refused]
        if status.next_best is not None:
            lines += ["", f"next best pose: {status.next_best.sentence()}"]
        return "\n".join(lines)


def run_mounting_live(scenario: Scenario, options: DemoOptions, progress: Progress) -> MountingReport:
    """Build, run, write.

    Raises:
        InputError, UnreachableScanner: the scenario or the options cannot be done; nothing has been written or moved.
    """
    start = time.monotonic()
    if options.robot not in (None, "simulated") or options.dry_run or options.pace is not None:
        raise InputError(HANDS_ON)
    if options.speed_factor is not None:
        scenario.job.speed_factor = options.speed_factor
        check_scenario(scenario)
    progress("plan", 0.0)
    meshcat = Meshcat(MeshcatParams(host="localhost", port=None)) if options.browser else None
    cell = make_mounting_cell(scenario, options.seed, meshcat)
    progress("visit the poses", 0.1)
    with closing(cell.station):
        run = run_mounting_cell(cell, meshcat)
    progress("write", 0.9)
    result = None
    if run.status.result is not None:
        result = solve_mounting(cell.scene, run.status.seen, folds=5)
    report = MountingReport(run, result, options.out, time.monotonic() - start)
    write_mounting(report, meshcat)
    return report


def write_mounting(report: MountingReport, meshcat: Meshcat | None) -> None:
    """Write hand_eye.yaml with its exports, sightings.csv, summary.txt, station.png, report.html and recording.html."""
    from weldcal.tools.report.mounting import mounting_report
    from weldcal.tools.report.mounting_picture import station_picture

    folder = report.folder
    scenario = yaml_dump_typed(report.run.cell.scenario)
    write_atomic(folder / "scenario.yaml", scenario)
    if report.result is not None:
        provenance = Provenance("scenario.yaml", sha256(scenario.encode()).hexdigest())
        export_hand_eye(report.result, report.mounting, folder, provenance)
    write_atomic(folder / "sightings.csv", _sightings(report.run))
    write_atomic(folder / "summary.txt", report.text() + "\n")
    picture = station_picture(report.run)
    write_atomic(folder / "station.png", picture)
    if meshcat is not None:
        write_atomic(folder / "recording.html", meshcat.StaticHtml())
    write_atomic(folder / "report.html", mounting_report(report, picture))


def _sightings(run: MountingRun) -> str:
    """One row a scan: joints (deg), centre (mm) and normal in the camera frame, share of the edge that was seen."""
    two = run.cell.scene.two
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    joints = [f"q{i}_deg" for i in range(1, 7)] + ([f"second_q{i}_deg" for i in range(1, 7)] if two else [])
    writer.writerow(["id", *joints, *(f"centre_{a}_mm" for a in "xyz"), *(f"normal_{a}" for a in "xyz"), "coverage"])
    for s in run.status.seen:
        q = np.degrees(s.pose.q if s.pose.q_2 is None else np.concatenate([s.pose.q, s.pose.q_2]))
        normal = np.zeros(3) if s.sighting.n_CM is None else s.sighting.n_CM
        values = [*q, *(1e3 * s.sighting.p_CM), *normal, s.coverage]
        writer.writerow([s.label, *(json.dumps(round(float(v), 6)) for v in values)])
    return text.getvalue()
