"""The map of the uncertainty of a scanned point, with the poses taken and the most informative next place."""

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from weldcal.calibration.eye_on_base.advice import sigma_at, weakest_place
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.models.arrays import Array
from weldcal.tools.report.pictures import svg

_STEPS = 25
_MARGIN = 0.35  # of the widest extent of the poses: so far around them the map reaches
_WIDEST = 3.0  # of the error in the middle: beyond, the map says "more"
_SHADES = LinearSegmentedColormap.from_list("known", ["#eef4f8", "#9dc0d8", "#1d5f8a", "#10324a"])


def knowledge_map(estimate: CalibrationEstimate, p_B: Array) -> bytes:
    """Standard deviation (3-D) of a scanned point through the middle of poses (n >= 2, 3) m, from above and from the side."""
    middle, extent = p_B.mean(axis=0), float(np.ptp(p_B, axis=0).max())
    weak, least = weakest_place(estimate, p_B), 1e3 * sigma_at(estimate, middle)
    figure = Figure(figsize=(8.2, 4.0), layout="constrained")
    levels = least * np.linspace(0.95, _WIDEST, 9)
    drawn = None
    all_axes = figure.subplots(1, 2)
    for axes, (i, j), title in zip(all_axes, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        reach = 0.5 * extent * (1.0 + 2.0 * _MARGIN)
        u, v = (np.linspace(-reach, reach, _STEPS) + middle[k] for k in (i, j))
        sigma = np.empty((_STEPS, _STEPS))
        for row, b in enumerate(v):
            for column, a in enumerate(u):
                p = middle.copy()
                p[i], p[j] = a, b
                sigma[row, column] = 1e3 * sigma_at(estimate, p)
        drawn = axes.contourf(1e3 * u, 1e3 * v, sigma, levels=levels, cmap=_SHADES, extend="both")
        axes.plot(
            1e3 * p_B[:, i],
            1e3 * p_B[:, j],
            "o",
            color="white",
            markeredgecolor="#222",
            markersize=5,
            label="poses taken",
        )
        axes.plot(
            1e3 * weak[i],
            1e3 * weak[j],
            "*",
            color="#e0872f",
            markeredgecolor="#222",
            markersize=15,
            label="best next pose",
        )
        axes.set_xlabel(f"base {'xyz'[i]}, mm")
        axes.set_ylabel(f"base {'xyz'[j]}, mm")
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_aspect("equal")
    assert drawn is not None
    bar = figure.colorbar(drawn, ax=all_axes, shrink=0.85, format="%.3g")
    bar.set_label("one sigma of a scanned point, mm")
    all_axes[0].legend(fontsize=8, loc="lower left", framealpha=0.9)
    return svg(figure, *all_axes)
