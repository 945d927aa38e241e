"""Results of the flange study: its JSON object, the paper's tables and Fig. 9 to 11, ours, and the true errors."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from tests.figures.flange.published.clouds import METHODS, CloudsOutcome
from tests.figures.flange.published.pairs import KinectOutcome, PairsOutcome
from tests.figures.flange.published.simulation import COSTS, Simulation
from tests.figures.harness import Row
from weldcal.calibration.data.results import statistics
from weldcal.models.arrays import Array
from weldcal.tools.report.pictures import OURS, PLANNED, THEIRS, TRUTH, plain, subplots, svg
from weldcal.tools.report.render import fixed

TABLE1: dict[str, tuple[float, ...]] = {
    "UR5 & PhoXi M": (11.60, 2.81, 5.55, 0.49, -0.89, -0.47),
    "UR10e & PhoXi M": (0.60, 1.75, -0.41, 0.10, -0.04, -0.23),
    "Franka Emika & PhoXi M": (4.34, -4.06, -0.13, -0.30, -0.34, -0.07),
    "AUBO i5 & PhoXi S": (-0.26, -0.27, -0.35, 0.14, 0.04, 0.01),
}
"""Table 1 of the paper: x, y, z in mm, roll, pitch, yaw in degrees."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PublishedResults:
    """All outcomes; ``notes`` are sentences about data that were missing or not usable."""

    simulation: Simulation
    pairs: tuple[PairsOutcome, ...]
    clouds: tuple[CloudsOutcome, ...]
    kinect: tuple[KinectOutcome, ...]
    notes: tuple[str, ...]


def in_mm(errors_m: Array) -> dict[str, float]:
    """Median, mean and 95 % in mm, NaN left out."""
    return statistics(1e3 * errors_m, "median", "mean", "p95")


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
    """Draw errors at the camera against the scans used (1 mm of noise), and at the flanges, not in the paper."""
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
    picture, axes = subplots(7.6, 3.2)
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
    picture, axes = subplots(7.6, 2.9)
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
    """Draw where the published circle puts the centre in the flange's plane, by seed and scan; ours is the origin."""
    picture, (axes, halves) = subplots(7.6, 3.2, 1, 2, width_ratios=(1.0, 1.2))
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
    picture, (*both, third) = subplots(7.6, 2.7, 1, 3)
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


_SIX = ("x mm", "y mm", "z mm", "roll °", "pitch °", "yaw °")
TABLE1_HEADER = ("robot and scanner", *_SIX)
COST_HEADER = ("chosen by", *_SIX, "true mm", "worst mm")
HELD_HEADER = ("calibration", "reported mm", "median mm", "mean mm", "95 % mm", "true / reported")
KINECT_HEADER = ("calibration", "median mm", "mean mm", "95 % mm")
SIGHT_HEADER = ("registration", "tilt x", "tilt y", "turn", "in x", "in y", "normal", "reports mm", "unobservable")
CIRCLE_HEADER = ("repeats", "off in x", "y", "z", "two halves apart", "the same by weldcal's edges")
SHORT = {
    "rotation about the flange axis": "turn",
    "in the flange plane, x": "plane x",
    "in the flange plane, y": "plane y",
}


def table1_rows(study: PublishedResults) -> list[Row]:
    """Table 1: the paper's row, then ours where there are data."""
    rows: list[Row] = []
    for name, numbers in TABLE1.items():
        rows.append((f"{name}, paper", *_numbers(numbers, 2)))
        here = [
            ("  ours, their verification", p.table1) for p in study.pairs if p.title == name and p.table1 is not None
        ]
        for c in (c for c in study.clouds if c.title == name):
            e = c.table1_camera[np.isfinite(c.table1_camera).all(axis=1)]
            here += [
                (f"  ours, median of {len(e)} scans", np.median(e, axis=0)),
                ("  spread over those scans", e.std(axis=0)),
            ]
        none = "  pairs without stored runs" if name in {p.title for p in study.pairs} else "  no data of it here"
        rows += [(label, *_six(e, 2)) for label, e in here] or [(none, *("–",) * 6)]
    return rows


def cost_rows(study: PublishedResults) -> list[Row]:
    """Section 3.1 at 1 mm: spread of the error at the camera, and the true error at the 75 flange centres."""
    rows: list[Row] = []
    for name, e in study.simulation.costs.items():
        runs = 1e3 * e.at_tcp.mean(axis=1)
        rows.append((COSTS[name], *_six(e.e.std(axis=0, ddof=1), 3), *_numbers((runs.mean(), runs.max()), 2)))
    return rows


def held_out_rows(outcome: CloudsOutcome) -> list[Row]:
    """One row per method: its own figure (median of the splits), the truth on held-out scans, and their ratio."""
    rows: list[Row] = []
    for split in outcome.splits:
        own = split.reported[np.isfinite(split.reported)]
        rows.append(
            _held_out(METHODS[split.name], 1e3 * float(np.median(own)) if len(own) else None, split.held_out, 3)
        )
    return rows


def pairs_rows(study: PublishedResults) -> list[Row]:
    """Per robot known by pairs: the paper's 50 runs, all pairs, ours; held-out errors."""
    rows: list[Row] = []
    for p in study.pairs:
        if p.runs is not None and p.matched:
            rows.append(_held_out(f"{p.title}: Alg. 1, {len(p.runs.X_BC)} runs", p.reported_mm, p.true, 3))
        rows += [
            _held_out(f"{p.title}: {name}", None, e, 3) for name, e in (("all pairs, SVD", p.svd), ("weldcal", p.ours))
        ]
    return rows


def sight_rows(outcome: CloudsOutcome) -> list[Row]:
    """Share of a known error that each registration reports, and what it reports of a good calibration."""
    rows: list[Row] = []
    for r in outcome.sights:
        own = fixed(1e3 * float(np.linalg.norm(r.value[3:])), 2)
        rows.append((r.title, *_numbers(r.share, 2), own, ", ".join(SHORT.get(b, b) for b in r.blind) or "nothing"))
    return rows


def kinect_rows(study: PublishedResults) -> list[Row]:
    """Return the all-pairs SVD, held out, ours, and the compensated one, errors at the wrist ring."""
    return [
        (what, *_numbers(in_mm(errors).values(), 2))
        for k in study.kinect
        for what, errors in (
            (f"all {k.n} pairs, SVD, on the same pairs", k.residual),
            ("the same, held out (5 folds)", k.held_out),
            ("weldcal, held out (5 folds)", k.ours),
            ("compensated by the paper's e (Eq. 21), on the pairs", k.compensated),
        )
    ]


def tables(study: PublishedResults) -> list[tuple[str, Row, list[Row]]]:
    """Return every table of the study that has lines."""
    found: list[tuple[str, Row, list[Row]]] = []
    if study.pairs or study.clouds:
        found.append(("Table 1: all pairs, no iteration", TABLE1_HEADER, table1_rows(study)))
    found.append(("Centre pairs: errors on pairs outside the fit", HELD_HEADER, pairs_rows(study)))
    for c in study.clouds:
        found.append((f"{c.title}: fitted on {c.n_fit} scans, judged on the others", HELD_HEADER, held_out_rows(c)))
        found.append((f"{c.title}: share of a known error that a registration reports", SIGHT_HEADER, sight_rows(c)))
        found.append((f"{c.title}: centre of the published circle, mm", CIRCLE_HEADER, [c.circle_row]))
    found.append(("Azure Kinect: errors at the wrist ring", KINECT_HEADER, kinect_rows(study)))
    found.append(("Notes", ("data",), [(note,) for note in study.notes]))
    return [table for table in found if table[2]]


def _numbers(values: Iterable[float], digits: int) -> tuple[str, ...]:
    return tuple(fixed(float(v), digits) for v in values)


def _six(e: Array, degree_digits: int) -> tuple[str, ...]:
    """x, y, z in mm and roll, pitch, yaw in degrees of (6,) [rotation; translation]."""
    return (*_numbers(1e3 * e[3:], 2), *_numbers(np.degrees(e[:3]), degree_digits))


def _held_out(name: str, reported_mm: float | None, errors_m: Array, digits: int) -> tuple[str, ...]:
    """Return a calibration's own figure, the true errors and their ratio."""
    true = in_mm(errors_m)
    ratio = f"{true['median'] / reported_mm:.1f}×" if reported_mm else "–"
    return (name, fixed(reported_mm, digits), *_numbers(true.values(), digits), ratio)


def pictures(study: PublishedResults) -> dict[str, Callable[[], bytes]]:
    """What draws every figure, by the name of its file."""
    sim = study.simulation
    drawn: dict[str, Callable[[], bytes]] = {
        "fig9_noise": lambda: fig9(sim),
        "fig10_steps": lambda: fig10(sim),
        "costs": lambda: costs(sim),
    }
    drawn |= {f"fig11_{p.name}": partial(fig11_stored, p) for p in study.pairs if p.runs is not None}
    for c in study.clouds:
        drawn |= {f"fig11_{c.name}": partial(fig11_rerun, c), f"held_out_{c.name}": partial(held_out, c)}
        drawn[f"circles_{c.name}"] = partial(circles, c)
    return {f"{name}.svg": draw for name, draw in drawn.items()}
