"""The flange study's numbers as rows: the paper's beside ours, for the terminal, the report and the JSON object."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from weldcal.tools.report.render import fixed
from weldcal.tools.studies.flange.published.clouds import METHODS, CloudsOutcome
from weldcal.tools.studies.flange.published.kinect import PAPER_E_RPY_DEG, PAPER_E_XYZ_MM
from weldcal.tools.studies.flange.published.simulation import COSTS

if TYPE_CHECKING:
    from weldcal.tools.studies.flange.published.command import Study

Array = NDArray[np.float64]

TABLE1: dict[str, tuple[float, ...]] = {
    "UR5 & PhoXi M": (11.60, 2.81, 5.55, 0.49, -0.89, -0.47),
    "UR10e & PhoXi M": (0.60, 1.75, -0.41, 0.10, -0.04, -0.23),
    "Franka Emika & PhoXi M": (4.34, -4.06, -0.13, -0.30, -0.34, -0.07),
    "AUBO i5 & PhoXi S": (-0.26, -0.27, -0.35, 0.14, 0.04, 0.01),
}
"""Table 1 of the paper: x, y, z in mm, roll, pitch, yaw in degrees."""
TABLE1_HEADER = ("robot and scanner", "x mm", "y mm", "z mm", "roll °", "pitch °", "yaw °")
COST_HEADER = (
    "chosen by", "x mm", "y mm", "z mm", "roll °", "pitch °", "yaw °", "true mm", "worst mm",
)  # fmt: skip
HELD_HEADER = ("calibration", "says mm", "median mm", "mean mm", "95 % mm", "true / said")
SHORT = {
    "rotation about the flange axis": "turn",
    "in the flange plane, x": "plane x",
    "in the flange plane, y": "plane y",
}
SIGHT_HEADER = ("registration", "tilt x", "tilt y", "turn", "in x", "in y", "normal", "says mm", "blind")


def statistics(errors_m: Array) -> dict[str, float]:
    """Median, mean and 95 % in mm, NaN left out."""
    e = 1e3 * errors_m[np.isfinite(errors_m)]
    if len(e) == 0:
        return {"median": float("nan"), "mean": float("nan"), "p95": float("nan")}
    return {"median": float(np.median(e)), "mean": float(e.mean()), "p95": float(np.percentile(e, 95))}


def table1_rows(study: Study) -> list[tuple[str, ...]]:
    """Table 1, the paper's row and then ours where the data are there."""
    rows: list[tuple[str, ...]] = []
    for name, numbers in TABLE1.items():
        rows.append((f"{name}, paper", *(fixed(v, 2) for v in numbers)))
        here = [
            ("  ours, their verification", p.table1) for p in study.pairs if p.title == name and p.table1 is not None
        ]
        for c in (c for c in study.clouds if c.title == name):
            e = _finite(c)
            here += [
                (f"  ours, median of {len(e)} scans", np.median(e, axis=0)),
                ("  spread over those scans", e.std(axis=0)),
            ]
        rows += [(label, *_six(e)) for label, e in here] or [("  no data of it here", *("–",) * 6)]
    return rows


def _finite(c: CloudsOutcome) -> Array:
    return np.asarray(c.table1_camera[np.isfinite(c.table1_camera).all(axis=1)])


def _six(e: Array) -> tuple[str, ...]:
    """x, y, z in mm and roll, pitch, yaw in degrees of (6,) [rotation; translation]."""
    return (*(fixed(float(1e3 * v), 2) for v in e[3:]), *(fixed(float(np.degrees(v)), 2) for v in e[:3]))


def cost_rows(study: Study) -> list[tuple[str, ...]]:
    """Section 3.1 at 1 mm: spread of the error at the camera, and the true error at the 75 flange centres."""
    rows: list[tuple[str, ...]] = []
    for name, e in study.simulation.costs.items():
        sd = e.e.std(axis=0, ddof=1)
        runs = 1e3 * e.at_tcp.mean(axis=1)
        cells = [fixed(1e3 * v, 2) for v in sd[3:]] + [fixed(np.degrees(v), 3) for v in sd[:3]]
        rows.append((COSTS[name], *cells, fixed(runs.mean(), 2), fixed(runs.max(), 2)))
    return rows


def held_out_rows(outcome: CloudsOutcome) -> list[tuple[str, ...]]:
    """One row a method: its own figure (median of the splits), the truth on scans kept aside, and their ratio."""
    rows: list[tuple[str, ...]] = []
    for split in outcome.splits:
        s = statistics(split.held_out)
        own = split.reported[np.isfinite(split.reported)]
        figure = 1e3 * float(np.median(own)) if len(own) else float("nan")
        ratio = s["median"] / figure if figure > 0 else float("nan")
        cells = (fixed(figure, 3), fixed(s["median"], 3), fixed(s["mean"], 3), fixed(s["p95"], 3))
        rows.append((METHODS[split.name], *cells, "–" if np.isnan(ratio) else f"{ratio:.1f}×"))
    return rows


def pairs_rows(study: Study) -> list[tuple[str, ...]]:
    """Per robot known by pairs: the paper's 50 runs, all pairs, ours; held-out errors."""
    rows: list[tuple[str, ...]] = []
    for p in study.pairs:
        if p.runs is not None and p.matched:
            figure = p.reported_mm
            s = statistics(p.true)
            cells = (fixed(figure, 3), fixed(s["median"], 3), fixed(s["mean"], 3), fixed(s["p95"], 3))
            rows.append((f"{p.title}: Alg. 1, {len(p.runs.X_BC)} runs", *cells, f"{s['median'] / figure:.1f}×"))
        for name, errors in (("all pairs, SVD", p.svd), ("weldcal", p.ours)):
            s = statistics(errors)
            cells = ("–", fixed(s["median"], 3), fixed(s["mean"], 3), fixed(s["p95"], 3))
            rows.append((f"{p.title}: {name}", *cells, "–"))
    return rows


def sight_rows(outcome: CloudsOutcome) -> list[tuple[str, ...]]:
    """Share of a known error that each registration reports, and what it says of a good calibration."""
    rows: list[tuple[str, ...]] = []
    for r in outcome.sights:
        shares = [fixed(float(v), 2) for v in r.share]
        says = fixed(1e3 * float(np.linalg.norm(r.value[3:])), 2)
        rows.append((r.title, *shares, says, ", ".join(SHORT.get(b, b) for b in r.blind) or "nothing"))
    return rows


def kinect_rows(study: Study) -> list[tuple[str, ...]]:
    """The all-pairs SVD, held out, ours, and the compensated one, errors at the wrist ring."""
    rows: list[tuple[str, ...]] = []
    for k in study.kinect:
        for what, errors in (
            (f"all {k.n} pairs, SVD, on the same pairs", k.residual),
            ("the same, held out (5 folds)", k.held_out),
            ("weldcal, held out (5 folds)", k.ours),
            ("compensated by the paper's e (Eq. 21), on the pairs", k.compensated),
        ):
            s = statistics(errors)
            rows.append((what, fixed(s["median"], 2), fixed(s["mean"], 2), fixed(s["p95"], 2)))
    return rows


def summary(study: Study) -> dict[str, object]:
    """The result for JSON: millimetres and degrees where the key says so."""
    sim = study.simulation
    return {
        "state": "done",
        "quick": study.options.quick,
        "seed": study.options.seed,
        "notes": list(study.notes),
        "simulation": {
            "std_ratio_all_over_algorithm1": dict(
                zip(("roll", "pitch", "yaw", "x", "y", "z"), map(float, sim.ratio), strict=True)
            ),
            "std_ratio_best_of_three": dict(
                zip(("roll", "pitch", "yaw", "x", "y", "z"), map(float, sim.best_ratio), strict=True)
            ),
            "at_1mm": {
                name: {
                    "std_xyz_mm": 1e3 * e.e[:, 3:].std(axis=0, ddof=1),
                    "std_rpy_deg": np.degrees(e.e[:, :3].std(axis=0, ddof=1)),
                    "true_mm": {
                        "mean": float(1e3 * e.at_tcp.mean()),
                        "worst_run": float(1e3 * e.at_tcp.mean(axis=1).max()),
                        "max": float(1e3 * e.at_tcp.max()),
                    },
                }
                for name, e in sim.costs.items()
            },
        },
        "paper_table1": {name: {"xyz_mm": v[:3], "rpy_deg": v[3:]} for name, v in TABLE1.items()},
        "pairs": {
            p.name: {
                "n": p.n,
                "outliers": list(p.outliers),
                "table1_xyz_mm": None if p.table1 is None else 1e3 * p.table1[3:],
                "table1_rpy_deg": None if p.table1 is None else np.degrees(p.table1[:3]),
                "algorithm1_reports_mm": None if p.runs is None else p.reported_mm,
                "algorithm1_own_four_mm": statistics(p.own_pool),
                "algorithm1_true_mm": statistics(p.true),
                "svd_held_out_mm": statistics(p.svd),
                "weldcal_held_out_mm": statistics(p.ours),
            }
            for p in study.pairs
        },
        "clouds": {
            c.name: {
                "n": c.n,
                "verification": c.verification,
                "n_fit": c.n_fit,
                "circle_repeat_mm": 1e3 * float(np.sqrt(np.mean([r.repeat_m**2 for r in c.circles]))),
                "circle_bias_R_mm": 1e3 * np.mean([r.offset_R for r in c.circles], axis=0),
                "circle_halves_mm": 1e3 * float(np.median([r.halves_published_m for r in c.circles])),
                "edges_halves_mm": 1e3 * float(np.median([r.halves_ours_m for r in c.circles])),
                "held_out_mm": {s.name: statistics(s.held_out) for s in c.splits},
                "reported_mm": {s.name: 1e3 * s.reported for s in c.splits},
                "sight": {r.title: {"share": r.share, "value": r.value, "blind": list(r.blind)} for r in c.sights},
            }
            for c in study.clouds
        },
        "kinect": {
            k.name: {
                "n": k.n,
                "paper_e": {"xyz_mm": PAPER_E_XYZ_MM, "rpy_deg": PAPER_E_RPY_DEG},
                "residual_mm": statistics(k.residual),
                "held_out_mm": statistics(k.held_out),
                "weldcal_held_out_mm": statistics(k.ours),
                "compensated_mm": statistics(k.compensated),
                "e_at_camera_mm": 1e3 * k.at_camera_m,
                "e_at_work_mm": 1e3 * k.shift_m,
            }
            for k in study.kinect
        },
        "wall_seconds": study.wall_seconds,
        "written_to": study.folder,
    }
