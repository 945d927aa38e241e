"""Pictures of the profiler study: Fig. 6 to 8 of the edge paper, the seam's deviations and the frustum."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from weldcal.tools.report.pictures import OURS, PLANNED, plain, svg
from weldcal.tools.studies.profiler.edge import COUNTS, EdgeRow
from weldcal.tools.studies.profiler.sphere import METHODS, WorldResult

PAPER = PLANNED
_COLOURS = {METHODS[0]: "black", METHODS[1]: PAPER, METHODS[2]: "#6aa5c9", METHODS[3]: OURS}


def against_rotations(
    rows: list[EdgeRow], names: tuple[str, ...], what: str, label: str, titles: dict[str, str]
) -> bytes:
    """Mean and standard deviation (bars) of a criterion over the number of rotations, a panel per set (Fig. 6 and 7)."""

    def draw(axes: Axes, found: dict[str, list[EdgeRow]]) -> None:
        for (method, r), colour, shift in zip(found.items(), (PAPER, OURS), (-0.35, 0.35), strict=True):
            mean, std = ([getattr(row, f"{what}_{part}_{label}") for row in r] for part in ("mean", "std"))
            low = np.minimum(std, mean)  # neither angle nor distance can be negative
            x, label_ = np.array(COUNTS) + shift, f"{method} method"
            axes.errorbar(x, mean, yerr=[low, std], color=colour, marker="o", ms=4, lw=1.2, capsize=3, label=label_)

    return _panels(
        rows, names, titles, draw, {"deg": "angle to the edge, deg", "mm": "distance to the edge, mm"}[label]
    )


def true_error(rows: list[EdgeRow], names: tuple[str, ...], titles: dict[str, str]) -> bytes:
    """The pose's own rms error, which the criteria hardly show, with the Cramer-Rao bound."""

    def draw(axes: Axes, found: dict[str, list[EdgeRow]]) -> None:
        for (method, r), colour in zip(found.items(), (PAPER, OURS), strict=True):
            values = [x.translation_mm for x in r]
            axes.semilogy(COUNTS, values, color=colour, marker="o", ms=4, lw=1.2, label=f"{method} method")
        bound = [x.crb_mm for x in found["joint"]]
        axes.semilogy(COUNTS, bound, color="black", lw=1.0, ls=":", label="Cramér-Rao bound")

    return _panels(rows, names, titles, draw, "translation error, mm")


def _panels(
    rows: list[EdgeRow],
    names: tuple[str, ...],
    titles: dict[str, str],
    draw: Callable[[Axes, dict[str, list[EdgeRow]]], None],
    y: str,
) -> bytes:
    """A panel per set over the number of rotations; `draw` gets the rows of each method in the order of COUNTS."""
    picture = Figure(figsize=(7.2, 2.6), layout="constrained")
    panels = np.atleast_1d(picture.subplots(1, len(names), sharey=True))
    for axes, name in zip(panels, names, strict=True):
        by = {(x.method, x.rotations): x for x in rows if x.name == name}
        draw(axes, {method: [by[method, n] for n in COUNTS] for method in ("paper", "joint")})
        axes.set_xticks(COUNTS)
        axes.set_title(titles[name], fontsize=9)
        plain(axes, "rotations", "")
    panels[0].set_ylabel(y)
    legend(picture, panels[0])
    return svg(picture)


def legend(picture: Figure, axes: Axes) -> None:
    """One legend for all panels, over them."""
    handles, labels = axes.get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 4), frameon=False, fontsize=8)


def ball(points: np.ndarray) -> bytes:
    """A ball's profiles (n, m, 3) m brought together, a colour for each orientation of the flange (Fig. 8)."""
    picture = Figure(figsize=(7.2, 4.0), layout="constrained")
    axes = picture.add_subplot(projection="3d")
    middle = points.reshape(-1, 3).mean(axis=0)
    for k, p in enumerate(points):
        axes.plot(*(1e3 * (p - middle)).T, color=f"C{(k // 6) % 10}", lw=0.8)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
    axes.set_box_aspect((1, 1, 0.6))
    return svg(picture)


def seam(results: list[WorldResult]) -> bytes:
    """Deviation of the seam's features from where the torch finds them, station by station (the sphere paper's Fig. 6)."""
    shown = [r for r in results if r.seam_each_mm is not None]
    first = [r for r in shown if r.world == shown[0].world]
    picture = Figure(figsize=(7.2, 5.2), layout="constrained")
    panels = picture.subplots(3, 1, sharex=True)
    for axes, j, title in zip(panels, range(3), ("first edge", "root", "second edge"), strict=True):
        for r in first:
            assert r.seam_each_mm is not None
            axes.semilogy(r.seam_each_mm[:, j], color=_COLOURS[r.method], marker=".", ms=3, lw=1.0, label=r.method)
        axes.set_title(title, fontsize=9, loc="left")
        plain(axes, "", "off, mm")
    panels[-1].set_xlabel("station along the seam")
    legend(picture, panels[0])
    return svg(picture)


def frustum(result: WorldResult) -> bytes:
    """The frustum's cloud by plane, with the slanted edges that were measured (Fig. 7 and 8)."""
    assert result.cloud is not None
    assert result.boss is not None
    b, p = result.boss, result.cloud
    middle = b.corners_top.mean(axis=0)
    picture = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = picture.add_subplot(projection="3d", computed_zorder=False)
    for label in (0, 2, 3, 4, 5, 1):
        q = 1e3 * (p[b.labels == label] - middle)
        near = np.abs(q[:, :2]).max(axis=1) < 60.0
        axes.scatter(*q[near][:: 8 if label == 0 else 4].T, s=0.8, color=f"C{label}", depthshade=False, rasterized=True)
    for top, base in zip(b.corners_top, b.corners_base, strict=True):
        axes.plot(*(1e3 * (np.array([top, base]) - middle)).T, color="black", lw=1.4, zorder=10)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
    axes.set_box_aspect((1, 1, 0.45))
    axes.view_init(elev=38, azim=-60)
    return svg(picture)
