"""Study ray-cast frames: flanges found and imagined, and half-hidden ones."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.figures.harness import Run, figure
from tests.worlds.flange_frames import WAYS, empty_frame, fit_frame, flange_frame, hidden_frame
from weldcal.calibration.data.results import statistics
from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import fit_flange
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner
from weldcal.tools.report.render import fixed

FLANGE = "iso9409-1-50-4-m6"


SAME_PLACE_M = 0.001  # a flange reported farther from where it is, is another thing taken for it


def fit_one(width: int, flange: str, rng: Sequence[int], kind: str, share: float = 0.5) -> dict[str, Any]:
    """Fit the flange of one frame ("whole", "empty", or hidden, see WAYS): its error (m), or why there is none."""
    scanner, standard, draw = get_scanner("phoxi_m", width), get_flange(flange), np.random.default_rng(list(rng))
    try:
        if kind == "empty":
            fit_flange(empty_frame(scanner, standard, draw).points_C, standard)
            return {"kind": kind, "imagined": True}
        frame = (
            flange_frame(scanner, standard, draw)
            if kind == "whole"
            else hidden_frame(kind, scanner, standard, draw, share=share)
        )
        found = fit_frame(frame, standard)
    except FlangeNotFound as problem:
        return {"kind": kind, "reason": problem.reason}
    mistaken = found.error_m > SAME_PLACE_M
    reason = f"found {1e3 * found.error_m:.1f} mm off" if mistaken else None
    return {"kind": kind, "mistaken": mistaken, "reason": reason, **found._asdict()}


def counted(kind: str, fits: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Count the detections of frames of a kind; errors in mm."""
    good = [f for f in fits if f.get("reason", "") is None]
    centre = statistics((f["error_m"] for f in good), "rms", "max")
    return {
        "kind": kind,
        "frames": len(fits),
        "found": len(good),
        "mistaken": sum(f.get("mistaken", False) for f in fits),
        "imagined": sum(f.get("imagined", False) for f in fits),
        "rms_mm": 1e3 * centre["rms"],
        "max_mm": 1e3 * centre["max"],
        "normalised": statistics((f["normalised"] for f in good), "mean")["mean"],
        "coverage": statistics((f["coverage"] for f in good), "mean")["mean"],
    }


HALF_MPX = 824


@figure("flange-frames", "the flange in ray-cast frames with and without one: detections, false ones, centre error")
def frames(run: Run) -> None:
    """Detect the flange in as many frames with one as without."""
    seeds = range(run.size(4, 500))
    whole = counted("whole", [fit_one(HALF_MPX, FLANGE, (run.seed, k), "whole") for k in seeds])
    empty = counted("empty", [fit_one(HALF_MPX, FLANGE, (run.seed, 1, k), "empty") for k in seeds])
    rows = (
        ("found", f"{whole['found']} of {len(seeds)} (wrong object detected: {whole['mistaken']})"),
        ("false detections", f"{empty['imagined']} of {len(seeds)} frames without a flange"),
        ("centre", f"{whole['rms_mm']:.3f} mm rms, {whole['max_mm']:.3f} at most"),
    )
    run.table("", ("", "found"), rows)


@figure("flange-hidden", "flanges of which half is hidden: detections, and errors in units of the stated uncertainty")
def hidden(run: Run) -> None:
    """Hide half of the flange's width by a plate, the image border or missing readings."""
    every = [counted(w, [fit_one(HALF_MPX, FLANGE, (run.seed, k), w) for k in range(run.size(2, 30))]) for w in WAYS]
    rows = (
        (
            *(r["kind"], f"{r['found']} of {r['frames']}", fixed(r["rms_mm"], 3), fixed(r["normalised"])),
            f"{100 * r['coverage']:.0f} %",
        )
        for r in every
    )
    header = ("hidden by", "found", "centre rms, mm", "squared error over stated variance", "of the edge seen")
    run.table("", header, rows)
