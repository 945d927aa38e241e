"""Tables and pictures of the flange study: the paper's numbers, ours, and the true errors."""

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from weldcal.models.arrays import Array
from weldcal.tools.report.render import fixed
from weldcal.tools.studies.flange.published import plots
from weldcal.tools.studies.flange.published.clouds import METHODS, CloudsOutcome
from weldcal.tools.studies.flange.published.results import TABLE1, PublishedResults, in_mm
from weldcal.tools.studies.flange.published.simulation import COSTS
from weldcal.tools.studies.harness import Results, Row, Table

_SIX = ("x mm", "y mm", "z mm", "roll °", "pitch °", "yaw °")
TABLE1_HEADER = ("robot and scanner", *_SIX)
COST_HEADER = ("chosen by", *_SIX, "true mm", "worst mm")
HELD_HEADER = ("calibration", "reported mm", "median mm", "mean mm", "95 % mm", "true / reported")
KINECT_HEADER = ("calibration", "median mm", "mean mm", "95 % mm")
SIGHT_HEADER = ("registration", "tilt x", "tilt y", "turn", "in x", "in y", "normal", "reports mm", "unobservable")
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
    """The all-pairs SVD, held out, ours, and the compensated one, errors at the wrist ring."""
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


def tables(study: PublishedResults) -> list[Table]:
    """Every table of the study that has lines."""
    found: list[Table] = []
    if study.pairs or study.clouds:
        found.append(("Table 1: all pairs, no iteration", TABLE1_HEADER, table1_rows(study)))
    found.append(("Centre pairs: errors on pairs outside the fit", HELD_HEADER, pairs_rows(study)))
    for c in study.clouds:
        found.append((f"{c.title}: fitted on {c.n_fit} scans, judged on the others", HELD_HEADER, held_out_rows(c)))
        found.append((f"{c.title}: share of a known error that a registration reports", SIGHT_HEADER, sight_rows(c)))
    found.append(("Azure Kinect: errors at the wrist ring", KINECT_HEADER, kinect_rows(study)))
    found.append(("Notes", ("data",), [(note,) for note in study.notes]))
    return [table for table in found if table[2]]


def _numbers(values: Iterable[float], digits: int) -> tuple[str, ...]:
    return tuple(fixed(float(v), digits) for v in values)


def _six(e: Array, degree_digits: int) -> tuple[str, ...]:
    """x, y, z in mm and roll, pitch, yaw in degrees of (6,) [rotation; translation]."""
    return (*_numbers(1e3 * e[3:], 2), *_numbers(np.degrees(e[:3]), degree_digits))


def _held_out(name: str, reported_mm: float | None, errors_m: Array, digits: int) -> tuple[str, ...]:
    """A calibration's own figure, the true errors and their ratio."""
    true = in_mm(errors_m)
    ratio = f"{true['median'] / reported_mm:.1f}×" if reported_mm else "–"
    return (name, fixed(reported_mm, digits), *_numbers(true.values(), digits), ratio)


def pictures(study: PublishedResults) -> dict[str, Callable[[Results], bytes]]:
    """What draws every figure, by the name of its file."""
    sim = study.simulation
    drawn: dict[str, Callable[[], bytes]] = {
        "fig9_noise": lambda: plots.fig9(sim),
        "fig10_steps": lambda: plots.fig10(sim),
        "costs": lambda: plots.costs(sim),
    }
    drawn |= {f"fig11_{p.name}": partial(plots.fig11_stored, p) for p in study.pairs if p.runs is not None}
    for c in study.clouds:
        drawn[f"fig11_{c.name}"] = partial(plots.fig11_rerun, c)
        drawn[f"held_out_{c.name}"] = partial(plots.held_out, c)
        drawn[f"circles_{c.name}"] = partial(plots.circles, c)
    figures = {f"figures/{name}.svg": draw for name, draw in drawn.items()}
    return {path: lambda results, draw=draw: draw() for path, draw in figures.items()}  # type: ignore[misc]
