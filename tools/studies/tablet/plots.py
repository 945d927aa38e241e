"""Pictures of the tablet study: where each sign leaves the nine touches, and what each model misses by unseen."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from weldcal.calibration.tablet.planar.fit import fit_plane_motion, hand_over
from weldcal.calibration.tablet.published.two_stage import Sign
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.tools.report.plots_weld import OURS, THEIRS, TRUTH, svg
from weldcal.tools.studies.tablet.study import HeldOutRow, ModelRow

_LARGER = 20.0
SIGN_WORDS = {Sign.PRINTED: "as printed (−)", Sign.NONE: "left out", Sign.CORRECTED: "reversed (+)"}


def sign_residuals(touches: TabletTouches) -> bytes:
    """For each sign of Eq. 20: the nine hand positions, and by how much a similarity of the tablet and a pen miss them."""
    picture = Figure(figsize=(9.6, 3.0), layout="constrained")
    every = picture.subplots(1, 3, sharex=True, sharey=True)
    for axes, sign in zip(every, Sign, strict=True):
        points = touches.pitch_m * (touches.landmark_px - sign * touches.delta_px)
        x = fit_plane_motion(points, touches.hand_m, touches.theta_rad, free_scale=True)
        e = 1e3 * (hand_over(x, points, touches.theta_rad) - touches.hand_m)
        hand = 1e3 * touches.hand_m
        colour = OURS if sign is Sign.CORRECTED else THEIRS
        axes.quiver(*hand.T, *e.T, angles="xy", scale_units="xy", scale=1.0 / _LARGER, color=colour, width=0.012)
        axes.plot(*hand.T, "o", color="black", ms=3)
        rms = float(np.sqrt((e**2).mean()))
        axes.set_title(f"{SIGN_WORDS[sign]}: {rms:.2f} mm per axis", fontsize=10)
        axes.set_aspect("equal")
        axes.set_xlabel("hand x, mm")
        axes.margins(0.15)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    every[0].set_ylabel("hand y, mm")
    return svg(picture)


def unseen_errors(models: tuple[ModelRow, ...], unseen: tuple[HeldOutRow, ...]) -> bytes:
    """Bars: left-out error on the published data, in-sample beside it; error on simulated queries."""
    picture = Figure(figsize=(9.0, 0.42 * (len(models) + len(unseen)) + 1.6), layout="constrained")
    left, queries = picture.subplots(2, 1, height_ratios=[len(models), len(unseen)], sharex=True)
    y = np.arange(len(models))
    left.barh(y, [m.left_out_mm for m in models], 0.6, color=[_colour(m.name) for m in models])
    left.plot([m.in_sample_mm for m in models], y, "|", color="black", ms=14, mew=2, label="in sample")
    _label(left, y, [f"{m.name} ({m.unknowns})" for m in models], [m.left_out_mm for m in models])
    left.set_title("published data, one landmark left out (unknowns)", fontsize=10, loc="left")
    left.legend(frameon=False, fontsize=8, loc="lower right")
    y = np.arange(len(unseen))
    queries.barh(y, [u.mean_mm for u in unseen], 0.6, color=[_colour(u.name) for u in unseen])
    _label(queries, y, [u.name for u in unseen], [u.mean_mm for u in unseen])
    queries.axvline(0.222, color=TRUTH, lw=1.0, ls=":")
    queries.set_title("simulated trials, queries that no fit saw (dotted: target)", fontsize=10, loc="left")
    queries.set_xlabel("mean error of the hand, mm")
    return svg(picture)


def _colour(name: str) -> str:
    return THEIRS if name.startswith("paper") else OURS


def _label(axes: object, y: np.ndarray, names: list[str], values: list[float]) -> None:
    from matplotlib.axes import Axes

    assert isinstance(axes, Axes)
    axes.set_yticks(y, names, fontsize=9)
    axes.invert_yaxis()
    for at, value in zip(y, values, strict=True):
        axes.text(value + 0.01, at, f"{value:.3f}", va="center", fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
