"""Draws the weld's progress in Meshcat: CAD over the cloud, planned and measured seam, torch, deflection arrow, gauge."""

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud

from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh
from weldcal.models.outline import outline
from weldcal.models.tool import WeldingTool
from weldcal.systems.bodies.textured_board import textured_board
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import PlannedSeam
from weldcal.systems.viewer.phase_labels import HEIGHT_M as SIGN_HEIGHT_M
from weldcal.systems.viewer.phase_labels import WIDTH_M as SIGN_WIDTH_M
from weldcal.systems.viewer.phase_labels import X_WS, label_image
from weldcal.systems.viewer.weld_gauge import HEIGHT_PX, WIDTH_PX, gauge_picture

PLANNED, REFINED, TORCH = Rgba(0.55, 0.55, 0.60, 1.0), Rgba(0.15, 0.45, 0.90, 1.0), Rgba(0.95, 0.45, 0.10, 1.0)
TIP, CAD, ARROW = Rgba(0.35, 0.80, 0.95, 1.0), Rgba(0.05, 0.50, 0.42, 1.0), Rgba(0.80, 0.10, 0.45, 1.0)
WAY_BACK = Rgba(0.48, 0.20, 0.80, 1.0)
SHOWN_ABOVE_M = 0.008  # paths are raised above the groove to be visible
DEFLECTION_SCALE = 10.0
_OVER_THE_HEAD = np.array([0.0, 0.0, 0.016])
PIECE_S = 1.0  # period of the updates of paths and gauge
GAUGE_HEIGHT_M = SIGN_WIDTH_M * HEIGHT_PX / WIDTH_PX


class WeldView:
    """Draws the weld incrementally and keeps the data sent to Meshcat; it holds no state of the simulation."""

    def __init__(self, meshcat: Meshcat, root: str, tool: WeldingTool, cad: TriMesh | None, weld_speed: float) -> None:
        self._meshcat, self._root, self._tool, self._cad = meshcat, root, tool, cad
        self._weld_speed = weld_speed
        self._seam, self._length, self._pieces, self._points, self._next = 0, 0.0, 0, 0, -np.inf
        self._torch: list[Array] = []
        self._tip: list[Array] = []
        self._gauge: list[tuple[float, float, float]] = []
        self._last: tuple[float, Array] | None = None
        self._arrow = False
        self._ways_back, self._way_shown = 0, False

    def draw(self, planned: PlannedSeam, servo: ServoReport, time: float) -> None:
        """Update the viewer with the newest plan and servo report."""
        if planned.sequence > self._seam and planned.seam is not None:
            self._seam, self._length = planned.sequence, planned.seam.length
            line = np.asarray(planned.seam.position(np.linspace(0.0, planned.seam.length, 300)))
            self._path("seam/planned", line, SHOWN_ABOVE_M, PLANNED, time)
            self._draw_cad(planned.X_BP, time)
        if servo.command is None or servo.X_BT is None:
            if self._arrow:
                self._arrow = False
                self._meshcat.SetProperty(f"{self._root}/deflection", "visible", False, time)
            return
        self._draw_way_back(servo, time)
        self._collect(servo)
        self._draw_arrow(servo, time)
        if time >= self._next and len(self._gauge) > 1:
            self._next = time + PIECE_S
            self._draw_pieces(servo, time)

    def _collect(self, servo: ServoReport) -> None:
        assert servo.command is not None
        assert servo.X_BT is not None
        p_BW, d = servo.X_BT @ self._tool.p_TW, servo.command.diagnostics
        if servo.torch_on:
            self._torch.append(p_BW)
        if d.p_BTip is not None and servo.phase == "TRACK":
            self._tip.append(d.p_BTip)
        speed = np.nan
        if self._last is not None and servo.torch_on and servo.time > self._last[0]:
            speed = float(np.linalg.norm(p_BW - self._last[1])) / (servo.time - self._last[0])
        self._last = (servo.time, p_BW)
        if servo.phase != "TOUCH":
            self._gauge.append((d.s_torch, speed, d.n_d_dot_n_t))

    def _draw_pieces(self, servo: ServoReport, time: float) -> None:
        piece = self._pieces
        refined = servo.state.refined.points if servo.state is not None else np.empty((0, 3))
        if self._torch:
            self._path(f"seam/torch/{piece:03d}", np.array(self._torch), SHOWN_ABOVE_M + 0.004, TORCH, time)
        if self._tip:
            self._path(f"seam/tip/{piece:03d}", np.array(self._tip), SHOWN_ABOVE_M - 0.003, TIP, time)
        if len(refined) > self._points:
            self._path(f"seam/refined/{piece:03d}", refined[self._points :], SHOWN_ABOVE_M, REFINED, time)
        s, speed, measure = np.array(self._gauge).T
        name = f"gauge_{piece:03d}"
        picture = gauge_picture(s, speed, measure, self._length, self._weld_speed)
        path = f"{self._root}/gauge/{piece:03d}"
        self._meshcat.SetObject(path, textured_board(name, SIGN_WIDTH_M, GAUGE_HEIGHT_M, picture))
        below = RigidTransform([0.0, -0.5 * (SIGN_HEIGHT_M + GAUGE_HEIGHT_M) - 0.008, 0.0])
        self._meshcat.SetTransform(path, X_WS @ below)
        self._show(path, time)
        if piece:
            self._meshcat.SetProperty(f"{self._root}/gauge/{piece - 1:03d}", "visible", False, time)
        self._torch, self._tip = self._torch[-1:], self._tip[-1:]
        self._points, self._pieces = len(refined), piece + 1

    def _draw_way_back(self, servo: ServoReport, time: float) -> None:
        """While a person holds the weld, and until it goes on: the torch's way back to where it goes on."""
        way = servo.interruption.way_back
        if bool(way) == self._way_shown:
            return
        self._way_shown = bool(way)
        if not way:
            self._meshcat.SetProperty(f"{self._root}/seam/way_back/{self._ways_back:02d}", "visible", False, time)
            return
        self._ways_back += 1
        line = np.array([point.X_BT @ self._tool.p_TW for point in way])
        self._path(f"seam/way_back/{self._ways_back:02d}", line, SHOWN_ABOVE_M + 0.008, WAY_BACK, time)

    def _draw_arrow(self, servo: ServoReport, time: float) -> None:
        """Draw the tip's deflection from rest as an arrow magnified ten times, with a label of the scale."""
        assert servo.X_BT is not None
        measurement = None if servo.state is None else servo.state.measurement
        length = 0.0 if measurement is None else float(np.linalg.norm(measurement.delta))
        if measurement is None or length < 1e-4:
            return
        path = f"{self._root}/deflection"
        if not self._arrow:
            self._arrow = True
            if not self._meshcat.HasPath(path):
                self._make_arrow(path)
            self._show(path, time)
        X_BArrow = RigidTransform(
            RotationMatrix.MakeFromOneVector(-measurement.delta, 2), np.asarray(servo.X_BT.translation())
        )
        self._meshcat.SetTransform(f"{path}/arrow", X_BArrow, time)
        self._meshcat.SetProperty(f"{path}/arrow/unit", "scale", [1.0, 1.0, DEFLECTION_SCALE * length], time)
        head = X_BArrow @ np.array([0.0, 0.0, DEFLECTION_SCALE * length])
        self._meshcat.SetTransform(f"{path}/word", RigidTransform(X_WS.rotation(), head + _OVER_THE_HEAD), time)

    def _make_arrow(self, path: str) -> None:
        """Create an arrow 1 m long along z, which _draw_arrow scales."""
        shaft, head = 0.72, 0.28
        self._meshcat.SetObject(f"{path}/arrow/unit/shaft", Cylinder(0.0018, shaft), ARROW)
        self._meshcat.SetTransform(f"{path}/arrow/unit/shaft", RigidTransform([0.0, 0.0, 0.5 * shaft]))
        self._meshcat.SetObject(f"{path}/arrow/unit/head", MeshcatCone(head, 0.0048, 0.0048), ARROW)
        # A Meshcat cone has its apex at its origin.
        over = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, 1.0])
        self._meshcat.SetTransform(f"{path}/arrow/unit/head", over)
        word = label_image(f"deflection x {DEFLECTION_SCALE:g}")[:, 250:774]
        self._meshcat.SetObject(f"{path}/word", textured_board("deflection", 0.09, 0.022, np.ascontiguousarray(word)))

    def _draw_cad(self, X_BP: RigidTransform | None, time: float) -> None:
        """Draw the edges of the CAD at the registered pose."""
        if self._cad is None or X_BP is None:
            return
        path = f"{self._root}/cad"
        starts, ends = outline(self._cad)
        self._meshcat.SetLineSegments(path, np.asfortranarray(starts.T), np.asfortranarray(ends.T), 2.0, CAD)
        self._meshcat.SetTransform(path, X_BP)
        self._show(path, time)

    def _path(self, name: str, points_B: Array, raise_m: float, rgba: Rgba, time: float) -> None:
        """Draw a path as a row of dots (browsers draw lines with a width of one pixel)."""
        dots = PointCloud(len(points_B), Fields(BaseField.kXYZs))
        dots.mutable_xyzs()[:] = (np.asarray(points_B) + np.array([0.0, 0.0, raise_m])).T
        self._meshcat.SetObject(f"{self._root}/{name}", dots, 0.004, rgba)
        self._show(f"{self._root}/{name}", time)

    def _show(self, path: str, time: float) -> None:
        """Show an item in the recording from `time` on."""
        self._meshcat.SetProperty(path, "visible", False, 0.0)
        self._meshcat.SetProperty(path, "visible", True, time)
