"""The 3D view of a capture session: all scans in the base by how they agree, the poses, and the next one as a ghost."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams, Rgba
from pydrake.math import RigidTransform
from pydrake.perception import BaseField, Fields, PointCloud

from weldcal.calibration.capture.session import ArmPose
from weldcal.calibration.capture.tasks import HOME_Q
from weldcal.calibration.data.clouds import read_cloud
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arms.shape import arm_shape
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh
from weldcal.tools.dashboard.capture_run import CaptureRun, JoggedArm

POINTS = 20_000
"""Points that are drawn of each scan."""
_AXIS_M = 0.08
_COLOURS = ((1.0, 0.0, 0.0), (0.0, 0.6, 0.0), (0.0, 0.3, 1.0))
_FROM_GOOD_TO_BAD = ((0.1, 0.9, 0.85), (0.6, 0.65, 0.1), (0.2, 0.1, 0.1))  # red, green and blue: green, yellow, red
_FROM_M = np.array([0.9, -0.9, 0.7])  # from where the camera looks at the first pose
_ARM = Rgba(0.75, 0.78, 0.8, 0.6)
_GHOST, _GHOST_ARM = Rgba(0.45, 0.25, 0.75, 0.9), Rgba(0.45, 0.25, 0.75, 0.25)


class CaptureView:
    """A Meshcat of its own; `url` is its address on this computer."""

    def __init__(self, arm: ArmModel | None = None) -> None:
        self._meshcat = Meshcat(MeshcatParams(host="127.0.0.1", show_stats_plot=False))
        self.url, self._arm = self._meshcat.web_url(), arm
        self._drawn: set[str] = set()
        self._looks = False

    def show(self, run: CaptureRun) -> None:
        """Draw the session as it is."""
        verdict, taken = run.verdict, {c.id: c for c in run.session.captures}
        last = list(taken.values())[-1].pose if taken else ArmPose()
        if isinstance(run.arm, JoggedArm):
            self._meshes("arm", run.arm.shape(), _ARM)
        elif last.X_BF is not None:
            self._meshes("arm", self._shape(last), _ARM)
        for id in self._drawn - set(taken):
            self._meshcat.Delete(f"taken/{id}")
        self._drawn = set(taken)
        seen = [c.pose.X_BF.translation() for c in taken.values() if c.pose.X_BF is not None]
        for id, one in taken.items():
            if one.pose.X_BF is not None:
                self._triad(f"taken/{id}", one.pose.X_BF, 1.0)
        odd = dict(verdict.odd)
        for id, X_BC, off_m in verdict.placed:
            if id in taken and isinstance(fit := taken[id].found, FlangeFit):
                with suppress(WeldcalError, OSError):
                    colour = _worth(np.inf if id in odd else 1e3 * off_m / run.required_mm)
                    self._cloud(f"taken/{id}/scan", X_BC, read_cloud(taken[id].file), fit, colour)
        if seen and not self._looks:  # afterwards the camera is the user's
            self._meshcat.SetCameraPose(seen[0] + _FROM_M, seen[0])
            self._looks = True
        self._meshcat.Delete("next")
        if verdict.advice is not None and verdict.advice.X_BF is not None:
            self._triad("next", verdict.advice.X_BF, 1.5, _GHOST)
            goal = ArmPose(X_BF=verdict.advice.X_BF, q=verdict.advice.q)
            self._meshes("next/arm", self._shape(goal, last.q), _GHOST_ARM)

    def _shape(self, pose: ArmPose, near: Array | None = None) -> list[TriMesh]:
        """The arm at a pose, with the joints nearest to some; nothing where the arm is not known."""
        if self._arm is None or pose.X_BF is None:
            return []
        q = pose.q if pose.q is not None else nearest_solution(self._arm, pose.X_BF, HOME_Q if near is None else near)
        bodies = [] if q is None else arm_shape(self._arm, q)
        return [mesh.transformed(body.X_BL) for body in bodies for mesh in body.meshes]

    def _meshes(self, path: str, meshes: list[TriMesh], colour: Rgba) -> None:
        for k, mesh in enumerate(meshes):
            self._meshcat.SetTriangleMesh(f"{path}/{k}", mesh.vertices.T, mesh.triangles.T, colour)

    def _triad(self, path: str, X: RigidTransform, size: float, colour: Rgba | None = None) -> None:
        p = X.translation()
        for k, rgb in enumerate(_COLOURS):
            line = np.column_stack([p, p + size * _AXIS_M * X.rotation().matrix()[:, k]])
            self._meshcat.SetLine(f"{path}/{'xyz'[k]}", line, 4.0, colour or Rgba(*rgb))

    def _cloud(self, path: str, X_BC: RigidTransform, points_C: Array, fit: FlangeFit, colour: Rgba) -> None:
        """Draw what lies about the flange, m; the scans overlay each other where the calibration is right."""
        p = points_C.reshape(-1, 3)
        p = p[np.isfinite(p).all(axis=1)]
        p = p[np.linalg.norm(p - fit.center_C, axis=1) < 3.0 * (fit.outer_radius_m or _AXIS_M)]
        p = p[:: max(1, len(p) // POINTS)]
        cloud = PointCloud(len(p), Fields(BaseField.kXYZs))
        cloud.mutable_xyzs()[:] = np.asarray(X_BC @ p.T, dtype=np.float32)
        self._meshcat.SetObject(path, cloud, 0.002, colour)


def _worth(off: float) -> Rgba:
    """The colour of a scan by its disagreement over the required error: green at half, yellow at one, red at two."""
    at = float(np.clip(np.log2(max(off, 0.1)), -1.0, 1.0))
    return Rgba(*(float(np.interp(at, (-1.0, 0.0, 1.0), c)) for c in _FROM_GOOD_TO_BAD))
