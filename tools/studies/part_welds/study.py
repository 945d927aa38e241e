"""Welds the made parts in the simulated cell, each from its STEP file and its seam's CSV, and scores the torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.refinement.refined import PLAIN
from weldcal.models.errors import InputError
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.demo import known_camera, run_scenario
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.part_welds.step_parts import PARTS, MadePart

COLUMNS = (
    "part", "joint", "seed", "state", "torch_mean_mm", "torch_max_mm", "plan_mean_mm", "plan_max_mm", "welded_mm", "refined",
    "plan_arm_sigma_mm", "plan_arm_turn_deg", "reason",
)  # fmt: skip
MEAN_TARGET_MM, MAX_TARGET_MM = 0.10, 0.40
REFINEMENTS = (PLAIN, "joints", "links")
_CELL = """\
description: {name}, a {joint} joint.
robot: !SimulatedUr {{repeatability_mm: 0.05, kinematic_error_mm: {arm_mm}}}
scanner: !RenderedScanner
  preset: phoxi_m
  width: 824
  height: 616
finger_camera: !RenderedFingerCamera {{}}
calibration:
  {calibration}
  mounting_guess: {{xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}
workpiece:
  file: {name}.step
  units: mm
  seams: [{{polyline: {name}.csv}}]
  joint: {joint}
  located_by: {located_by}
  pose_guess: {{xyz_m: [{x:.4f}, {y:.4f}, {z:.4f}], rpy_deg: [0.0, 0.0, 90.0]}}
  placement_error: {{translation_mm: {translation_mm}, rotation_deg: {rotation_deg}}}
  groove_error: {{translation_mm: {bow_mm}}}
planning: {{search: {search}}}
welding: {{seam_length_mm: {seam_mm}}}
home_deg: [190.0, -120.0, 135.0, -105.0, -90.0, 90.0]
"""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """How the parts lie and are found: deviations of the true part, and the source of its pose; and what is known of the arm.

    `arm_mm`: rms distance of the true flange from the reported one. `refine`: as calibration.refine; with any but none the cell is
    calibrated before it welds, else it is given the scanner's pose.
    """

    located_by: str = "scan"
    search: str = "anywhere"
    translation_mm: float = 6.0
    rotation_deg: float = 1.5
    bow_mm: float = 0.5
    seam_mm: float | None = None
    refine: str = PLAIN
    arm_mm: float = 0.4

    @classmethod
    def of(cls, located_by: str, seam_mm: float | None = None, refine: str = PLAIN, arm_mm: float = 0.4) -> Trial:
        """The trial by the source of the pose: what only the drawing tells must be nearer to the truth. Raises InputError: an unknown
        refinement."""
        if refine not in REFINEMENTS:
            raise InputError(f"--refine must be {', '.join(REFINEMENTS[:-1])} or {REFINEMENTS[-1]}, not '{refine}'.")
        if located_by == "drawing":
            return cls(
                located_by=located_by,
                translation_mm=1.0,
                rotation_deg=0.3,
                seam_mm=seam_mm,
                refine=refine,
                arm_mm=arm_mm,
            )
        return cls(located_by=located_by, seam_mm=seam_mm, refine=refine, arm_mm=arm_mm)

    def calibration(self) -> Mapping[str, object]:
        """The keys of the scenario's calibration, besides the guess of the mounting."""
        if self.refine == PLAIN:
            return {"required_error_mm": 0.15, "maximum_scans": 12}
        # As docs/calibration.md has it: an arm's errors show in scans of many orientations only.
        return {
            "refine": self.refine,
            "minimum_scans": 16,
            "maximum_scans": 18,
            "theta_max_deg": 40,
            "required_error_mm": 0.5,
            "verification_scans": 3,
        }

    def scenario(self, cell: Path) -> Scenario:
        """The scenario of a cell of this trial: it calibrates and welds, or welds with the scanner's true pose."""
        return known_camera(str(cell)) if self.refine == PLAIN else load_scenario(str(cell))


def write_cell(part: MadePart, folder: Path, trial: Trial) -> Path:
    """Write the part, its seam and a scenario that welds it; the scenario's path."""
    folder.mkdir(parents=True, exist_ok=True)
    part.write(folder)
    middle = part.line_mm[len(part.line_mm) // 2] if len(part.line_mm) > 2 else part.line_mm.mean(axis=0)
    # Turned by 90 deg about z, standing on the table, the middle of its seam 0.65 m before the robot.
    text = _CELL.format(
        name=part.name,
        joint=part.joint,
        located_by=trial.located_by,
        search=trial.search,
        x=0.65 + 1e-3 * middle[1],
        y=-1e-3 * middle[0],
        z=-1e-3 * lowest(part),
        translation_mm=trial.translation_mm,
        rotation_deg=trial.rotation_deg,
        bow_mm=trial.bow_mm,
        arm_mm=trial.arm_mm,
        calibration="\n  ".join(f"{key}: {value}" for key, value in trial.calibration().items()),
        seam_mm="null" if trial.seam_mm is None else trial.seam_mm,
    )
    path = folder / f"{part.name}.yaml"
    write_atomic(path, text)
    return path


def lowest(part: MadePart) -> float:
    """The least z of a part, mm."""
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib

    bounds = Bnd_Box()
    BRepBndLib.AddOptimal_s(part.shape, bounds, False, False)
    return float(bounds.CornerMin().Z())


def run_part_welds(
    out: Path,
    names: Sequence[str] | None,
    seeds: range,
    trial: Trial | None = None,
    progress: Progress = no_progress,
) -> Mapping[str, object]:
    """Weld each part once per seed; parts.csv grows row by row.

    Returns the worst figures and how many welds reached the targets.

    Raises:
        InputError: a part of another name, or no OpenCascade.
    """
    chosen = list(PARTS) if names is None else list(names)
    unknown = [name for name in chosen if name not in PARTS]
    if unknown:
        raise InputError(f"There is no part '{unknown[0]}': choose from {', '.join(PARTS)}.")
    trial = trial or Trial()
    rows: list[dict[str, object]] = []
    runs = [(name, seed) for name in chosen for seed in seeds]
    for k, (name, seed) in enumerate(runs):
        part = PARTS[name]()
        folder = out / name
        cell = write_cell(part, folder, trial)

        def shown(stage: str, share: float, k: int = k, name: str = name) -> None:
            progress(f"{name}: {stage}", (k + share) / len(runs))

        options = RunOptions(scenario=str(cell), out=folder / f"seed{seed}", seed=seed, recording=False)
        result = run_scenario(trial.scenario(cell), options, shown)
        result.run.raise_if_interrupted()
        summary = result.summary()
        found = summary.get("refinement")
        refined = isinstance(found, Mapping) and found.get("accepted") is True
        rows.append({**summary, "part": name, "joint": part.joint, "seed": seed, "refined": refined})
        write_atomic(out / "parts.csv", csv_text(COLUMNS, ([row.get(name, "") for name in COLUMNS] for row in rows)))
    return _summed(rows)


def _summed(rows: list[dict[str, object]]) -> dict[str, object]:
    def of(row: Mapping[str, object], key: str) -> float:
        value = row.get(key)
        return float(value) if isinstance(value, int | float) else float("nan")

    good = [
        row["state"] == "done"
        and of(row, "torch_mean_mm") <= MEAN_TARGET_MM
        and of(row, "torch_max_mm") <= MAX_TARGET_MM
        for row in rows
    ]
    means, most = ([of(row, key) for row in rows] for key in ("torch_mean_mm", "torch_max_mm"))
    return {
        "state": "done" if all(row["state"] == "done" for row in rows) else "held",
        "welds": len(rows),
        "within_targets": int(sum(good)),
        "worst_torch_mean_mm": float(np.nanmax(means)) if np.isfinite(means).any() else None,
        "worst_torch_max_mm": float(np.nanmax(most)) if np.isfinite(most).any() else None,
        "parts": [{key: row.get(key) for key in COLUMNS if key in row} for row in rows],
    }
