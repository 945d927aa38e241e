"""Decide how the flange poses of profiles are to be read.

The target of the calibration must be one sphere or one edge.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from weldcal.calibration.data.poses.readings import PoseReading
from weldcal.calibration.errors import InconsistentData
from weldcal.calibration.geometry.robust import f_quantile
from weldcal.calibration.geometry.se3 import angle_of, exp_rotation
from weldcal.calibration.profiler.edge.joint import edge_optima
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.sphere.joint import sphere_optima
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.calibration.profiler.step_target import ShownSteps, fit_step
from weldcal.models.errors import WeldcalError

CHANCE = 1e-6  # as for readings of a dataset (eye_on_base/observations.py)
"""Chance that the right reading is rejected in favour of a wrong one."""
_KEPT = 0.7  # share of the scans that must agree: the others may be outliers
_FLOOR_M = 2e-6  # printed digits
_SIGMAS_M = (0.06e-3, 0.5e-3)  # of the robust loss of an edge, by which readings are compared
_LARGEST_M = 1e-3  # residual of a reading that may be used
_POINTS = 16  # points of a profile of the sphere that are compared
_STEP_M = 0.01e-3  # a choice: what one sigma of a step's height is taken for
_SAME_M, _SAME_RAD = 0.1e-3, 1e-3


@dataclass(frozen=True, eq=False)
class ReadingFit:
    """What a reading of the poses leaves.

    Squared residual (n,) m^2 of each scan, numbers that each scan contributes, unknowns, R_FS and p_FS.
    """

    square: Floats
    each: int
    unknowns: int
    rotation: Floats
    translation: Floats

    @property
    def kept(self) -> int:
        """Scans that must agree."""
        return max(int(np.ceil(_KEPT * len(self.square))), min(len(self.square), 5))

    @property
    def dof(self) -> int:
        """Degrees of freedom of the residual."""
        return max(self.each * self.kept - self.unknowns, 3)

    @property
    def rms_m(self) -> float:
        """Root mean square of the least residuals."""
        return float(np.sqrt(np.sort(self.square)[: self.kept].mean())) + _FLOOR_M


Fit = Callable[[FlangePoses], ReadingFit]


def flange_poses(reading: PoseReading) -> FlangePoses:
    """Return the poses of a reading."""
    return FlangePoses.checked(reading.X[:, :3, :3], reading.X[:, :3, 3])


def choose_reading(readings: Sequence[PoseReading], fit: Fit, what: str) -> tuple[int, str]:
    """Number of the reading under which the profiles show one target, and a sentence about it.

    If a reading were right, its residual would exceed that of the best by more than the root of the quantile of F(dof,
    dof) with probability CHANCE at most. Readings beyond it are rejected.

    Args:
        readings: the candidates, the usual one first.
        fit: solves for the profiler's pose with the poses of a reading. It also fits a motion that leaves a direction
            open: such a motion is no evidence against a reading. It raises WeldcalError for poses that cannot be fitted
            at all.
        what: the target, for messages: sphere or edge.

    Raises:
        InconsistentData: several readings agree and their results differ.
    """
    if len(readings) < 2:
        return 0, ""
    fits: dict[int, ReadingFit] = {}
    for k, one in enumerate(readings):
        try:
            fits[k] = fit(flange_poses(one))
        except (WeldcalError, np.linalg.LinAlgError):
            continue
    if not fits:
        return 0, ""
    order = sorted(fits, key=lambda k: fits[k].rms_m)
    best = fits[order[0]]
    if best.rms_m > _LARGEST_M:
        raise InconsistentData(
            f"No reading of the poses fits the profiles: the best of {len(readings)}, {readings[order[0]].words},"
            f" leaves {_mm(best)} of one {what}. Check that each profile has its own pose and shows the target, or"
            " state the form with --as robot-form=FORM."
        )
    limit = float(np.sqrt(f_quantile(1.0 - CHANCE / (2.0 * (len(readings) - 1)), best.dof, best.dof)))
    firm = [k for k in order if not readings[k].doubted]
    if firm and fits[firm[0]].rms_m <= limit * best.rms_m:
        order, best = firm, fits[firm[0]]
    alive = [k for k in order if fits[k].rms_m <= limit * best.rms_m]
    rivals = [k for k in alive[1:] if not _same(fits[k], best)]
    if rivals:
        one, other = readings[order[0]], readings[rivals[0]]
        raise InconsistentData(
            f"The profiles do not show how the poses are written: read as {one.words} they leave {_mm(best)} of one"
            f" {what}, as {other.words} {_mm(fits[rivals[0]])}, and the results differ. State the right one with"
            f" --as robot-form={one.form} or --as robot-form={other.form}, or take more scans with the flange turned"
            " about other axes."
        )
    dead = [k for k in order if k not in alive]
    chosen = min(alive)  # the usual one of those that are the same
    text = f"Poses read as {readings[chosen].words}: residuals {_mm(fits[chosen])}"
    if dead:
        text += f"; the next best reading leaves {_mm(fits[dead[0]])}"
    elif len(alive) > 1:
        text += "; another reading gives the same result"
    else:
        text += f"; the other {len(readings) - 1} readings fit no {what}"
    return chosen, text + "."


def _mm(fit: ReadingFit) -> str:
    return f"{1e3 * fit.rms_m:.3g} mm"


def _same(one: ReadingFit, other: ReadingFit) -> bool:
    turn = float(angle_of(one.rotation.T @ other.rotation))
    return turn < _SAME_RAD and float(np.linalg.norm(one.translation - other.translation)) < _SAME_M


def sphere_fit(profiles: Sequence[Floats], radius_m: float) -> Fit:
    """Return the comparison of readings by arcs (m, 2) m of one sphere, one for each pose."""
    thin = []
    for p in profiles:
        p = p[np.isfinite(p).all(axis=1)]
        thin.append(p[np.unique(np.linspace(0, len(p) - 1, _POINTS).round().astype(int))])

    def fit(poses: FlangePoses) -> ReadingFit:
        data = SphereData(poses=poses, profiles=thin, radius_m=radius_m)
        R, found = sphere_optima(data, SphereSigmas())[0]
        R, p_FS, centre = exp_rotation(found.x[:3]) @ R, found.x[3:6], found.x[6:9]
        square = []
        for k, p in enumerate(thin):
            p_F = np.column_stack([p[:, 0], np.zeros(len(p)), p[:, 1]]) @ R.T + p_FS
            at = p_F @ poses.rotation[k].T + poses.translation[k]
            square.append(float(np.mean((np.linalg.norm(at - centre, axis=1) - radius_m) ** 2)))
        return ReadingFit(np.array(square), 3, 9, R, p_FS)

    return fit


def step_fit(shown: ShownSteps) -> Fit:
    """Return the comparison of readings by profiles of one step target."""

    def fit(poses: FlangePoses) -> ReadingFit:
        R_BF = poses.rotation[shown.number]
        found = fit_step(R_BF, shown.gradient, shown.covariance)
        square = _STEP_M**2 * np.sum(found.off**2, axis=1)
        return ReadingFit(square, 2, 8, found.rotation, np.zeros(3))

    return fit


def edge_fit(points: Floats) -> Fit:
    """Return the comparison of readings by points (n, 2) m of one edge, one for each pose."""

    def fit(poses: FlangePoses) -> ReadingFit:
        fits = [_of_edge(edge_optima(poses, points, s, np.full(2, s))[0][0], poses, points) for s in _SIGMAS_M]
        return min(fits, key=lambda one: one.rms_m)

    return fit


def _of_edge(e: EdgeState, poses: FlangePoses, points: Floats) -> ReadingFit:
    p_S = np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]])
    p_F = p_S @ e.rotation.T + e.translation
    away = np.einsum("nij,nj->ni", poses.rotation, p_F) + poses.translation - e.point
    away -= np.outer(away @ e.direction, e.direction)
    return ReadingFit((away**2).sum(axis=1), 2, 10, e.rotation, e.translation)
