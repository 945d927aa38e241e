"""Hand-eye calibrations of simulated cells beside OpenCV's, and every mounting over several seeds."""

from typing import Any

import numpy as np

from tests.figures.harness import Run, figure
from tests.worlds.hand_eye import KINDS, WEIGHTINGS, ratios
from weldcal.calibration.planning.mounting_poses import work_point
from weldcal.systems.jobs.job import job_of
from weldcal.systems.scenario.loading import load_scenario, scenario_names
from weldcal.tools.commands.mounting_live import run_mounting_live
from weldcal.tools.report.first_screen import USE
from weldcal.tools.report.run import RunOptions

MARGIN = 0.02  # by which a method must be better to count as ahead


@figure("hand-eye-cells", "cells in which some OpenCV method has the smaller held-out error; 95 % ratio of deg and mm")
def hand_eye_cells(run: Run) -> None:
    """Compare with OpenCV's best on cells with a wrong camera matrix, a wrong robot, or both."""
    found: dict[str, list[dict[str, Any]]] = {}
    for k, kind in enumerate(KINDS):
        run.progress(kind, k / len(KINDS))
        found[kind] = [dict(ratios(kind, seed)) for seed in run.seeds(1, 40)]
    found["all"] = [cell for cells in found.values() for cell in cells]
    rows = []
    for kind, cells in found.items():
        each = [np.array([cell[name] for cell in cells]) for name in WEIGHTINGS]
        ahead = [100.0 * float((r > 1.0 + MARGIN).any(axis=1).mean()) for r in each]
        p95 = [np.percentile(r, 95, axis=0, method="lower") for r in each]
        rows.append((kind, *(f"{a:.0f} % ({deg:.2f}, {mm:.2f})" for a, (deg, mm) in zip(ahead, p95, strict=True))))
    run.table("", ("cells", *WEIGHTINGS), rows)


@figure("mountings", "every mounting calibrated live: errors against the truth, and in units of the covariance")
def mountings(run: Run) -> None:
    """Calibrate every mounting in simulation, with errors of scanner and arm."""
    rows = []
    names = [n for n in scenario_names() if job_of(load_scenario(n)).key == "mounting"]
    for name in run.size(["eye_on_base"], names):
        good = []
        for seed in run.seeds(1, 3):
            run.progress(f"{name}, seed {seed}", 0.0)
            options = RunOptions(scenario=name, out=run.out / name / f"seed{seed}", seed=seed, recording=False)
            report = run_mounting_live(load_scenario(name), options, run.progress)
            r = report.result
            if r is None or report.state != "done":
                run.say(f"{name}, seed {seed}: {report.reason}")
                continue
            assert report.device is not None
            p = work_point(report.scene)
            seen = report.device.measured(p)
            e = r.place(seen) - report.truth["X"] @ p
            good.append(
                {
                    "scans": len(report.status.seen),
                    "work_mm": 1e3 * float(np.linalg.norm(e)),
                    "bound_mm": 1e3 * report.status.error_95_m,
                    "nees_point": float(e @ np.linalg.solve(r.point_covariance(seen), e)) / 3.0,
                    "use": float(report.first.verdict == USE),
                    **{k: r.normalised_error(k, X) / 6.0 for k, X in report.truth.items() if k in r.poses},
                }
            )
        if good:
            of = {key: np.array([g[key] for g in good]) for key in good[0]}
            work = " / ".join(f"{v:.3f}" for v in np.percentile(of["work_mm"], [50, 95, 100]))
            inside = 100.0 * float((of["work_mm"] <= of["bound_mm"]).mean())
            nees = ", ".join(f"{k} {of[k].mean():.2f}" for k in report.truth if k in of)
            rows.append(
                (
                    *(name, str(len(good)), f"{of['scans'].mean():.1f}", work),
                    f"{np.median(of['bound_mm']):.3f} ({inside:.0f} %)",
                    *(nees, f"{of['nees_point'].mean():.2f}", f"{of['use'].sum():.0f}"),
                )
            )
    point = "scanned point at best distance, mm: median / 95 % / worst"
    stated = "stated 95 %, mm (errors within)"
    run.table("", ("scenario", "runs", "scans", point, stated, "NEES per unknown", "of the point", "use it"), rows)
