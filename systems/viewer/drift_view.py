"""DriftView: shows a watched calibration in Meshcat: the scanner as believed, the fitted ring, error, offset and drift over time."""

from dataclasses import dataclass

import cv2
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, EventStatus, LeafSystem

from weldcal.models.arrays import Array
from weldcal.systems.bodies.textured_board import textured_board
from weldcal.systems.messages import FlangeEstimate
from weldcal.systems.motion.drift_monitor import DriftStatus
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.viewer.phase_labels import WIDTH_M, X_WS
from weldcal.systems.viewer.weld_gauge import Picture

ROOT = "/weldcal/drift"
WIDTH_PX, HEIGHT_PX = 1024, 600
_INK, _GROUND, _BAND, _LIMIT = (240, 240, 240), (46, 38, 33), (70, 62, 56), (90, 90, 240)  # BGR, as in the weld gauge
_AXES = (("x", (110, 110, 245)), ("y", (120, 210, 110)), ("z", (235, 190, 110)))
_LEFT, _RIGHT, _HIGH = 60, 990, 120
_FONT = cv2.FONT_HERSHEY_DUPLEX
_LEAST_MM, _LEAST_MS = 0.2, 1.0  # half of a strip's height at least
_RING, _TRIAD = Rgba(0.90, 0.15, 0.35, 1.0), (Rgba(0.9, 0.2, 0.2, 1), Rgba(0.2, 0.75, 0.2, 1), Rgba(0.2, 0.4, 0.95, 1))


@dataclass
class _Drawn:
    """What was sent to Meshcat so far; not part of the simulation's state."""

    board: int = 0
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

    The board shows of the newest frames the error, the offset of the clock and the test's statistic against its threshold.
    """

    def __init__(
        self, meshcat: Meshcat, circle_radius_m: float, config: VisualizationConfig, period_s: float = 1.0
    ) -> None:
        super().__init__()
        self._meshcat, self._radius_m, self._period_s = meshcat, circle_radius_m, period_s
        self._drift = self.DeclareAbstractInputPort("drift", AbstractValue.Make(DriftStatus()))
        self._estimate = self.DeclareAbstractInputPort("flange_estimate", AbstractValue.Make(FlangeEstimate()))
        self._drawn = _Drawn()
        self.DeclarePeriodicPublishEvent(1.0 / config.recording_fps, 0.0, self._draw)

    def _draw(self, context: Context) -> EventStatus:
        time, status = context.get_time(), self._drift.Eval(context)
        self._draw_ring(self._estimate.Eval(context), status, time)
        if time >= self._drawn.at_s + self._period_s and status.frames != self._drawn.frames:
            self._draw_board(status, time)
            self._draw_scanner(status, time)
            self._drawn.at_s, self._drawn.frames = time, status.frames
        return EventStatus.Succeeded()

    def _draw_board(self, status: DriftStatus, time: float) -> None:
        k = self._drawn.board
        path = f"{ROOT}/board/{k:04d}"
        height = WIDTH_M * HEIGHT_PX / WIDTH_PX
        self._meshcat.SetObject(path, textured_board(f"drift_{k:04d}", WIDTH_M, height, drift_picture(status)))
        self._meshcat.SetTransform(path, X_WS @ RigidTransform([0.0, -0.5 * height, 0.0]))
        self._meshcat.SetProperty(path, "visible", False, 0.0)
        self._meshcat.SetProperty(path, "visible", True, time)
        if k:
            self._meshcat.SetProperty(f"{ROOT}/board/{k - 1:04d}", "visible", False, time)
        self._drawn.board = k + 1

    def _draw_scanner(self, status: DriftStatus, time: float) -> None:
        if status.X_BC is None:
            return
        path = f"{ROOT}/scanner"
        if not self._meshcat.HasPath(path):
            for axis, rgba in enumerate(_TRIAD):
                ends = np.zeros((3, 2))
                ends[axis, 1] = 0.10
                self._meshcat.SetLine(f"{path}/axis{axis}", ends, 4.0, rgba)
        self._meshcat.SetTransform(path, status.X_BC, time)

    def _draw_ring(self, estimate: FlangeEstimate, status: DriftStatus, time: float) -> None:
        if estimate.sequence <= self._drawn.fit or estimate.fit is None or status.X_BC is None:
            return
        path = f"{ROOT}/ring"
        if not self._meshcat.HasPath(path):
            angle = np.linspace(0.0, 2.0 * np.pi, 73)
            circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)]) * self._radius_m
            self._meshcat.SetLine(path, circle, 4.0, _RING)
        R = RotationMatrix.MakeFromOneVector(status.X_BC.rotation() @ estimate.fit.normal_C, 2)
        self._meshcat.SetTransform(path, RigidTransform(R, status.X_BC @ estimate.fit.center_C), time)
        self._drawn.fit = estimate.sequence


def drift_picture(status: DriftStatus) -> Picture:
    """Draw error, offset and statistic of the newest frames as a (600, 1024, 3) uint8 BGR image."""
    board = np.full((HEIGHT_PX, WIDTH_PX, 3), _GROUND, dtype=np.uint8)
    recent = status.recent
    t = recent[:, 0] - recent[-1, 0] if len(recent) else np.empty(0)
    errors = 1e3 * recent[:, 1:4]
    last = (
        " ".join(f"{name} {value:+.2f}" for (name, _), value in zip(_AXES, errors[-1], strict=True)) if len(t) else ""
    )
    reach = max(_LEAST_MM, 1.2 * _largest(errors))
    _strip(board, 0, f"error, mm  {last}", t, [(errors[:, k], colour) for k, (_, colour) in enumerate(_AXES)], reach)
    offset = 1e3 * recent[:, 4]
    heading = f"clock's offset, ms  {offset[-1]:+.2f}" if len(t) else "clock's offset, ms"
    _strip(board, 1, heading, t, [(offset, _INK)], max(_LEAST_MS, 1.2 * _largest(offset)))
    # in powers of ten about the threshold, which is the middle line
    level = (
        np.log10(np.maximum(recent[:, 5], 0.1) / status.threshold)
        if np.isfinite(status.threshold)
        else np.zeros(len(t))
    )
    verdict = "THE SCANNER HAS MOVED" if status.moved else "no drift"
    _strip(board, 2, f"drift  {verdict}", t, [(level, _INK)], 2.5, limit=True)
    return (np.minimum(board, 243) + 6) // 12 * 12


def _largest(values: Array) -> float:
    """The 98th percentile of the size of values, 0 without any."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.percentile(known, 98.0)) if known.size else 0.0


def _strip(
    board: Picture, row: int, heading: str, t: Array, curves: list[tuple[Array, tuple[int, int, int]]], reach: float,
    *, limit: bool = False,
) -> None:  # fmt: skip
    """Draw curves against the time t (N,) s before now, from -reach to reach."""
    top = row * (_HIGH + 80) + 45
    cv2.rectangle(board, (_LEFT, top), (_RIGHT, top + _HIGH), _BAND, -1)
    cv2.putText(
        board,
        f"{heading}  (+-{reach:.1f})" if not limit else heading,
        (_LEFT, top - 12),
        _FONT,
        1.1,
        _INK,
        2,
        cv2.LINE_AA,
    )
    middle = top + _HIGH // 2
    cv2.line(board, (_LEFT, middle), (_RIGHT, middle), _LIMIT if limit else _GROUND, 2)
    span = min(float(t[0]), -1.0) if len(t) else -1.0
    for values, colour in curves:
        good = np.isfinite(values)
        x = _RIGHT + (_RIGHT - _LEFT) * t[good] / -span
        y = middle - 0.5 * _HIGH * np.clip(values[good] / reach, -1.0, 1.0)
        if good.sum() > 1:
            cv2.polylines(board, [np.column_stack([x, y]).round().astype(np.int32)], False, colour, 3, cv2.LINE_AA)
