"""Hand-eye calibrations of simulated cells and made pictures beside OpenCV's, and every mounting over several seeds."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from tests.figures.harness import Figures, Results, Row, Study, Target
from tests.worlds.board_pictures import BOARDS, calibrated
from tests.worlds.hand_eye import KINDS, WEIGHTINGS, ratios
from tests.worlds.light_runs import MountedWorld, mounted_world
from weldcal.calibration.hand_eye.opencv_methods import METHODS
from weldcal.calibration.planning.mounting_estimate import expected_error, solve_mounting
from weldcal.calibration.planning.mounting_poses import work_point
from weldcal.models.errors import InputError
from weldcal.systems.jobs.job import job_of
from weldcal.systems.scenario.loading import load_scenario, scenario_names
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option, switch
from weldcal.tools.commands.mounting_live import recorded_report, run_mounting_live
from weldcal.tools.report.first_screen import USE
from weldcal.tools.report.mounting import MountingReport, RecordedMounting
from weldcal.tools.report.run import RunOptions

MARGIN = 0.02  # by which a method must be better to count as ahead


def _ahead(results: Results) -> Figures:
    """Count cells of a hundred in which OpenCV is ahead in a column by MARGIN; also the ratio's 95th percentile."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for name, cell in results.items():
        found.setdefault(name.rpartition(", cell ")[0], []).append(cell)
    runs = len(next(iter(found.values())))
    cells = {}
    found["all"] = list(results.values())
    for kind, each in found.items():
        for name in WEIGHTINGS:
            ratio = np.array([cell[name] for cell in each])
            deg, mm = (float(v) for v in np.percentile(ratio, 95, axis=0, method="lower"))
            ahead = 100.0 * float((ratio > 1.0 + MARGIN).any(axis=1).mean())
            cells[f"{kind}, {name}"] = {"opencv_ahead_percent": ahead, "p95_deg": deg, "p95_mm": mm}
    return {"runs": runs, "cells": cells}


def _ahead_rows(figures: Figures) -> Iterable[Row]:
    cells = figures["cells"]
    for kind in dict.fromkeys(key.rpartition(", ")[0] for key in cells):
        found = (cells[f"{kind}, {name}"] for name in WEIGHTINGS)
        yield kind, *(f"{c['opencv_ahead_percent']:.0f} % ({c['p95_deg']:.2f}, {c['p95_mm']:.2f})" for c in found)


CELLS = Study(
    name="hand-eye-cells",
    what=(
        "Cells in which some OpenCV method has the smaller held-out error, and the 95 % ratio of the errors (deg, mm)."
    ),
    case=ratios,
    figures=_ahead,
    header=("cells", *WEIGHTINGS),
    rows=_ahead_rows,
)


@command(
    "benchmark hand-eye-cells",
    short_help="Compare with OpenCV on cells with a wrong camera or arm.",
    hidden=True,
    options=FARM,
)
def hand_eye_cells(
    call: Call, runs: Annotated[int, option("--runs", "N", "Number of cells of each kind.", min=1)] = 40
) -> Outcome:
    """Compare held-out errors with OpenCV's best on simulated cells with a wrong camera matrix, a wrong robot, or
    both."""
    seeds = range(call.seed, call.seed + runs)
    return CELLS.outcome(call, {f"{kind}, cell {s}": {"kind": kind, "seed": s} for kind in KINDS for s in seeds})


LIVE, RECORDED, RENDERED = "live", "recorded", "rendered"


def run_mounting(name: str, seed: int, kind: str, folder: str = "") -> Mapping[str, object]:
    """One calibration: what the table needs of it, mm.

    ``kind``: rendered (the live job with its renderer), live (light world, scans until the expected error is small
    enough) or recorded (light world, all scans).
    """
    if kind == RENDERED:
        options = RunOptions(scenario=name, out=Path(folder), seed=seed, recording=False)
        report: MountingReport = run_mounting_live(load_scenario(name), options, lambda *_: None)
        if report.result is None or report.state != "done":
            return {"state": report.state, "reason": report.reason}
        truth, device = report.truth, report.device
    else:
        world = mounted_world(name, seed)
        report, truth, device = _light(name, world, kind), world.truth, world.device
    r, p = report.result, work_point(report.scene)
    assert r is not None
    assert device is not None
    seen = device.measured(p)
    e = r.place(seen) - truth["X"] @ p
    return {
        "state": "done",
        "scans": len(report.status.seen),
        "work_mm": 1e3 * float(np.linalg.norm(e)),
        "error_95_mm": 1e3 * report.status.error_95_m,
        "nees": {k: r.normalised_error(k, X) / 6.0 for k, X in truth.items() if k in r.poses},
        "nees_point": float(e @ np.linalg.solve(r.point_covariance(seen), e)) / 3.0,
        "verdict": report.first.verdict,
        "limit_mm": report.tolerance[0],
    }


def _light(name: str, world: MountedWorld, kind: str) -> RecordedMounting:
    """Return the report of a light world's scans."""
    limits, scene, seen = load_scenario(name).calibration, world.scene, world.seen
    n = limits.minimum_scans if kind == LIVE else len(seen)
    while n < len(seen) and 1e3 * expected_error(scene, solve_mounting(scene, seen[:n]))[1] > limits.required_error_mm:
        n += 1
    return recorded_report(scene, seen[:n], limit_mm=limits.required_error_mm)


def _mountings(results: Results) -> Figures:
    kinds: dict[str, dict[str, Any]] = {}
    for case, run in results.items():
        name, _, seed = case.rpartition(", seed ")
        kinds.setdefault(name, {})[seed] = run
    rows = [_mounting(name, runs) for name, runs in kinds.items()]
    failures = [f"{row['scenario']} {text}" for row in rows for text in row["failed"]]
    figures = {"state": "failed" if failures else "done", "mountings": rows}
    return figures | ({"reason": failures[0]} if failures else {})


def _mounting(name: str, runs: Mapping[str, Any]) -> dict[str, Any]:
    failed = [f"seed {s}: {run['reason']}" for s, run in runs.items() if run["state"] != "done"]
    good = [run for run in runs.values() if run["state"] == "done"]
    if not good:
        return {"scenario": name, "runs": 0, "failed": failed}
    work, bound = (np.array([run[key] for run in good]) for key in ("work_mm", "error_95_mm"))
    use = np.array([run["verdict"] == USE for run in good])
    over = np.array([run["work_mm"] > run["limit_mm"] for run in good])
    return {
        "scenario": name,
        "runs": len(good),
        "failed": failed,
        "scans": float(np.mean([run["scans"] for run in good])),
        "work_mm": [float(v) for v in np.percentile(work, [50, 95, 100])],
        "stated_95_mm": float(np.median(bound)),
        "inside_percent": 100.0 * float((work <= bound).mean()),
        "nees": {k: float(np.mean([run["nees"][k] for run in good])) for k in good[0]["nees"]},
        "nees_point": float(np.mean([run["nees_point"] for run in good])),
        "use_it": int(use.sum()),
        "over_tolerance": int(over.sum()),
        "wrong_use_it": int((use & over).sum()),
    }


def _mounting_rows(figures: Figures) -> Iterable[Row]:
    for r in figures["mountings"]:
        if r["runs"] == 0:
            yield r["scenario"], "0", *("-",) * 6
            continue
        yield (
            r["scenario"],
            f"{r['runs']:.0f}",
            f"{r['scans']:.1f}",
            " / ".join(f"{v:.3f}" for v in r["work_mm"]),
            f"{r['stated_95_mm']:.3f} ({r['inside_percent']:.1f} %)",
            ", ".join(f"{k} {v:.2f}" for k, v in r["nees"].items()),
            f"{r['nees_point']:.2f}",
            f"{r['use_it']} / {r['over_tolerance']} / {r['wrong_use_it']}",
        )


MOUNTINGS = Study(
    name="mountings",
    what=(
        "Every mounting calibrated in simulation with errors of scanner and arm: errors against the truth, and in units"
        " of the covariance."
    ),
    case=run_mounting,
    figures=_mountings,
    header=(
        "scenario",
        "runs",
        "scans",
        "scanned point at best distance, mm: median / 95 % / worst",
        "stated 95 %, mm (errors within)",
        "NEES per unknown",
        "of the point",
        "use it / over the tolerance / both",
    ),
    rows=_mounting_rows,
)


@command("benchmark mountings", short_help="Calibrate every mounting over several seeds.", hidden=True, options=FARM)
def mountings(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of seeds of each.", min=1)] = 5,
    names: Annotated[list[str] | None, option("--scenario", "NAME", "Only this scenario; repeat for more.")] = None,
    light: Annotated[bool, switch("--light", "Without the renderer: live and recorded, by the fits' noise.")] = False,
) -> Outcome:
    """Calibrate every mounting over several seeds: errors against the truth, and in units of the covariance."""
    chosen = names or [n for n in scenario_names() if job_of(load_scenario(n)).key == "mounting"]
    for name in chosen:
        if job_of(load_scenario(name)).key != "mounting":
            raise InputError(f"Scenario '{name}' has no mounting part; choose one that has.")
    folder = MOUNTINGS.folder(call)
    cases = {
        f"{name}, {kind}, seed {seed}": {
            "name": name,
            "seed": seed,
            "kind": kind,
            "folder": str(folder.absolute() / Path(name).stem / f"seed{seed}"),
        }
        for name in chosen
        for kind in ((LIVE, RECORDED) if light else (RENDERED,))
        for seed in range(call.seed, call.seed + runs)
    }
    return MOUNTINGS.outcome(call, cases, folder)


def _figures(results: Results) -> Figures:
    cells = {}
    for kind in ("corners", "pictures", "bad"):
        for board in ("all", *BOARDS):
            runs = [r for name, r in results.items() if name.startswith(f"{kind}, {'' if board == 'all' else board}")]
            good = [r for r in runs if "square" in r]
            if not good:
                continue
            ours = np.sqrt(np.mean(np.square([r["error"] for r in good]), axis=0))
            theirs = [[r["opencv"][m] or (np.inf, np.inf) for r in good] for m in METHODS]
            cells[f"{kind}, {board}"] = {
                "runs": len(runs),
                "solved": len(good),
                "inside_percent": 100.0 * float(np.mean([r["inside"] for r in good])),
                "nees": float(np.mean([r["square"] for r in good])) / 6.0,
                "nees_each": np.mean([r["each"] for r in good], axis=0).tolist(),
                "rms_deg_mm": ours.tolist(),
                "opencv_deg_mm": np.sqrt(np.mean(np.square(theirs), axis=1)).min(axis=0).tolist(),
                "right_percent": 100.0 * sum(r.get("right", False) for r in runs) / len(runs),
            }
    return {"cells": cells}


def _rows(figures: Figures) -> Iterable[Row]:
    for name, c in figures["cells"].items():
        each = " ".join(f"{v:.2f}" for v in c["nees_each"])
        pairs = (f"{a:.4f} ({b:.4f})" for a, b in zip(c["rms_deg_mm"], c["opencv_deg_mm"], strict=True))
        yield (
            name,
            f"{c['solved']} of {c['runs']}",
            f"{c['inside_percent']:.1f} %",
            f"{c['nees']:.2f}: {each}",
            *pairs,
            f"{c['right_percent']:.1f} %",
        )


def _targets(figures: Figures) -> list[Target]:
    bounds = {"corners": (95.0, 2.0), "pictures": (94.5, 4.5)}
    cells = {kind: figures["cells"].get(f"{kind}, all") for kind in bounds}
    found = [(kind, c["inside_percent"], *bounds[kind]) for kind, c in cells.items() if c]
    return [Target(f"truth inside 95 %, {kind}", "%", v, middle, "±", by) for kind, v, middle, by in found]


STUDY = Study(
    name="hand-eye-pictures",
    what=(
        "Calibrations from pictures of six boards: truth in the 95 % region, NEES per unknown, rms errors (best of"
        " OpenCV's), right pictures used."
    ),
    case=calibrated,
    figures=_figures,
    rows=_rows,
    targets=_targets,
    header=("input", "solved", "inside 95 %", "NEES: each", "deg (OpenCV)", "mm (OpenCV)", "right pictures"),
)


@command("benchmark hand-eye-pictures", short_help="Test calibrations from pictures.", hidden=True, options=FARM)
def hand_eye_pictures(
    call: Call,
    corners: Annotated[int, option("--corners", "N", "Runs on rendered corners.", min=0)] = 1000,
    pictures: Annotated[
        int, option("--pictures", "N", "Runs on rendered pictures; half as many with three bad.", min=0)
    ] = 200,
) -> Outcome:
    """Calibrate from rendered corners and pictures of six boards, and count how often the stated region holds the
    truth."""
    counts = {"corners": corners, "pictures": pictures, "bad": pictures // 2}
    runs = [(kind, BOARDS[s % len(BOARDS)], call.seed + s) for kind, n in counts.items() for s in range(n)]
    return STUDY.outcome(call, {f"{k}, {b}, {s}": {"kind": k, "board": b, "seed": s} for k, b, s in runs})
