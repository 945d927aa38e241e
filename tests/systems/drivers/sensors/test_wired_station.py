"""A cell whose scanner is a folder: the same result as with the scanner in the Diagram, and a lost device holds the job
by name."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from tests.systems.drivers.sensors.scripted import (
    MjpegCamera,
    Scripted,
    StatusSource,
    mjpeg_camera,
    number_in,
    wait_until,
)
from tests.systems.drivers.sensors.test_folder_scanner import drop
from tests.systems.plugin_robot import JointIntegrator, KinematicArm
from tests.systems.plugin_scanner import RayScanner, RaySensor
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.systems.cell import build_cell
from weldcal.systems.drivers.discovery import driver_configs
from weldcal.systems.drivers.sensors.acquisition import Acquisition, DeviceLost, Rules
from weldcal.systems.drivers.sensors.folder_scanner import FolderScanner
from weldcal.systems.drivers.sensors.video_finger_camera import VideoFingerCamera
from weldcal.systems.drivers.sensors.watch import DeviceWatch
from weldcal.systems.drivers.sensors.wired_camera import WiredPictures, acquire_pictures
from weldcal.systems.runner import Run, run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario

FEW = "calibration: {minimum_scans: 4, maximum_scans: 4, verification_scans: 1}"


class FlangeScanner(threading.Thread):
    """Another program: casts rays at the flange where the arm is, whenever the trigger file changes."""

    def __init__(self, folder: Path, arm_is_at: list[np.ndarray]) -> None:
        super().__init__(daemon=True)
        self._folder, self._arm_is_at = folder, arm_is_at
        self.trigger, self.stop = folder / "trigger", threading.Event()
        config = RayScanner()
        X_BC = RigidTransform(RollPitchYaw(np.deg2rad(config.rpy_deg)), config.xyz_m)
        self._sensor, self._X_BC = RaySensor(X_BC, config.scanner()), X_BC
        self.start()

    def run(self) -> None:
        done = 0
        while not self.stop.wait(0.005):
            if not self.trigger.exists() or int(self.trigger.read_text().split()[1]) == done:
                continue
            done = int(self.trigger.read_text().split()[1])
            X_BF = forward_kinematics(_arm(), self._arm_is_at[-1])
            points = self._sensor._cast(self._X_BC.inverse() @ X_BF, np.random.default_rng(done))
            drop(self._folder, f"{done}.npz", points, request=done)


def _arm():
    from tests.systems.cells import the_arm

    return the_arm()


def scenario(**devices: object) -> Scenario:
    found = load_scenario("calibrate_only", FEW)
    found.robot = KinematicArm()
    for name, config in devices.items():
        setattr(found, name, config)
    return found


@pytest.fixture
def arm_is_at(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The joints, as the world outside would know them."""
    seen: list[np.ndarray] = []
    step = JointIntegrator._step

    def noted(self: JointIntegrator, context: object, discrete: object) -> None:
        step(self, context, discrete)
        seen.append(np.array(discrete.value()[:6]))  # type: ignore[attr-defined]
        del seen[:-2]

    monkeypatch.setattr(JointIntegrator, "_step", noted)
    return seen


@pytest.fixture
def program(tmp_path: Path, arm_is_at: list[np.ndarray]) -> Iterator[FlangeScanner]:
    found = FlangeScanner(tmp_path, arm_is_at)
    yield found
    found.stop.set()


def found_X_BC(run: Run) -> np.ndarray:
    calibrator = run.cell.job.calibrator
    port = calibrator.GetOutputPort("calibration_status")
    return port.Eval(calibrator.GetMyContextFromRoot(run.root)).X_BC.GetAsMatrix4()


def test_a_job_with_a_folder_gives_what_it_gives_with_the_scanner_in_the_diagram(
    program: FlangeScanner, tmp_path: Path
) -> None:
    wired = FolderScanner(folder=str(tmp_path), trigger=f"file:{program.trigger}", settle_s=0.02, width=824, height=616)
    by_wire = run_cell(build_cell(scenario(scanner=wired)))
    assert by_wire.command.phase == "done", by_wire.reason
    inside = run_cell(build_cell(scenario(scanner=RayScanner())))
    assert inside.command.phase == "done", inside.reason
    # the same poses, the same rays, single precision in both
    assert np.abs(found_X_BC(by_wire) - found_X_BC(inside)).max() < 1e-6
    assert [p[0] for p in by_wire.phases] == [p[0] for p in inside.phases]


def test_a_scanner_that_delivers_nothing_holds_the_job_by_its_name(tmp_path: Path) -> None:
    silent = FolderScanner(folder=str(tmp_path), scan_timeout_s=0.3, width=824, height=616)
    run = run_cell(build_cell(scenario(scanner=silent)))
    assert run.command.phase == "held"
    assert run.reason == f"The scanner that writes into '{tmp_path}' did not deliver scan 1 within 0.3 s."


def test_a_closed_station_lets_its_devices_go(tmp_path: Path) -> None:
    before = threading.active_count()
    with mjpeg_camera() as camera:
        config = VideoFingerCamera(width=64, height=48, rate_hz=50.0, source=camera.url)
        wired = FolderScanner(folder=str(tmp_path), width=824, height=616)
        cell = build_cell(scenario(scanner=wired, finger_camera=config))
        names = {system.get_name() for system in cell.station.diagram.GetSystems()}
        assert {"scanner", "scanner_watch", "finger_camera", "finger_camera_watch"} <= names
        assert threading.active_count() > before
        cell.station.close()
        assert wait_until(lambda: all("_work" not in t.name for t in threading.enumerate()))
    assert wait_until(lambda: threading.active_count() <= before)


def test_a_camera_that_is_not_there_is_refused_and_nothing_stays_open(tmp_path: Path) -> None:
    before = threading.active_count()
    wired = FolderScanner(folder=str(tmp_path), width=824, height=616)
    absent = VideoFingerCamera(source=str(tmp_path / "none.avi"))
    with pytest.raises(DeviceLost.__mro__[1], match="there is no file"):
        build_cell(scenario(scanner=wired, finger_camera=absent))
    assert wait_until(lambda: threading.active_count() == before)


def test_the_drivers_are_found_by_their_files() -> None:
    names = {
        config.__name__ for device in ("scanner", "finger_camera", "profiler") for config in driver_configs(device)
    }
    assert {"FolderScanner", "GenicamScanner", "VideoFingerCamera", "GenicamFingerCamera"} <= names
    assert {"FolderProfiler", "GenicamProfiler"} <= names
    assert not {"WiredScanner", "WiredFingerCamera", "WiredProfiler"} & names


def test_a_fault_is_latched_though_the_device_works_again() -> None:
    device = Scripted(np.zeros(3))
    acquisition = Acquisition(device, Rules(silent_s=0.1, lost_s=0.1))
    acquisition.start(1.0, first_frame=True)
    builder = DiagramBuilder()
    robot, watching = builder.AddSystem(StatusSource()), builder.AddSystem(DeviceWatch(acquisition))
    builder.Connect(robot.GetOutputPort("status"), watching.GetInputPort("robot_status"))
    simulator = Simulator(builder.Build())
    try:

        def status():
            context = watching.GetMyContextFromRoot(simulator.get_context())
            return watching.GetOutputPort("status").Eval(context)

        simulator.AdvanceTo(0.02)
        assert status().ready
        device.script.append(DeviceLost("unplugged"))
        device.refuses = DeviceLost("unplugged")
        # a Diagram that looks at it all the time
        for k in range(1, 60):
            time.sleep(0.01)
            simulator.AdvanceTo(0.02 + 0.01 * k)
        assert status().fault == "The scripted device is not connected: unplugged."
        assert not status().ready
        device.refuses = None
        device.script.extend(np.zeros(3) for _ in range(3))
        assert wait_until(lambda: acquisition.fault(time.monotonic()) is None)
        simulator.AdvanceTo(1.0)
        assert status().fault == "The scripted device is not connected: unplugged."
    finally:
        acquisition.close()


def test_a_diagram_that_stood_does_not_blame_the_device() -> None:
    now = [0.0]
    device = Scripted(np.zeros(3))
    acquisition = Acquisition(device, Rules(silent_s=0.1, lost_s=10.0))
    acquisition.start(1.0, first_frame=True)
    now[0] = time.monotonic()
    builder = DiagramBuilder()
    robot, watching = builder.AddSystem(StatusSource()), builder.AddSystem(DeviceWatch(acquisition, lambda: now[0]))
    builder.Connect(robot.GetOutputPort("status"), watching.GetInputPort("robot_status"))
    simulator = Simulator(builder.Build())
    try:
        context = watching.GetMyContextFromRoot(simulator.get_context())
        now[0] += 5.0  # a plan was computed
        simulator.AdvanceTo(0.02)
        assert watching.GetOutputPort("status").Eval(context).ready
        for k in range(30):
            now[0] += 0.008
            simulator.AdvanceTo(0.03 + 0.01 * k)
        assert not watching.GetOutputPort("status").Eval(context).ready
    finally:
        acquisition.close()


def test_pictures_have_the_diagrams_time_though_it_runs_slower_and_stands() -> None:
    """The Diagram runs at a third of the wall's pace, then stands for a while."""
    with mjpeg_camera() as camera:
        config = VideoFingerCamera(width=64, height=48, rate_hz=50.0, source=camera.url, stamps="host")
        acquisition = acquire_pictures(config, config.open_source())
        acquisition.start(2.0, first_frame=True)
        builder = DiagramBuilder()
        pictures, on = builder.AddSystem(WiredPictures(acquisition)), builder.AddSystem(ConstantVectorSource([1.0]))
        builder.Connect(on.get_output_port(), pictures.GetInputPort("streaming"))
        simulator = Simulator(builder.Build())
        walls, times, seen = [], [], {}
        for k in range(90):
            simulator.AdvanceTo(0.004 * k)
            walls.append(time.monotonic())
            times.append(0.004 * k)
            context = pictures.GetMyContextFromRoot(simulator.get_context())
            image = pictures.GetOutputPort("image").Eval(context)
            if image.sequence:
                seen[number_in(image.pixels)] = image.capture_time
                assert pictures.GetOutputPort("capture_time").Eval(context)[0] == image.capture_time
            time.sleep(0.2 if k == 45 else 0.010)
        acquisition.close()
        errors = [seen[n] - np.interp(camera.taken[n], walls, times) for n in seen if camera.taken[n] > walls[0]]
        assert len(errors) > 20
        # a tick of the Diagram, 4 ms of its time, and what this computer takes
        assert np.abs(errors).max() < 0.006
        assert isinstance(camera, MjpegCamera)
