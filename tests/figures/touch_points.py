"""How often touched points lie in the stated 95 % region, in light worlds whose truth is not the estimator's model."""

import numpy as np

from tests.figures.harness import Run, figure
from tests.worlds.touch import touch_world
from weldcal.calibration.data.results import statistics
from weldcal.calibration.touch.judge import judge_touches


@figure("touch", "how often points that the robot touches lie in the 95 % region that their calibration states")
def touch(run: Run) -> None:
    """Touch six points in each of many light worlds, and judge them."""
    judged = []
    for seed in run.seeds(20, 500):
        run.progress("touches", (seed - run.seed) / len(run.seeds(20, 500)))
        world = touch_world(seed)
        judged.append(judge_touches(world.result, world.touches))
    kinds = np.array([kind for j in judged for kind in j.features])
    error, limit, relative, inside, related = (
        np.concatenate([np.asarray(getattr(j, name), dtype=float) for j in judged])
        for name in ("error_m", "limit_m", "relative_m", "inside", "relative_inside")
    )
    known = np.isfinite(relative)
    e, r = (statistics(1e3 * np.abs(v), "median", "p95") for v in (error, relative[known]))
    alarms = 100.0 * np.mean([j.outside > j.most_outside for j in judged])
    rows = [
        ("touches", str(len(error))),
        ("in the stated 95 % region", f"{100.0 * inside.mean():.1f} %"),
        *((f"  of each {k}", f"{100.0 * inside[kinds == k].mean():.1f} %") for k in sorted(set(kinds))),
        ("error, median and 95 %", f"{e['median']:.3f} and {e['p95']:.3f} mm"),
        ("stated limit, median", f"{1e3 * np.median(limit):.3f} mm"),
        ("relative error, median and 95 %", f"{r['median']:.3f} and {r['p95']:.3f} mm"),
        ("relative, in its 95 % region", f"{100.0 * related[known].mean():.1f} %"),
        ("false alarms", f"{alarms:.1f} % of {len(judged)} worlds"),
    ]
    run.table("", ("of all touches", "found"), rows)
