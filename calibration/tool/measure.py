"""Measures a tool by the scans of a calibrated cell and by touches, and compares it with its tool file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ScannerCorrection, correction_from_document
from weldcal.calibration.errors import FlangeNotFound, ToolNotFound
from weldcal.calibration.flange.fit import FlangeGuess, fit_flange
from weldcal.calibration.geometry.robust import chi2_quantile, f_quantile, radius_95
from weldcal.calibration.geometry.se3 import frames_along, skew
from weldcal.calibration.tool.scan_fit import FEWEST_SCANS, SurfaceFit, ToolScan, fit_surface
from weldcal.calibration.tool.surfaces import Nozzle, TipBall
from weldcal.calibration.tool.wire import WirePoint, WireTouch, find_wire
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard
from weldcal.models.tools.loading import LoadedTool

FALSE_ALARM = 1e-3  # chance that a part that has not moved is said to have
_WIDE_M = 0.03  # a choice: no nozzle is wider, and no bend moves one out of it
_BESIDE_M = 0.006  # a choice: of the tip's ball, beyond its radius
_RING_M = 0.03  # a choice: where the ring is looked for
_BALL_M = 2e-5  # a choice, per axis: what the outline's pixels do to a ball of some ten of them
_PROFILE_M = 1e-3  # of the nozzle's wall, about its radius
_MOUTH_M = 4e-4  # scans find the mouth to 0.25 mm (24 tools, `python -m tests.calibration.tool.torches --first 8000`)
_FEWEST_DEG = 120.0  # a choice: of the circle about the nozzle


@dataclass(frozen=True, kw_only=True)
class NozzlePart:
    """Which part of the nozzle is fitted, m behind the wire point: from ``start_m``, ``length_m`` long."""

    start_m: float = 0.014  # a usual stick-out of 12 mm, and the mouth's rounded edge
    length_m: float = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class RingPlace:
    """The ring's centre (3,) m and outward normal (3,) in F, with covariances (3, 3) of both."""

    centre: Array
    normal: Array
    covariance: Array
    normal_covariance: Array
    scans: int


@dataclass(frozen=True, eq=False)
class Move:
    """How far a part is from its place in the tool file.

    ``shift`` (3,) m in F with its covariance (3, 3) m^2, and where it has a direction the ``turn`` (2,) rad with its
    covariance (2, 2).
    """

    part: str
    shift: Array
    covariance: Array
    turn: Array | None = None
    turn_covariance: Array | None = None

    @property
    def distance_m(self) -> float:
        """How far it has moved."""
        return float(np.linalg.norm(self.shift))

    @property
    def margin_m(self) -> float:
        """Error of the shift that is not exceeded with 95 %."""
        return radius_95(self.covariance)

    @property
    def turn_rad(self) -> float:
        """How far it has turned."""
        return 0.0 if self.turn is None else float(np.linalg.norm(self.turn))

    @property
    def turn_margin_rad(self) -> float:
        """Error of the turn that is not exceeded with 95 %."""
        return 0.0 if self.turn_covariance is None else radius_95(self.turn_covariance)

    @property
    def moved(self) -> bool:
        """Whether it has moved by more than chance explains."""
        return _beyond(self.shift, self.covariance) or (
            self.turn is not None and self.turn_covariance is not None and _beyond(self.turn, self.turn_covariance)
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ToolMeasurement:
    """What scans and touches show of a tool.

    ``axis`` (3,), and ``p_FN`` (3,) m the point of the nozzle's axis beside the wire point of the file.
    ``axis_covariance`` (4, 4) of its shifts (m) and turns (rad) along the first two rows of ``nozzle.surface.axes``.
    ``mouth_m`` is the nozzle's end behind the wire point, its stick-out, with its sigma; NaN where it is not seen.
    """

    tool: LoadedTool
    nozzle: SurfaceFit[Nozzle]
    p_FN: Array
    axis_covariance: Array
    ball: SurfaceFit[TipBall] | None
    ring: RingPlace | None
    wire: WirePoint | None
    stick_out_m: float
    stick_out_sigma_m: float
    seen_deg: float
    notes: tuple[str, ...] = ()
    moves: tuple[Move, ...] = field(default=())

    @property
    def p_FW(self) -> Array:
        """The wire point (3,) m: touched, or on the nozzle's axis, by the file's place or by its stick-out."""
        return self.p_FN if self.wire is None else self.wire.p_FW

    @property
    def axis(self) -> Array:
        """Direction (3,) of the nozzle towards the work."""
        return self.nozzle.surface.axis

    def move(self, part: str) -> Move | None:
        """Return how far a part has moved; None where it was not measured."""
        return next((m for m in self.moves if m.part == part), None)


def tool_scans(data: Dataset, calibration: CalibrationResult) -> tuple[tuple[ToolScan, ...], tuple[str, ...]]:
    """Return the scans of a dataset in the flange's frame, corrected, and a sentence for each that cannot be read."""
    correction = correction_from_document(calibration.scanner_correction) or ScannerCorrection()
    X_BC = calibration.X_BC
    scans, notes = [], [f"{id} was not used: {reason}" for id, reason in data.refused]
    for id in data.clouds:
        try:
            p_C = data.cloud(id).reshape(-1, 3)
        except CloudError as refusal:
            notes.append(f"{id} was not used: {refusal.reason}")
            continue
        p_C = p_C[np.isfinite(p_C).all(axis=1) & (np.abs(p_C).max(axis=1, initial=0.0) > 0.0)]
        X_FB = data.poses[id].inverse()
        p_F = np.asarray((X_FB @ X_BC) @ correction.points(p_C).T).T.reshape(-1, 3)
        scans.append(ToolScan(id, p_F, X_FB, np.asarray(X_BC.translation())))
    return tuple(scans), tuple(notes)


def measure_tool(
    tool: LoadedTool,
    scans: Sequence[ToolScan],
    covariance: Array,
    touches: Sequence[WireTouch] = (),
    *,
    part: NozzlePart | None = None,
    wire_m: float = 1.2e-3,
    ring: RingPlace | None = None,
    notes: Sequence[str] = (),
) -> ToolMeasurement:
    """Find the nozzle and the ball in scans and the wire's end by touches; ``covariance`` (6, 6) of X_BC.

    Raises:
        ToolNotFound: the scans do not show the nozzle, or the touches do not determine the wire's end.
    """
    notes, part = list(notes), part or NozzlePart()
    p_file, axis_file = tool.p_FW, tool.torch_axis
    points = np.concatenate([s.p_F[np.linalg.norm(s.p_F - p_file, axis=1) < 0.3] for s in scans] or [np.zeros((0, 3))])
    if not len(points):
        raise ToolNotFound("No scan shows the torch where the tool file has it: check the poses and the tool file.")
    start = Nozzle.about(p_file, axis_file, part.start_m, part.length_m, points, _WIDE_M)
    nozzle = fit_surface(start, scans, covariance, "nozzle")
    seen = nozzle.surface.seen_deg(nozzle.points)
    if seen < _FEWEST_DEG:
        notes.append(f"Only {seen:.0f} degrees of the nozzle's circle were scanned: turn the tool about it.")
    u, v, a = nozzle.surface.axes
    along = float((p_file - nozzle.surface.centre) @ a)
    p_FN = nozzle.surface.centre + along * a
    T = np.eye(4)
    T[0, 2] = T[1, 3] = along
    C = T @ nozzle.covariance[:4, :4] @ T.T
    across = np.array([u, v])
    moves = [
        Move(
            "nozzle",
            p_FN - p_file,
            across.T @ C[:2, :2] @ across,
            across @ (a - axis_file * (a @ axis_file)),
            C[2:, 2:],
        )
    ]
    wire = None
    if touches:
        wire = find_wire(touches, p_FN, a, wire_m)
        if wire.left_out:
            notes.append(f"Touch {wire.left_out[0]} contradicts the others and was left out.")
        moves.append(Move("wire", wire.p_FW - p_file, wire.covariance))
    ball = _ball(tool, scans, covariance, notes)
    if ball is not None:
        vague = ball.covariance + _BALL_M**2 * np.eye(3)
        moves.append(Move("tip", ball.surface.centre - tool.tool.X_FT.translation(), vague))
    if ring is not None:
        X_FR = tool.tool.X_FR
        z = X_FR.rotation().matrix()[:, 2]
        plane = frames_along(z[None])[0][:, :2].T
        moves.append(
            Move(
                "ring",
                ring.centre - X_FR.translation(),
                ring.covariance,
                plane @ ring.normal,
                plane @ ring.normal_covariance @ plane.T,
            )
        )
    stick_out, sigma = _stick_out(nozzle.surface, points, p_FN if wire is None else wire.p_FW)
    if wire is None:
        of_file = tool.tool.stick_out_m
        if of_file is not None and abs(of_file - stick_out) > _MOUTH_M:
            p_FN, stick_out = p_FN + (of_file - stick_out) * a, of_file
            notes.append(f"The wire was not touched: its end is {1e3 * of_file:.1f} mm from the measured mouth.")
        else:
            notes.append("The wire was not touched: its end along the nozzle is that of the tool file.")
    return ToolMeasurement(
        tool=tool,
        nozzle=nozzle,
        p_FN=p_FN,
        axis_covariance=C,
        ball=ball,
        ring=ring,
        wire=wire,
        stick_out_m=stick_out,
        stick_out_sigma_m=sigma,
        seen_deg=seen,
        notes=tuple(notes),
        moves=tuple(moves),
    )


def _stick_out(nozzle: Nozzle, points: Array, p_FW: Array) -> tuple[float, float]:
    """Return the length of wire beyond the nozzle's mouth, m, and the sigma of the mouth."""
    along, end = (points - nozzle.centre) @ nozzle.axis, float((p_FW - nozzle.centre) @ nozzle.axis)
    mouth, sigma = nozzle.mouth(points[along < end], _PROFILE_M)  # what lies beyond the wire's end is no nozzle
    return end - mouth, sigma


def _ball(
    tool: LoadedTool, scans: Sequence[ToolScan], covariance: Array, notes: list[str]
) -> SurfaceFit[TipBall] | None:
    t = tool.tool
    axis = -t.X_FT.rotation().matrix()[:, 2]
    start = TipBall(np.array(t.X_FT.translation()), t.tip_radius_m, axis, t.tip_radius_m + _BESIDE_M)
    try:
        return fit_surface(start, scans, covariance, "tip's ball")
    except ToolNotFound as missing:
        notes.append(f"The tip was not measured. {missing}")
        return None


def find_ring(
    data: Dataset, calibration: CalibrationResult, X_FR: RigidTransform, standard: FlangeStandard
) -> RingPlace | None:
    """Find the ring on the flange in the scans that show it; None where fewer than three do."""
    correction = correction_from_document(calibration.scanner_correction) or ScannerCorrection()
    X_BC = calibration.X_BC
    centres, normals, levers, turns = [], [], [], []
    for id in data.clouds:
        X_FB = data.poses[id].inverse()
        X_CR = X_BC.InvertAndCompose(data.poses[id] @ X_FR)
        normal = X_CR.rotation().matrix()[:, 2]
        if float(normal @ X_CR.translation()) > 0.0:
            continue  # its back
        try:
            fit = fit_flange(data.cloud(id), standard, guess=FlangeGuess(np.array(X_CR.translation()), _RING_M, normal))
        except (FlangeNotFound, CloudError):
            continue
        X_FC, p_C = X_FB @ X_BC, correction.points(fit.center_C)
        R_FC = X_FC.rotation().matrix()
        centres.append(np.asarray(X_FC @ p_C))
        normals.append(R_FC @ correction.normals(fit.center_C, fit.normal_C))
        R_FB = X_FB.rotation().matrix()
        lever = X_BC.rotation().matrix() @ p_C
        levers.append(R_FB @ np.hstack([-skew(lever), np.eye(3)]))
        turns.append(R_FB @ np.hstack([-skew(R_FB.T @ normals[-1]), np.zeros((3, 3))]))
    n = len(centres)
    if n < FEWEST_SCANS:
        return None
    centre, normal = np.mean(centres, axis=0), np.mean(normals, axis=0)
    widened = f_quantile(0.95, 3, 3 * (n - 1)) * 3.0 / chi2_quantile(0.95, 3)
    shared, turned = np.mean(levers, axis=0), np.mean(turns, axis=0)
    own = float(((np.array(centres) - centre) ** 2).sum()) / (3 * (n - 1)) / n
    own_normal = float(((np.array(normals) - normal) ** 2).sum()) / (2 * (n - 1)) / n
    C = calibration.covariance
    return RingPlace(
        centre=centre,
        normal=normal / np.linalg.norm(normal),
        covariance=widened * own * np.eye(3) + shared @ C @ shared.T,
        normal_covariance=widened * own_normal * np.eye(3) + turned @ C @ turned.T,
        scans=n,
    )


def _beyond(change: Array, C: Array) -> bool:
    """Whether a change (d,) is larger than its covariance (d, d) explains; directions without variance are left out."""
    values, vectors = np.linalg.eigh(C)
    kept = values > 1e-9 * values[-1]
    along = vectors[:, kept].T @ change
    return float((along**2 / values[kept]).sum()) > chi2_quantile(1.0 - FALSE_ALARM, int(kept.sum()))
