"""Compares weldcal's held-out errors with OpenCV's best on simulated cells whose errors the noise model does not have."""

import numpy as np

from weldcal.calibration.hand_eye.choice import CANDIDATES, Candidate
from weldcal.calibration.hand_eye.opencv_methods import METHODS, opencv_held_out
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem
from weldcal.models.errors import WeldcalError
from weldcal.tools.farm.run import Farm
from weldcal.tools.studies.hand_eye.imperfect_cells import KINDS, imperfect_cell
from weldcal.tools.studies.output import markdown_table

WEIGHTINGS: dict[str, tuple[Candidate, ...]] = {
    "weldcal": CANDIDATES,
    "least squares alone": CANDIDATES[:1],
    "rotations alone": CANDIDATES[5:6],
}
NO_ANSWER = 1e9  # the ratio where weldcal gives none: the worst one
MARGIN = 0.02  # by which a method must be better to count as ahead


def ratios(kind: str, seed: int) -> dict[str, list[float]]:
    """Held-out errors (deg, mm) of each of WEIGHTINGS in one cell over the best of OpenCV's methods in that column."""
    cell = imperfect_cell(kind, seed)
    theirs = [opencv_held_out(m, cell.F, cell.G) for m in METHODS]
    whole = [h for h in theirs if np.isfinite(h.translation).all()]
    best = min(h.rms_deg for h in whole), min(h.rms_translation for h in whole)
    out = {}
    for name, weightings in WEIGHTINGS.items():
        try:
            ours = solve_problem(full_problem(cell.F, cell.G), config=HandEyeConfig(candidates=weightings)).held_out
            out[name] = [ours.rms_deg / best[0], ours.rms_translation / best[1]]
        except WeldcalError:
            out[name] = [NO_ANSWER, NO_ANSWER]
    return out


def run_cells(farm: Farm, runs: int, seed: int = 0) -> tuple[dict[str, object], str]:
    """``runs`` cells of each kind: in how many of a hundred some OpenCV method is ahead in a column by more than MARGIN, and the
    95th percentile of the ratio in each column. Returns the JSON object and a table."""
    tasks = {f"{kind}, cell {s}": {"kind": kind, "seed": s} for kind in KINDS for s in range(seed, seed + runs)}
    cells = list(farm.run(ratios, tasks).values())
    found = [
        {name: np.array([cell[name] for cell in cells[k * runs : (k + 1) * runs]]) for name in WEIGHTINGS}
        for k in range(len(KINDS))
    ]
    rows, summary = [], {}
    for kind, ratio in (
        *zip(KINDS, found, strict=True),
        ("all", {n: np.vstack([f[n] for f in found]) for n in WEIGHTINGS}),
    ):
        row = [kind]
        for name in WEIGHTINGS:
            ahead = 100.0 * float((ratio[name] > 1.0 + MARGIN).any(axis=1).mean())
            deg, mm = (float(v) for v in np.percentile(ratio[name], 95, axis=0, method="lower"))
            row.append(f"{ahead:.0f} % ({deg:.2f}, {mm:.2f})")
            summary[f"{kind}, {name}"] = {"opencv_ahead_percent": ahead, "p95_deg": deg, "p95_mm": mm}
        rows.append(tuple(row))
    return {"state": "done", "runs": runs, "cells": summary}, markdown_table(("cells", *WEIGHTINGS), rows)
