"""The result of a part's registration, its limits, and the errors that refuse it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform

from weldcal.welding.locate.registration_result import WorkpieceNotFound

Floats = npt.NDArray[np.float64]


class PartNotFound(WorkpieceNotFound):
    """The scan does not show this part, or too little of it."""


class AmbiguousPart(WorkpieceNotFound):
    """The scan agrees with several poses of the part; the text names the directions that are free."""


@dataclass(frozen=True, kw_only=True)
class PartConfig:
    """Limits of the search and of the decision.

    Attributes:
        min_points: fewest scan points on the part.
        min_agreement: smallest share that meet the part where it is predicted, of the rays that nothing keeps from it.
        min_met: the same of all rays predicted to meet it.
        max_violation: largest share that pass through it.
        max_goes_on: largest share of the edges that should end a seen face beyond which it goes on.
        min_seen: smallest share of the part's visible surface that the scan shows.
        rival: a rival at least this good, in the rays where the two differ, is as good.
        max_sigma_m: how uncertain any of the points that matter may be (rms over them, in the worst direction).
        reach_m, reach_rad: how far a guess may be off.
        turn_step_rad: step of the turns in the search.
        cell_m: cell of the search, at least; larger for a large scene.
    """

    min_points: int = 250
    min_agreement: float = 0.72
    min_met: float = 0.3
    max_violation: float = 0.13
    max_goes_on: float = 0.35
    min_seen: float = 0.35
    rival: float = 0.55
    max_sigma_m: float = 0.0015
    reach_m: float = 0.020
    reach_rad: float = math.radians(8.0)
    turn_step_rad: float = math.radians(6.0)
    cell_m: float = 0.004
    seed: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class PartRegistration:
    """The pose X_BP of a part, and how well the scan agrees with it.

    Attributes:
        covariance: (6,6) of the small motion of P in P that leads from X_BP to the truth, rotation (rad), translation
            (m).
        rms_m: rms distance of the scan's points from the part's surface, m.
        agreement: share of the rays predicted to meet the part that do.
        seen: share of the part's surface facing the scanner that the scan shows.
        confidence: 0 to 1: agreement less the share that pass through it, reduced by the best other pose.
        summary: the result in one sentence.
    """

    X_BP: RigidTransform
    covariance: Floats
    rms_m: float
    agreement: float
    seen: float
    confidence: float
    summary: str

    def spread_at(self, points_P: Floats) -> Floats:
        """Covariance (N,3,3) m^2 of each point (N,3) of the part, in P."""
        cross = np.zeros((len(points_P), 3, 6))
        x, y, z = points_P.T
        cross[:, 0, 1], cross[:, 0, 2] = z, -y
        cross[:, 1, 0], cross[:, 1, 2] = -z, x
        cross[:, 2, 0], cross[:, 2, 1] = y, -x
        cross[:, :, 3:] = np.eye(3)
        return np.asarray(cross @ self.covariance @ cross.transpose(0, 2, 1))

    def sigma_at(self, points_P: Floats) -> Floats:
        """Largest standard deviation (N,) of each point (N,3) of the part over all directions, m."""
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(self.spread_at(points_P))[:, -1], 0.0)))
