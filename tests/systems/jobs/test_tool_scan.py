"""The arm shows a tool with a bent torch to the scanner, and the torch is measured by those scans."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform
from typer.testing import CliRunner

from tests.systems.cells import KNOWN_CAMERA, Q_HOME, the_arm
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.results import CalibrationResult, save_result
from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.tool.comparison import measured_file
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.errors import InputError
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.systems.jobs.tool_scan.job import ToolScanInputs, ToolScanProcedure, ToolScanState
from weldcal.systems.jobs.tool_scan.planner import ToolView, plan_tool_views
from weldcal.systems.messages import Scan, UrStatus
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.cli.app import app
from weldcal.tools.commands.cell.tool import showing_tool

NOMINAL = load_tool(WELDING)
BEND = np.array([1.2e-3, -0.9e-3, 0.0])  # 1.5 mm
RING_MM = np.array([0.0, 0.8, 0.0])  # off its place
AXIS = np.array([0.012, -0.009, 1.0]) / np.linalg.norm([0.012, -0.009, 1.0])  # 0.86 degrees


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A scenario whose world has a bent torch and a shifted ring, and the result of its calibration."""
    folder = tmp_path_factory.mktemp("tool_scan")
    true: Any = SimpleNamespace(
        tool=NOMINAL, p_FW=NOMINAL.p_FW + BEND, axis=AXIS, move=lambda _: None, stick_out_m=float("nan")
    )
    bent = measured_file(true)
    bent["ring"]["xyz_mm"] = (RING_MM + bent["ring"]["xyz_mm"]).tolist()
    (folder / "bent.yaml").write_text(yaml.safe_dump(bent))
    tool = f"tool: {{file: {WELDING}, simulated: bent.yaml}}"
    scanner = (
        "scanner: !RenderedScanner {preset: phoxi_m, width: 824, height: 616, exposure_s: 0.1, scale_error: 0.0,"
        " gradient_error_per_m: [0.0, 0.0], warp_mm: 0.0, mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}"
    )
    robot = "robot: !SimulatedUr {repeatability_mm: 0.0, kinematic_error_mm: 0.0}"
    (folder / "cell.yaml").write_text("\n".join(["extends: straight_groove", tool, scanner, robot, ""]))
    X_BC = yaml.safe_load(KNOWN_CAMERA)["X_BC"]
    _result(folder / "result", X_BC["xyz_m"])
    return str(folder / "cell.yaml"), folder / "result"


def _result(folder: Path, xyz_m: list[float]) -> None:
    X_BC = load_scenario("straight_groove", "job: {calibrate: false, " + KNOWN_CAMERA + "}").job.X_BC
    assert X_BC is not None
    pose = RigidTransform(X_BC.pose().rotation(), xyz_m)
    covariance = np.diag(np.repeat([1e-4, 5e-5], 3) ** 2)
    save_result(CalibrationResult(X_BC=pose, covariance=covariance, held_out_mm={}, tilt_deg={}, poses=()), folder)


def test_the_arm_shows_a_bent_torch_and_its_bend_is_found(cell: tuple[str, Path], tmp_path: Path) -> None:
    """The tool file is the nominal one; only the simulated world knows of the bend."""
    words = ["tool", "measure", "--scenario", cell[0], "--calibration", str(cell[1]), "--scans", "8"]
    found = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out"), "--json"])
    assert found.exit_code == 0, found.output
    told = json.loads(found.stdout.strip().splitlines()[-1])
    axis = np.array(told["torch"]["axis"])
    off = 1e-3 * np.array(told["torch"]["xyz_mm"]) - NOMINAL.p_FW - BEND
    assert np.linalg.norm(np.cross(off, AXIS)) < 0.15e-3
    assert np.degrees(np.arccos(axis @ AXIS)) < 0.2
    assert told["moved"]["nozzle"]["moved"]
    assert not told["moved"]["tip"]["moved"]
    assert told["moved"]["ring"]["moved"]
    assert np.linalg.norm(told["moved"]["ring"]["shift_mm"] - RING_MM) < 0.1
    assert told["moved"]["ring"]["turned_deg"] < 0.05
    assert abs(told["torch"]["stick_out_mm"] - 12.0) < 0.5  # the mouth, by its last pixels
    assert told["cause"].startswith("The torch is bent")
    data = load_dataset(tmp_path / "out/scans")
    joints = data.joints()
    assert 8 <= told["scans"] == len(data.clouds) == len(joints)
    for id, q in joints.items():
        np.testing.assert_allclose(
            data.poses[id].GetAsMatrix4(), forward_kinematics(the_arm(), q).GetAsMatrix4(), atol=1e-6
        )
    again = ["tool", "measure", str(tmp_path / "out/scans"), "--calibration", str(cell[1]), "--tool", str(WELDING)]
    found = CliRunner().invoke(app, [*again, "--out", str(tmp_path / "again"), "--json"])
    assert json.loads(found.stdout.strip().splitlines()[-1])["torch"]["xyz_mm"] == told["torch"]["xyz_mm"]


def test_the_views_surround_the_nozzle_and_the_scanner_sees_it(cell: tuple[str, Path]) -> None:
    scenario = showing_tool(cell[0], cell[1], 8)
    station = make_station(scenario, 0)
    X_BC, preset, config = station.truth.X_BC, station.truth.scanner, scenario.scanner_config()
    assert X_BC is not None
    assert preset is not None
    assert config is not None
    views = plan_tool_views(scenario, station, 0)
    p_F = NOMINAL.p_FW - np.array([[0.0], [0.02], [0.064]]) * NOMINAL.torch_axis
    around = []
    for view in views[:8]:
        X_BF = forward_kinematics(station.arm, view.q)
        p_C = np.asarray((X_BC.inverse() @ X_BF) @ p_F.T)
        assert preset.device.near_m < p_C[2].min()
        assert p_C[2].max() < preset.device.far_m
        u, v, w = config.scanner().K @ p_C
        assert (np.abs(u / w - config.scanner().cx) < 0.5 * config.scanner().width).all()
        assert (np.abs(v / w - config.scanner().cy) < 0.5 * config.scanner().height).all()
        to_eye = X_BF.inverse() @ X_BC.translation() - p_F[1]
        assert abs(to_eye @ NOMINAL.torch_axis) < np.sin(np.radians(45.0)) * np.linalg.norm(to_eye)
        around.append(np.degrees(np.arctan2(to_eye[1], to_eye[0])))
    gaps = np.diff(np.sort([*around, min(around) + 360.0]))
    assert gaps.max() < 100.0
    assert sum(view.tip for view in views) >= 3
    station.close()


def test_what_cannot_be_shown_is_one_sentence(cell: tuple[str, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="only to a scanner that is fixed in the cell"):
        showing_tool("carried_scanner", cell[1])
    with pytest.raises(InputError, match="needs a welding tool"):
        showing_tool("calibrate_only", cell[1])
    with pytest.raises(InputError, match="give --calibration RESULT"):
        showing_tool(cell[0], None)
    _result(tmp_path, [4.0, 0.0, 0.95])
    scenario = showing_tool(cell[0], tmp_path)
    station = make_station(scenario, 0)
    with pytest.raises(UnreachableScanner, match=r"Only 0 of 12 scans .* out of the arm's reach\. Choose a home_deg"):
        plan_tool_views(scenario, station, 0)
    station.close()


def test_each_view_is_scanned_once_and_a_silent_scanner_holds_the_job() -> None:
    views = tuple(ToolView(np.full(6, 0.1 * k), np.ones(3)) for k in (1, 2))
    procedure = ToolScanProcedure(views, Q_HOME)

    def run(*, silent: bool) -> ToolScanState:
        state = ToolScanState()
        for k in range(10_000):
            q = Q_HOME if state.q_goal is None else state.q_goal
            scan = Scan(sequence=0 if silent else state.trigger)
            now = ToolScanInputs(time=0.008 * k, q=q, settled_goal=state.goal_id, robot=UrStatus(), scan=scan)
            state = procedure.next_state(state, now)
            if state.finished:
                break
        return state

    done = run(silent=False)
    assert done.phase == "done"
    np.testing.assert_allclose(done.taken, [view.q for view in views])
    held = run(silent=True)
    assert held.held
    assert "check the scanner" in held.reason
