"""Draws the weld's progress in Meshcat.

CAD edges, planned, felt and welded seam, an arrow beside the tip for its deflection.
"""

import math

import numpy as np
import numpy.typing as npt
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import WeldingTool
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import PlannedSeam
from weldcal.systems.viewer.scene import CAD, DEFLECTION, DEFLECTION_SCALE, FELT, PLANNED, WAY_BACK, WELDED, coloured

Floats = npt.NDArray[np.float64]


def outline(mesh: TriMesh, least_angle_rad: float = math.radians(20.0)) -> tuple[Floats, Floats]:
    """Starts and ends (N, 3) m of the edges with one face, or whose faces turn by more than the least angle.

    Args:
        mesh: faces that meet share their vertices (as TriMesh's makers do).
        least_angle_rad: between the faces' normals.
    """
    corners = mesh.triangles
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(corners)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, face = edges[order], face[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    second = np.concatenate([[False], same])
    alone = ~second & ~np.concatenate([same, [False]])
    pairs = np.flatnonzero(same)
    turned = np.einsum("ni,ni->n", mesh.normals[face[pairs]], mesh.normals[face[pairs + 1]]) < math.cos(least_angle_rad)
    kept = np.concatenate([edges[alone], edges[pairs[turned]]])
    return mesh.vertices[kept[:, 0]], mesh.vertices[kept[:, 1]]


SHOWN_ABOVE_M = 0.006  # paths are raised out of the groove's root to be visible
ARROW_ASIDE_M = 0.018  # beside the tip, which it must not hide
PIECE_S = 0.5  # period of the updates of the paths
_DASH_M, _DOT_M, _DOTS_EVERY_M = 0.006, 0.0020, 0.0008


class WeldView:
    """Draws the weld incrementally and keeps the data sent to Meshcat; it holds no state of the simulation."""

    def __init__(self, meshcat: Meshcat, root: str, tool: WeldingTool, cad: TriMesh | None) -> None:
        self._meshcat, self._root, self._tool, self._cad = meshcat, root, tool, cad
        self._seam, self._pieces, self._next = (0, 0, 0), 0, -np.inf
        self._torch: list[Array] = []
        self._felt: list[Array] = []
        self._arrow, self._aside = False, np.zeros(3)
        self._ways_back, self._way_shown = 0, False

    def draw(self, planned: PlannedSeam, servo: ServoReport, time: float) -> None:
        """Update the viewer with the newest plan and servo report."""
        if planned.key != self._seam and planned.seam is not None:
            self._seam = planned.key
            s = np.arange(0.0, planned.seam.length, _DOTS_EVERY_M)
            line = np.asarray(planned.seam.position(s[s % (2.0 * _DASH_M) < _DASH_M]))
            self._path("seam/planned", line, SHOWN_ABOVE_M, PLANNED, time)
            chord = planned.seam.position(planned.seam.length) - planned.seam.position(0.0)
            aside = np.cross(chord, [0.0, 0.0, 1.0])
            self._aside = ARROW_ASIDE_M * aside / max(float(np.linalg.norm(aside)), 1e-9)
            self._draw_cad(planned.X_BP, time)
        if servo.command is None or servo.X_BT is None:
            if self._arrow:
                self._arrow = False
                self._meshcat.SetProperty(f"{self._root}/deflection", "visible", False, time)
            return
        self._draw_way_back(servo, time)
        self._collect(servo)
        self._draw_arrow(servo, time)
        if time >= self._next and (self._torch or self._felt):
            self._next = time + PIECE_S
            self._draw_pieces(time)

    def _collect(self, servo: ServoReport) -> None:
        assert servo.command is not None
        assert servo.X_BT is not None
        p_BW, d = servo.X_BT @ self._tool.p_TW, servo.command.diagnostics
        if servo.torch_on:
            self._torch.append(p_BW)
        if d.p_BTip is not None and servo.phase == "TRACK":
            self._felt.append(d.p_BTip)

    def _draw_pieces(self, time: float) -> None:
        piece = self._pieces
        if self._torch:
            self._path(f"seam/torch/{piece:03d}", np.array(self._torch), SHOWN_ABOVE_M + 0.0012, WELDED, time)
        if self._felt:
            self._path(f"seam/felt/{piece:03d}", np.array(self._felt), SHOWN_ABOVE_M + 0.0006, FELT, time)
        self._torch, self._felt = self._torch[-1:], self._felt[-1:]
        self._pieces = piece + 1

    def _draw_way_back(self, servo: ServoReport, time: float) -> None:
        """Draw the torch's path back to where the weld goes on, from an operator's hold until then."""
        way = servo.interruption.way_back
        if bool(way) == self._way_shown:
            return
        self._way_shown = bool(way)
        if not way:
            self._meshcat.SetProperty(f"{self._root}/seam/way_back/{self._ways_back:02d}", "visible", False, time)
            return
        self._ways_back += 1
        line = np.array([point.X_BT @ self._tool.p_TW for point in way])
        self._path(f"seam/way_back/{self._ways_back:02d}", line, SHOWN_ABOVE_M + 0.003, WAY_BACK, time)

    def _draw_arrow(self, servo: ServoReport, time: float) -> None:
        """Draw the tip's deflection from rest as an arrow magnified ten times, beside the tip."""
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
            RotationMatrix.MakeFromOneVector(-measurement.delta, 2), np.asarray(servo.X_BT.translation()) + self._aside
        )
        self._meshcat.SetTransform(f"{path}/arrow", X_BArrow, time)
        self._meshcat.SetProperty(f"{path}/arrow/unit", "scale", [1.0, 1.0, DEFLECTION_SCALE * length], time)

    def _make_arrow(self, path: str) -> None:
        """Create an arrow 1 m long along z, which _draw_arrow scales."""
        shaft, head = 0.72, 0.28
        self._meshcat.SetObject(f"{path}/arrow/unit/shaft", Cylinder(0.0010, shaft), DEFLECTION)
        self._meshcat.SetTransform(f"{path}/arrow/unit/shaft", RigidTransform([0.0, 0.0, 0.5 * shaft]))
        self._meshcat.SetObject(f"{path}/arrow/unit/head", MeshcatCone(head, 0.0028, 0.0028), DEFLECTION)
        # A Meshcat cone has its apex at its origin.
        over = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, 1.0])
        self._meshcat.SetTransform(f"{path}/arrow/unit/head", over)

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
        raised = np.asarray(points_B) + np.array([0.0, 0.0, raise_m])
        self._meshcat.SetObject(f"{self._root}/{name}", coloured(raised), _DOT_M, rgba)
        self._show(f"{self._root}/{name}", time)

    def _show(self, path: str, time: float) -> None:
        """Show an item in the recording from `time` on."""
        self._meshcat.SetProperty(path, "visible", False, 0.0)
        self._meshcat.SetProperty(path, "visible", True, time)
