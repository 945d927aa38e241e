"""CellVisualizer: shows the cell's estimates in Meshcat: clouds, fitted circle, camera, seams, torch and the job's phase."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import Ellipsoid, Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.framework import Context, EventStatus, LeafSystem, OutputPort

from weldcal.models.mesh import TriMesh
from weldcal.models.tool import WeldingTool
from weldcal.systems.jobs.weld.sequencer import PHASES, JobState
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, Message, PlannedSeam, Scan
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.viewer.phase_labels import add_phase_label
from weldcal.systems.viewer.weld_view import WeldView
from weldcal.systems.wiring import Wiring

ROOT = "/weldcal"
CLOUD, CIRCLE, BELIEF = Rgba(0.95, 0.80, 0.25, 0.9), Rgba(0.90, 0.15, 0.35, 1.0), Rgba(0.10, 0.70, 0.55, 0.35)
ALL_PHASES = (*PHASES, "done", "held")


@dataclass
class _Drawn:
    """The items sent to Meshcat so far, so that each is drawn once; not part of the simulation's state."""

    phase: str = ""
    scan: int = 0
    fit: int = 0
    status: int = 0
    cloud_hidden: bool = False


class CellVisualizer(LeafSystem):
    """Draws the cell's estimates when they change.

    .. pydrake_system::

        name: CellVisualizer
        input_ports:
        - job_state
        - calibration_status
        - flange_estimate
        - scan
        - planned_seam
        - servo_report

    An item that appears during the job is hidden in the recording before that time.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        tool: WeldingTool | None,
        X_BC_guess: RigidTransform,
        circle_radius_m: float,
        config: VisualizationConfig,
        cad: TriMesh | None = None,
        weld_speed_m_s: float = 0.008,
    ) -> None:
        super().__init__()
        self._meshcat, self._config = meshcat, config
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
        self._drawn = _Drawn()
        self._weld = None if tool is None else WeldView(meshcat, ROOT, tool, cad, weld_speed_m_s)
        self.DeclarePeriodicPublishEvent(1.0 / config.recording_fps, 0.0, self._draw)
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

    def _draw(self, context: Context) -> EventStatus:
        time = context.get_time()
        seen = {name: port.Eval(context) for name, port in self._ports.items()}
        self._draw_phase(seen["job_state"], time)
        self._draw_scan(seen["scan"], seen["calibration_status"], seen["servo_report"], time)
        self._draw_fit(seen["flange_estimate"], seen["calibration_status"], time)
        self._draw_calibration(seen["calibration_status"], time)
        if self._weld is not None:
            self._weld.draw(seen["planned_seam"], seen["servo_report"], time)
        return EventStatus.Succeeded()

    def _draw_phase(self, job: JobState, time: float) -> None:
        phase, before = job.command.phase, self._drawn.phase
        if phase == before:
            return
        if before:
            self._meshcat.SetProperty(f"{ROOT}/phase/{before}", "visible", False, time)
        self._meshcat.SetProperty(f"{ROOT}/phase/{phase}", "visible", True, time)
        self._drawn.phase = phase

    def _draw_scan(self, scan: Scan, status: CalibrationStatus, servo: ServoReport, time: float) -> None:
        if servo.torch_on and self._drawn.scan and not self._drawn.cloud_hidden:
            self._drawn.cloud_hidden = True  # or it would hide the paths
            self._meshcat.SetProperty(f"{ROOT}/scan/{self._drawn.scan:02d}", "visible", False, time)
        if scan.sequence <= self._drawn.scan:
            return
        points = scan.points_C.reshape(-1, 3).astype(np.float64)
        points = points[np.isfinite(points[:, 2])]
        points = points[:: max(1, len(points) // self._config.cloud_points)]
        X_BC = status.X_BC or self._X_BC_guess
        cloud = PointCloud(len(points), Fields(BaseField.kXYZs))
        cloud.mutable_xyzs()[:] = (status.correction.points(points) @ X_BC.rotation().matrix().T + X_BC.translation()).T
        if self._drawn.scan:
            self._meshcat.SetProperty(f"{ROOT}/scan/{self._drawn.scan:02d}", "visible", False, time)
        path = f"{ROOT}/scan/{scan.sequence:02d}"
        self._meshcat.SetObject(path, cloud, 0.0012, CLOUD)
        self._show(path, time)
        self._drawn.scan = scan.sequence

    def _draw_fit(self, estimate: FlangeEstimate, status: CalibrationStatus, time: float) -> None:
        if estimate.sequence <= self._drawn.fit or estimate.fit is None:
            return
        X_BC = status.X_BC or self._X_BC_guess
        z = X_BC.rotation().matrix() @ estimate.fit.normal_C
        R = RotationMatrix.MakeFromOneVector(z, 2).matrix()
        angle = np.linspace(0.0, 2.0 * np.pi, 73)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)]) * self._circle_radius_m
        path = f"{ROOT}/circle/{estimate.sequence:02d}"
        self._meshcat.SetLine(
            path, R @ ring + (X_BC @ status.correction.points(estimate.fit.center_C))[:, None], 4.0, CIRCLE
        )
        self._show(path, time)
        self._drawn.fit = estimate.sequence

    def _draw_calibration(self, status: CalibrationStatus, time: float) -> None:
        if status.sequence <= self._drawn.status or status.estimate is None:
            return
        if self._drawn.status:
            self._meshcat.SetProperty(f"{ROOT}/camera/{self._drawn.status:02d}", "visible", False, time)
        self._draw_camera(f"{status.sequence:02d}", status.estimate.X_BC, status.estimate.covariance, time)
        self._drawn.status = status.sequence

    def _draw_camera(
        self, name: str, X_BC: RigidTransform, covariance: NDArray[np.float64] | None, time: float
    ) -> None:
        """Draw the camera frame as a triad, with its 3-sigma position ellipsoid magnified 100 times to be visible."""
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


def add_visualizer(
    wiring: Wiring,
    circle_radius_m: float,
    X_BC_guess: RigidTransform,
    weld_speed_m_s: float,
    ports: dict[str, OutputPort],
) -> CellVisualizer:
    """Add the CellVisualizer to the builder; the cell itself draws the bodies."""
    assert wiring.meshcat is not None
    station, config = wiring.station, wiring.scenario.visualization
    cad = None if station.cad is None else station.cad.mesh
    viewer = CellVisualizer(wiring.meshcat, station.tool, X_BC_guess, circle_radius_m, config, cad, weld_speed_m_s)
    wiring.add("cell_visualizer", viewer)
    wiring.connect(viewer, **ports)
    return viewer
