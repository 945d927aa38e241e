"""Runs Algorithm 1 on the scans of a calibration and compares its reported figure with its error at unused poses."""

from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.results import IcpRecord
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, run_algorithm1
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.published.algorithm1 import (
    CentreVerification,
    Sight,
    Verification,
    Verifier,
    icp_error,
    make_verification,
    sight,
)
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard
from weldcal.tools.report.calibration import Algorithm1Outcome, error_summary


def compare_algorithm1(
    observations: list[Observation],
    inliers: list[Observation],
    clouds: dict[str, Array],
    fits: dict[str, FlangeFit],
    standard: FlangeStandard,
    seed: int,
) -> tuple[Algorithm1Outcome | None, Verifier | None, tuple[IcpRecord, ...]]:
    """Algorithm 1 with the pose nearest the middle held out for verification; None for fewer than six inliers."""
    if len(inliers) < 6:
        return None, None, ()
    middle = np.median([o.p_BR for o in inliers], axis=0)
    held = min(inliers, key=lambda o: (float(np.linalg.norm(o.p_BR - middle)), o.id))
    pool = [o for o in observations if o.id != held.id]
    good = [o for o in inliers if o.id != held.id]
    ours = estimate_eye_on_base(good, SolveConfig(seed=seed, leave_one_out=False)).X_BC
    icp: list[IcpRecord] = []
    shares: Sight | None = None
    verifier: Verifier
    if clouds:
        as_published = make_verification(clouds[held.id], held.X_BR, standard, max_points=1500, seed=seed)
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
        return None, verifier, tuple(icp)
    true = run.true_errors[[o.id in {g.id for g in good} for o in pool if o.id not in run.pool]]
    outcome = Algorithm1Outcome(
        verification=held.id,
        metric=metric,
        figure_mm=1e3 * run.cost,
        true_mm=error_summary(1e3 * true),
        at_verification_mm=1e3 * float(position_errors(run.X_BC, [held])[0]),
        unseen=unseen,
        shares=tuple(float(s) for s in shares.share) if shares is not None else (),
        run=run,
    )
    return outcome, verifier, tuple(icp)


def _icp_record(held: Observation, X_BC: RigidTransform, verification: Verification) -> IcpRecord:
    """The published figure for our own calibration, made without the verification pose."""
    error = icp_error(X_BC, verification)
    return IcpRecord(
        id=held.id,
        method=verification.method,
        rotation_deg=tuple(float(v) for v in np.degrees(error.value[:3])),
        translation_mm=tuple(float(v) for v in 1e3 * error.value[3:]),
        translation_norm_mm=float(1e3 * np.linalg.norm(error.value[3:])),
        unseen=sight(X_BC, verification).unseen,
        true_error_mm=float(1e3 * position_errors(X_BC, [held])[0]),
    )
