"""The same job on both robots: what the cell finds and how it welds does not depend on which of them moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.places import ROOT
from tests.short_job import SEED, ShortJobs, short_job_scenario
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.run import chosen_robot
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, Emulator, emulator_process
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.run import RunOptions

# Both arms stand at the same planned poses, so the same picture is fitted twice: what may differ is a few pixels at the
# edge of the flange, 0.02 mm of the fit (test_cell). The weld on a controller is test_wired_cell's.
SAME_MM = {"X_BC_error_mm": 0.02, "X_BC_error_at_work_mm": 0.02}
JOB_PACE = 1.0  # in lockstep: a busy machine only takes longer
PACE = 0.5  # a faster one leaves the link less time than a busy machine of two cores may take
NOMINAL = ROOT / "models/arms/ur10e/default_kinematics.yaml"


@pytest.fixture(scope="module")
def emulated_job(tmp_path_factory: pytest.TempPathFactory) -> DemoResult:
    """The short job's calibration on the emulated controller, whose time waits for a computer that is busy."""
    folder = tmp_path_factory.mktemp("emulated") / "run"
    options = RunOptions(
        scenario="a test's own", out=folder, seed=SEED, robot="emulated", pace=JOB_PACE, recording=False
    )
    scenario = short_job_scenario()
    scenario.job.weld = False
    return run_scenario(scenario, options)


def test_the_same_calibration_on_the_emulated_robot_ends_with_the_same_figures(
    emulated_job: DemoResult, short_jobs: ShortJobs
) -> None:
    emulated, simulated = emulated_job.summary(), short_jobs.summary()
    assert emulated["state"] == "done", emulated.get("reason")
    assert simulated["state"] == "done", simulated.get("reason")
    for key, same_mm in SAME_MM.items():
        assert emulated[key] == pytest.approx(simulated[key], abs=same_mm), key
    # The demo's promise.
    assert simulated["X_BC_error_mm"] < 0.15
    assert simulated["torch_mean_mm"] <= 0.10
    assert simulated["torch_max_mm"] <= 0.30
    # Not only are the errors of one size: it is the same scanner at the same place.
    ours, theirs = np.array(emulated["X_BC"]), np.array(simulated["X_BC"])
    assert np.linalg.norm(ours[:3, 3] - theirs[:3, 3]) < 1e-3 * SAME_MM["X_BC_error_mm"]
    assert emulated["n_scans"] == simulated["n_scans"]
    assert emulated["robot"] == "an emulated controller"


def test_a_run_under_a_clock_reports_how_well_it_kept_to_it(emulated_job: DemoResult) -> None:
    summary = emulated_job.summary()
    assert {"late_ms", "thinking_ms", "reanchored"} <= set(summary)
    assert ("fell_behind" in summary) == (summary["reanchored"] != 0)
    # What it was late by was not made up for: the run took at least as long as its pace says.
    assert emulated_job.run.wall_seconds >= 0.99 * emulated_job.run.root.get_time() / JOB_PACE


@pytest.fixture(scope="module")
def controller(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulator]:
    """A controller with a factory calibration of its own (the forearm 0.4 mm longer), its arm a little off the cell's
    home."""
    text = NOMINAL.read_text()
    assert "x: -0.6127" in text
    path = tmp_path_factory.mktemp("robot") / "calibration.yaml"
    path.write_text(text.replace("x: -0.6127", "x: -0.6131"))
    with emulator_process(q=Q_START.tolist(), kinematics=path, pace=PACE, lockstep=LOCKSTEP_S) as made:
        yield made


Q_START = np.deg2rad(load_scenario("straight_groove").home_deg) + np.array([0.1, 0.0, 0.0, 0.0, 0.0, -0.1])


def weld_only() -> Scenario:
    return load_scenario(
        "straight_groove",
        "scanner: !RenderedScanner {mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}\n"
        "job: {calibrate: false, X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}",
    )


def test_a_dry_run_has_the_robots_kinematics_and_joints_and_sends_it_nothing(controller: Emulator) -> None:
    scenario = weld_only()
    with chosen_robot(controller.host, scenario, dry_run=True, pace=PACE) as robot:
        assert robot.prepared is not None
        assert robot.prepared.q_start == pytest.approx(Q_START)
        assert robot.prepared.pace is None
        longer = forward_kinematics(robot.prepared.arm, Q_START).translation()
    assert isinstance(scenario.robot, SimulatedUr)
    assert "nothing was sent to it" in robot.title
    nominal = forward_kinematics(load_arm("ur10e"), Q_START).translation()
    assert np.linalg.norm(longer - nominal) == pytest.approx(0.4e-3, rel=1e-3)
    state = controller.state()
    assert (state["programs_started"], state["program"], state["command"]) == (0, None, 0)


def run_until(controller: Emulator, folder: Path, stage: str, happens: Callable[[], object]) -> DemoResult:
    """A weld on the controller's arm; something happens when a phase begins."""

    def watch(phase: str, _: float) -> None:
        if phase == phase_words(stage):
            happens()

    options = RunOptions(scenario="a test's own", out=folder, pace=PACE, recording=False)
    scenario = weld_only()
    scenario.robot = UrRtde(host=controller.host, lockstep=True)
    controller.do("reset_checker")
    result = run_scenario(scenario, options, watch)
    assert result.state == "held"
    assert (folder / "report.html").exists()
    state, checked = controller.state(), controller.ask(check="summary")
    assert np.abs(state["qd"]).max() < 1e-3
    assert state["program"] is None
    assert (checked["moves_after_a_fault"], checked["moves_without_a_command"]) == (0, 0)
    return result


def test_ctrl_c_brings_the_arm_to_rest_and_ends_the_program(controller: Emulator, tmp_path: Path) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    result = run_until(controller, tmp_path / "run", "approach_above", interrupt)
    assert result.summary()["reason"] == "The operator stopped the run with Ctrl-C, in the phase 'approach_above'."
    phases = [name for name, _, _ in result.run.phases]
    assert phases[:3] == ["start", "move_home", "park"], "it stood elsewhere, and went home first"


def test_a_fault_holds_the_job_and_names_itself(controller: Emulator, tmp_path: Path) -> None:
    result = run_until(controller, tmp_path / "run", "approach_above", lambda: controller.fault("protective_stop"))
    reason = str(result.summary()["reason"])
    assert reason.startswith("PROTECTIVE STOP: ")
    assert "Enable Robot" in reason
