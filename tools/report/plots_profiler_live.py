"""Pictures of a live profiler run: pose errors in sigmas of their prediction, the seam and the torch against the truth, raw profiles."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from weldcal.models.arrays import Array
from weldcal.tools.outcomes.profiler import PathOutcome, PoseOutcome
from weldcal.tools.report.pictures import OURS, svg

RUST, GREY, GREEN = "#c4622d", "#9aa3ab", "#4b7f52"
PARTS = ("turn x", "turn y", "turn z", "shift x", "shift y", "shift z")
_COLOURS = {"edge": OURS, "sphere": RUST}


def sigmas_picture(poses: Mapping[str, Sequence[PoseOutcome]]) -> bytes:
    """Each of six parts of the error of X_FS in sigmas of its own prediction, a dot a run; the band is 3 sigma."""
    figure = Figure(figsize=(8.2, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(-3.0, 3.0, color="#e8eef2", zorder=0)
    axes.axhline(0.0, color="#444", linewidth=0.8)
    for k, (name, found) in enumerate(poses.items()):
        shift = 0.24 * (k - 0.5 * (len(poses) - 1))
        for j, pose in enumerate(found):
            spread = 0.0 if len(found) == 1 else 0.16 * (j / (len(found) - 1) - 0.5)
            at, size = np.arange(6) + shift + spread, 5.0 if len(found) == 1 else 3.5
            axes.plot(at, pose.parts, "o", color=_COLOURS[name], markersize=size, label=name if j == 0 else None)
    axes.set_xticks(range(6), PARTS)
    largest = max(float(np.abs(p.parts).max()) for found in poses.values() for p in found)
    axes.set_ylim(-max(4.0, 1.1 * largest), max(4.0, 1.1 * largest))
    axes.set_ylabel("error / predicted sigma")
    axes.legend(frameon=False, ncols=2, loc="upper right")
    return svg(figure, axes)


def path_picture(paths: Mapping[str, PathOutcome], limit_mm: float) -> bytes:
    """Distance from the true line along it: raw points as dots, the seam and the torch as lines."""
    figure = Figure(figsize=(8.2, 3.2), layout="constrained")
    axes = figure.subplots()
    styles = {"points": (".", GREY, "each profile's root"), "curve": ("-", OURS, "seam as found"), "torch": ("-", RUST, "torch")}  # fmt: skip
    for name, path in paths.items():
        style, colour, label = styles[name]
        axes.plot(1e3 * path.s, path.distance_mm, style, color=colour, label=label, markersize=3, linewidth=1.6)
    axes.axhline(limit_mm, color="#a8402f", linewidth=1, linestyle=":")
    axes.annotate(f"{limit_mm:g} mm", (axes.get_xlim()[0], limit_mm), fontsize=9, va="bottom", color="#a8402f")
    axes.set_ylim(0.0, None)
    axes.set_xlabel("along the seam, mm")
    axes.set_ylabel("off the true line, mm")
    axes.legend(frameon=False, ncols=3, loc="upper right")
    return svg(figure, axes)


def profiles_picture(profiles: Mapping[str, Array]) -> bytes:
    """One raw profile (n, 2) m of each kind, as the sensor returned it, z downwards."""
    figure = Figure(figsize=(8.2, 2.7), layout="constrained")
    for k, (name, p) in enumerate(profiles.items()):
        axes = figure.add_subplot(1, len(profiles), k + 1)
        near = p[np.isfinite(p).all(axis=1)]
        if len(near):
            top = float(np.percentile(near[:, 1], 3.0))
            near = near[near[:, 1] < top + 0.045]
        axes.plot(1e3 * near[:, 0], 1e3 * near[:, 1], ".", color=OURS, markersize=2.5)
        axes.invert_yaxis()
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("x, mm")
        if k == 0:
            axes.set_ylabel("z, mm")
        axes.spines[["top", "right"]].set_visible(False)
    return svg(figure, figure.axes[0])


def torch_bars(seeds: Sequence[int], paths: Sequence[PathOutcome], limit_mm: float) -> bytes:
    """Mean and largest distance of the torch from the true line, a pair a seed."""
    figure = Figure(figsize=(8.2, 3.0), layout="constrained")
    axes = figure.subplots()
    x = np.arange(len(paths))
    axes.bar(x, [p.distance_mm.max() for p in paths], color="#e3c3ae", width=0.7, label="largest")
    axes.bar(x, [p.distance_mm.mean() for p in paths], color=RUST, width=0.7, label="mean")
    axes.axhline(limit_mm, color="#a8402f", linewidth=1, linestyle=":")
    axes.annotate(f"{limit_mm:g} mm", (-0.35, limit_mm), fontsize=9, va="bottom", color="#a8402f")
    axes.set_xticks(x, [str(s) for s in seeds])
    axes.set_xlabel("seed")
    axes.set_ylabel("torch off the true line, mm")
    axes.set_ylim(0.0, 1.3 * max(limit_mm, max(float(p.distance_mm.max()) for p in paths)))
    axes.legend(frameon=False, ncols=2, loc="upper right")
    return svg(figure, axes)
