"""The 3D view of a capture session: all scans in the base, the poses that were taken, and the next one as a ghost."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams, Rgba
from pydrake.math import RigidTransform
from pydrake.perception import BaseField, Fields, PointCloud

from weldcal.calibration.data.clouds import read_cloud
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.tools.dashboard.capture_run import CaptureRun, JoggedArm

POINTS = 20_000
"""Points that are drawn of each scan."""
_AXIS_M = 0.08
_COLOURS = ((1.0, 0.0, 0.0), (0.0, 0.6, 0.0), (0.0, 0.3, 1.0))
_FROM_M = np.array([0.9, -0.9, 0.7])  # from where the camera looks at the first pose
_ARM = Rgba(0.75, 0.78, 0.8, 0.6)
_GHOST = Rgba(0.45, 0.25, 0.75, 0.9)


class CaptureView:
    """A Meshcat of its own; `url` is its address on this computer."""

    def __init__(self) -> None:
        self._meshcat = Meshcat(MeshcatParams(host="127.0.0.1", show_stats_plot=False))
        self.url = self._meshcat.web_url()
        self._drawn: set[str] = set()
        self._looks = False

    def show(self, run: CaptureRun) -> None:
        """Draw the session as it is."""
        if isinstance(run.arm, JoggedArm):
            for k, mesh in enumerate(run.arm.shape()):
                self._meshcat.SetTriangleMesh(f"arm/{k}", mesh.vertices.T, mesh.triangles.T, _ARM)
        verdict, taken = run.verdict, {c.id: c for c in run.session.captures}
        for id in self._drawn - set(taken):
            self._meshcat.Delete(f"taken/{id}")
        self._drawn = set(taken)
        odd = dict(verdict.odd)
        for id, one in taken.items():
            if one.pose.X_BF is not None:
                self._triad(f"taken/{id}", one.pose.X_BF, 1.0)
            if verdict.X is not None and verdict.symbol == "X_BC" and isinstance(one.found, FlangeFit):
                with suppress(WeldcalError, OSError):
                    self._cloud(f"taken/{id}/scan", verdict.X, read_cloud(one.file), one.found, id in odd)
        if verdict.X is not None and verdict.symbol == "X_BC":
            self._triad("scanner", verdict.X, 1.5)
        seen = [one.pose.X_BF.translation() for one in taken.values() if one.pose.X_BF is not None]
        if seen and not self._looks:  # afterwards the camera is the user's
            self._meshcat.SetCameraPose(seen[0] + _FROM_M, seen[0])
            self._looks = True
        self._meshcat.Delete("next")
        if verdict.advice is not None and verdict.advice.X_BF is not None:
            self._triad("next", verdict.advice.X_BF, 1.5, _GHOST)

    def _triad(self, path: str, X: RigidTransform, size: float, colour: Rgba | None = None) -> None:
        p = X.translation()
        for k, rgb in enumerate(_COLOURS):
            line = np.column_stack([p, p + size * _AXIS_M * X.rotation().matrix()[:, k]])
            self._meshcat.SetLine(f"{path}/{'xyz'[k]}", line, 4.0, colour or Rgba(*rgb))

    def _cloud(self, path: str, X_BC: RigidTransform, points_C: Array, fit: FlangeFit, odd: bool) -> None:
        """Draw what lies about the flange, m; the scans overlay each other where the calibration is right."""
        p = points_C.reshape(-1, 3)
        p = p[np.isfinite(p).all(axis=1)]
        p = p[np.linalg.norm(p - fit.center_C, axis=1) < 3.0 * (fit.outer_radius_m or _AXIS_M)]
        p = p[:: max(1, len(p) // POINTS)]
        cloud = PointCloud(len(p), Fields(BaseField.kXYZs))
        cloud.mutable_xyzs()[:] = np.asarray(X_BC @ p.T, dtype=np.float32)
        self._meshcat.SetObject(path, cloud, 0.002, Rgba(0.85, 0.1, 0.1) if odd else Rgba(0.3, 0.4, 0.5))
