"""The first screens of a tablet calibration: of one visit, of many visits, and of a run in simulation."""

from collections.abc import Mapping, Sequence

import numpy as np

from weldcal.calibration.tablet.result import TabletResult
from weldcal.models.arrays import Array
from weldcal.tools.outcomes.first_screen import Expected, Findings, FirstScreen, Next, ShownPose, Tolerance, after_hold

WORDS = "pose of the camera C in the robot's flange F"
NO_KEY = "No scenario key states how exact a touch must be: compare the error with what your job allows."
NOTHING = Expected("error of a touch, 95 %", "not known", "there is no calibration")


def tablet_screen(result: TabletResult, queries_mm: Array, limit_mm: float | None, no_tolerance: str) -> FirstScreen:
    """Of one visit. The error is that of a touch at a landmark which its fit did not use; of the file's queries (n,) mm where it has any."""
    left = np.array([v for v in result.leave_one_out_mm if v is not None])
    held, what = (queries_mm, "queries of the file") if queries_mm.size else (left, "landmarks")
    expected, tolerance = _touch(held, what, limit_mm)
    found = Findings(
        tolerance=tolerance,
        no_tolerance=no_tolerance,
        unseen=len(held),
        concerns=(*result.warnings, *result.unobservable),
    )
    poses, more = (), {"pose": "none: planar touches determine a map from the picture to the hand, in tablet.yaml"}
    if result.X_FC is not None and result.p_FP_m is not None:
        pen = ", ".join(f"{1e3 * v:.3f}" for v in result.p_FP_m)
        more = {"pen": f"its tip is at ({pen}) mm in the flange"}
        return FirstScreen(found, expected, _next(tolerance), (ShownPose("X_FC", WORDS, result.X_FC),), more)
    return FirstScreen(found, expected, _next(tolerance), poses, more)


def visits_screen(
    held_mm: Array,
    queried: bool,
    warnings: Sequence[str],
    refused: Sequence[tuple[str, str]],
    n: int,
    limit_mm: float | None,
) -> FirstScreen:
    """Of ``n`` visits, each calibrated by itself; ``held_mm`` are the errors of all of them."""
    expected, tolerance = _touch(held_mm, f"{'queries' if queried else 'landmarks'} in {n} visits", limit_mm)
    concerns = [*(f"Visit {name} was refused: {reason}" for name, reason in refused), *warnings]
    found = Findings(tolerance=tolerance, unseen=len(held_mm), concerns=concerns)
    more = {"pose": "none for all visits together: each visit has its parameters in visits.csv"}
    return FirstScreen(found, expected, _next(tolerance), (), more)


def run_screen(first: FirstScreen | None, reason: str, found: Mapping[str, object], ended: bool = False) -> FirstScreen:
    """Of a run in simulation: its calibration's (None: it was held before, or the operator `ended` it), with the errors that the simulation knows."""
    if first is None:
        lost = Findings(against=[reason or "The job was held."], unseen=0)
        return FirstScreen(lost, NOTHING, after_hold(ended), more={"pose": "none was found"})
    unseen = found["unseen_touch_mm"]
    assert isinstance(unseen, Mapping)
    truth = (
        f"camera off by {found['X_FC_error_mm']:.2f} mm and {found['X_FC_error_deg']:.3f} degrees; at 50 untouched points the pen is off by "
        f"{unseen['mean']:.3f} mm on average, {unseen['max']:.3f} at most (known in simulation only)"
    )
    return FirstScreen(first.found, first.expected, first.next, first.poses, {**first.more, "truth": truth})


def _touch(held_mm: Array, what: str, limit_mm: float | None) -> tuple[Expected, Tolerance | None]:
    held = held_mm[np.isfinite(held_mm)]
    p95 = float(np.percentile(held, 95)) if len(held) else float("nan")
    name = "error of a touch, 95 %"
    tolerance = None if limit_mm is None else Tolerance(f"the {name},", p95, limit_mm, "--limit-mm")
    if not len(held):
        return Expected(name, "not known", "no landmark could be left out"), tolerance
    return Expected(
        name, f"{p95:.3f} mm", f"of {len(held)} {what} that the fit did not use; mean {held.mean():.3f} mm"
    ), tolerance


def _next(tolerance: Tolerance | None) -> Next:
    if tolerance is not None and not tolerance.met:
        return Next("Touch more landmarks, with the pen tilted differently at each, then calibrate again.")
    return Next("Touch a point on the tablet that is no landmark, and compare.")
