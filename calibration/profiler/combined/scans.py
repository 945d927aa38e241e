"""Reduces the scans of an edge, a sphere or planes to a few numbers each, and predicts these from the mounting.

An edge gives its point [x, z], a sphere the circle [x, z, r] of its arc, a plane two points of its line, which lie off
the plane by nothing. All are compared in the scan plane's frame S, where a twist of S says what any error of the
mounting or of the arm does.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import frames_along, skew
from weldcal.calibration.profiler.edge.model import EdgeState, predicted
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.sphere.arc import fit_circle
from weldcal.calibration.profiler.sphere.model import corrected

RADIUS_M = 0.58e-3  # of an edge's break: the root mean square of 0 to 1 mm, the usual ones of ISO 13715
EXACT = 1e-7  # m or rad: sigma of what is not free; below any effect, and the equations stay well scaled
SPHERE_M = 5e-6  # of a stated radius: balls of ISO 3290 grade 40 and better
_GRAZING = np.radians(75.0)  # beyond it no profiler measures the near face
_STEP = 1e-4  # of scale and shear, for differences of circles
_LEAST = 0.05  # of the sphere's radius: a smaller circle says nothing of how far the centre is


@dataclass(frozen=True, eq=False)
class PredictedScans:
    """Predicted less measured numbers e (n, k) m, and derivatives.

    ``twist`` (n, k, 6) by [turn; shift] of S in its own axes, ``numbers`` (n, k, m) by the feature's numbers.
    """

    e: Floats
    twist: Floats
    numbers: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class FeatureScans(ABC):
    """Scans of one feature.

    Attributes:
        name: edge, sphere or planes.
        poses: flange at each scan.
        own: covariance (n, k, k) m^2 of the numbers by the sensor's noise.
        by_sensor: derivatives (n, k, 3) of e by scale and shear about ``origin`` (2,) m.
        numbers: (m,) of the feature at the start; known: sigmas (m,) of what is known of them, infinite where nothing.
        X_FS: (4, 4) by these scans alone, None where they do not determine it.
    """

    name: str
    poses: FlangePoses
    own: Floats
    by_sensor: Floats
    numbers: Floats
    known: Floats
    X_FS: Floats | None = None

    @abstractmethod
    def placed(self, R_BS: Floats, p_BS: Floats, numbers: Floats) -> PredictedScans:
        """Predict the scans with the scan plane at poses R_BS (n, 3, 3), p_BS (n, 3)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeScans(FeatureScans):
    """Points (n, 2) m of an edge; its numbers: point and direction across the start's, and the radius of its break.

    ``break_by`` (n,): how far the found point moves along ``inward`` (3,) in B, per radius.
    """

    points: Floats
    start: EdgeState
    break_by: Floats
    inward: Floats

    def placed(self, R_BS: Floats, p_BS: Floats, numbers: Floats) -> PredictedScans:
        """See FeatureScans: the model of edge_joint with S as its flange, and the break."""
        across = frames_along(self.start.direction)[:, :2]
        e = self.start.direction + across @ numbers[2:4]
        e /= np.linalg.norm(e)
        point = self.start.point + across @ numbers[:2]
        p, J, by_robot = predicted(EdgeState(np.eye(3), np.zeros(3), point, e), FlangePoses(R_BS, p_BS))
        to_start = frames_along(e)[:, :2].T @ across
        by_break = -np.einsum("nai,i,n->na", by_robot, self.inward, self.break_by)
        by = np.concatenate([J[:, :, 6:8] @ to_start, J[:, :, 8:10] @ to_start, by_break[:, :, None]], axis=2)
        return PredictedScans(p + numbers[4] * by_break - self.points, J[:, :, :6], by)


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereScans(FeatureScans):
    """Circles (n, 3) m [x, z, r] of a sphere; its numbers: centre in B and radius."""

    circles: Floats

    def placed(self, R_BS: Floats, p_BS: Floats, numbers: Floats) -> PredictedScans:
        """See FeatureScans."""
        c = np.einsum("nji,nj->ni", R_BS, numbers[:3] - p_BS)
        radius = numbers[3]
        r = np.sqrt(np.maximum(radius**2 - c[:, 1] ** 2, (_LEAST * radius) ** 2))
        K = np.zeros((len(c), 3, 3))
        K[:, 0, 0] = K[:, 1, 2] = 1.0
        K[:, 2, 1] = -c[:, 1] / r
        twist = np.concatenate([K @ skew(c), -K], axis=2)
        by_radius = np.zeros((len(c), 3, 1))
        by_radius[:, 2, 0] = radius / r
        e = np.column_stack([c[:, 0], c[:, 2], r]) - self.circles
        return PredictedScans(e, twist, np.concatenate([K @ np.swapaxes(R_BS, 1, 2), by_radius], axis=2))


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaneScans(FeatureScans):
    """Two points (n, 2, 2) m of the line in each profile of a plane; ``of`` (n,): which plane.

    Numbers of each plane: two of its normal across that of the start (p, 3), and the distance from ``middle`` (p, 3) m.
    """

    points: Floats
    of: NDArray[np.intp]
    normal: Floats
    middle: Floats

    def placed(self, R_BS: Floats, p_BS: Floats, numbers: Floats) -> PredictedScans:
        """See FeatureScans: e is how far the points lie beyond the plane."""
        each = numbers.reshape(-1, 3)
        across = frames_along(self.normal)[:, :, :2]
        long = self.normal + (across @ each[:, :2, None])[:, :, 0]
        length = np.linalg.norm(long, axis=1)
        n = (long / length[:, None])[self.of]
        p_S = np.insert(self.points, 1, 0.0, axis=2)
        at = p_S @ np.swapaxes(R_BS, 1, 2) + (p_BS - self.middle[self.of])[:, None]
        n_S = np.einsum("nji,nj->ni", R_BS, n)
        twist = np.concatenate([np.cross(p_S, n_S[:, None]), np.repeat(n_S[:, None], 2, axis=1)], axis=2)
        by = np.zeros((len(n), 2, len(each), 3))
        tilt = (np.eye(3) - n[:, :, None] * n[:, None, :]) @ (across / length[:, None, None])[self.of]
        by[np.arange(len(n)), :, self.of, :2] = at @ tilt
        by[np.arange(len(n)), :, self.of, 2] = -1.0
        e = np.einsum("nki,ni->nk", at, n) - each[self.of, 2:]
        return PredictedScans(e, twist, by.reshape(len(n), 2, -1))


def edge_scans(
    poses: FlangePoses,
    points: Floats,
    start: EdgeState,
    *,
    sigma_xz_m: Floats,
    origin: Floats,
    faces: Floats | None = None,
    away: float = 1.0,
    radius_m: float = RADIUS_M,
) -> EdgeScans:
    """Return the scans of an edge about an estimate of it.

    Args:
        points: (n, 2) m; sigma_xz_m: (2,) of them; origin: (2,) m of scale and shear.
        faces: (n, 2) direction [x, z] of the near face in each profile, away from the edge; None: a break does not move
            the feature, such as the apex of a blade. away: 1 where z grows away from the sensor, else -1.
        radius_m: one sigma of the break's radius, which is unknown.
    """
    M = poses.rotation @ start.rotation
    break_by, inward = np.zeros(len(points)), np.zeros(3)
    if faces is not None:
        across = np.eye(3) - np.outer(start.direction, start.direction)
        along = np.einsum("nia,na->ni", M[:, :, [0, 2]], faces) @ across
        inward = (along / np.linalg.norm(along, axis=1, keepdims=True)).mean(axis=0)
        inward /= np.linalg.norm(inward)
        rays, down = away * M[:, :, 2], np.cross(start.direction, inward)
        down *= np.sign((rays @ down).sum())
        hidden = np.clip(np.arctan2(-rays @ inward, rays @ down), 0.0, _GRAZING)
        # the last ray that is not hidden touches the break; the near face, prolonged, is cut there
        break_by = (np.cos(hidden) + np.sin(hidden) - 1.0) / np.cos(hidden)
    x, z = (points - origin).T
    zero = np.zeros_like(x)
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = start.rotation, start.translation
    return EdgeScans(
        name="edge",
        poses=poses,
        own=np.broadcast_to(np.diag(np.asarray(sigma_xz_m) ** 2), (len(points), 2, 2)),
        by_sensor=-np.stack([np.column_stack([x, zero, z]), np.column_stack([zero, z, x])], axis=1),
        numbers=np.zeros(5),
        known=np.array([*[np.inf] * 4, EXACT if faces is None else radius_m]),
        X_FS=X,
        points=points,
        start=start,
        break_by=break_by,
        inward=inward,
    )


def sphere_scans(
    poses: FlangePoses, arcs: Sequence[Floats], radius_m: float, centre: Floats, X_FS: Floats, origin: Floats
) -> SphereScans:
    """Return the scans of a sphere from the points (m, 2) m of their arcs, its centre (3,) m in B and X_FS (4, 4)."""
    found = [fit_circle(p) for p in arcs]
    circles = np.array([circle for circle, _ in found])
    n = np.array([len(p) for p in arcs])
    noise = float(np.sqrt(np.sum(n * np.square([rms for _, rms in found])) / np.sum(n - 3)))
    own, by_sensor = np.empty((len(arcs), 3, 3)), np.empty((len(arcs), 3, 3))
    for k, p in enumerate(arcs):
        off = p - circles[k, :2]
        J = np.column_stack([off / np.linalg.norm(off, axis=1, keepdims=True), np.ones(len(p))])
        own[k] = noise**2 * np.linalg.inv(J.T @ J)
        for j in range(3):
            changed = corrected(p, _STEP * np.eye(3)[j], origin)[:, [0, 2]]
            by_sensor[k, :, j] = -(fit_circle(changed)[0] - circles[k]) / _STEP
    return SphereScans(
        name="sphere",
        poses=poses,
        own=own,
        by_sensor=by_sensor,
        numbers=np.array([*centre, radius_m]),
        known=np.array([*[np.inf] * 3, SPHERE_M]),
        X_FS=X_FS,
        circles=circles,
    )
