"""Study ray-cast frames: flanges found and imagined, and half-hidden ones."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import numpy as np

from tests.figures.harness import Cases, Figures, Results, Row, Study
from tests.worlds.flange_frames import WAYS, empty_frame, fit_frame, flange_frame, hidden_frame
from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import fit_flange
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.render import fixed, statistics

WidthOption = Annotated[int, option("--width", "PX", "Width of the PhoXi M images; 2064 is the full width.", min=200)]
FlangeName = Annotated[str, option("--flange", "NAME", "Flange standard.")]
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


def frame_cases(frames: int, empty: int, seed: int, width: int, flange: str = FLANGE) -> Cases:
    """``frames`` frames that show the flange and ``empty`` that do not."""
    of = {"width": width, "flange": flange}
    whole = {f"frame {k}": {**of, "rng": [seed, k], "kind": "whole"} for k in range(frames)}
    return whole | {f"empty frame {k}": {**of, "rng": [seed, 1, k], "kind": "empty"} for k in range(empty)}


def _frame_figures(results: Results) -> Figures:
    whole = [r for r in results.values() if r["kind"] == "whole"]
    good = [r["error_m"] for r in whole if r["reason"] is None]
    missed = [(k, r["reason"]) for k, r in enumerate(whole) if "mistaken" not in r]
    centre = statistics(good, "rms", "max")
    return {
        "frames": len(whole),
        "found": len(good),
        "mistaken": sum(r.get("mistaken", False) for r in whole),
        "imagined": sum(r.get("imagined", False) for r in results.values()),
        "centre_rms_mm": 1e3 * centre["rms"],
        "centre_max_mm": 1e3 * centre["max"] if good else 0.0,
        "missed": [{"frame": k, "reason": why} for k, why in missed],
    }


def _frame_rows(f: Figures) -> Iterable[Row]:
    yield "found", f"{f['found']} of {f['frames']} (wrong object detected: {f['mistaken']})"
    yield "false detections", f"{f['imagined']} of {f['frames']} frames without a flange"
    yield "centre", f"{f['centre_rms_mm']:.3f} mm rms, {f['centre_max_mm']:.3f} at most"


FRAMES = Study(
    name="flange-frames",
    what="The flange in ray-cast frames with and without one: detections, false detections and centre error.",
    case=fit_one,
    figures=_frame_figures,
    header=("", "found"),
    rows=_frame_rows,
)


@command("benchmark flange-frames", short_help="Count detections in frames with and without a flange.", hidden=True)
def frames(
    call: Call,
    count: Annotated[int, option("--frames", "N", "Number of frames with a flange, and without.", min=1)] = 500,
    width: WidthOption = 824,
    flange: FlangeName = FLANGE,
) -> Outcome:
    """Detect the flange in ray-cast frames with and without one: detections, false detections and centre error."""
    get_flange(flange)
    return FRAMES.outcome(call, frame_cases(count, count, call.seed, width, flange))


def hidden_cases(
    count: int, share: float, seed: int, width: int, flange: str = FLANGE, ways: Sequence[str] = WAYS
) -> Cases:
    """Return ``count`` frames of each obstacle that hides ``share`` of the flange's width."""
    of = {"width": width, "flange": flange, "share": share}
    return {f"{way} {k}": {**of, "rng": [seed, k], "kind": way} for way in ways for k in range(count)}


def _hidden_figures(results: Results) -> Figures:
    rows = []
    for way in dict.fromkeys(r["kind"] for r in results.values()):
        all_ = [r for r in results.values() if r["kind"] == way]
        good = [r for r in all_ if r["reason"] is None]
        rows.append(
            {
                "way": way,
                "frames": len(all_),
                "found": len(good),
                "centre_rms_mm": 1e3 * statistics((r["error_m"] for r in good), "rms")["rms"],
                "normalised": statistics((r["normalised"] for r in good), "mean")["mean"],
                "coverage": statistics((r["coverage"] for r in good), "mean")["mean"] if good else 0.0,
                "missed": [r["reason"] for r in all_ if r["reason"] is not None],
            }
        )
    return {"rows": rows}


def _hidden_rows(f: Figures) -> Iterable[Row]:
    for r in f["rows"]:
        found = (fixed(r["centre_rms_mm"], 3), fixed(r["normalised"]), f"{100 * r['coverage']:.0f} %")
        yield r["way"], f"{r['found']} of {r['frames']}", *found


HIDDEN = Study(
    name="flange-hidden",
    what="Flanges of which a part is hidden: detections, and errors in units of the stated uncertainty.",
    case=fit_one,
    figures=_hidden_figures,
    header=("hidden by", "found", "centre rms, mm", "squared error over stated variance", "of the edge seen"),
    rows=_hidden_rows,
)


@command("benchmark flange-hidden", short_help="Detect a flange that is partly hidden.", hidden=True)
def hidden(
    call: Call,
    count: Annotated[int, option("--frames", "N", "Number of frames for each kind of occlusion.", min=1)] = 30,
    share: Annotated[float, option("--share", "S", "Hidden share of the flange's width.", min=0.0, max=0.9)] = 0.5,
    width: WidthOption = 824,
    flange: FlangeName = FLANGE,
) -> Outcome:
    """Detect a flange partly hidden by a plate, the image border or missing readings: detections, and errors in units
    of the stated uncertainty."""
    get_flange(flange)
    return HIDDEN.outcome(call, hidden_cases(count, share, call.seed, width, flange))
