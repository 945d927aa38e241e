"""Scenarios that weld the made parts: how each part lies and is found, and what is known of the arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.worlds.parts.step_parts import MadePart
from weldcal.calibration.calibrate import PLAIN
from weldcal.models.errors import InputError
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.weld import known_camera
from weldcal.tools.report.render import write_atomic

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
welding: {{posture: any, seam_length_mm: {seam_mm}}}
home_deg: [190.0, -120.0, 135.0, -105.0, -90.0, 90.0]
"""


@dataclass(frozen=True, kw_only=True)
class PartTrial:
    """How the parts lie and are found: deviations of the true part, and the source of its pose.

    And what is known of the arm.

    `arm_mm`: rms distance of the true flange from the reported one. `refine`: as calibration.refine; with any but none
    the cell is calibrated before it welds, else it is given the scanner's pose.
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
    def of(cls, located_by: str, seam_mm: float | None = None, refine: str = PLAIN, arm_mm: float = 0.4) -> PartTrial:
        """Return the trial by the source of the pose: a pose from the drawing must be nearer to the truth.

        Raises InputError: an unknown refinement.
        """
        if refine not in REFINEMENTS:
            raise InputError(f"--refine must be {', '.join(REFINEMENTS[:-1])} or {REFINEMENTS[-1]}, not '{refine}'.")
        mm, deg = (1.0, 0.3) if located_by == "drawing" else (cls.translation_mm, cls.rotation_deg)
        return cls(
            located_by=located_by, translation_mm=mm, rotation_deg=deg, seam_mm=seam_mm, refine=refine, arm_mm=arm_mm
        )

    def calibration(self) -> Mapping[str, object]:
        """Return the keys of the scenario's calibration, besides the guess of the mounting."""
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


def write_cell(part: MadePart, folder: Path, trial: PartTrial) -> Path:
    """Write the part, its seam and a scenario that welds it; the scenario's path."""
    folder.mkdir(parents=True, exist_ok=True)
    part.write(folder)
    middle = part.line_mm[len(part.line_mm) // 2] if len(part.line_mm) > 2 else part.line_mm.mean(axis=0)
    # Turned by 90 deg about z, on the table, the middle of its seam 0.65 m before the robot.
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
    """Return the least z of a part, mm."""
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib

    bounds = Bnd_Box()
    BRepBndLib.AddOptimal_s(part.shape, bounds, False, False)
    return float(bounds.CornerMin().Z())
