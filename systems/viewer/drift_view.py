"""DriftView: shows a watched calibration in Meshcat: the scanner as believed, and the ring in its newest frame."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, EventStatus

from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import FlangeEstimate
from weldcal.systems.motion.drift_monitor import DriftStatus
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.viewer.kept import keep
from weldcal.systems.viewer.scene import CIRCLE, draw_ring, draw_triad

ROOT = "/weldcal/drift"


@dataclass
class _Drawn:
    """What was sent to Meshcat so far; not part of the simulation's state."""

    at_s: float = -np.inf
    frames: int = -1
    fit: int = 0


class DriftView(LeafSystem):
    """Draws the watch once a second, and the ring of the newest frame.

    .. pydrake_system::

        name: DriftView
        input_ports:
        - drift
        - flange_estimate

    The dashboard shows the error, the offset of the clock and the test's statistic against its threshold.
    """

    def __init__(
        self, meshcat: Meshcat, circle_radius_m: float, config: VisualizationConfig, period_s: float = 1.0
    ) -> None:
        super().__init__()
        self._meshcat, self._radius_m, self._period_s = keep(meshcat), circle_radius_m, period_s
        self._drift = self.DeclareAbstractInputPort("drift", AbstractValue.Make(DriftStatus()))
        self._estimate = self.DeclareAbstractInputPort("flange_estimate", AbstractValue.Make(FlangeEstimate()))
        self._drawn = _Drawn()
        self.DeclarePeriodicPublishEvent(1.0 / config.recording_fps, 0.0, self._draw)

    def _draw(self, context: Context) -> EventStatus:
        time, status = context.get_time(), self._drift.Eval(context)
        self._draw_ring(self._estimate.Eval(context), status, time)
        if time >= self._drawn.at_s + self._period_s and status.frames != self._drawn.frames:
            self._draw_scanner(status, time)
            self._drawn.at_s, self._drawn.frames = time, status.frames
        return EventStatus.Succeeded()

    def _draw_scanner(self, status: DriftStatus, time: float) -> None:
        if status.X_BC is None:
            return
        path = f"{ROOT}/scanner"
        if not self._meshcat.HasPath(path):
            draw_triad(self._meshcat, path)
        self._meshcat.SetTransform(path, status.X_BC, time)

    def _draw_ring(self, estimate: FlangeEstimate, status: DriftStatus, time: float) -> None:
        if estimate.sequence <= self._drawn.fit or estimate.fit is None or status.X_BC is None:
            return
        path = f"{ROOT}/ring"
        if not self._meshcat.HasPath(path):
            draw_ring(self._meshcat, path, self._radius_m, CIRCLE)
        R = RotationMatrix.MakeFromOneVector(status.X_BC.rotation() @ estimate.fit.normal_C, 2)
        self._meshcat.SetTransform(path, RigidTransform(R, status.X_BC @ estimate.fit.center_C), time)
        self._drawn.fit = estimate.sequence
