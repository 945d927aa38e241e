"""Algorithm 1 on the scans of a calibration: its own figure, the truth on poses outside its pool, and its blind spots."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.data.results import (
    IcpRecord,
)
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import (
    Algorithm1Run,
    position_errors,
    run_algorithm1,
)
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.published.icp import (
    CentreVerification,
    Sight,
    Verification,
    Verifier,
    icp_error,
    make_verification,
    sight,
)
from weldcal.models.flanges import FlangeStandard

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Algorithm1Outcome:
    """Algorithm 1 on the same data: its own figure beside the truth on poses outside its pool, and the figure's blind
    spots.

    ``verification``: id of the pose held out for it. ``figure_mm`` is what Algorithm 1 reports; ``true_mm`` the errors
    at the flange on poses it did not use; ``unseen`` the components of a true error of which less than half enters the
    figure.
    """

    verification: str
    metric: str
    figure_mm: float
    true_mm: dict[str, float]
    at_verification_mm: float
    unseen: tuple[str, ...]
    shares: tuple[float, ...]
    run: Algorithm1Run

    @property
    def sentence(self) -> str:
        """One sentence for the terminal."""
        blind = f" ({self.metric}); it cannot see: {'; '.join(self.unseen)}" if self.unseen else f" ({self.metric})"
        return (
            f"Algorithm 1 reports {self.figure_mm:.3f} mm at its verification pose {self.verification}{blind}. "
            f"Its true error on poses it did not use: {self.true_mm['median']:.3f} mm median."
        )


def compare_algorithm1(
    observations: list[Observation],
    inliers: list[Observation],
    clouds: dict[str, Array],
    fits: dict[str, FlangeFit],
    standard: FlangeStandard,
    seed: int,
) -> tuple[Algorithm1Outcome | None, Verifier | None, tuple[IcpRecord, ...]]:
    """Algorithm 1 with one pose held out for verification: the one nearest the middle, where the arm will
    mostly work."""
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
        metric = "distance of the verification pair's centre, in place of the ICP, as there are no clouds"
        unseen = ("every rotation (one centre has none)", "the error at any other pose")
    run = run_algorithm1(pool, verifier)
    if run is None:
        return None, verifier, tuple(icp)
    true = run.true_errors[[o.id in {g.id for g in good} for o in pool if o.id not in run.pool]]
    outcome = Algorithm1Outcome(
        held.id,
        metric,
        1e3 * run.cost,
        summary_of(1e3 * true),
        1e3 * float(position_errors(run.X_BC, [held])[0]),
        unseen,
        tuple(float(s) for s in shares.share) if shares is not None else (),
        run,
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


def summary_of(values: Array) -> dict[str, float]:
    v = np.asarray(values, dtype=float)
    v = v[np.isfinite(v)]
    if len(v) == 0:
        return {"median": float("nan"), "mean": float("nan"), "p95": float("nan"), "max": float("nan")}
    return {
        "median": float(np.median(v)),
        "mean": float(v.mean()),
        "p95": float(np.percentile(v, 95)),
        "max": float(v.max()),
    }
