"""A live run of the profiler's cell against the truth that only its simulation knows: poses in sigmas of their prediction, seam, torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.stats import chi2

from weldcal.calibration.profiler.result import ProfilerEstimate
from weldcal.systems.jobs.profiler.cell import ProfilerCell, ProfilerRun
from weldcal.systems.jobs.profiler.estimates import pose_sigmas
from weldcal.welding.record.process import path_error
from weldcal.welding.seam.curve import SeamCurve

Array = NDArray[np.float64]
JOINT_3_SIGMA = float(chi2.ppf(chi2.cdf(9.0, 1), 6))  # 20.06


@dataclass(frozen=True, eq=False)
class PoseOutcome:
    """X_FS against the truth: error, its prediction, each of six parts in its sigma, and e^T C^-1 e of all six."""

    error_mm: float
    error_deg: float
    sigma_mm: float
    sigma_deg: float
    parts: Array
    nees: float

    @property
    def within_3_sigma(self) -> bool:
        """Whether all six together are as likely as 3 sigma of one: 99.73 %."""
        return self.nees <= JOINT_3_SIGMA

    @property
    def largest(self) -> float:
        """Of the six parts, in sigmas."""
        return float(np.abs(self.parts).max())


@dataclass(frozen=True, eq=False)
class PathOutcome:
    """Something along the seam: where (n,) m, and beside and above (n,) m the line that it should be on."""

    s: Array
    lateral: Array
    height: Array

    @property
    def distance_mm(self) -> Array:
        """From the line (n,)."""
        return np.asarray(1e3 * np.hypot(self.lateral, self.height))


@dataclass(frozen=True, eq=False)
class LiveOutcome:
    """All that a run came to; None for what the scenario has not."""

    edge: PoseOutcome | None
    sphere: PoseOutcome | None
    tip_mm: float | None
    center_mm: float | None
    points: PathOutcome | None
    curve: PathOutcome | None
    torch: PathOutcome | None


def pose_outcome(estimate: ProfilerEstimate, X_FS: RigidTransform) -> PoseOutcome:
    """An estimate against the true X_FS."""
    R = X_FS.rotation() @ RotationMatrix.ProjectToRotationMatrix(estimate.rotation).inverse()
    error = RigidTransform(R, X_FS.translation() - estimate.translation)
    parts, nees = pose_sigmas(error, estimate.covariance)
    return PoseOutcome(
        error_mm=1e3 * float(np.linalg.norm(error.translation())),
        error_deg=float(np.degrees(abs(R.ToAngleAxis().angle()))),
        sigma_mm=1e3 * float(np.sqrt(np.trace(estimate.covariance[3:, 3:]))),
        sigma_deg=float(np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))),
        parts=parts,
        nees=nees,
    )


def live_outcome(cell: ProfilerCell, run: ProfilerRun) -> LiveOutcome:
    """The run against the truth of its station."""
    truth, s = cell.station.truth, run.state
    profiler = truth.profiler
    if profiler is None:
        raise RuntimeError("this station has no profiler")
    touched = s.sphere if s.sphere is not None and s.sphere.estimate.tip is not None else None
    tip = center = None
    if touched is not None and touched.estimate.tip is not None:
        tip = 1e3 * float(np.linalg.norm(touched.estimate.tip - profiler.p_FTip))
        center = 1e3 * float(np.linalg.norm(touched.estimate.center - profiler.center))
    points = curve = torch = None
    job = cell.scenario.profiler_job
    if s.seam is not None and truth.workpiece is not None and truth.X_BP is not None and job is not None:
        part, X = truth.workpiece, truth.X_BP
        up = X.rotation().matrix()[:, 2].copy()
        true = SeamCurve.from_points(X.multiply(np.asarray(part.seam_P).T).T, up)
        points = _off(s.seam.points_B, true)
        curve = _off(s.seam.curve.position(np.linspace(0.0, s.seam.curve.length, 300)), true)
        if len(run.torch_B):
            torch = _off(run.torch_B, true.raised(1e-3 * job.seam.above_root_mm))
    return LiveOutcome(
        edge=None if s.edge is None else pose_outcome(s.edge.estimate, profiler.X_FS),
        sphere=None if touched is None else pose_outcome(touched.estimate, profiler.X_FS),
        tip_mm=tip,
        center_mm=center,
        points=points,
        curve=curve,
        torch=torch,
    )


def _off(p: Array, line: SeamCurve) -> PathOutcome:
    error = path_error(p, line)
    return PathOutcome(error.s, error.lateral, error.height)
