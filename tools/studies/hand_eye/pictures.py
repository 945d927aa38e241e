"""How often the stated region of a calibration from pictures holds the truth, and its error beside OpenCV's on the same
corners."""

from collections.abc import Iterable
from typing import Annotated

import numpy as np

from weldcal.calibration.hand_eye.opencv_methods import METHODS
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.studies.harness import Figures, Results, Row, Study
from weldcal.tools.studies.targets import Target
from weldcal.tools.worlds.board_pictures import BOARDS, calibrated


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
