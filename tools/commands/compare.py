"""weldcal compare: are two results the same within their regions, and if not, in which direction?"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from weldcal.calibration.compared_results import LEVEL, ComparedResults, compare_results
from weldcal.tools.cli.options import LOOK, Call, Outcome, command
from weldcal.tools.report.first_screen import CARE, DO_NOT, USE, ExpectedError, Findings, FirstScreen, Next

SAME, DIFFER, NO_TEST = "the same within their regions", "they differ", "no comparison"
ResultArgument = Annotated[
    Path, typer.Argument(metavar="RESULT", help="Folder of calibrate, hand-eye or profiler, or its YAML file.")
]


@command("compare", common=(*LOOK, "verbose"), short_help="Say whether two results are the same within their regions.")
def compare(call: Call, first: ResultArgument, second: ResultArgument) -> Outcome:
    """Compare two results of one mounting that have no data in common: the difference, its squared Mahalanobis distance
    with the 95 % limit, and the direction that differs most. The exit code is 1 where they differ."""
    found = compare_results(first, second)
    screen = compare_screen(found)
    summary = {
        "verdict": screen.named,
        "reason": screen.reason,
        "pose": found.symbol,
        "squared_distance": found.square,
        "limit": found.limit,
        "origin_mm": found.origin_mm,
        "origin_deg": found.origin_deg,
        "work_mm": float(np.linalg.norm(found.work_mm)),
        "work_xyz_mm": list(found.work_mm),
        "work_p_mm": list(1e3 * found.work_p),
        "corrected": found.corrected,
        "direction": found.direction,
        "direction_sigmas": found.sigmas,
        "direction_share": found.share,
        "notes": list(screen.notes),
    }
    return Outcome({"state": "done", **summary}, values={}, first=screen)


def compare_screen(found: ComparedResults) -> FirstScreen:
    """Return the first screen of a comparison; its verdict is this command's own."""
    words = NO_TEST if found.shared else DIFFER if found.differ else SAME
    verdict = {NO_TEST: CARE, DIFFER: DO_NOT, SAME: USE}[words]
    side = "above" if found.differ else "within"
    reason = (
        f"The squared Mahalanobis distance is {found.square:.1f}, {side} its {100 * LEVEL:.0f} % limit of"
        f" {found.limit:.1f}."
    )
    if found.shared:
        reason = "The results have data in common, so that their errors are not independent and the test is invalid."
    x, y, z = 1e3 * found.work_p
    parent = "base" if found.symbol == "X_BC" else "flange"
    place = "the middle of the scans" if found.work_known else "taken 0.7 m before the sensor"
    applied = ", scanner corrections applied" if found.corrected else ""
    expected = ExpectedError(
        "difference at the work point",
        f"{np.linalg.norm(found.work_mm):.3f} mm and {found.origin_deg:.4f} deg",
        f"at ({x:.0f}, {y:.0f}, {z:.0f}) mm in the {parent}, {place}{applied}",
    )
    more = {"at the origin": f"{found.origin_mm:.3f} mm and {found.origin_deg:.4f} deg between the two {found.symbol}"}
    if not found.shared:
        more["differs most"] = (
            f"{found.direction}, {found.sigmas:.1f} sigma: {100 * found.share:.0f} % of the squared distance"
        )
    step = {
        SAME: Next("Use either result: the other one confirms it."),
        DIFFER: Next("Find what moved or was stated wrongly in the direction above. Verify both results on new scans."),
        NO_TEST: Next("Calibrate again from new data, and compare with that result."),
    }[words]
    return FirstScreen(Findings(settled=(verdict, reason), words=words, notes=found.notes), expected, step, (), more)
