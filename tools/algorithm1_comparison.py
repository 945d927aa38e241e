"""Run Algorithm 1 on the scans of a calibration and compare its reported figure with its error at unused poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.results import IcpRecord, statistics
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, shuffled_orders
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.published.algorithm1 import (
    CentreVerification,
    Sight,
    Verification,
    VerificationError,
    Verifier,
    algorithm1_start,
    algorithm1_step,
    icp_error,
    make_verification,
    sight,
    translation_cost,
)
from weldcal.calibration.recorded_flange import RecordedFlange
from weldcal.models.arrays import Array
from weldcal.models.flanges import get_flange
from weldcal.tools.report.calibration import Algorithm1Outcome

FEWEST = 6
"""Inliers below which Algorithm 1 is not compared."""


@dataclass(frozen=True, kw_only=True)
class Algorithm1Run:
    """The end of one run of Algorithm 1: its calibration, its own figure, and errors (m) on poses outside its pool."""

    X_BC: RigidTransform
    error: VerificationError
    cost: float
    pool: tuple[str, ...]
    true_errors: Array
    counts: Array
    figures: Array
    path: tuple[RigidTransform, ...]


def run_algorithm1(observations: Sequence[Observation], verification: Verifier) -> Algorithm1Run | None:
    """Feed all observations, in order, to Algorithm 1 without a required error; None if it never registered."""
    state = algorithm1_start(e_required=1e-12, k_max=max(1, len(observations)))
    counts, figures, path = [], [], []
    for used, o in enumerate(observations, start=1):
        state = algorithm1_step(state, o, verification, translation_cost)
        if state.X_BC is None:
            continue
        counts.append(used)
        figures.append(state.cost)
        path.append(state.X_BC)
    if state.X_BC is None:
        return None
    inside = {o.id for o in state.pool}
    return Algorithm1Run(
        X_BC=state.X_BC,
        error=state.error,
        cost=state.cost,
        pool=tuple(o.id for o in state.pool),
        true_errors=position_errors(state.X_BC, [o for o in observations if o.id not in inside]),
        counts=np.array(counts, dtype=float),
        figures=np.array(figures),
        path=tuple(path),
    )


def algorithm1_curve(
    observations: Sequence[Observation], verification: Verifier, counts: Array, *, orders: int = 8, seed: int = 0
) -> tuple[Array, Array]:
    """Run Algorithm 1 over the orders of `convergence`.

    Returns:
        What it reports (orders, k) and its errors on the scans that were not used yet (rows, k), m, after ``counts``
        (k,) scans; NaN where open.
    """
    n = len(observations)
    figure, true = np.full((orders, len(counts)), np.nan), np.full((orders * n, len(counts)), np.nan)
    for r, shuffled in enumerate(shuffled_orders(observations, orders, seed)):
        run = run_algorithm1(shuffled, verification)
        for k, m in enumerate(counts.astype(int)):
            taken = 0 if run is None else int((run.counts <= m).sum())
            if run is not None and taken:
                figure[r, k] = run.figures[taken - 1]
                true[r * n : r * n + n - m, k] = position_errors(run.path[taken - 1], shuffled[m:])
    return figure, true


def compare_algorithm1(found: RecordedFlange) -> tuple[Algorithm1Outcome | None, tuple[IcpRecord, ...]]:
    """Run Algorithm 1 with the pose nearest the middle held out for verification; None for fewer than six inliers."""
    seen, inliers, seed = found.seen, found.inliers, found.result.seed
    if len(inliers) < FEWEST:
        return None, ()
    middle = np.median([o.p_BR for o in inliers], axis=0)
    held = min(inliers, key=lambda o: (float(np.linalg.norm(o.p_BR - middle)), o.id))
    pool = [o for o in seen.observations if o.id != held.id]
    good = [o for o in inliers if o.id != held.id]
    ours = estimate_eye_on_base(good, SolveConfig(seed=seed, leave_one_out=False)).X_BC
    icp: list[IcpRecord] = []
    shares: Sight | None = None
    verifier: Verifier
    if seen.clouds:
        standard = get_flange(found.result.flange)
        as_published = make_verification(seen.clouds[held.id], held.X_BR, standard, max_points=1500, seed=seed)
        verifier = as_published
        metric = "point-to-point ICP of the verification cloud against the flange's model"
        shares = sight(ours, as_published)
        for v in (as_published, replace(as_published, method="point_to_plane")):
            icp.append(_icp_record(held, ours, v))
        unseen = shares.unseen
    else:
        verifier = CentreVerification(held)
        metric = "distance of the verification pair's centre instead of the ICP, as there are no clouds"
        unseen = ("every rotation (one centre has none)", "the error at any other pose")
    run = run_algorithm1(pool, verifier)
    if run is None:
        return None, tuple(icp)
    true = run.true_errors[[o.id in {g.id for g in good} for o in pool if o.id not in run.pool]]
    outcome = Algorithm1Outcome(
        verification=held.id,
        metric=metric,
        figure_mm=1e3 * run.cost,
        true_mm=statistics(1e3 * true),
        at_verification_mm=1e3 * float(position_errors(run.X_BC, [held])[0]),
        unseen=unseen,
        shares=tuple(float(s) for s in shares.share) if shares is not None else (),
        curve=algorithm1_curve(inliers, verifier, found.convergence.counts, seed=seed),
    )
    return outcome, tuple(icp)


def _icp_record(held: Observation, X_BC: RigidTransform, verification: Verification) -> IcpRecord:
    """Return the published figure for our own calibration, made without the verification pose."""
    error = icp_error(X_BC, verification)
    (a, b, c), (x, y, z) = np.degrees(error.value[:3]).tolist(), (1e3 * error.value[3:]).tolist()
    return IcpRecord(
        id=held.id,
        method=verification.method,
        rotation_deg=(a, b, c),
        translation_mm=(x, y, z),
        translation_norm_mm=float(1e3 * np.linalg.norm(error.value[3:])),
        unseen=sight(X_BC, verification).unseen,
        true_error_mm=float(1e3 * position_errors(X_BC, [held])[0]),
    )
