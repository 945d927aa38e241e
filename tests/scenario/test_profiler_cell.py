"""The profiler's cell in short: edge scanned, sphere scanned and touched, groove scanned, and the torch taken along
it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from typer.testing import CliRunner

from weldcal.calibration.profiler.record import load_record
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler, drawn_pose
from weldcal.systems.jobs.profiler.config import ProfilerJob
from weldcal.systems.jobs.profiler.plan import PlanningContext, plan_touches
from weldcal.systems.jobs.profiler.procedure import ProfilerProcedure, ProfilerState
from weldcal.systems.messages import ProfileScan, TorchTouch, UrStatus
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.app import app
from weldcal.tools.commands.profiler.live import run_profiler_live
from weldcal.tools.procedure import kind_of, runner_of
from weldcal.tools.report.profiler_live import ProfilerLive
from weldcal.tools.report.run import RunOptions

# fewer scans and touches than shipped, and the first 60 mm of the seam
SHORT = """
profiler_job:
  edge: {scans: 9, held_out: 1}
  sphere: {scans: 7, held_out: 1, touches: 6, descent_mm_s: 10.0, gap_mm: 8.0}
  seam: {seam_length_mm: 60.0, passes: 1, torch_mm_s: 20.0}
"""


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> ProfilerLive:
    scenario = load_scenario("profiler_seam", SHORT)
    assert runner_of(kind_of(scenario)) is run_profiler_live
    options = RunOptions(scenario="profiler_seam", out=tmp_path_factory.mktemp("live"), seed=2, recording=False)
    return run_profiler_live(scenario, options, lambda *_: None)


def test_all_stages_are_done_and_nothing_is_lost(live: ProfilerLive) -> None:
    s = live.state
    assert (s.phase, s.reason) == ("done", "")
    assert (len(s.edge_scans), len(s.sphere_scans), len(s.touches)) == (10, 8, 6)
    assert len(s.seam_scans) >= 28


def test_both_poses_lie_within_three_sigma_of_their_prediction(live: ProfilerLive) -> None:
    for pose in (live.outcome.edge, live.outcome.sphere):
        assert pose is not None
        assert pose.within_3_sigma
        assert pose.sigma_mm < 1.5  # a prediction that says something: the drawing is 4 mm and 2 deg off


def test_touches_are_where_tip_and_sphere_met(live: ProfilerLive) -> None:
    truth, arm = live.run.cell.station.truth.profiler, live.run.cell.station.arm
    assert truth is not None
    tips = [forward_kinematics(arm, q).multiply(truth.p_FTip) for q in live.state.touches]
    off = np.linalg.norm(np.array(tips) - truth.center, axis=1) - truth.radius_m
    # the robot's error of 0.06 mm, and up to a tick of 4 ms at 10 mm/s deep
    assert abs(off.mean() + 0.02e-3) < 4 * 0.06e-3 / np.sqrt(6)
    assert np.abs(off).max() < 4 * 0.06e-3


def test_the_torch_runs_where_the_groove_truly_is(live: ProfilerLive) -> None:
    torch = live.outcome.torch
    assert torch is not None
    assert torch.distance_mm.mean() < 0.3
    assert np.ptp(torch.s) > 0.055


def test_what_was_measured_is_written_as_the_commands_read_it(live: ProfilerLive, tmp_path: Path) -> None:
    names = {path.name for path in live.folder.iterdir()}
    assert {"edge.npz", "sphere.npz", "seam.npz", "seam.csv", "report.html", "edge", "sphere"} <= names
    e = live.state.edge
    assert e is not None
    np.testing.assert_allclose(load_record(live.folder / "edge").translation, e.estimate.translation, atol=1e-12)
    words = ["profiler", "seam", str(live.folder / "seam.npz"), "--calibration", str(live.folder / "sphere")]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "seam"), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout.strip().splitlines()[-1])["found"] == len(live.state.seam_scans)


@dataclass(eq=False)
class Alone:
    """The procedure by itself: every goal is reached at once, no touch is felt."""

    simulator: Simulator
    procedure: ProfilerProcedure

    def tell(self, **inputs: object) -> None:
        for name, value in inputs.items():
            self.procedure.GetInputPort(name).FixValue(self.simulator.get_mutable_context(), value)

    @property
    def state(self) -> ProfilerState:
        shown: ProfilerState = self.procedure.GetOutputPort("state").Eval(self.simulator.get_context())
        return shown

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            s = self.state
            if s.goals:
                self.tell(settled_goal=[s.goal_id], position=np.array(s.goals[0].q))
            self.simulator.AdvanceTo(self.simulator.get_context().get_time() + 0.02)


@pytest.fixture
def alone() -> Alone:
    job = ProfilerJob(stages=["edge"])
    job.edge.scans, job.edge.held_out = 8, 1
    q = np.deg2rad([190.0, -120.0, 135.0, -105.0, -90.0, 90.0])
    config = RenderedProfiler()
    tip, ball = np.array(job.torch.tip_m), np.array(job.ball.xyz_m)
    planning = PlanningContext(
        arm=load_arm("ur10e"), job=job, q_home=q, X_FS=drawn_pose(config), p_FTip=tip, center=ball
    )
    procedure = ProfilerProcedure(planning, config, 0)
    made = Alone(Simulator(procedure), procedure)
    made.tell(
        position=q,
        settled_goal=[0.0],
        history=AbstractValue.Make(PoseHistory(np.array([0.0, 100.0]), np.array([q, q]))),
        robot_status=AbstractValue.Make(UrStatus()),
        profile=AbstractValue.Make(ProfileScan()),
        touch=AbstractValue.Make(TorchTouch()),
        hold=[0.0],
    )
    return made


def test_profiles_that_show_nothing_hold_it_with_a_sentence(alone: Alone) -> None:
    nothing = np.column_stack([np.linspace(-0.02, 0.02, 200), np.full(200, 0.09)])
    for _ in range(300):
        if alone.state.phase == "held":
            break
        alone.tell(profile=AbstractValue.Make(ProfileScan(alone.state.trigger, 1.0, nothing)))
        alone.run(0.1)
    assert alone.state.phase == "held"
    assert "edge" in alone.state.reason


def test_a_stopped_robot_holds_it_with_its_own_words(alone: Alone) -> None:
    alone.run(0.1)
    alone.tell(robot_status=AbstractValue.Make(UrStatus(safety_mode="PROTECTIVE_STOP", fault="It stopped.")))
    alone.run(0.04)
    assert (alone.state.phase, alone.state.reason) == ("held", "It stopped.")
    assert not alone.procedure.GetOutputPort("creep").Eval(alone.simulator.get_context()).any()


def test_a_torch_that_touches_on_its_way_holds_it(alone: Alone) -> None:
    alone.run(0.1)
    alone.tell(touch=AbstractValue.Make(TorchTouch(1, 0.1, True)))
    alone.run(0.04)
    assert alone.state.phase == "held"
    assert "touches something in the step 'edge'" in alone.state.reason
    assert not alone.procedure.GetOutputPort("creep").Eval(alone.simulator.get_context()).any()


def test_a_person_holds_it(alone: Alone) -> None:
    alone.run(0.1)
    alone.tell(hold=[1.0])
    alone.run(0.04)
    assert alone.state.phase == "held"
    assert alone.state.reason.startswith("The operator ended the job in phase")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("profiler: !NoDevice {}", "needs a profiler"),
        ("profiler_job: {stages: [seam]}", "needs the torch's tip"),
        ("profiler_job: {stages: [sphere, edge]}", "in this order"),
        ("profiler_job: {edge: {scans: 3}}", "8 scans of the edge"),
        ("tool: welding\ncalibration: {feature: tool_ring}", "replaces the tool"),
        ("workpiece: null", "needs a workpiece"),
        ("profiler_job: {torch: {tip_m: [0.0, 0.1]}}", "three numbers"),
        ("profiler: !RenderedProfiler {width_far_mm: 30.0}", "wider far away"),
        ("profiler: !RenderedProfiler {samples: 1}", "two samples"),
        ("profiler_job: {sphere: {descent_mm_s: 0.0}}", "must be positive"),
    ],
)
def test_what_no_cell_could_do_is_refused_in_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        load_scenario("profiler_seam", text)


def test_a_scenario_without_a_profiler_is_refused_on_the_command_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["profiler", "live", "s_groove", "--out", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert "has no profiler" in " ".join(result.output.split())
    assert not (tmp_path / "out").exists()


def test_moves_between_touches_keep_torch_and_tip_clear_of_the_sphere_all_along() -> None:
    job, q_home = ProfilerJob(), np.deg2rad([190.0, -120.0, 135.0, -105.0, -90.0, 90.0])
    tip, ball = np.array(job.torch.tip_m), np.array(job.ball.xyz_m)
    planning = PlanningContext(
        arm=load_arm("ur10e"), job=job, q_home=q_home, X_FS=drawn_pose(RenderedProfiler()), p_FTip=tip, center=ball
    )
    for seed in range(2):
        q, gaps, tips = q_home, [], []
        for goal in plan_touches(planning, q_home, seed):
            n = int(np.ceil(np.abs(goal.q - q).max() / 0.01)) + 1
            for at in np.linspace(q, goal.q, n):
                X_BF = forward_kinematics(planning.arm, at)
                gaps.append(planning.gap(X_BF))
                tips.append(float(np.linalg.norm(X_BF.multiply(tip) - ball)) - planning.radius_m)
            q = goal.q
        assert min(gaps) > 0.5e-3 * job.clearance_mm - 2e-4
        assert min(tips) > 0.5e-3 * job.clearance_mm  # more than the tip is off its drawing
