"""CellVisualizer: what the cell believes, in Meshcat: clouds, fitted circle, camera, seams, torch and the phase of the job."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import Ellipsoid, Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Rgba, Role
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, OutputPort, State

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.tool import WeldingTool
from weldcal.systems.job_sequencer import PHASES, JobState
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, Message, PlannedSeam, Scan
from weldcal.systems.phase_labels import add_phase_label
from weldcal.systems.scenario import VisualizationConfig
from weldcal.systems.station import Station
from weldcal.systems.welding_velocity_servo import ServoReport

ROOT = "/weldcal"
PLANNED, REFINED, TORCH = Rgba(0.55, 0.55, 0.60, 1.0), Rgba(0.15, 0.45, 0.90, 1.0), Rgba(0.95, 0.45, 0.10, 1.0)
CLOUD, CIRCLE, BELIEF = Rgba(0.95, 0.80, 0.25, 0.9), Rgba(0.90, 0.15, 0.35, 1.0), Rgba(0.10, 0.70, 0.55, 0.35)
SHOWN_ABOVE_M = 0.008
ALL_PHASES = (*PHASES, "done", "held")


class _Drawn(Message):
    """What has been drawn so far, so that each thing is drawn once."""

    def __init__(self, **numbers: Any) -> None:
        self.phase: str = numbers.get("phase", "")
        self.scan: int = numbers.get("scan", 0)
        self.fit: int = numbers.get("fit", 0)
        self.status: int = numbers.get("status", 0)
        self.seam: int = numbers.get("seam", 0)
        self.points: int = numbers.get("points", 0)
        self.torch: tuple[tuple[float, float, float], ...] = numbers.get("torch", ())
        self.pieces: int = numbers.get("pieces", 0)

    def but(self, **changes: Any) -> _Drawn:
        """The same with some numbers changed."""
        return _Drawn(**{**self.__dict__, **changes})


class CellVisualizer(LeafSystem):
    """Draws the cell's beliefs as they change.

    .. pydrake_system::

        name: CellVisualizer
        input_ports:
        - job_state
        - calibration_status
        - flange_estimate
        - scan
        - planned_seam
        - servo_report
        - position_measured

    Everything that appears during the job is hidden before its time in the recording, so the recording replays the story.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        arm: ArmModel,
        tool: WeldingTool | None,
        X_BC_guess: RigidTransform,
        circle_radius_m: float,
        config: VisualizationConfig,
    ) -> None:
        super().__init__()
        self._meshcat, self._arm, self._tool, self._config = meshcat, arm, tool, config
        self._X_BC_guess, self._circle_radius_m = X_BC_guess, circle_radius_m
        messages: dict[str, Message] = {
            "job_state": JobState(),
            "calibration_status": CalibrationStatus(),
            "flange_estimate": FlangeEstimate(),
            "scan": Scan(),
            "planned_seam": PlannedSeam(),
            "servo_report": ServoReport(),
        }
        self._ports = {name: self.DeclareAbstractInputPort(name, AbstractValue.Make(m)) for name, m in messages.items()}
        self._q = self.DeclareVectorInputPort("position_measured", 6)
        self._state = self.DeclareAbstractState(AbstractValue.Make(_Drawn()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(1.0 / config.recording_fps, 0.0, self._draw)
        self.DeclareInitializationPublishEvent(self._prepare)

    def _prepare(self, context: Context) -> EventStatus:
        for k, phase in enumerate(ALL_PHASES):
            add_phase_label(self._meshcat, f"{ROOT}/phase/{phase}", phase)
            self._meshcat.SetProperty(f"{ROOT}/phase/{phase}", "visible", k == 0, 0.0)
        self._draw_camera("guess", self._X_BC_guess, None, 0.0)
        return EventStatus.Succeeded()

    def _show(self, path: str, time: float) -> None:
        self._meshcat.SetProperty(path, "visible", False, 0.0)
        self._meshcat.SetProperty(path, "visible", True, time)

    def _draw(self, context: Context, state: State) -> None:
        drawn: _Drawn = context.get_abstract_state(self._state).get_value()
        time = context.get_time()
        seen = {name: port.Eval(context) for name, port in self._ports.items()}
        new = self._draw_phase(drawn, seen["job_state"], time)
        new = self._draw_scan(new, seen["scan"], seen["calibration_status"], time)
        new = self._draw_fit(new, seen["flange_estimate"], seen["calibration_status"], time)
        new = self._draw_calibration(new, seen["calibration_status"], time)
        new = self._draw_weld(new, seen["planned_seam"], seen["servo_report"], self._q.Eval(context), time)
        state.get_mutable_abstract_state(self._state).set_value(new)

    def _draw_phase(self, drawn: _Drawn, job: JobState, time: float) -> _Drawn:
        phase = job.command.phase
        if phase == drawn.phase:
            return drawn
        if drawn.phase:
            self._meshcat.SetProperty(f"{ROOT}/phase/{drawn.phase}", "visible", False, time)
        self._meshcat.SetProperty(f"{ROOT}/phase/{phase}", "visible", True, time)
        return drawn.but(phase=phase)

    def _draw_scan(self, drawn: _Drawn, scan: Scan, status: CalibrationStatus, time: float) -> _Drawn:
        if scan.sequence <= drawn.scan:
            return drawn
        points = scan.points_C.reshape(-1, 3)
        points = points[np.isfinite(points[:, 2])]
        points = points[:: max(1, len(points) // self._config.cloud_points)]
        X_BC = status.X_BC or self._X_BC_guess
        cloud = PointCloud(len(points), Fields(BaseField.kXYZs))
        cloud.mutable_xyzs()[:] = (points @ X_BC.rotation().matrix().T + X_BC.translation()).T
        if drawn.scan:
            self._meshcat.SetProperty(f"{ROOT}/scan/{drawn.scan:02d}", "visible", False, time)
        path = f"{ROOT}/scan/{scan.sequence:02d}"
        self._meshcat.SetObject(path, cloud, 0.0012, CLOUD)
        self._show(path, time)
        return drawn.but(scan=scan.sequence)

    def _draw_fit(self, drawn: _Drawn, estimate: FlangeEstimate, status: CalibrationStatus, time: float) -> _Drawn:
        if estimate.sequence <= drawn.fit or estimate.fit is None:
            return drawn
        X_BC = status.X_BC or self._X_BC_guess
        z = X_BC.rotation().matrix() @ estimate.fit.normal_C
        R = RotationMatrix.MakeFromOneVector(z, 2).matrix()
        angle = np.linspace(0.0, 2.0 * np.pi, 73)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)]) * self._circle_radius_m
        path = f"{ROOT}/circle/{estimate.sequence:02d}"
        self._meshcat.SetLine(path, R @ ring + (X_BC @ estimate.fit.center_C)[:, None], 4.0, CIRCLE)
        self._show(path, time)
        return drawn.but(fit=estimate.sequence)

    def _draw_calibration(self, drawn: _Drawn, status: CalibrationStatus, time: float) -> _Drawn:
        if status.sequence <= drawn.status or status.estimate is None:
            return drawn
        if drawn.status:
            self._meshcat.SetProperty(f"{ROOT}/camera/{drawn.status:02d}", "visible", False, time)
        self._draw_camera(f"{status.sequence:02d}", status.estimate.X_BC, status.estimate.covariance, time)
        return drawn.but(status=status.sequence)

    def _draw_camera(
        self, name: str, X_BC: RigidTransform, covariance: NDArray[np.float64] | None, time: float
    ) -> None:
        """The camera frame as a triad; its 3-sigma position ellipsoid is drawn 100 times its size, or nothing could be seen."""
        path = f"{ROOT}/camera/{name}"
        for axis, rgba in enumerate((Rgba(0.9, 0.2, 0.2, 1), Rgba(0.2, 0.75, 0.2, 1), Rgba(0.2, 0.4, 0.95, 1))):
            ends = np.zeros((3, 2))
            ends[axis, 1] = 0.10
            self._meshcat.SetLine(f"{path}/axis{axis}", ends, 4.0, rgba)
        if covariance is not None:
            values, vectors = np.linalg.eigh(covariance[3:, 3:])
            if np.linalg.det(vectors) < 0:
                vectors[:, 0] *= -1.0
            a, b, c = np.clip(300.0 * np.sqrt(np.maximum(values, 0.0)), 1e-3, 0.15)
            R_CE = X_BC.rotation().matrix().T @ vectors
            self._meshcat.SetObject(f"{path}/three_sigma_x100", Ellipsoid(a, b, c), BELIEF)
            self._meshcat.SetTransform(f"{path}/three_sigma_x100", RigidTransform(RotationMatrix(R_CE), np.zeros(3)))
        self._meshcat.SetTransform(path, X_BC)
        if time > 0.0:
            self._show(path, time)

    def _draw_weld(
        self, drawn: _Drawn, planned: PlannedSeam, servo: ServoReport, q: NDArray[np.float64], time: float
    ) -> _Drawn:
        if planned.sequence > drawn.seam and planned.seam is not None:
            line = np.asarray(planned.seam.position(np.linspace(0.0, planned.seam.length, 300)))
            self._draw_path("planned", line, SHOWN_ABOVE_M, PLANNED, time)
            drawn = drawn.but(seam=planned.sequence)
        if servo.command is None or self._tool is None:
            return drawn
        if servo.torch_on:
            if not drawn.torch:
                self._meshcat.SetProperty(f"{ROOT}/scan/{drawn.scan:02d}", "visible", False, time)
            p_BW = forward_kinematics(self._arm, q) @ self._tool.X_FT @ self._tool.p_TW
            drawn = drawn.but(torch=(*drawn.torch, tuple(p_BW)))
        refined = servo.state.refined.points if servo.state is not None else np.empty((0, 3))
        if len(drawn.torch) >= 11 or len(refined) - drawn.points >= 30:  # about a second: one piece of each path
            piece = drawn.pieces
            if drawn.torch:
                self._draw_path(f"torch/{piece:03d}", np.array(drawn.torch), SHOWN_ABOVE_M + 0.004, TORCH, time)
            if len(refined) > drawn.points:
                self._draw_path(f"refined/{piece:03d}", refined[drawn.points :], SHOWN_ABOVE_M, REFINED, time)
            drawn = drawn.but(torch=drawn.torch[-1:], points=len(refined), pieces=piece + 1)
        return drawn

    def _draw_path(self, name: str, points_B: NDArray[np.float64], raise_m: float, rgba: Rgba, time: float) -> None:
        """A path as a row of dots (a browser draws lines one pixel thin), raised out of the groove so that it can be seen."""
        dots = PointCloud(len(points_B), Fields(BaseField.kXYZs))
        dots.mutable_xyzs()[:] = (np.asarray(points_B) + np.array([0.0, 0.0, raise_m])).T
        self._meshcat.SetObject(f"{ROOT}/seam/{name}", dots, 0.004, rgba)
        self._show(f"{ROOT}/seam/{name}", time)


def add_visualizer(
    builder: DiagramBuilder,
    meshcat: Meshcat,
    station: Station,
    circle_radius_m: float,
    X_BC_guess: RigidTransform,
    config: VisualizationConfig,
    ports: dict[str, OutputPort],
) -> CellVisualizer:
    """Add Drake's own visualizer for the bodies and ours for the beliefs; one Meshcat, passed in."""
    params = MeshcatVisualizerParams(role=Role.kIllustration, prefix="cell", publish_period=1.0 / config.recording_fps)
    visualizer = MeshcatVisualizer(meshcat, params)
    visualizer.set_name("meshcat_visualizer")
    builder.AddSystem(visualizer)
    builder.Connect(station.diagram.GetOutputPort("query_object"), visualizer.query_object_input_port())
    viewer = CellVisualizer(meshcat, station.arm, station.tool, X_BC_guess, circle_radius_m, config)
    viewer.set_name("cell_visualizer")
    builder.AddSystem(viewer)
    for name, port in ports.items():
        builder.Connect(port, viewer.GetInputPort(name))
    return viewer
