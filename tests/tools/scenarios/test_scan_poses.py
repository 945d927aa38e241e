"""A part larger than one scan: its scan poses are proposed, and it is welded from all scans; a scan that is off is
refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from typer.testing import CliRunner

from tests.worlds.parts.step_parts import assembly, box, write_step
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.errors import InputError
from weldcal.models.mesh import extrude
from weldcal.models.scanners import cast, get_scanner
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.seam_planning import plan_seam
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.messages import PlannedSeam, Scan, ScanView
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.cli.app import app
from weldcal.tools.commands.cell import scan_poses
from weldcal.tools.commands.cell.new import OwnPart, write_cell
from weldcal.tools.commands.replay import replay_recording
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.run import RunOptions

UP = np.array([0.0, 0.0, 1.0])
SHORT = "workpiece: {{seams: [{{edges: {edges}, start_mm: {start}}}]}}\nwelding: {{seam_length_mm: 40.0}}"


def write_beam(folder: Path) -> Path:
    """A T of two solids, 1500 x 100 x 100 x 8 mm."""
    path = folder / "beam.step"
    write_step(assembly(box((0, -50, 0), (1500, 100, 8)), box((0, -4, 8), (1500, 8, 92))), path)
    return path


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("beam")
    words = ["new", str(folder / "cell"), "--part", str(write_beam(folder)), "--from", "carried_scanner", "--json"]
    finished = CliRunner().invoke(app, words)
    assert finished.exit_code == 0, finished.stdout
    return Path(json.loads(finished.stdout.splitlines()[-1])["written"])


def test_a_long_part_gets_scan_poses_that_overlap_and_pass_its_ends(cell: Path) -> None:
    scenario = load_scenario(str(cell))
    assert scenario.workpiece is not None
    station = make_station(scenario, 0)
    station.close()
    scanner, X_FC = get_scanner("phoxi_m"), scenario.carried_scanner()
    assert X_FC is not None
    poses = [np.deg2rad(q) for q in scenario.planning.scan_poses_deg]
    eyes = np.array([(forward_kinematics(station.arm, q) @ X_FC.pose()).translation() for q in poses])
    assert len(eyes) == 3
    away = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    shown = scanner.footprint_m(scanner.optimum_m - 0.05)[0]  # at the part's top
    assert np.all(away < shown - 0.02)
    assert away.sum() + shown > 1.5 + 0.04


@pytest.mark.parametrize("start", [0.0, 730.0])
def test_a_long_part_is_welded_from_all_scans_and_replayed(cell: Path, start: float, tmp_path: Path) -> None:
    seams = load_scenario(str(cell)).workpiece
    assert seams is not None
    scenario = load_scenario(str(cell), SHORT.format(edges=seams.seams[0].edges, start=start))
    replayed = start > 0.0
    result = run_scenario(
        scenario, RunOptions(scenario=str(cell), out=tmp_path / "run", recording=False, record=replayed)
    )
    outcome = result.summary()
    assert outcome["state"] == "done", outcome
    assert outcome["welded_mm"] > 39.0
    assert outcome["torch_max_mm"] < 0.3
    phases = [name for name, _, _ in result.run.phases]
    assert phases.count("move_to_scan") == phases.count("scan_workpiece") == 3
    if replayed:
        assert replay_recording(tmp_path / "run/recording.mcap").first is None


def planned(cell: Path, number: int, off_B: list[float]) -> PlannedSeam:
    """The plan from scans at the cell's poses; the scan with this number is fused with a pose that is off."""
    scenario = load_scenario(str(cell))
    station, carried = make_station(scenario, 0), scenario.carried_scanner()
    station.close()
    assert scenario.workpiece is not None
    assert station.cad is not None
    assert carried is not None
    X_BP = RigidTransform([0.004, -0.003, 0.0]) @ scenario.workpiece.pose_guess.pose()
    table = extrude(np.array([[0.1, -1.0], [1.2, -1.0], [1.2, 1.0], [0.1, 1.0]]), -0.02, 0.0)
    views = []
    for k, q in enumerate(scenario.planning.scan_poses_deg):
        X_BC = forward_kinematics(station.arm, np.deg2rad(q)) @ carried.pose()
        cloud = cast([station.cad.mesh.transformed(X_BP), table], X_BC, get_scanner("phoxi_m", 412), k)
        X_CB = X_BC.inverse()
        points_C = (cloud @ X_CB.rotation().matrix().T + X_CB.translation()).astype(np.float32)
        stated = RigidTransform(off_B) @ X_BC if k == number else X_BC
        views.append(ScanView(Scan(k + 1, points_C=points_C), stated))
    planning = seam_planning(scenario, station, servo_config(scenario, station))
    return plan_seam(planning, views[-1].scan, views[-1].X_BC, ScannerCorrection(), tuple(views[:-1]))


def test_a_scan_that_is_5_mm_off_is_refused(cell: Path) -> None:
    across = planned(cell, 1, [0.005, 0.0, 0.0])
    assert across.seam is None
    assert "number 2 shows the part elsewhere than the others" in str(across.reason)
    up = planned(cell, 1, [0.0, 0.0, 0.005])
    assert up.seam is None  # the web's side still agrees: what is off may be named as a thing that is not drawn


def test_a_scanner_beside_the_arm_that_shows_too_little_names_the_other_cell(tmp_path: Path) -> None:
    written, reason = write_cell(tmp_path / "cell", "s_groove", OwnPart(write_beam(tmp_path)))
    assert written.name == "unfinished.yaml"
    assert "The part is 1.5 m long, and the scanner beside the arm shows 0.82 m of it" in reason
    assert "new FOLDER --part FILE --from carried_scanner" in reason


def test_a_part_whose_end_is_in_view_is_looked_for_in_one_scan() -> None:
    """A scanner 0.9 m above the table shows 0.8 m; a beam of 1.5 m lies centred below it, or with one end there."""
    scanner, X_BC, up = get_scanner("phoxi_m"), RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, 0.9]), UP
    beam = extrude(np.array([[-0.75, -0.05], [0.75, -0.05], [0.75, 0.05], [-0.75, 0.05]]), 0.0, 0.1)
    for aside, sought in ((0.0, False), (0.3, False), (0.4, True), (0.75, True)):
        part = beam.transformed(RigidTransform([aside, 0.0, 0.0]))
        assert (scan_poses._too_long(part, scanner, X_BC, up, ends=True) == "") is sought
        assert scan_poses._too_long(part, scanner, X_BC, up).startswith("The part is 1.5 m long")


@pytest.mark.parametrize(
    ("name", "keys", "refusal"),
    [
        (
            "straight_groove",
            "planning: {scan_poses_deg: [[0, -80, 110, -120, -90, 0]]}",
            "A scanner beside the arm has one view",
        ),
        ("carried_scanner", "job: {calibrate: true}", "needs its pose there"),
        (
            "carried_scanner",
            "planning: {scan_poses_deg: [[0, -80, 110]]}",
            r"scan_poses_deg\[0\] must hold 6 angles, not 3",
        ),
        (
            "carried_scanner",
            "planning: {scan_poses_deg: [[0, -80, 400, -120, -90, 0]]}",
            r"scan_poses_deg\[0\] puts joint 3",
        ),
        (
            "carried_scanner",
            "planning: {scan_poses_deg: [[0, -80, 110, -120, -90, 0], [9, -80, 110, -120, -90, 0]]}",
            "several poses are for a part from a file",
        ),
    ],
)
def test_scan_poses_that_cannot_be_used_are_refused(name: str, keys: str, refusal: str) -> None:
    with pytest.raises(InputError, match=refusal):
        load_scenario(name, keys)
