"""A station in which no device is simulated: no simulated world, no `cheat.*`, and yet a whole job with its report."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw

from tests.systems.plugin_robot import KinematicArm
from tests.systems.plugin_scanner import RayScanner
from weldcal.systems.cell import build_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.run import RunOptions


def real_cell() -> Scenario:
    scenario = load_scenario("calibrate_only", "calibration: {minimum_scans: 5, maximum_scans: 5}")
    scenario.robot, scenario.scanner = KinematicArm(), RayScanner()
    return scenario


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> DemoResult:
    return run_scenario(
        real_cell(), RunOptions(scenario="calibrate_only", out=tmp_path_factory.mktemp("real"), recording=False)
    )


def test_it_holds_no_world_and_speaks_of_no_truth(finished: DemoResult) -> None:
    station = finished.run.cell.station
    assert station.world is None
    outputs = [station.diagram.get_output_port(k).get_name() for k in range(station.diagram.num_output_ports())]
    assert [name for name in outputs if name.startswith("cheat")] == []
    names = {system.get_name() for system in station.diagram.GetSystems()}
    assert names == {"kinematic_arm", "ray_scanner", "scene_graph", "drawn_poses"}


def test_the_job_is_done_and_its_report_gives_no_true_error(finished: DemoResult) -> None:
    summary = finished.summary()
    assert summary["state"] == "done", summary.get("reason")
    assert "X_BC_error_mm" not in summary
    X_BC = RigidTransform(np.asarray(summary["X_BC"]))
    drawn = RayScanner()
    true = RigidTransform(RollPitchYaw(np.deg2rad(drawn.rpy_deg)), drawn.xyz_m)
    # 0.03 mm of noise along each ray, five scans: the camera's origin, 0.7 m away, is known to some 0.1 mm
    assert np.linalg.norm(X_BC.translation() - true.translation()) < 2e-4
    page = (finished.folder / "report.html").read_text()
    assert "Error at the work point, 95\u00a0%" in page
    assert "known in simulation only" not in page
    assert "Robot: KinematicArm, seed 0." in page
    assert {"calibration.yaml", "scans"} <= {path.name for path in finished.folder.iterdir()}


def test_the_viewer_shows_the_arm_where_it_is_measured() -> None:
    meshcat = Meshcat(MeshcatParams(host="localhost", port=None))
    cell = build_cell(real_cell(), meshcat=meshcat)
    diagram = cell.diagram
    context = diagram.CreateDefaultContext()
    diagram.ForcedPublish(context)
    assert meshcat.HasPath("/drake/cell")
    query = cell.station.diagram.GetOutputPort("query_object").Eval(cell.station.diagram.GetMyContextFromRoot(context))
    inspector = query.inspector()
    (flange,) = (f for f in inspector.GetAllFrameIds() if inspector.GetName(f).endswith("flange"))
    shown = query.GetPoseInWorld(flange)
    measured = cell.station.diagram.GetOutputPort("arm.X_BF").Eval(cell.station.diagram.GetMyContextFromRoot(context))
    assert np.linalg.norm(shown.translation() - measured.translation()) < 1e-9
