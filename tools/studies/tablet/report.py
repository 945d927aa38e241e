"""Report page and pictures of the tablet study: targets, the paper's tables and ours, the sign, the models."""

import numpy as np
from matplotlib.figure import Figure

from weldcal.calibration.tablet.planar.fit import fit_plane_motion, hand_over
from weldcal.calibration.tablet.published.two_stage import Sign
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.tools.report.pictures import OURS, THEIRS, TRUTH, svg
from weldcal.tools.report.render import fixed, render
from weldcal.tools.studies.tablet.results import TabletStudy, limit_words
from weldcal.tools.studies.tablet.study import HeldOutRow, ModelRow, Reproduced
from weldcal.tools.worlds.tablet import TABLE_NUMBER, TOUCHING_MM, printed_stage, published_touches

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
    """Bars: left-out and in-sample error on the published data; error on simulated queries."""
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


_TITLES = {
    ("htm", 1): "six-parameter transforms, stage 1", ("dh", 1): "Denavit-Hartenberg, stage 1",
    ("htm", 2): "affine pair on the transforms", ("dh", 2): "affine pair on Denavit-Hartenberg",
}  # fmt: skip


def table_rows(r: Reproduced) -> list[tuple[str, ...]]:
    """One of the paper's tables: name, printed, ours, by differential evolution (first seed)."""
    printed = printed_stage(r.model, r.stage)
    ours, evolved = r.ours, r.evolved[0] if r.evolved else None
    rows: list[tuple[str, ...]] = []

    def row(name: str, digits: int, printed_value: float, our_value: float, evolved_value: float | None) -> None:
        rows.append((name, fixed(printed_value), fixed(our_value, digits), fixed(evolved_value, digits)))

    for k, name in enumerate(("F", "f1", "f2")):
        de = getattr(evolved.fitness, name) if evolved else None
        row(f"{name}, mm", 4, printed.fitness[k], getattr(ours.fitness, name), de)
    for k, name in enumerate(printed.names):
        row(name, 2, printed.parameters[k], ours.parameters[k], evolved.parameters[k] if evolved else None)
    return rows


def tablet_report(study: TabletStudy) -> str:
    """The whole report as one self-contained HTML text."""
    touches = published_touches()
    tables = [
        {
            "title": f"Table {TABLE_NUMBER[r.model, r.stage]}: {_TITLES[r.model, r.stage]}",
            "rows": table_rows(r),
            "run": r,
        }
        for r in sorted(study.stages, key=lambda r: TABLE_NUMBER[r.model, r.stage])
    ]
    return render(
        "tablet_study.html.j2",
        study=study,
        tables=tables,
        targets=[(t.what, fixed(t.value, 4), limit_words(t), t.verdict) for t in study.targets],
        missed=sum(not t.met for t in study.targets if t.decides),
        signs=[
            (SIGN_WORDS[s.sign], fixed(s.rigid_mm, 3), fixed(s.scaled_mm, 3), fixed(s.left_out_mm, 2))
            for s in study.signs
        ],
        dh=[(name, fixed(f.F, 4), fixed(f.f1, 4), fixed(f.f2, 4)) for name, f in study.dh.items()],
        models=[
            (m.name, m.unknowns, fixed(m.in_sample_mm, 3), fixed(m.left_out_mm, 3), fixed(m.worst_mm))
            for m in study.models
        ],
        unseen=[(u.name, u.trials, fixed(u.mean_mm, 3)) for u in study.unseen],
        touching=[(f"Table {n}", *(fixed(v) for v in values)) for n, values in TOUCHING_MM.items()],
        residuals=sign_residuals(touches),
        errors=unseen_errors(study.models, study.unseen),
    )
