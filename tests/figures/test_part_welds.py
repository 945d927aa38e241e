"""The welds of made parts: how the cell of a trial is calibrated, and how far its arm is off."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.figures.parts.welds import COLUMNS
from tests.worlds.parts.cells import PartTrial, write_cell
from tests.worlds.parts.step_parts import PARTS
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.seam_planning import plan_drawn_seam
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.messages import CalibrationStatus, PlannedSeam, Refinement
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.report.demo import DemoResult, seam_document
from weldcal.welding.record.process import PathError


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


@pytest.mark.parametrize("word", ["wrists", "all"])
def test_another_refinement_is_refused_before_any_work(word: str) -> None:
    with pytest.raises(InputError, match=f"must be .*, not '{word}'"):
        PartTrial.of("scan", refine=word)


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


def test_a_seams_figures_name_its_ends() -> None:
    """3-4-5 at the start, 5-12-13 at the end, 0.1 mm between."""
    s = np.arange(0.0, 0.051, 0.001)
    lateral, height = np.full(len(s), 1e-4), np.zeros(len(s))
    lateral[2], height[2], lateral[-3], height[-3] = 3e-4, 4e-4, -5e-5, 1.2e-4
    found = seam_document(PathError(s, lateral, height))
    ends = {"torch_first_max_mm": 0.5, "torch_last_max_mm": 0.13, "torch_middle_max_mm": 0.1}
    assert {key: found[key] for key in ends} == pytest.approx(ends)
    assert found["torch_max_mm"] == pytest.approx(0.5)
    assert set(ends) - {"torch_middle_max_mm"} <= set(COLUMNS)


def test_the_arm_of_the_cell_follows_the_bent_web_without_meeting_itself(tmp_path: Path) -> None:
    """On the branch of home the tool's ring would meet the forearm at its end."""
    scenario = load_scenario(str(write_cell(PARTS["curved_web"](), tmp_path, PartTrial())))
    station = make_station(scenario, 0)
    try:
        assert plan_drawn_seam(seam_planning(scenario, station, servo_config(scenario, station)), 1).reason is None
    finally:
        station.close()
