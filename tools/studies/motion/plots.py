"""Pictures of the motion study: the track, the history of errors, the quality of both modes."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from weldcal.models.arrays import Array
from weldcal.tools.report.pictures import GREY, OURS, THEIRS, TRUTH, plain, svg

_COLOURS = (OURS, THEIRS, TRUTH)
COMPONENTS = ("roll", "pitch", "yaw", "x", "y", "z")
_SECONDS = 14.0  # of the history that a reader can still follow


def track_picture(scanner: Array, robot: Array, robot_at_arrival: Array) -> bytes:
    """Fig. 5: the flange's centre (N, 3) m by the scanner, and by the robot at the capture and, for comparison, at the
    arrival, in x-y and x-z."""
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    for axes, (a, b) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        for p, marker, colour, size, label in (
            (robot_at_arrival, "x", GREY, 4, "robot, at arrival"),
            (robot, ".", "#5b7d4e", 7, "robot, at the capture found"),
            (scanner, ".", TRUTH, 3, "scanner"),
        ):
            axes.plot(1e3 * p[:, a], 1e3 * p[:, b], marker, color=colour, ms=size, label=label)
        axes.set_aspect("equal")
        plain(axes, f"{'xyz'[a]}, mm", f"{'xyz'[b]}, mm")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return svg(figure)


def _components(axes: Axes, t: Array, errors: Array, first: int) -> None:
    """Three components over the seconds that a reader can follow: rotation (``first`` 0) or translation (3)."""
    shown = t < t[0] + _SECONDS
    for k in range(3):
        axes.plot(
            t[shown], errors[shown, first + k], ".-", ms=4, lw=0.8, color=_COLOURS[k], label=COMPONENTS[first + k]
        )
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper right")


def history_picture(t: Array, before: Array, after: Array) -> bytes:
    """Fig. 6: components (N, 6) of the calibration's error by ICP over time (N,) s, before and after
    synchronisation."""
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    every = figure.subplots(2, 2, sharex=True, sharey="row")
    both = (("poses at arrival", before), ("joint estimate of X_BC and clock", after))
    for column, (title, errors) in enumerate(both):
        for row, (first, unit) in enumerate(((3, "mm"), (0, "degrees"))):
            axes = every[row, column]
            _components(axes, t, errors, first)
            plain(axes, "time, s" if row else "", unit if not column else "")
            if not row:
                axes.set_title(title, fontsize=10)
    return svg(figure)


def after_picture(t: Array, errors: Array) -> bytes:
    """The right half of Fig. 6 in its own scale."""
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    for axes, first, unit in zip(figure.subplots(1, 2), (3, 0), ("mm", "degrees"), strict=True):
        _components(axes, t, errors, first)
        plain(axes, "time, s", unit)
    return svg(figure)


def quality_picture(faces: Mapping[str, Array], titles: Mapping[str, str]) -> bytes:
    """Fig. 9: points (N, 3) mm of the flange in both modes, from the front by height and from the side."""
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    every = figure.subplots(2, 2, height_ratios=[3.0, 1.0], sharex=True)
    for column, (name, points) in enumerate(faces.items()):
        front, side = every[:, column]
        dots = front.scatter(
            points[:, 0], points[:, 1], c=points[:, 2], s=0.6, cmap="viridis", vmin=-1.5, vmax=1.5, rasterized=True
        )
        front.set_aspect("equal")
        front.set_title(titles[name], fontsize=10)
        plain(front, "", "mm")
        front.set_xlim(-36, 36)
        front.set_ylim(-36, 36)
        band = np.abs(points[:, 1]) < 2.0
        side.plot(points[band, 0], points[band, 2], ".", ms=1.5, color=OURS, rasterized=True)
        side.set_ylim(-10.0, 4.0)
        plain(side, "mm", "height, mm")
    figure.colorbar(dots, ax=every[0, :].tolist(), label="height over the face, mm", shrink=0.7)
    return svg(figure)
