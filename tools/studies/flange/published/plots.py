"""Pictures of the flange study: the paper's Fig. 9, 10 and 11 with the true errors, circles and held-out errors."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.tools.report.pictures import OURS, PLANNED, THEIRS, TRUTH, plain, svg
from weldcal.tools.studies.flange.published.clouds import METHODS, CloudsOutcome
from weldcal.tools.studies.flange.published.pairs import PairsOutcome
from weldcal.tools.studies.flange.published.simulation import Simulation

# the paper's order and grouping: x, y, z above roll, pitch, yaw
PANELS = (
    (3, "x", "mm", 1e3),
    (4, "y", "mm", 1e3),
    (5, "z", "mm", 1e3),
    (0, "roll", "degrees", np.degrees(1.0)),
    (1, "pitch", "degrees", np.degrees(1.0)),
    (2, "yaw", "degrees", np.degrees(1.0)),
)
REPORTED = ("reported translation, mm", "reported rotation, degrees")
COLOURS = ("#c2503f", "#3f8f5b", "#2f6fb0")


def fig9(s: Simulation) -> bytes:
    """Errors at the camera against the noise, all pairs (gray) and Algorithm 1 judged by the truth (coloured)."""
    picture = Figure(figsize=(7.6, 4.6), layout="constrained")
    axes = picture.subplots(2, 3, sharex=True).ravel()
    x = 1e3 * s.levels_m
    for ax, (k, name, unit, scale), colour in zip(axes, PANELS, COLOURS * 2, strict=True):
        ax.fill_between(
            x, scale * (s.all_mean - s.all_std)[:, k], scale * (s.all_mean + s.all_std)[:, k], color=PLANNED, alpha=0.5
        )
        ax.plot(x, scale * s.all_mean[:, k], color="black", lw=0.8, ls="--")
        low, high = s.truth_mean - s.truth_std, s.truth_mean + s.truth_std
        ax.fill_between(x, scale * low[:, k], scale * high[:, k], color=colour, alpha=0.45)
        ax.plot(x, scale * s.truth_mean[:, k], color=colour, lw=1.0)
        _plain(ax, "noise, mm" if ax in axes[3:] else "", f"{name}, {unit}")
    return svg(picture)


def fig10(s: Simulation) -> bytes:
    """Errors at the camera against the scans used, 1 mm of noise, and the error that the paper does not plot: at the
    flanges."""
    steps = np.arange(4, 4 + len(s.history))
    picture, true = _steps(steps, s.history.transpose(1, 0, 2), ("translation at the camera, mm", "rotation, degrees"))
    high = 1e3 * s.history_tcp
    true.fill_between(steps, *np.percentile(high, [16, 84], axis=1), color=TRUTH, alpha=0.3)
    true.plot(steps, high.mean(axis=1), color=TRUTH, lw=1.2, label="Algorithm 1")
    true.axhline(1e3 * float(s.costs["all"].at_tcp.mean()), color="black", lw=0.8, ls="--", label="all pairs, SVD")
    _finish(true, "true error at the flanges, mm")
    return svg(picture)


def fig11_stored(p: PairsOutcome) -> bytes:
    """The authors' stored runs: their reported errors step by step, and the true errors at the end."""
    assert p.runs is not None
    picture, true = _steps(np.arange(5, 5 + p.runs.components.shape[1]), p.runs.components, REPORTED)
    rows = [
        ("reported", 1e3 * p.runs.reported[:, -1], THEIRS),
        ("its own 4 pairs", 1e3 * p.own_pool, THEIRS),
        ("all other pairs", 1e3 * p.true, TRUTH),
        ("all pairs, SVD*", 1e3 * p.svd, PLANNED),
        ("weldcal*", 1e3 * p.ours, OURS),
    ]
    _boxes(true, [r for r in rows if len(r[1])])
    return svg(picture)


def fig11_rerun(c: CloudsOutcome) -> bytes:
    """Algorithm 1 on the scans themselves: e_icp step by step, and the true error at the same steps."""
    steps = np.arange(4, 4 + c.path.shape[1])
    finite = np.where(np.isfinite(c.path), c.path, np.nan)
    picture, true = _steps(steps, finite, REPORTED)
    figure = 1e3 * np.linalg.norm(finite[:, :, 3:], axis=2)
    for values, colour, label in ((figure, THEIRS, "reported"), (1e3 * c.path_true, TRUTH, "true, other scans")):
        true.fill_between(steps, *np.nanpercentile(values, [16, 84], axis=0), color=colour, alpha=0.3)
        true.plot(steps, np.nanmedian(values, axis=0), color=colour, lw=1.2, label=label)
    ours = next(s for s in c.splits if s.name == "ours").held_out
    true.axhline(1e3 * float(np.nanmedian(ours)), color=OURS, lw=1.2, ls="--", label="weldcal, held out")
    _finish(true, "error, mm")
    return svg(picture)


def held_out(c: CloudsOutcome) -> bytes:
    """Errors on held-out scans, method by method, and what each reports of itself."""
    picture = Figure(figsize=(7.6, 3.2), layout="constrained")
    axes = picture.subplots()
    rows = []
    for s in c.splits:
        colour = OURS if s.name in ("rigid", "ours") else PLANNED if s.name == "svd" else TRUTH
        rows.append((METHODS[s.name], 1e3 * s.held_out[np.isfinite(s.held_out)], colour))
    _boxes(axes, rows)
    for k, s in enumerate(c.splits):
        own = s.reported[np.isfinite(s.reported)]
        if len(own):
            at = 1e3 * float(np.median(own))
            label = "its own figure" if k == 0 else None
            axes.plot([at], [len(rows) - 1 - k], "D", color=THEIRS, ms=6, label=label)
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    return svg(picture)


def costs(s: Simulation) -> bytes:
    """Simulated, 1 mm of noise: error at the camera's origin, which the cost uses, and at the flanges."""
    picture = Figure(figsize=(7.6, 2.9), layout="constrained")
    axes = picture.subplots()
    names = {
        "truth": "cost: the truth",
        "verification": "cost: a measured pose",
        "median": "cost: median residual",
        "all": "all pairs, SVD",
        "ours": "weldcal",
    }
    y = np.arange(len(s.costs))[::-1]
    camera = [1e3 * float(np.linalg.norm(e.e[:, 3:], axis=1).mean()) for e in s.costs.values()]
    flanges = [1e3 * float(e.at_tcp.mean()) for e in s.costs.values()]
    axes.barh(y + 0.19, camera, 0.36, color=THEIRS, label="at the camera's origin, which the cost uses")
    axes.barh(y - 0.19, flanges, 0.36, color=TRUTH, label="at the 75 flange centres, where the robot works")
    axes.set_yticks(y, [names[n] for n in s.costs])
    _plain(axes, "mean error, mm (1 mm of noise)", "")
    picture.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return svg(picture)


def circles(c: CloudsOutcome) -> bytes:
    """Where the published circle puts the centre, in the flange's own plane: seed to seed, scan by scan; ours is the
    origin."""
    picture = Figure(figsize=(7.6, 3.2), layout="constrained")
    axes, halves = picture.subplots(1, 2, width_ratios=(1.0, 1.2))
    k = np.arange(len(c.circles))
    halves.bar(k - 0.2, [1e3 * r.halves_published_m for r in c.circles], 0.4, color=THEIRS, label="published circle")
    halves.bar(k + 0.2, [1e3 * r.halves_ours_m for r in c.circles], 0.4, color=OURS, label="weldcal's edges")
    halves.legend(frameon=False, fontsize=8)
    halves.set_xticks(k[::3], [str(v) for v in k[::3] + 1])
    _plain(halves, "scan", "between two halves, mm")
    for row in c.circles:
        x, y = 1e3 * row.offset_R[:2]
        spread = 1e3 * row.repeat_m / np.sqrt(3)
        axes.errorbar(x, y, xerr=spread, yerr=spread, color=THEIRS, lw=0.8, fmt="o", ms=3)
    axes.plot(0, 0, "+", color=OURS, ms=14, mew=2)
    reach = 1.1 * max(1.0, *(1e3 * float(np.abs(r.offset_R[:2]).max() + r.repeat_m) for r in c.circles))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.set_aspect("equal")
    _plain(axes, "x of the flange, mm", "y of the flange, mm")
    return svg(picture)


def _steps(steps: NDArray[np.int64], values: Array, labels: tuple[str, str]) -> tuple[Figure, Axes]:
    """Translations and rotations (runs, steps, 6) over the scans in two panels, and a third panel to draw in."""
    picture = Figure(figsize=(7.6, 2.7), layout="constrained")
    *both, third = picture.subplots(1, 3)
    for axes, panels, label in zip(both, (PANELS[:3], PANELS[3:]), labels, strict=True):
        _bands(axes, steps, values, panels)
        _plain(axes, "scans", label)
    return picture, third


def _finish(axes: Axes, label: str) -> None:
    """Legend and axes of a panel of errors over the scans."""
    axes.set_ylim(0.0, None)
    axes.legend(frameon=False, fontsize=7)
    _whole_steps(axes)
    _plain(axes, "scans", label)


def _bands(axes: Axes, x: NDArray[np.int64], values: Array, panels: tuple[tuple[int, str, str, float], ...]) -> None:
    """Mean and standard deviation over runs of (runs, steps, 6)."""
    for (k, name, _unit, scale), colour in zip(panels, COLOURS, strict=True):
        mean, sd = scale * np.nanmean(values[:, :, k], axis=0), scale * np.nanstd(values[:, :, k], axis=0)
        axes.fill_between(x, mean - sd, mean + sd, color=colour, alpha=0.25)
        axes.plot(x, mean, color=colour, lw=1.2, label=name)
    axes.axhline(0.0, color="black", lw=0.6, ls=":")
    axes.legend(frameon=False, fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    _whole_steps(axes)


def _boxes(axes: Axes, rows: list[tuple[str, Array, str]]) -> None:
    """Median, quartiles and 5 to 95 % of each row, first row on top."""
    y = np.arange(len(rows))[::-1]
    for at, (_, values, colour) in zip(y, rows, strict=True):
        p5, q1, middle, q3, p95 = np.percentile(values, [5, 25, 50, 75, 95])
        axes.plot([p5, p95], [at, at], color=colour, lw=1.2)
        axes.barh(at, q3 - q1, 0.5, left=q1, color=colour, alpha=0.45)
        axes.plot([middle, middle], [at - 0.25, at + 0.25], color=colour, lw=2.0)
    axes.set_yticks(y, [name for name, _, _ in rows])
    axes.set_xlim(0.0, None)
    _plain(axes, "error at the flange, mm", "")


def _whole_steps(axes: Axes) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))


def _plain(axes: Axes, x: str, y: str) -> None:
    """As `plain`, in small letters."""
    plain(axes, x, y)
    axes.tick_params(labelsize=8)
    axes.xaxis.label.set_fontsize(8)
    axes.yaxis.label.set_fontsize(8)
