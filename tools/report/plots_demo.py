"""The pictures of a run: how the calibration converged, where tip, torch and robot went, how the weld went along the seam."""

from __future__ import annotations

import io

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from weldcal.systems.messages import CalibrationStatus
from weldcal.tools.outcome import WeldOutcome
from weldcal.welding.process import path_error
from weldcal.welding.servo_state import Phase

OURS, THEIRS, TRUTH, PLANNED, TORCH, ROBOT = "#1d5f8a", "#b08a2e", "#a8402f", "#9aa3ab", "#d9700f", "#5b7d4e"
Array = NDArray[np.float64]


def svg(figure: Figure) -> bytes:
    """The figure as SVG bytes, the same for the same figure."""
    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "weldcal"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()


def _plain(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)


def convergence(status: CalibrationStatus, required_m: float) -> bytes:
    """Expected and held-out error of the estimate in use and Algorithm 1's own figure, against the scans taken (Fig. 11)."""
    n, expected, held_out, figure = (np.array(c, dtype=float) for c in zip(*status.history, strict=True))
    picture = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = picture.subplots()
    axes.semilogy(n, 1e3 * expected, "o-", color=OURS, label="expected at the work point (one sigma, 3-D)")
    axes.semilogy(n, 1e3 * held_out, "s--", color=ROBOT, label="held out, at the ring (median)")
    if np.isfinite(figure).any():
        axes.semilogy(n, 1e3 * figure, "^:", color=THEIRS, label="Algorithm 1: its own ICP figure")
    axes.axhline(1e3 * required_m, color=TRUTH, lw=1.0, label="required")
    axes.set_xticks(n)
    _plain(axes, "scans used", "error, mm")
    picture.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return svg(picture)


def seam_paths(weld: WeldOutcome) -> bytes:
    """Planned seam, true seam, and the paths of tip, torch and robot, seen from above in the base frame (Fig. 13)."""
    reach = np.ptp(np.vstack([weld.log.p_BRobot, weld.log.p_BTorch]), axis=0)
    height = float(np.clip(6.4 * reach[0] / max(reach[1], 1e-6) + 1.6, 2.8, 7.0))
    picture = Figure(figsize=(7.2, height), layout="constrained")
    axes = picture.subplots()
    true = weld.true_seam.position(np.linspace(0.0, weld.true_seam.length, 400))
    if weld.planned is not None:
        plan = weld.planned.position(np.linspace(0.0, weld.planned.length, 400))
        axes.plot(1e3 * plan[:, 1], 1e3 * plan[:, 0], color=PLANNED, lw=3.0, label="planned from the scan and the CAD")
    axes.plot(1e3 * true[:, 1], 1e3 * true[:, 0], color="black", lw=1.0, ls="--", label="true seam (simulation only)")
    log, on = weld.log, weld.log.torch_on
    felt = log.telemetry["phase"] == list(Phase).index(Phase.TRACK)
    axes.plot(
        1e3 * log.p_BRobot[:, 1], 1e3 * log.p_BRobot[:, 0], color=ROBOT, lw=1.0, label="robot (rest point of the tip)"
    )
    axes.plot(1e3 * log.p_BTip[felt, 1], 1e3 * log.p_BTip[felt, 0], color=OURS, lw=1.0, label="tip, as felt")
    axes.plot(1e3 * log.p_BTorch[on, 1], 1e3 * log.p_BTorch[on, 0], color=TORCH, lw=1.8, label="torch, arc on")
    axes.set_aspect("equal")
    _plain(axes, "y of the base, mm", "x of the base, mm")
    picture.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=8)
    return svg(picture)


def error_along_seam(weld: WeldOutcome) -> bytes:
    """How far plan and torch lie off the true seam, sideways and in height, over arc length."""
    picture = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = picture.subplots()
    if weld.plan_error is not None:
        axes.plot(1e3 * weld.plan_error.s, 1e3 * weld.plan_error.lateral, color=PLANNED, lw=3.0, label="plan, sideways")
    if weld.error is not None:
        axes.plot(1e3 * weld.error.s, 1e3 * weld.error.lateral, color=TORCH, label="torch, sideways")
        axes.plot(1e3 * weld.error.s, 1e3 * weld.error.height, color=OURS, lw=1.0, label="torch, height")
    _plain(axes, "arc length of the true seam, mm", "off the true seam, mm")
    axes.legend(frameon=False, fontsize=8)
    return svg(picture)


def along_the_weld(weld: WeldOutcome, weld_speed_m_s: float) -> bytes:
    """Deflection of the tip, torch speed in its +-25 % band, turning rate and n_d . n_t, over the torch's place on the seam."""
    log = weld.log
    picture = Figure(figsize=(7.2, 7.6), layout="constrained")
    deflection, speed, omega, measure = picture.subplots(4, 1, sharex=True)
    touching = log.telemetry["phase"] == list(Phase).index(Phase.TOUCH)  # the search has no place along the seam
    s = np.where(touching, np.nan, 1e3 * log.telemetry["s_torch"])
    for k, (name, colour) in enumerate((("tangential", PLANNED), ("normal", OURS), ("axial", ROBOT))):
        deflection.plot(s, 1e3 * log.deflection_T[:, k], color=colour, lw=1.0, label=name)
    deflection.legend(frameon=False, fontsize=8, ncols=3)
    _plain(deflection, "", "tip deflection, mm")
    t, v = _speed(log.time, log.p_BTorch)
    band = 1e3 * weld_speed_m_s
    speed.axhspan(0.75 * band, 1.25 * band, color=TORCH, alpha=0.10)
    on = np.interp(t, log.time, log.torch_on.astype(float)) > 0.99
    speed.plot(np.interp(t, log.time, s), np.where(on, 1e3 * v, np.nan), color=TORCH, lw=1.2)
    _plain(speed, "", "torch speed, mm/s")
    omega.plot(s, np.degrees(log.telemetry["omega"]), color=OURS, lw=1.0)
    _plain(omega, "", "turning rate, deg/s")
    measure.plot(s, log.telemetry["n_d_dot_n_t"], color=TRUTH, lw=1.0)
    measure.axhline(0.0, color="black", lw=0.8, ls=":")
    _plain(measure, "torch along the planned seam, mm (negative: before the seam)", "n_d · n_t")
    return svg(picture)


def _speed(time: Array, p: Array, window_s: float = 0.1) -> tuple[Array, Array]:
    even = np.arange(time[0], time[-1], window_s)
    q = np.column_stack([np.interp(even, time, p[:, k]) for k in range(3)])
    return 0.5 * (even[1:] + even[:-1]), np.linalg.norm(np.diff(q, axis=0), axis=1) / window_s


def tip_error(weld: WeldOutcome) -> float:
    """Mean distance (m) sideways between the felt tip line and the true seam while the servo tracked."""
    felt = weld.log.telemetry["phase"] == list(Phase).index(Phase.TRACK)
    return path_error(weld.log.p_BTip[felt], weld.true_seam).mean_m if felt.any() else float("nan")
