"""Plots that several reports share: errors as bars, errors as arrows across the scanner's field of view."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arrays import Array

if TYPE_CHECKING:
    from weldcal.calibration.flange.fit import FlangeFit
    from weldcal.calibration.flange.observation import Observation

OURS, THEIRS, TRUTH, GREY = "#1d5f8a", "#b08a2e", "#a8402f", "#9aa3ab"
PLANNED, TORCH, ROBOT = GREY, "#d9700f", "#5b7d4e"
_MOST_BARS = 400
_GROSS = 10.0  # times the median: a gross outlier
_PLATE = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.0}  # keeps a label readable on a bar


def error_bars(
    ids: Sequence[str],
    error: Array,
    keep: NDArray[np.bool_],
    label: str,
    *,
    stated: tuple[float, str] | None = None,
    median_of: str = "",
) -> bytes:
    """Draw one bar per pose (n,), grey where not ``keep``, and the median of the others as a line.

    ``median_of`` names them; ``stated`` (a height and its name) is another line. Gross outliers end at the top
    edge, with their value.
    """
    x = np.arange(len(error))
    figure, axes = subplots(8.2, 3.2)
    keep = keep & np.isfinite(error)
    if not np.isfinite(error).any():
        axes.text(0.5, 0.5, "too few scans for cross-validation", transform=axes.transAxes, ha="center", color="#555")
        axes.set_axis_off()
        return svg(figure, axes)
    if len(error) <= _MOST_BARS:
        axes.bar(x, error, color=[OURS if k else GREY for k in keep], width=0.7)
    else:  # thousands of bars are a picture of many megabytes, each thinner than a pixel
        for of, colour in ((keep, OURS), (~keep, GREY)):
            axes.fill_between(x, 0.0, np.where(of, error, np.nan), step="mid", color=colour, linewidth=0.5)
    median = float(np.median(error[keep])) if keep.any() else float(np.nanmedian(error))
    # gross outliers would flatten every other bar
    usual = np.isfinite(error) & (
        error <= _GROSS * max(float(np.nanmedian(error)), stated[0] if stated is not None else 0.0)
    )
    shown = usual & keep if (usual & keep).any() else usual
    top = 1.25 * float(error[shown].max())
    if stated is not None:
        axes.axhline(stated[0], color=TRUTH, linewidth=1, linestyle=":")
        name = f"{stated[1]} {stated[0]:.2f}"
        axes.annotate(name, (x[0] - 0.5, stated[0]), fontsize=9, va="bottom", color=TRUTH, bbox=_PLATE)
        top = max(top, 1.25 * stated[0])
    axes.axhline(median, color="#444", linewidth=1, linestyle="--")
    if median <= top:
        name, right = f"median\n{median_of}{median:.2f}", ("axes fraction", "data")  # right of the bars, not over them
        axes.annotate(name, (1.01, median), xycoords=right, fontsize=9, va="center", annotation_clip=False)
    step = max(1, len(x) // 25)
    axes.set_xticks(x[::step], list(ids)[::step], rotation=60, ha="right", fontsize=8)
    axes.set_ylim(0.0, max(top, 1e-9))
    for i in np.nonzero(error > top)[0]:
        axes.annotate(f"{error[i]:.1f}", (float(i), top), fontsize=8, ha="center", va="top", color="#333", bbox=_PLATE)
    axes.set_ylabel(label)
    return svg(figure, axes)


def error_field(X_BC: RigidTransform, observations: Sequence[Observation]) -> bytes:
    """Draw errors in the camera frame, across the view and along the line of sight: a pattern is the scanner's."""
    R = X_BC.rotation().matrix()
    seen = np.array([o.p_CR for o in observations])
    base = np.array([o.p_BR for o in observations])
    error = (seen @ R.T + X_BC.translation() - base) @ R
    figure, (left, right) = subplots(8.2, 3.7, 1, 2)
    # a lone pose has no extent: its arrow is drawn against 50 mm
    extent = max(float(np.ptp(seen[:, :2], axis=0).max()), 0.05)
    scale = 0.12 * extent / max(float(np.median(np.linalg.norm(error, axis=1))), 1e-9)
    for axes, (i, j), names in ((left, (0, 1), ("x", "y")), (right, (0, 2), ("x", "z"))):
        at, e = 1e3 * seen[:, (i, j)].T, error[:, (i, j)].T
        axes.quiver(*at, *e, angles="xy", scale_units="xy", scale=1e-3 / scale, color=OURS, width=0.004)
        axes.plot(*at, ".", color="#555", markersize=4)
        axes.set(xlabel=f"camera {names[0]}, mm", ylabel=f"camera {names[1]}, mm")
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()
        axes.margins(0.15)
    left.set_title(f"errors, enlarged {scale:.0f} times", fontsize=9, loc="left")
    return svg(figure, left, right)


MOST_SCANS = 48  # a choice: a page of eight rows; more would take megabytes and seconds
_POINTS = 1500  # drawn a scan: a choice, dense at this size
_HEIGHT_MM = 0.3  # of the colours' ends: a choice, beyond the noise of a good scanner


def scan_pictures(clouds: Mapping[str, Array], fits: Mapping[str, FlangeFit]) -> bytes:
    """Draw each scan's points (N, 3) m of C about its flange, along the found normal, with the found edges; PNG.

    Colours: height above the found face. The first MOST_SCANS scans are drawn.
    """
    ids = [id for id in clouds if id in fits][:MOST_SCANS]
    columns = 6
    rows = -(-len(ids) // columns)
    figure = Figure(figsize=(8.2, 1.5 * rows + 0.1), layout="constrained")
    for axes, id in zip_longest(figure.subplots(rows, columns, squeeze=False).flat, ids):
        axes.set_axis_off()
        axes.set(xticks=[], yticks=[])
        if id is None:
            continue
        fit = fits[id]
        R = RotationMatrix.MakeFromOneVector(fit.normal_C, 2).matrix()
        points = 1e3 * (clouds[id][:: len(clouds[id]) // _POINTS + 1] - fit.center_C) @ R
        axes.scatter(*points.T[:2], c=points[:, 2], s=0.6, cmap="coolwarm", vmin=-_HEIGHT_MM, vmax=_HEIGHT_MM)
        for radius in (fit.outer_radius_m, fit.bore_radius_m):
            if radius is not None:
                axes.add_patch(Circle((0.0, 0.0), 1e3 * radius, fill=False, color="#111", linewidth=0.8))
        axes.plot(0.0, 0.0, "+", color="#111", markersize=5, markeredgewidth=0.8)
        axes.set_aspect("equal")
        axes.set_title(id, fontsize=7, pad=2, y=1.0)  # where it would be found, among ticks that are not drawn
    return png(figure)


def subplots(width: float, height: float, *grid: int, **settings: Any) -> tuple[Figure, Any]:
    """An empty figure of that size in inches, and its axes: one, or a ``grid`` of rows and columns as in subplots."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(*grid, **settings)


def millimetres(axes: Axes) -> None:
    """Ticks of a logarithmic axis as an operator writes lengths: 0.04, not 4 times ten to the minus two."""
    axes.yaxis.set_major_formatter("{x:g}")
    low, high = axes.get_ylim()
    digits = "123456789" if high < 2.5 * low else "235" if high < 30.0 * low else ""

    def label(x: float, _: int | None) -> str:
        return f"{x:g}" if f"{x:e}"[0] in digits else ""

    axes.yaxis.set_minor_formatter(FuncFormatter(label))


def plain(axes: Axes, x: str, y: str) -> None:
    """Axis labels, no box, a faint grid."""
    axes.set(xlabel=x, ylabel=y)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)


def png(figure: Figure) -> bytes:
    """Return the figure as PNG, the same bytes for the same data."""
    return _saved(figure, 120, FigureCanvasAgg(figure).print_png, {"Software": None})


def svg(figure: Figure, *all_axes: Axes) -> bytes:
    """Return the figure as SVG, the same bytes for the same data."""
    for axes in all_axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e3e6e9", linewidth=0.8)
        axes.set_axisbelow(True)
    with matplotlib.rc_context({"svg.hashsalt": "weldcal", "svg.fonttype": "path"}):
        return _saved(figure, FigureCanvasSVG.fixed_dpi, FigureCanvasSVG(figure).print_svg, {"Date": None})


def _saved(figure: Figure, dpi: float, save: Callable[..., None], metadata: dict[str, None]) -> bytes:
    """Lay the figure out and save it: savefig would draw the whole figure once more only for its layout."""
    figure.dpi = dpi
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    save(stream := io.BytesIO(), metadata=metadata)
    return stream.getvalue()
