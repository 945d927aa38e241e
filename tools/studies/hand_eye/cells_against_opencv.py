"""Compares weldcal's held-out errors with OpenCV's best on simulated cells whose errors the noise model does not have."""

import numpy as np

from weldcal.tools.farm.run import Farm
from weldcal.tools.studies.output import markdown_table
from weldcal.tools.worlds.imperfect_cells import KINDS, WEIGHTINGS, ratios

MARGIN = 0.02  # by which a method must be better to count as ahead


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
