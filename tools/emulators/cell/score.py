"""The contents of the truth file: where the scanner stands, how far the torch was from the true seam, and how the job
ended."""

import numpy as np

from weldcal.tools.emulators.cell.physics import Physics
from weldcal.tools.report.weld import true_seam
from weldcal.welding.record.process import path_error

FEWEST = 30  # points with a burning arc
WELDED = 0.95  # share of the wanted length


def score(physics: Physics, wanted_m: float | None, *, arc_burns: bool, at_rest: bool) -> dict[str, object]:
    """The contents of the truth file. `wanted_m` is the arc length to weld; None: the whole seam.

    `state` is what the world can see: waiting (no arc yet), welding, done (the arc has gone off, the arm is at rest,
    the seam's length is welded and nothing collided), or stopped.
    """
    truth = physics.station.truth
    found: dict[str, object] = {}
    if truth.X_BC is not None:
        found["X_BC"] = truth.X_BC.GetAsMatrix4().tolist()
    if truth.profiler is not None:
        found["X_FS"] = truth.profiler.X_FS.GetAsMatrix4().tolist()
        found["p_FTip"], found["sphere_center"] = truth.profiler.p_FTip.tolist(), truth.profiler.center.tolist()
    seam = true_seam(truth)
    if seam is None:  # a world without a workpiece
        return found | {"collisions": physics.collisions, "time_s": physics.time_s}
    welded_m = 0.0
    if len(physics.torch) >= FEWEST:
        error = path_error(np.array(physics.torch), seam)
        distance = 1e3 * np.hypot(error.lateral, error.height)
        welded_m = float(error.s.max() - error.s.min())
        found |= {
            "torch_mean_mm": float(distance.mean()),
            "torch_max_mm": float(distance.max()),
            "torch_lateral_mean_mm": 1e3 * error.mean_m,
            "torch_lateral_max_mm": 1e3 * error.max_m,
        }
    else:
        found |= {"torch_mean_mm": None, "torch_max_mm": None}
    whole = welded_m >= WELDED * (seam.length if wanted_m is None else wanted_m)
    state = "waiting"
    if physics.arc_on_s:
        good = whole and physics.collisions == 0
        state = "welding" if arc_burns else ("done" if good and at_rest else "stopped")
    return found | {
        "arc_on_s": physics.arc_on_s,
        "welded_mm": 1e3 * welded_m,
        "collisions": physics.collisions,
        "state": state,
        "time_s": physics.time_s,
    }
