"""The welds of made parts: how the cell of a trial is calibrated, and how far its arm is off."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from typer.testing import CliRunner

from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.messages import CalibrationStatus, PlannedSeam, Refinement
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.app import app
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.studies.parts.welds import run_part_welds
from weldcal.tools.worlds.parts.cells import PartTrial, write_cell
from weldcal.tools.worlds.parts.step_parts import PARTS


def test_a_refined_cell_calibrates_scanner_and_arm_before_it_welds(tmp_path: Path) -> None:
    trial = PartTrial.of("scan", refine="links", arm_mm=0.7)
    scenario = trial.scenario(write_cell(PARTS["straight_web"](), tmp_path, trial))
    assert scenario.job.calibrate
    assert scenario.job.weld
    assert scenario.job.X_BC is None
    assert scenario.calibration.refine == "links"
    assert isinstance(scenario.robot, SimulatedUr)
    assert scenario.robot.kinematic_error_mm == 0.7


def test_without_it_the_scanners_pose_is_given(tmp_path: Path) -> None:
    trial = PartTrial()
    scenario = trial.scenario(write_cell(PARTS["straight_web"](), tmp_path, trial))
    assert not scenario.job.calibrate
    assert scenario.job.X_BC is not None
    assert scenario.calibration == load_scenario(str(tmp_path / "straight_web.yaml")).calibration
    assert scenario.calibration.refine == "none"


def test_another_refinement_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"calibration.refine must be .*, not 'wrists'"):
        run_part_welds(tmp_path, ["straight_web"], range(1), PartTrial(refine="wrists"))


def of_plan(sigma_m: float, refinement: Refinement | None = None) -> DemoResult:
    """The result of a run of which only the plan's forecast matters."""
    plan = PlannedSeam(arm_sigma_m=sigma_m, arm_turn_rad=math.radians(44.0))
    run: Any = SimpleNamespace(cell=SimpleNamespace(job=SimpleNamespace(planned_seam=lambda root: plan)), root=None)
    status = CalibrationStatus(refinement=refinement)
    return DemoResult(options=cast(Any, None), run=run, status=status, calibration=None, weld=cast(Any, object()))


def test_a_bent_seam_is_noted_where_the_arm_matters() -> None:
    (note,) = of_plan(0.00021).arm_note
    assert "up to 44 deg" in note
    assert "0.21 mm" in note
    assert "calibration.refine: links" in note
    assert of_plan(0.00007).arm_note == ()
    assert of_plan(math.nan).arm_note == ()
    refined = Refinement(kind="links", sentence="", accepted=True, arm=cast(Any, object()))
    (note,) = of_plan(0.00021, refined).arm_note
    assert "What the refinement leaves" in note
    assert "Calibrate" not in note


def test_an_unknown_refinement_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    found = CliRunner().invoke(app, ["benchmark", "part-welds", "--refine", "all", "--out", str(tmp_path / "out")])
    assert found.exit_code == 1
    assert "--refine must be none, joints or links, not 'all'." in " ".join(found.output.split())
    assert not (tmp_path / "out").exists()
