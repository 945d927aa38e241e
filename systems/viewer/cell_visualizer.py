"""CellVisualizer: shows the weld job's estimates in Meshcat.

View cone, clouds by residual, circles, uncertainty, seams, torch.
"""

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, EventStatus, OutputPort

from weldcal.calibration.flange.fit import FlangeFit
from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh
from weldcal.models.scanners import ScannerPreset
from weldcal.models.tool import WeldingTool
from weldcal.systems.jobs.weld.sequencer import JobState
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, Message, PlannedSeam, Scan
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.viewer.kept import keep
from weldcal.systems.viewer.scene import (
    CIRCLE,
    CLOUD,
    CONE,
    R_SIGN,
    RESIDUAL_MM,
    UNCERTAINTY,
    WELDING_PHASES,
    coloured,
    diverging,
    draw_ring,
    draw_sign,
    draw_triad,
    draw_view_cone,
    uncertainty_at,
)
from weldcal.systems.viewer.weld_view import WeldView
from weldcal.systems.wiring import Wiring

ROOT = "/weldcal"
SEEN, GUESS, ELLIPSOID = f"{ROOT}/estimate", f"{ROOT}/guess", f"{ROOT}/error/at_work_point"
WITH_FLANGE = (f"{SEEN}/circle", f"{SEEN}/face", f"{ROOT}/error")
WITH_SCANS = (f"{SEEN}/scan", f"{SEEN}/cone")
"""Groups that are shown while the flange is scanned, and while anything is."""
FADES = (("new", 1.0, 0), ("recent", 0.45, 1), ("old", 0.18, 4))
"""Of the circles: name, opacity, and the least number of newer circles."""
_FACE_POINTS, _SIGN_M = 4000, 0.030
_CONE_PAST_M = 0.05  # the cone ends behind the work point
_CIRCLE_SIGN, _CAMERA_SIGN = (88, 25, 215), (60, 52, 46)  # BGR


@dataclass
class _Circle:
    """A drawn circle: its scan's label, and which of its shapes is visible."""

    label: str
    showing: str = ""


@dataclass(kw_only=True)
class _Drawn:
    """The items sent to Meshcat so far, so that each is drawn once; not part of the simulation's state."""

    scan: int = 0
    fit: int = 0
    status: int = 0
    face: int = 0
    circles: dict[int, _Circle] = field(default_factory=dict)
    visible: dict[str, bool] = field(default_factory=dict)
    magnification: int = 0


class CellVisualizer(LeafSystem):
    """Draws the cell's estimates when they change, at the recording's rate at most.

    .. pydrake_system::

        name: CellVisualizer
        input_ports:
        - job_state
        - calibration_status
        - flange_estimate
        - scan
        - planned_seam
        - servo_report

    What was seen stands below the estimate in Meshcat's tree, so that it moves with each better estimate. An item that
    appears during the job is hidden in the recording before that time. `work_B` (3,) m is where the calibration's error
    is shown.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        tool: WeldingTool | None,
        X_BC_guess: RigidTransform,
        circle_radius_m: float,
        config: VisualizationConfig,
        cad: TriMesh | None = None,
        scanner: ScannerPreset | None = None,
        work_B: Array | None = None,
    ) -> None:
        super().__init__()
        self._meshcat, self._config, self._scanner, self._work_B = keep(meshcat), config, scanner, work_B
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
        self._weld = None if tool is None else WeldView(meshcat, ROOT, tool, cad)
        self.DeclarePeriodicPublishEvent(1.0 / config.recording_fps, 0.0, self._draw)
        self.DeclareInitializationPublishEvent(self._prepare)

    def _prepare(self, context: Context) -> EventStatus:
        for path in (*WITH_FLANGE, *WITH_SCANS):
            # a recording shows an item's first value from its begin on
            self._meshcat.SetProperty(path, "visible", True, 0.0)
        draw_triad(self._meshcat, f"{GUESS}/triad", dashed=True)
        self._meshcat.SetTransform(f"{GUESS}/triad", self._X_BC_guess)
        self._sign(f"{GUESS}/sign", "guess", _CAMERA_SIGN, self._beside(self._X_BC_guess, 0.14))
        self._meshcat.SetTransform(SEEN, self._X_BC_guess, 0.0)
        if self._scanner is not None:
            depth = self._scanner.far_m
            if self._work_B is not None:
                depth = min(depth, float(np.linalg.norm(self._work_B - self._X_BC_guess.translation())) + _CONE_PAST_M)
            draw_view_cone(self._meshcat, f"{SEEN}/cone", self._scanner, depth, CONE)
        return EventStatus.Succeeded()

    def _sign(self, path: str, text: str, colour: tuple[int, int, int], p_B: Array) -> None:
        draw_sign(self._meshcat, path, text, _SIGN_M, colour)
        self._meshcat.SetTransform(path, RigidTransform(R_SIGN, p_B))

    def _beside(self, X_BC: RigidTransform, up_m: float) -> Array:
        """Return where the sign of a camera is: beside its axes, off the housing."""
        return np.asarray(X_BC.translation() + np.array([0.0, 0.0, up_m]))

    def _show(self, path: str, time: float) -> None:
        self._meshcat.SetProperty(path, "visible", False, 0.0)
        self._meshcat.SetProperty(path, "visible", True, time)
        self._drawn.visible[path] = True

    def _switch(self, path: str, on: bool, time: float) -> None:
        """Show or hide a group of items, where that is a change."""
        if self._drawn.visible.get(path, True) != on:
            self._meshcat.SetProperty(path, "visible", on, time)
            self._drawn.visible[path] = on

    def _draw(self, context: Context) -> EventStatus:
        time = context.get_time()
        seen = {name: port.Eval(context) for name, port in self._ports.items()}
        status: CalibrationStatus = seen["calibration_status"]
        self._draw_groups(seen["job_state"].phase, time)
        self._draw_scan(seen["scan"], time)
        self._draw_fit(seen["flange_estimate"], status, time)
        self._draw_calibration(status, time)
        self._draw_face(seen["flange_estimate"], status, time)
        if self._weld is not None:
            self._weld.draw(seen["planned_seam"], seen["servo_report"], time)
        return EventStatus.Succeeded()

    def _draw_groups(self, phase: str, time: float) -> None:
        """Clouds and circles go where they would hide what matters next."""
        welding = phase in WELDING_PHASES
        for path in WITH_FLANGE:
            self._switch(path, not welding and phase != "scan_workpiece", time)
        for path in WITH_SCANS:
            self._switch(path, not welding, time)

    def _draw_scan(self, scan: Scan, time: float) -> None:
        if scan.sequence <= self._drawn.scan:
            return
        points = scan.points_C.reshape(-1, 3)
        points = points[np.isfinite(points[:, 2])]
        step = max(1, len(points) // self._config.cloud_points)
        if self._drawn.scan:
            self._meshcat.SetProperty(f"{SEEN}/scan/{self._drawn.scan:02d}", "visible", False, time)
        path = f"{SEEN}/scan/{scan.sequence:02d}"
        self._meshcat.SetObject(path, coloured(points[::step].astype(np.float64)), 0.0010, CLOUD)
        self._show(path, time)
        self._drawn.scan = scan.sequence

    def _draw_fit(self, estimate: FlangeEstimate, status: CalibrationStatus, time: float) -> None:
        drawn = self._drawn
        if estimate.sequence <= drawn.fit:
            return
        drawn.fit = estimate.sequence
        if estimate.fit is None:
            return
        X_CR = _circle_pose(estimate.fit, status)
        path = f"{SEEN}/circle/{estimate.sequence:02d}"
        for name, opacity, _ in FADES:
            rgba = Rgba(CIRCLE.r(), CIRCLE.g(), CIRCLE.b(), opacity)
            draw_ring(self._meshcat, f"{path}/{name}", self._circle_radius_m, rgba)
            self._meshcat.SetProperty(f"{path}/{name}", "visible", False, 0.0)
        draw_ring(self._meshcat, f"{path}/refused", self._circle_radius_m, CIRCLE, dashed=True)
        self._meshcat.SetProperty(f"{path}/refused", "visible", False, 0.0)
        draw_sign(self._meshcat, f"{path}/number", str(estimate.sequence), _SIGN_M, _CIRCLE_SIGN)
        X_BC = status.X_BC or self._X_BC_guess
        R_CR = X_CR.rotation().inverse() @ X_BC.rotation().inverse() @ R_SIGN
        aside = R_SIGN.matrix()[:, 0] * (self._circle_radius_m + 0.012)
        p = X_CR.rotation().inverse() @ (X_BC.rotation().inverse() @ aside)
        self._meshcat.SetTransform(f"{path}/number", RigidTransform(R_CR, p))
        self._meshcat.SetTransform(path, X_CR)
        self._show(path, time)
        drawn.circles[estimate.sequence] = _Circle(estimate.label)
        self._fade(status, time)

    def _fade(self, status: CalibrationStatus, time: float) -> None:
        """Newer circles are stronger; those that the calibration refused are dashed."""
        refused = {label for label, _ in status.refused}
        if status.estimate is not None and len(status.estimate.inliers) == len(status.observations):
            refused |= {o.id for o, used in zip(status.observations, status.estimate.inliers, strict=True) if not used}
        circles = self._drawn.circles
        for age, number in enumerate(sorted(circles, reverse=True)):
            circle = circles[number]
            wanted = next(name for name, _, least in reversed(FADES) if age >= least)
            wanted = "refused" if circle.label in refused else wanted
            if wanted == circle.showing:
                continue
            path = f"{SEEN}/circle/{number:02d}"
            if circle.showing:
                self._meshcat.SetProperty(f"{path}/{circle.showing}", "visible", False, time)
            self._meshcat.SetProperty(f"{path}/{wanted}", "visible", True, time)
            circle.showing = wanted

    def _draw_calibration(self, status: CalibrationStatus, time: float) -> None:
        drawn, estimate = self._drawn, status.estimate
        if status.sequence <= drawn.status:
            return
        drawn.status = status.sequence
        self._fade(status, time)
        if estimate is None:
            return
        triad, sign = f"{SEEN}/triad", f"{ROOT}/estimate_sign"
        if not self._meshcat.HasPath(triad):
            draw_triad(self._meshcat, triad)
            self._show(triad, time)
            draw_sign(self._meshcat, sign, "estimate", _SIGN_M, _CAMERA_SIGN)
            self._show(sign, time)
        self._meshcat.SetTransform(SEEN, estimate.X_BC, time)
        self._meshcat.SetTransform(sign, RigidTransform(R_SIGN, self._beside(estimate.X_BC, 0.115)), time)
        if self._work_B is None:
            return
        found = uncertainty_at(estimate, self._work_B)
        if not self._meshcat.HasPath(ELLIPSOID):
            self._meshcat.SetObject(f"{ELLIPSOID}/ball/unit", Sphere(1.0), UNCERTAINTY)
            self._show(ELLIPSOID, time)
        scale = np.maximum(found.magnification * found.half_axes, 5e-4)
        self._meshcat.SetTransform(
            f"{ELLIPSOID}/ball", RigidTransform(RotationMatrix.ProjectToRotationMatrix(found.R_BE), self._work_B), time
        )
        self._meshcat.SetProperty(f"{ELLIPSOID}/ball/unit", "scale", scale.tolist(), time)
        if found.magnification != drawn.magnification:
            if drawn.magnification:
                self._meshcat.SetProperty(f"{ELLIPSOID}/sign/{drawn.magnification}", "visible", False, time)
            path = f"{ELLIPSOID}/sign/{found.magnification}"
            if not self._meshcat.HasPath(path):
                self._sign(path, f"3 sigma x {found.magnification}", (88, 120, 25), self._work_B)
            self._show(path, time)
            drawn.magnification = found.magnification
        self._meshcat.SetTransform(f"{ELLIPSOID}/sign", RigidTransform([0.0, 0.0, float(scale.max()) + 0.012]), time)

    def _draw_face(self, estimate: FlangeEstimate, status: CalibrationStatus, time: float) -> None:
        """Colour the scan's flange face by its distance from where the arm and the calibration put it."""
        drawn = self._drawn
        if (
            estimate.sequence <= drawn.face
            or status.sequence < estimate.sequence
            or status.estimate is None
            or estimate.points_C is None
            or not status.observations
            or status.observations[-1].id != estimate.label
        ):
            return
        points = np.asarray(estimate.points_C, dtype=np.float64)
        points = points[:: max(1, len(points) // _FACE_POINTS)]
        residual = face_residuals(points, status)
        if drawn.face:
            self._meshcat.SetProperty(f"{SEEN}/face/{drawn.face:02d}", "visible", False, time)
        path = f"{SEEN}/face/{estimate.sequence:02d}"
        self._meshcat.SetObject(path, coloured(points, diverging(1e3 * residual / RESIDUAL_MM)), 0.0022)
        self._show(path, time)
        drawn.face = estimate.sequence


def face_residuals(points_C: Array, status: CalibrationStatus) -> Array:
    """Distances (n,) m of scanned points (n, 3) above the flange face where the arm and the calibration put it."""
    X_BC, X_BR = status.X_BC, status.observations[-1].X_BR
    assert X_BC is not None
    points_B = status.correction.points(points_C) @ X_BC.rotation().matrix().T + X_BC.translation()
    return np.asarray((points_B - X_BR.translation()) @ X_BR.rotation().matrix()[:, 2])


def _circle_pose(fit: FlangeFit, status: CalibrationStatus) -> RigidTransform:
    """Return the pose of a found circle in C, where the scanner's correction puts it."""
    return RigidTransform(
        RotationMatrix.MakeFromOneVector(np.asarray(fit.normal_C), 2), status.correction.points(fit.center_C)
    )


def add_visualizer(
    wiring: Wiring, circle_radius_m: float, X_BC_guess: RigidTransform, work_B: Array, ports: dict[str, OutputPort]
) -> CellVisualizer:
    """Add the CellVisualizer to the builder; the cell itself draws the bodies."""
    assert wiring.meshcat is not None
    station, scenario = wiring.station, wiring.scenario
    cad = None if station.cad is None else station.cad.mesh
    config = scenario.scanner_config()
    scanner = None if config is None else config.scanner()
    viewer = CellVisualizer(
        meshcat=wiring.meshcat,
        tool=station.tool,
        X_BC_guess=X_BC_guess,
        circle_radius_m=circle_radius_m,
        config=scenario.visualization,
        cad=cad,
        scanner=scanner,
        work_B=work_B,
    )
    wiring.add("cell_visualizer", viewer)
    wiring.connect(viewer, **ports)
    return viewer
