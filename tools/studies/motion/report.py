"""Report page and pictures of the motion study: Table 1, the track, the history of errors, the quality of both modes."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from weldcal.models.arrays import Array
from weldcal.tools.report.pictures import GREY, OURS, THEIRS, TRUTH, plain, svg
from weldcal.tools.report.render import fixed, render
from weldcal.tools.studies.motion.results import COMPONENTS, MotionStudy, Row

_COLOURS = (OURS, THEIRS, TRUTH)
_SECONDS = 14.0  # of the history that a reader can still follow


def track_picture(study: MotionStudy) -> bytes:
    """Fig. 5: the flange's centre by the robot and by the scanner, in x-y and x-z; the pose at arrival for comparison."""
    t = study.track
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    for axes, (a, b) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        axes.plot(
            1e3 * t.robot_at_arrival[:, a],
            1e3 * t.robot_at_arrival[:, b],
            "x",
            color=GREY,
            ms=4,
            label="robot, at arrival",
        )
        axes.plot(
            1e3 * t.robot[:, a], 1e3 * t.robot[:, b], ".", color="#5b7d4e", ms=7, label="robot, at the capture found"
        )
        axes.plot(1e3 * t.scanner[:, a], 1e3 * t.scanner[:, b], ".", color=TRUTH, ms=3, label="scanner")
        axes.set_aspect("equal")
        plain(axes, f"{'xyz'[a]}, mm", f"{'xyz'[b]}, mm")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return svg(figure)


def _components(axes: Axes, study: MotionStudy, errors: Array, first: int) -> None:
    """Three components over the seconds that a reader can follow: rotation (``first`` 0) or translation (3)."""
    shown = study.history_t < study.history_t[0] + _SECONDS
    for k in range(3):
        axes.plot(
            study.history_t[shown], errors[shown, first + k], ".-", ms=4, lw=0.8, color=_COLOURS[k],
            label=COMPONENTS[first + k],
        )  # fmt: skip
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper right")


def history_picture(study: MotionStudy) -> bytes:
    """Fig. 6: components of the calibration's error by ICP over time, before and after synchronisation."""
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    every = figure.subplots(2, 2, sharex=True, sharey="row")
    for column, (title, errors) in enumerate(
        (("poses at arrival", study.history_before), ("joint estimate of X_BC and clock", study.history_after))
    ):
        for row, (first, unit) in enumerate(((3, "mm"), (0, "degrees"))):
            axes = every[row, column]
            _components(axes, study, errors, first)
            plain(axes, "time, s" if row else "", unit if not column else "")
            if not row:
                axes.set_title(title, fontsize=10)
    return svg(figure)


def after_picture(study: MotionStudy) -> bytes:
    """The right half of Fig. 6 in its own scale."""
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    for axes, first, unit in zip(figure.subplots(1, 2), (3, 0), ("mm", "degrees"), strict=True):
        _components(axes, study, study.history_after, first)
        plain(axes, "time, s", unit)
    return svg(figure)


def quality_picture(study: MotionStudy) -> bytes:
    """Fig. 9: points of the flange in both modes, from the front by height and from the side."""
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    every = figure.subplots(2, 2, height_ratios=[3.0, 1.0], sharex=True)
    for column, (name, points) in enumerate(study.faces.items()):
        q = study.quality[name]
        front, side = every[:, column]
        dots = front.scatter(
            points[:, 0], points[:, 1], c=points[:, 2], s=0.6, cmap="viridis", vmin=-1.5, vmax=1.5, rasterized=True
        )
        front.set_aspect("equal")
        front.set_title(f"{name}: {q.points} points, {q.plane_mm:.2f} mm rms", fontsize=10)
        plain(front, "", "mm")
        front.set_xlim(-36, 36)
        front.set_ylim(-36, 36)
        band = np.abs(points[:, 1]) < 2.0
        side.plot(points[band, 0], points[band, 2], ".", ms=1.5, color=OURS, rasterized=True)
        side.set_ylim(-10.0, 4.0)
        plain(side, "mm", "height, mm")
    figure.colorbar(dots, ax=every[0, :].tolist(), label="height over the face, mm", shrink=0.7)
    return svg(figure)


def table_rows(rows: tuple[Row, ...]) -> list[tuple[str, ...]]:
    """Mean and standard deviation of each component."""

    def cells(row: Row) -> list[str]:
        return [f"{fixed(row.mean[k])} ± {fixed(row.spread[k])}" for k in (0, 1, 3, 4, 5)]

    return [(r.name, str(len(r.errors)), *cells(r), fixed(r.rms_mm)) for r in rows]


def motion_report(study: MotionStudy) -> str:
    """The whole report as one self-contained HTML text."""
    return render(
        "motion_study.html.j2",
        study=study,
        targets=[(t.what, fixed(t.value, 3), t.wanted, t.verdict) for t in study.targets],
        missed=sum(not t.met for t in study.targets),
        deciding=sum(not t.met for t in study.targets if t.decides),
        table_1=table_rows(study.rows),
        errors=[(name, fixed(a, 3), fixed(b, 3), fixed(c, 4)) for name, (a, b, c) in study.X_errors.items()],
        compensation=[(name, fixed(a, 3), fixed(b, 3)) for name, (a, b) in study.compensation.items()],
        quality=[(n, str(q.points), fixed(q.plane_mm, 3), fixed(q.edge_mm, 3)) for n, q in study.quality.items()],
        track=track_picture(study),
        history=history_picture(study),
        after=after_picture(study),
        faces=quality_picture(study),
    )
