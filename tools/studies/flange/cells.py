"""Calibrations of simulated cells without rendering: arms with errors of their own, and an imperfect scanner and
arm."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Annotated

import numpy as np
import typer

from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.studies.harness import Figures, Results, Row, Study, statistics
from weldcal.tools.worlds.arm_cells import calibrate_cell
from weldcal.tools.worlds.light_runs import LightRuns, study_light_runs
from weldcal.tools.worlds.wrong_models import Found, judged, station, study_station


def wrong_arm(seed: int, kind: str) -> Mapping[str, object]:
    """One world, plain and refined."""
    return {"kind": kind, **asdict(study_station(station(seed, links=kind == "links"), kind))}


def _arm_figures(results: Results) -> Figures:
    kinds = [r["kind"] for r in results.values()]
    found = [Found(**{k: np.array(v) for k, v in r.items() if k != "kind"}) for r in results.values()]
    return {"worlds": len(found), "kind": kinds[0], **judged(found)}


def _arm_rows(f: Figures) -> Iterable[Row]:
    yield "error at new scans, plain", f"{f['plain_mm']:.3f} mm mean"
    yield "error at new scans, refined", f"{f['refined_mm']:.3f} mm mean (ratio {f['ratio']:.2f})"
    yield "in the stated 95 % region", f"{f['inside_95_percent']:.1f} %"
    yield "joint offsets within 3 sigma", f"{f['offsets_within_3_sigma_percent']:.1f} %"


ARM = Study(
    name="flange-arm",
    what="UR10e cells with factory-size errors of the arm, calibrated from 20 planned scans, plain and refined.",
    case=wrong_arm,
    figures=_arm_figures,
    header=("", "found"),
    rows=_arm_rows,
)


@command("benchmark flange-arm", short_help="Calibrate cells with errors of the arm, and refine them.", hidden=True)
def arm(
    call: Call,
    worlds: Annotated[int, option("--worlds", "N", "Number of simulated cells.", min=1)] = 40,
    kind: Annotated[
        str, option("--kind", "KIND", "links: all errors of the arm; joints: zeros of the joints only.")
    ] = "links",
) -> Outcome:
    """Calibrate UR10e cells with factory-size errors of the arm from 20 planned scans, plain and refined, and judge
    both on new scans."""
    seeds = range(call.seed, call.seed + worlds)
    return ARM.outcome(call, {f"world {s}": {"seed": s, "kind": kind} for s in seeds})


def _imperfect(found: LightRuns) -> dict[str, object]:
    ours, rigid = (statistics(1e3 * v, "mean", "rms", "p95", "max") for v in (found.error_m, found.rigid_m))
    return {
        "runs": len(found.error_m),
        "scans_mean": float(np.mean(found.scans)),
        "at_work_mm": {"mean": ours["mean"], "p95": ours["p95"], "worst": ours["max"]},
        "rms_at_work_mm": ours["rms"],
        "expected_mm": float(1e3 * np.sqrt(np.mean(found.expected_m**2))),
        "inside_95": found.share_inside,
        "inside_95_chance": list(found.chance()),
        "rigid_at_work_mm": {"mean": rigid["mean"], "worst": rigid["max"]},
    }


def _imperfect_rows(f: Figures) -> Iterable[Row]:
    e, (low, high) = f["at_work_mm"], f["inside_95_chance"]
    yield (
        "error at the work point",
        (
            f"{e['mean']:.3f} mm mean, {e['p95']:.3f} 95 %, {e['worst']:.3f} at most ({f['rms_at_work_mm']:.3f} rms; "
            f"{f['expected_mm']:.3f} expected), from {f['scans_mean']:.1f} scans"
        ),
    )
    yield (
        "in the stated 95 % region",
        f"{100 * f['inside_95']:.1f} % of {f['runs']} (exact regions: {100 * low:.1f} to {100 * high:.1f} %)",
    )
    yield "without a scanner correction", "{mean:.3f} mm mean, {worst:.3f} at most".format(**f["rigid_at_work_mm"])


IMPERFECT = Study(
    name="flange-imperfect",
    what=(
        "Live calibrations with an imperfect scanner and arm, without rendering: errors, and how often they lie in the"
        " region."
    ),
    figures=lambda results: results["all"],
    header=("", "found"),
    rows=_imperfect_rows,
)


@command("benchmark flange-imperfect", short_help="Calibrate with an imperfect scanner and arm.", hidden=True)
def imperfect(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="[SCENARIO]", help="A scenario with simulated arm and scanner.")
    ] = "s_groove",
    runs: Annotated[int, option("--runs", "N", "Number of calibrations, each in its own world.", min=10)] = 200,
) -> Outcome:
    """Calibrate with an imperfect scanner and arm, without rendering: errors at the work point, and how often they lie
    in the stated 95 % region."""
    folder = IMPERFECT.folder(call)
    found = study_light_runs(load_scenario(scenario), runs, seed=call.seed, progress=call.progress)
    return IMPERFECT.measured({"all": _imperfect(found)}, folder).outcome()


def _start_figures(results: Results) -> Figures:
    of = results.values()
    counts: Figures = {k: Counter(str(r.get(k, "failed")) for r in of) for k in ("start", "calibration", "alone")}
    return {"cells": len(of), **counts, "start_mm": statistics(r.get("start_mm", np.nan) for r in of)}


def _start_rows(f: Figures) -> Iterable[Row]:
    yield from ((k, ", ".join(f"{n} {v}" for v, n in sorted(f[k].items()))) for k in ("start", "calibration", "alone"))
    yield "error of all starts at the work point", "{median:.0f} mm median, {p95:.0f} mm 95 %".format(**f["start_mm"])


START = Study(
    name="flange-start",
    what=(
        "Ray-cast cells of seven arms with a small, far or hidden flange, calibrated without a guess; the start is from"
        " three scans."
    ),
    case=calibrate_cell,
    figures=_start_figures,
    header=("", "found"),
    rows=_start_rows,
)


@command("benchmark flange-start", short_help="Calibrate cells whose flange is small, far or hidden.", hidden=True)
def start(call: Call, cells: Annotated[int, option("--cells", "N", "Number of cells.", min=1)] = 200) -> Outcome:
    """Calibrate ray-cast cells with a small, far or hidden flange without a guess, and start from the visible arm in
    three scans."""
    return START.outcome(call, {f"cell {call.seed + k}": {"seed": call.seed + k} for k in range(cells)})
