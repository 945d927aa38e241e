"""Scanners with a wrong scale: how often the stated 95 % regions hold X_BC and points that no scan saw."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.calibration.eye_on_base.test_left_uncorrected import scaled
from tests.calibration.planning.test_mounting_estimate import point_error
from tests.figures.harness import Run, figure
from tests.worlds.light_runs import mounted_world
from weldcal.calibration.eye_on_base.estimate import point_error_covariance
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly, left_uncorrected
from weldcal.calibration.eye_on_base.solve import SolveConfig
from weldcal.calibration.planning.mounting_estimate import solve_mounting


@figure("scanner-scale", "stated regions with a scanner scale of -0.3 to 0.3 %, with and without a correction")
def scanner_scale(run: Run) -> None:
    """Count regions that hold the truth: a correction chosen, not chosen, no hole in view, and a carried scanner."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for holes in (True, False):
        for seed in run.seeds(10, 250):
            X_BC, scale, observations, patterns = scaled(seed, holes)
            e, verdict = estimate_jointly(observations, patterns, config=SolveConfig(allow_coplanar=True))
            applied = verdict is not None and verdict.accepted is not None
            if not holes:
                e = left_uncorrected(estimate_jointly(observations, correct_scanner=False)[0], e)
            turn = Rotation.from_matrix((X_BC.rotation() @ e.X_BC.rotation().inverse()).matrix()).as_rotvec()
            d = np.concatenate([turn, X_BC.translation() - e.X_BC.translation()])
            inside = []
            rng = np.random.default_rng([seed, 6])
            for p in np.column_stack([rng.uniform(-0.12, 0.12, (20, 2)), rng.uniform(0.58, 0.82, 20)]):
                seen = p / scale if e.scanner is None else e.scanner.points(p / scale)
                off = e.X_BC @ seen - X_BC @ p
                C = point_error_covariance(e, X_BC @ p)
                inside.append(float(off @ np.linalg.solve(C, off) < chi2.ppf(0.95, 3)))
            of_X = float(d @ np.linalg.solve(e.covariance, d) < chi2.ppf(0.95, 6))
            kind = "no hole circle" if not holes else "correction chosen" if applied else "not chosen"
            rows.setdefault(kind, []).append((of_X, float(np.mean(inside))))
    for name in ("eye_in_hand", "eye_on_arm"):
        for seed in run.seeds(3, 60):
            for scans in (8, 14, 20):
                world = mounted_world(name, 2000 + seed, scans=scans)
                found = solve_mounting(world.scene, world.seen)
                off, C = point_error(world, found)
                of_X = float(found.normalised_error("X", world.true.X_LC) < chi2.ppf(0.95, 6))
                of_point = float(off @ np.linalg.solve(C, off) < chi2.ppf(0.95, 3))
                rows.setdefault(f"carried, {name}, -0.2 %", []).append((of_X, of_point))
    heads = ("", "sets", "X_BC inside", "points inside")
    table = [(k, str(len(v)), *(f"{100 * x:.1f} %" for x in np.mean(v, axis=0))) for k, v in rows.items()]
    run.table("", heads, table)
