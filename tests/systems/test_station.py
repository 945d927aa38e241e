"""The station is what the scenario says, its ports have fixed names, and what differs from the drawing comes from the
seed."""

from __future__ import annotations

import dataclasses as dc

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import VectorLogSink

from tests.systems.cells import EXACT_PLATE, Q_HOME, TOOL, Drive, plain_station, scenario, the_arm, weld_only_cell
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import NoDevice
from weldcal.systems.drivers.simulated import rendered_finger_camera, rendered_scanner
from weldcal.systems.drivers.simulated import ur as simulated_ur
from weldcal.systems.drivers.simulated.rendered_finger_camera import RenderedFingerCamera
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.drivers.station_build import PreparedRobot, StationBuild
from weldcal.systems.messages import Image, JobCommand, Scan
from weldcal.systems.scenario.loading import scenario_class
from weldcal.systems.station import Station, apply_driver_config, make_station
from weldcal.systems.wall_clock import WallClock

INPUTS = {"arm.velocity_command", "scanner.trigger", "finger_camera.streaming"}
OUTPUTS = {
    "arm.position_measured",
    "arm.velocity_measured",
    "arm.X_BF",
    "arm.sample_time",
    "arm.status",
    "scanner.scan",
    "finger_camera.image",
    "finger_camera.capture_time",
    "cheat.X_BC",
    "cheat.truth",
    "cheat.contact",
    "cheat.torch",
    "query_object",
}


def ports(station: Station) -> tuple[set[str], set[str]]:
    diagram = station.diagram
    return (
        {diagram.get_input_port(k).get_name() for k in range(diagram.num_input_ports())},
        {diagram.get_output_port(k).get_name() for k in range(diagram.num_output_ports())},
    )


@pytest.mark.parametrize(
    ("config", "module"),
    [
        (SimulatedUr(), simulated_ur),
        (RenderedScanner(), rendered_scanner),
        (RenderedFingerCamera(), rendered_finger_camera),
    ],
)
def test_a_driver_is_found_beside_its_config(config: object, module: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ApplyDriverConfig", lambda *arguments: ("its answer", *arguments))
    build = StationBuild(
        builder=DiagramBuilder(), arm=the_arm(), tool=TOOL, q_start=Q_HOME, rng=np.random.default_rng(0)
    )
    assert apply_driver_config(config, build) == ("its answer", config, build)


def test_an_absent_device_adds_nothing() -> None:
    build = StationBuild(
        builder=DiagramBuilder(), arm=the_arm(), tool=TOOL, q_start=Q_HOME, rng=np.random.default_rng(0)
    )
    assert apply_driver_config(NoDevice(), build) is None
    assert (build.inputs, build.outputs) == ({}, {})


class OpenLine:
    """Something that a driver holds open."""

    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1


def found_robot() -> PreparedRobot:
    return PreparedRobot(dc.replace(the_arm(), calibration="its own"), Q_HOME + 0.05, OpenLine(), WallClock(0.5))


def test_a_driver_may_say_which_arm_there_is_and_where_it_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, asked = found_robot(), []
    monkeypatch.setattr(
        simulated_ur, "PrepareRobot", lambda *arguments: asked.append(arguments) or robot, raising=False
    )
    bare = scenario_class()(scanner=NoDevice(), finger_camera=NoDevice(), home_deg=np.rad2deg(Q_HOME).tolist())
    station = make_station(bare, 0)
    assert [type(a) for a in asked[0]] == [SimulatedUr, type(the_arm())]
    assert (station.arm, station.q_start is robot.q_start, station.pace) == (robot.arm, True, 0.5)
    drive = Drive(station)
    assert drive.get("arm.position_measured") == pytest.approx(robot.q_start)
    assert station.world.plant.GetPositions(drive.plant, station.world.arm) == pytest.approx(robot.q_start)
    station.close()
    assert isinstance(robot.handle, OpenLine)
    assert robot.handle.closed == 1


def test_a_driver_that_says_nothing_has_the_scenarios_arm_at_home() -> None:
    station = plain_station()
    assert station.q_start == pytest.approx(np.deg2rad(scenario().home_deg))
    assert station.pace is None
    station.close()


def test_a_robot_that_was_found_already_is_not_looked_for() -> None:
    robot = found_robot()
    assert make_station(scenario(), 0, robot).arm is robot.arm


def test_a_station_that_cannot_be_built_lets_go_of_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise InputError("The scanner is broken.")

    monkeypatch.setattr(rendered_scanner, "ApplyDriverConfig", broken)
    robot = found_robot()
    with pytest.raises(InputError, match="broken"):
        make_station(scenario(), 0, robot)
    assert isinstance(robot.handle, OpenLine)
    assert robot.handle.closed == 1


def test_the_seed_draws_the_same_world_wherever_the_arm_stands() -> None:
    one, other = make_station(scenario(), 3).truth, make_station(scenario(), 3, found_robot()).truth
    assert one.X_BC is not None
    assert other.X_BC is not None
    assert one.X_BP is not None
    assert other.X_BP is not None
    assert one.X_BC.IsExactlyEqualTo(other.X_BC)
    assert one.X_BP.IsExactlyEqualTo(other.X_BP)


def test_a_simulated_driver_without_a_world_says_so() -> None:
    build = StationBuild(
        builder=DiagramBuilder(), arm=the_arm(), tool=TOOL, q_start=Q_HOME, rng=np.random.default_rng(0)
    )
    with pytest.raises(RuntimeError, match="needs a SimulatedWorld in the station"):
        apply_driver_config(SimulatedUr(), build)


def test_the_stations_ports_have_their_fixed_names() -> None:
    assert ports(plain_station()) == (INPUTS, OUTPUTS)


def test_a_station_without_a_camera_lacks_the_cameras_ports_and_no_others() -> None:
    bare = dc.replace(scenario(), finger_camera=NoDevice())
    assert ports(make_station(bare, 0)) == (
        INPUTS - {"finger_camera.streaming"},
        OUTPUTS - {"finger_camera.image", "finger_camera.capture_time"},
    )


def test_an_undisturbed_station_is_the_drawing() -> None:
    truth = plain_station().truth
    assert truth.X_BC is not None
    assert truth.X_BP is not None
    assert truth.workpiece is not None
    spec = scenario().workpiece
    assert spec is not None
    assert truth.X_BC.IsNearlyEqualTo(scenario().calibration.mounting_guess.pose(), 1e-12)
    assert truth.X_BP.IsNearlyEqualTo(spec.pose_guess.pose(), 1e-12)
    assert truth.workpiece.X_PG.IsNearlyEqualTo(RigidTransform(), 1e-12)


@pytest.fixture(scope="module")
def seeded() -> list[Station]:
    """The demo's station from seeds 1, 1 again and 2."""
    return [make_station(scenario(), seed) for seed in (1, 1, 2)]


def test_the_world_differs_from_the_drawing_by_exactly_what_was_asked(seeded: list[Station]) -> None:
    spec = scenario().workpiece
    assert spec is not None
    for station in seeded:
        truth = station.truth
        assert truth.X_BC is not None
        assert truth.X_BP is not None
        assert truth.workpiece is not None
        nominal = scenario().calibration.mounting_guess.pose()
        assert np.linalg.norm(truth.X_BC.translation() - nominal.translation()) == pytest.approx(0.015)
        angle = (nominal.rotation().inverse() @ truth.X_BC.rotation()).ToAngleAxis().angle()
        assert np.degrees(angle) == pytest.approx(1.5)
        placed = spec.pose_guess.pose().inverse() @ truth.X_BP
        assert np.linalg.norm(placed.translation()) == pytest.approx(spec.placement_error.translation_mm * 1e-3)
        assert placed.translation()[2] == pytest.approx(0.0, abs=1e-12)  # it lies on its fixture
        assert placed.rotation().matrix()[2] == pytest.approx([0.0, 0.0, 1.0])
        groove = truth.workpiece.X_PG
        assert np.linalg.norm(groove.translation()) == pytest.approx(spec.groove_error.translation_mm * 1e-3)
        assert np.degrees(groove.rotation().ToAngleAxis().angle()) == pytest.approx(spec.groove_error.rotation_deg)


def test_a_hole_is_in_the_part_and_not_in_its_drawing() -> None:
    drawn = "shape: straight"
    station = make_station(scenario(EXACT_PLATE.replace(drawn, f"{drawn}, hole_from_mm: 120.0")), 0)
    assert station.cad is not None
    assert station.truth.workpiece is not None
    reach = [float(np.ptp(part.groove_mesh.vertices[:, 0])) for part in (station.cad, station.truth.workpiece)]
    assert reach == pytest.approx([0.200, 0.120], abs=1e-3)
    # The scanner sees a whole plate: nothing but the touch can tell.
    assert len(station.truth.workpiece.mesh.vertices) == len(station.cad.mesh.vertices)


def test_the_same_seed_is_the_same_world_and_another_is_not(seeded: list[Station]) -> None:
    one, again, other = (station.truth for station in seeded)
    assert one.X_BC is not None
    assert again.X_BC is not None
    assert other.X_BC is not None
    assert one.X_BC.IsExactlyEqualTo(again.X_BC)
    assert not one.X_BC.IsNearlyEqualTo(other.X_BC, 1e-3)


def test_cheating_shows_where_tip_and_torch_truly_are() -> None:
    drive = Drive(plain_station())
    push = np.array([1e-3, -2e-3, 3e-3])
    drive.place_arm(Q_HOME + 0.1, push)
    X_BT = forward_kinematics(the_arm(), Q_HOME + 0.1) @ TOOL.X_FT
    contact = drive.get("cheat.contact")
    assert contact[:3] == pytest.approx(X_BT @ push, abs=1e-9)
    assert contact[3:] == pytest.approx(push, abs=1e-9)
    assert drive.get("cheat.torch") == pytest.approx(X_BT @ TOOL.p_TW, abs=1e-9)


def test_the_drawings_ring_and_tag_are_where_the_bodies_carry_them() -> None:
    # The ring's face looks up when the tool points down, 8 mm above the plate; the tag looks back at the camera, 40 mm
    # away.
    X_BF = forward_kinematics(the_arm(), Q_HOME)
    assert (X_BF @ TOOL.X_FR).rotation().matrix()[2, 2] == pytest.approx(1.0, abs=0.01)
    assert np.linalg.norm(TOOL.X_KM_rest.translation()) == pytest.approx(TOOL.camera_distance_m)
    assert TOOL.X_KM_rest.rotation().matrix()[:, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)


def test_messages_are_passed_on_and_never_copied() -> None:
    for message in (Scan(), Image(), JobCommand()):
        assert message.__deepcopy__({}) is message


def test_no_algorithm_reads_what_only_a_simulation_knows() -> None:
    cell = weld_only_cell()
    readers: dict[str, set[type]] = {}
    for (reader, _), (source, port) in cell.diagram.connection_map().items():
        if source is cell.station.diagram:
            readers.setdefault(source.get_output_port(port).get_name(), set()).add(type(reader))
    cheats = {name: kinds for name, kinds in readers.items() if name.startswith("cheat.")}
    assert set(cheats) == {"cheat.contact", "cheat.torch"}
    assert all(kinds == {VectorLogSink} for kinds in cheats.values())
    assert VectorLogSink not in readers["scanner.scan"]  # the map does tell one reader from another
