"""Calibrates a profiler by planes: the line that each profile shows lies on an unknown plane.

Source: Lembono, Suarez-Ruiz and Pham, SCALAR, 2018 (three planes); Sharifzadeh, Biro and Kinnell, Robotics and
Computer-Integrated Manufacturing 61 (2020) 101823 (one plane, moved to many tilts).
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.adjustment import Kind, Observed, Unknowns, adjust, helmert, soft_l1
from weldcal.calibration.errors import FeatureNotFound, TooFewTranslations
from weldcal.calibration.geometry.se3 import pose
from weldcal.calibration.profiler.combined.scans import PlaneScans
from weldcal.calibration.profiler.edge.features import MINIMUM_RUN, robust_line
from weldcal.calibration.profiler.edge.joint import cube_rotations
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.reading_choice import Fit, ReadingFit
from weldcal.calibration.profiler.returns import returns_of

MINIMUM_SCANS = 6  # two numbers each, for the six of the pose and three of a plane, and more to judge them
_MOST = 200  # points of a profile: pairs of them give the line's start
_ON_LINE = 0.6  # a choice: share of a profile that must lie on one line
_NOISE_M = 0.5e-3  # a choice: coarse profilers have less; two faces leave more
_STEPS = 60


def line_of(profile: Floats) -> tuple[Floats, float, float]:
    """Return two points (2, 2) m of the line of a profile, the standard deviation m of both, and that of a sample.

    They lie one standard deviation of x on both sides of the middle, where their errors are independent.

    Raises:
        FeatureNotFound: less than 60 % of the profile is one line, or it is not straight within 0.5 mm (rms).
    """
    p = returns_of(profile, MINIMUM_RUN, "plane")
    p = p[:: max(1, len(p) // _MOST)]
    a, b, sigma, n = robust_line(p[:, 0], p[:, 1])
    if n < _ON_LINE * len(p) or sigma > _NOISE_M:
        raise FeatureNotFound("The profile is no single line: bring the plane alone into the laser line.")
    x = p[:, 0].mean() + p[:, 0].std() * np.array([-1.0, 1.0])
    return np.column_stack([x, a + b * x]), sigma * float(np.sqrt(2.0 / n)), sigma


def plane_scans(
    poses: FlangePoses, profiles: Sequence[Floats], of: NDArray[np.intp], origin: Floats, X_FS: Floats | None = None
) -> PlaneScans:
    """Return the scans of planes, of which ``of`` (n,) numbers them from 0, about X_FS (4, 4) or from no start.

    Raises:
        FeatureNotFound: a profile is no line. TooFewTranslations: too few scans.
    """
    if len(poses) < MINIMUM_SCANS:
        raise TooFewTranslations(f"{len(poses)} profiles of planes are too few: take {MINIMUM_SCANS} or more.")
    lines = [line_of(p) for p in profiles]
    points, sigma = np.array([line[0] for line in lines]), np.array([line[1] for line in lines])
    x, z = np.moveaxis(points - origin, 2, 0)

    def about(X: Floats) -> PlaneScans:
        at = np.insert(points, 1, 0.0, axis=2) @ np.swapaxes(poses.rotation @ X[:3, :3], 1, 2)
        at += (poses.rotation @ X[:3, 3] + poses.translation)[:, None]
        groups = [at[of == k].reshape(-1, 3) for k in range(int(of.max()) + 1)]
        normal = np.array([np.linalg.svd(g - g.mean(axis=0))[2][2] for g in groups])
        n_S = np.einsum("nji,nj->ni", poses.rotation @ X[:3, :3], normal[of])
        by = np.stack([n_S[:, :1] * x, n_S[:, 2:] * z, n_S[:, :1] * z + n_S[:, 2:] * x], axis=2)
        return PlaneScans(
            name="planes",
            poses=poses,
            own=(sigma**2)[:, None, None] * np.eye(2),
            by_sensor=by,
            numbers=np.zeros(3 * len(groups)),
            known=np.full(3 * len(groups), np.inf),
            X_FS=X if X_FS is None else None,
            points=points,
            of=of,
            normal=normal,
            middle=np.array([g.mean(axis=0) for g in groups]),
        )

    return about(X_FS if X_FS is not None else _start(poses, about))


def planes_fit(profiles: Sequence[Floats], of: NDArray[np.intp]) -> Fit:
    """Return the comparison of readings of the poses by profiles of planes, one for each pose."""

    def fit(poses: FlangePoses) -> ReadingFit:
        scans = plane_scans(poses, profiles, of, np.zeros(2))
        assert scans.X_FS is not None
        R, t = scans.X_FS[:3, :3], scans.X_FS[:3, 3]
        placed = scans.placed(poses.rotation @ R, poses.rotation @ t + poses.translation, scans.numbers)
        return ReadingFit(np.mean(placed.e**2, axis=1), 2, 6 + len(scans.numbers), R, t)

    return fit


def _start(poses: FlangePoses, about: Callable[[Floats], PlaneScans]) -> Floats:
    """Return X_FS (4, 4) from the 24 orientations of a cube, each with its planes and the position linear in them."""
    found = []
    for R in cube_rotations():
        scans: PlaneScans = about(pose(R, np.zeros(3)))

        def rows(at: Unknowns, scans: PlaneScans = scans) -> list[Observed]:
            X = at.poses[0]
            R_BS, p_BS = poses.rotation @ X[:3, :3], poses.rotation @ X[:3, 3] + poses.translation
            placed = scans.placed(R_BS, p_BS, at.numbers)
            to_S = np.kron(np.eye(2), X[:3, :3].T)
            return [Observed(placed.e, np.concatenate([placed.twist @ to_S, placed.numbers], axis=2))]

        kind = Kind(rank=2.0, loss=soft_l1, spread=helmert)
        best = adjust(Unknowns((pose(R, np.zeros(3)),), scans.numbers), rows, [kind], steps=_STEPS)
        found.append((float(np.median(np.abs(best.rows[0].e))), best.at.poses[0]))
    return min(found, key=lambda one: one[0])[1]
