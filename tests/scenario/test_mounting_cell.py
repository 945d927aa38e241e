"""Every mounting live, in few poses: the scanner (and the second arm) is found where the simulation truly put it."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from typer.testing import CliRunner

from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.planning.mounting_estimate import solve_mounting
from weldcal.calibration.planning.mounting_poses import work_point
from weldcal.calibration.recorded_carried import calibrate_carried
from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.jobs.mounting.job import mounting_scene
from weldcal.systems.jobs.mounting.procedure import MountingProcedure, MountingState, MountingStatus
from weldcal.systems.messages import UrStatus
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.app import app
from weldcal.tools.commands.mounting_live import live_report, run_mounting_live, write_mounting
from weldcal.tools.commands.run import JobRun
from weldcal.tools.procedure import kind_of
from weldcal.tools.report.mounting import MountingReport
from weldcal.tools.report.run import RunOptions

# few poses near home, a coarse image, a controller at a quarter of its rate: seconds instead of a minute
IDEAL_ARM = "!SimulatedUr {control_period_s: 0.008, repeatability_mm: 0.0, kinematic_error_mm: 0.0}"
SHORT = {
    "eye_in_hand": (560, 5, "mounting: {travel_deg: 40.0}"),
    "eye_on_arm": (412, 5, "mounting: {spread_deg: 18.0}"),
    "eye_on_arm_base": (560, 5, "mounting: {spread_deg: 20.0}"),
    "co_manipulation": (560, 6, f"mounting: {{travel_deg: 30.0, spread_deg: 8.0}}\nrobot_2: {IDEAL_ARM}"),
}
SEED = 1


def ideal_short(name: str) -> Scenario:
    """The scenario with an exact arm and a scanner that has noise only."""
    width, scans, extra = SHORT[name]
    exact = "scale_error: 0.0, gradient_error_per_m: [0.0, 0.0], warp_mm: 0.0"
    scanner = f"scanner: !RenderedScanner {{width: {width}, height: {3 * width // 4}, exposure_s: 0.02, {exact}}}\n"
    count = f"calibration: {{minimum_scans: {scans}, maximum_scans: {scans}, verification_scans: 1}}\n"
    return load_scenario(name, f"robot: {IDEAL_ARM}\n" + scanner + count + extra)


@cache
def finished(name: str) -> MountingReport:
    """A run as the command has it, before anything is written."""
    run = run_cell(build_cell(ideal_short(name), SEED))
    return live_report(JobRun(run, None, "simulated"), Path(), time.monotonic())


@pytest.mark.parametrize("name", list(SHORT))
def test_what_is_sought_is_found_where_it_truly_is(name: str) -> None:
    run = finished(name)
    result = run.status.result
    assert run.state == "done", run.reason
    assert result is not None
    assert set(result.poses) == set(run.truth) == ({"X", "Y"} if name == "co_manipulation" else {"X"})
    assert result.unobservable == ()
    for letter, truth in run.truth.items():
        assert result.normalised_error(letter, truth) < result.region(0.9973)  # three sigma
        # a pixel is about a millimetre; an edge of hundreds of them places a centre to a tenth of one
        if (
            letter == "X"
        ):  # pose and correction go together: few scans in a small region do not separate them, a scanned point needs both
            p = work_point(run.scene)
            assert np.linalg.norm(result.place(p) - truth @ p) < 3e-4
        else:
            assert np.linalg.norm(result.poses[letter].translation() - truth.translation()) < 3e-4
    # the tape measure was off by 8 mm and more
    assert np.linalg.norm(run.scene.X_LC.translation() - run.truth["X"].translation()) > 7e-3


@pytest.mark.parametrize("name", list(SHORT))
def test_a_held_out_pose_is_where_the_calibration_expects_it(name: str) -> None:
    (aside,) = finished(name).status.held_out
    assert aside.error_m < 3e-4
    assert np.degrees(aside.tilt_rad) < 0.1


@pytest.mark.parametrize("name", list(SHORT))
def test_the_next_best_pose_is_new_and_would_help(name: str) -> None:
    run = finished(name)
    best = run.status.next_best
    assert best is not None
    assert best.after_m < best.before_m
    assert min(np.abs(best.q - s.pose.q).max() for s in run.status.seen) > np.radians(0.5)
    assert run.scene.seen(best.q, best.q_2).translation()[2] > 0.3  # before the scanner


def test_a_circle_of_unknown_place_leaves_its_turn_about_its_own_normal_open_and_nothing_else() -> None:
    run = finished("eye_in_hand")
    scene = replace(run.scene, target_known=False)
    result = solve_mounting(scene, run.status.seen)
    (name,) = result.unobservable
    assert name == "rotation about (+0.00, +0.00, +1.00): pose of the target in the base frame: X_BM"
    assert result.normalised_error("X", run.truth["X"]) < result.region(0.9973)
    assert result.covariance["Y"][2, 2] > 1.0  # rad^2: not a confident number
    assert np.linalg.norm(result.Y.translation() - scene.X_HR.translation()) < 1e-3


def test_the_first_joint_shows_the_foot_no_other_side() -> None:
    """The base circle turns about the first joint's own axis: a scanner on the arm sees the same, wherever that joint
    is."""
    _, scene, _ = mounting_scene(ideal_short("eye_on_arm_base"), finished("eye_on_arm_base").scene.arm)
    q = scene.q_home
    turned = q + np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    a, b = scene.seen(q), scene.seen(turned)
    assert np.linalg.norm(a.translation() - b.translation()) < 1e-9
    assert np.linalg.norm(a.rotation().matrix()[:, 2] - b.rotation().matrix()[:, 2]) < 1e-9


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> MountingReport:
    """The command's own way from the same run to files."""
    made = replace(finished("eye_on_arm"), folder=tmp_path_factory.mktemp("live"))
    assert made.run is not None
    write_mounting(made, JobRun(made.run, None, "simulated"))
    return made


def test_the_result_says_its_direction_in_words(report: MountingReport) -> None:
    text = report.text()
    assert "mm" in report.first.rows()["one sigma"]
    assert "base B --X_BL(robot)--> link L ==X_LC==> camera C" in text
    assert "mm at held-out poses" in text
    assert "X_FM is known: the target M is the flange itself" in text
    assert "The arm link L is the forearm." in text
    summary: dict[str, Any] = report.summary()
    assert summary["state"] == "done"
    assert summary["X_is"] == "pose of the camera in the arm link frame: X_LC"
    assert summary["work_error_mm"] < 0.3


def test_the_result_folder_is_whole(report: MountingReport) -> None:
    names = {p.name for p in report.folder.iterdir()}
    assert {"hand_eye.yaml", "X_LC.urdf.xacro", "sightings.csv", "station.png", "report.html", "scenario.yaml"} <= names
    assert (report.folder / "station.png").read_bytes()[:4] == b"\x89PNG"
    assert len((report.folder / "sightings.csv").read_text().splitlines()) == 1 + len(report.status.seen)
    page = (report.folder / "report.html").read_text()
    assert "Pose of the camera in the arm link frame: X_LC" in page
    assert "Next best pose" in page


def test_recorded_scans_give_the_live_answer(report: MountingReport, tmp_path: Path) -> None:
    """The folder scans/ of a run, read by `weldcal calibrate`, leads to the run's own poses and correction."""
    call = ["calibrate", str(report.folder / "scans"), "--out", str(tmp_path / "again"), "--limit-mm", "0.8", "--json"]
    ran = CliRunner().invoke(app, call)
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.output.splitlines()[-1])
    assert report.result is not None
    assert (found["state"], found["configuration"]) == ("done", "eye_on_arm_target_on_flange")
    np.testing.assert_allclose(found["X_LC"], report.result.X.GetAsMatrix4(), atol=5e-6)
    assert found["scanner_correction"]["scale"] == pytest.approx(report.result.correction.scale, abs=1e-6)
    np.testing.assert_allclose(found["covariance_X"], report.result.covariance["X"], rtol=0.05, atol=1e-10)
    assert found["n_used"] == len(report.status.seen)
    assert np.isfinite(found["held_out_mm"])
    page = (tmp_path / "again" / "report.html").read_text()
    assert "Pose of the camera in the arm link frame: X_LC" in page
    assert "goes with the scanner" in page
    written = (tmp_path / "again" / "hand_eye.yaml").read_text()
    assert "scanner_correction" in written


@pytest.mark.parametrize(
    ("line", "other", "match"),
    [
        ("scanner_link: forearm", "scanner_link: ''", "must name the link that carries the scanner"),
        ("robot: ur10e", "robot: panda", "The arm 'panda' is not known"),
        ("robot: ur10e", "robot: ur5e", "do not lead the ur5e to its stated pose"),
        ("arm_error_mm: 0.4", "arm_error_mm: 0.0", "arm_error_mm must be above 0"),
    ],
)
def test_a_dataset_that_lacks_something_says_what(
    report: MountingReport, tmp_path: Path, line: str, other: str, match: str
) -> None:
    folder = tmp_path / "scans"
    shutil.copytree(report.folder / "scans", folder)
    text = (folder / "dataset.yaml").read_text()
    assert line in text
    (folder / "dataset.yaml").write_text(text.replace(line, other))
    with pytest.raises(InputError, match=match):
        calibrate_carried(folder)


def test_other_commands_refuse_scans_of_a_carried_scanner(report: MountingReport) -> None:
    with pytest.raises(InputError, match=r"on an arm \(eye_on_arm_target_on_flange\)"):
        load_dataset(report.folder / "scans")


def test_what_does_not_belong_together_is_refused_before_any_work(tmp_path: Path) -> None:
    def refused(name: str, overrides: str, match: str) -> None:
        with pytest.raises(InputError, match=match):
            load_scenario(name, overrides)

    refused("eye_in_hand", "scanner: !RenderedScanner {mounted_on: forearm}", "mounted_on flange, not 'forearm'")
    refused("eye_in_hand", "scanner: !RenderedScanner {mounted_on: roof}", "mounted_on must be one of")
    refused("eye_in_hand", "calibration: {configuration: eye_in_foot}", "configuration must be one of")
    refused("calibrate_only", "robot_2: !SimulatedUr {}", "second robot belongs to co_manipulation")
    refused("co_manipulation", "robot_2: !NoDevice {}", "robot_2")
    refused("eye_on_arm", "mounting: {spread_deg: -3.0}", "positive")
    second = "mounting: {second_arm: {home_deg: [0.0, -400.0, 110.0, -120.0, -90.0, 0.0]}}"
    refused(
        "co_manipulation",
        second,
        "second_arm.home_deg puts joint 2 of the ur10e at -400 deg, and its limits are -360 to 360",
    )
    with pytest.raises(InputError, match="has no mounting part"):
        run_mounting_live(
            load_scenario("calibrate_only"), RunOptions(scenario="calibrate_only", out=tmp_path), lambda *_: None
        )
    assert not any(tmp_path.iterdir())
    assert kind_of(load_scenario("eye_in_hand")) == "mounting"
    assert kind_of(load_scenario("calibrate_only")) == ""


@dataclass(eq=False)
class Alone:
    """The procedure of two arms by itself: every goal it sets is reached at once, every scan digested at once."""

    simulator: Simulator
    procedure: MountingProcedure

    def tell(self, **inputs: Any) -> None:
        for name, value in inputs.items():
            self.procedure.GetInputPort(name).FixValue(self.simulator.get_mutable_context(), value)

    @property
    def state(self) -> MountingState:
        state: MountingState = self.procedure.GetOutputPort("state").Eval(self.simulator.get_context())
        return state

    def run(self, until: str, most_s: float = 5.0) -> list[tuple[str, str, int]]:
        """(phase, label, arm) of every state on the way."""
        log: list[tuple[str, str, int]] = []
        while self.state.phase != until and self.simulator.get_context().get_time() < most_s:
            s = self.state
            if s.phase == "move":
                self.tell(**{"settled_goal_2" if s.moving else "settled_goal": [s.goal_id]})
            self.tell(status=AbstractValue.Make(MountingStatus(sequence=s.trigger)))
            entry = (s.phase, s.label, s.moving)
            if not log or log[-1] != entry:
                log.append(entry)
            self.simulator.AdvanceTo(self.simulator.get_context().get_time() + 0.01)
        return log


@pytest.fixture
def alone() -> Alone:
    run = finished("co_manipulation").run
    assert run is not None
    job = run.cell.job
    home = (job.scene.q_home, job.scene.q_home_2)
    procedure = MountingProcedure(job.plan[:3], 2, 1, home, maximum_time_s=60.0)
    made = Alone(Simulator(procedure), procedure)
    ready = AbstractValue.Make(UrStatus())
    made.tell(settled_goal=[0.0], settled_goal_2=[0.0], robot_status=ready, robot_status_2=ready)
    made.tell(status=AbstractValue.Make(MountingStatus()), hold=[0.0], position_measured=home[0])
    return made


def test_one_arm_moves_at_a_time_and_the_way_home_is_the_way_back(alone: Alone) -> None:
    log = alone.run("done")
    assert alone.state.phase == "done"
    assert [e for e in log if e[0] == "move"] == [
        ("move", "pose01", 1),
        ("move", "pose01", 0),
        ("move", "pose02", 1),
        ("move", "pose02", 0),
        ("move", "", 0),
        ("move", "", 1),
        ("move", "aside01", 1),
        ("move", "aside01", 0),
        ("move", "", 0),
        ("move", "", 1),
    ]
    assert alone.state.trigger == 3


def test_a_fault_of_either_arm_holds_the_procedure_with_its_own_words(alone: Alone) -> None:
    alone.run("scan")
    stopped = UrStatus(safety_mode="PROTECTIVE_STOP", fault="The second one stopped.")
    alone.tell(robot_status_2=AbstractValue.Make(stopped))
    alone.simulator.AdvanceTo(alone.simulator.get_context().get_time() + 0.05)
    assert (alone.state.phase, alone.state.reason) == ("held", "The second one stopped.")
    for name in ("job", "job_2"):
        assert alone.procedure.GetOutputPort(name).Eval(alone.simulator.get_context()).mode == "hold"


def test_a_person_holds_the_procedure_on_its_way(alone: Alone) -> None:
    alone.run("scan")
    alone.tell(hold=[1.0])
    alone.simulator.AdvanceTo(alone.simulator.get_context().get_time() + 0.05)
    assert alone.state.phase == "held"
    assert alone.state.reason.startswith("The operator ended the job in phase")
    command = alone.procedure.GetOutputPort("job").Eval(alone.simulator.get_context())
    assert (command.finished, command.held, command.mode) == (True, True, "hold")


def test_an_arm_that_stands_elsewhere_goes_home_first(alone: Alone) -> None:
    alone.tell(position_measured=np.array(alone.procedure.home[0]) + 0.2)
    alone.simulator.AdvanceTo(0.02)
    assert (alone.state.phase, alone.state.label) == ("move", "")
    np.testing.assert_array_equal(alone.state.q_goal, alone.procedure.home[0])
    log = alone.run("done")
    assert [e[1] for e in log if e[0] == "move"][:4] == ["", "", "pose01", "pose01"]


def test_a_job_that_takes_too_long_holds_itself(alone: Alone) -> None:
    alone.simulator.AdvanceTo(60.1)
    assert alone.state.phase == "held"
    assert "took longer than its 60 s" in alone.state.reason


def test_a_second_base_is_drawn_from_the_seed_and_the_first_world_stays_as_it_was() -> None:
    truth = finished("co_manipulation").run.cell.station.truth
    assert truth.X_BC is None
    assert truth.X_BD is not None
    drawn = finished("co_manipulation").run.cell.job.scene.X_BD
    assert isinstance(drawn, RigidTransform)
    assert np.linalg.norm(truth.X_BD.translation() - drawn.translation()) == pytest.approx(0.015)
