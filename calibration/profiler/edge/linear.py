"""The straight-edge paper's method: X_FS in two linear steps from a grid of rotations and translations.

As published it answers some degenerate motions with confident nonsense (collinear translations: 93 degrees off),
because the rank of its matrix does not show them in noise. Here these motions are named and refused. Kept beside
edge_joint to compare.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from weldcal.calibration.errors import DegenerateMotion, InconsistentData, TooFewRotations, TooFewTranslations
from weldcal.calibration.geometry.se3 import nearest_rotation, skew
from weldcal.calibration.profiler.motion import (
    FlangePoses,
    Floats,
    checked_points,
    rotation_axes_spread,
    rotation_groups,
)
from weldcal.models.errors import InputError

MINIMUM_GROUPS = 3
MINIMUM_TRANSLATIONS = 3
SMALL_M = 1e-3  # rms of a group's translations across their main direction: below, they are hardly more than noise
PLANAR = 0.05  # second over first singular value of a group's translations: below, they lie on a line
ONE_AXIS = 0.05  # of the axes between the orientations
ONE_EDGE_M = 2e-3  # rms of the orientations' middles off the edge: more than an arm is wrong by
ONE_EDGE = 2.0  # and over the rms within orientations, which noise and outliers raise likewise


@dataclass(frozen=True, eq=False)
class EdgeLinear:
    """The paper's result.

    R_FS (3, 3), p_FS (3,) m, the edge's unit direction (3,) in B and the distances (n,) m to it.
    """

    rotation: Floats
    translation: Floats
    direction: Floats
    distances_m: Floats


def edge_linear(
    rotation: ArrayLike, translation: ArrayLike, points: ArrayLike, group: ArrayLike | None = None
) -> EdgeLinear:
    """Rotation from parallel vectors (Eq. 24-27), then translation from points on one line (Eq. 28-35).

    Args:
        rotation: (n, 3, 3) R_BF; translation: (n, 3) p_BF m; points: (n, 2) profile points [x, z] m of the edge.
        group: (n,) which poses share an orientation; found where it is not given.

    Raises:
        InputError: shapes, numbers that are not finite, no rotation.
        TooFewRotations, TooFewTranslations: fewer than three orientations, or than three positions in one.
        DegenerateMotion: positions of a group on a line, or orientations about one axis only.
        InconsistentData: the orientations do not see one edge.
    """
    poses = FlangePoses.checked(rotation, translation)
    p = checked_points(points, len(poses))
    of = rotation_groups(poses) if group is None else np.asarray(group)
    if of.shape != (len(poses),):
        raise InputError(f"{len(poses)} poses need {len(poses)} group numbers, not an array of shape {of.shape}.")
    groups = [np.flatnonzero(of == g) for g in np.unique(of)]
    _refuse_degenerate(poses, groups)
    p_S = np.column_stack([p[:, 0], np.zeros(len(p)), p[:, 1]])
    R = _rotation(poses, p_S, groups)
    e = _direction(poses, p_S, groups, R)
    t, off = _translation(poses, p_S, R, e)
    _refuse_two_edges(off, groups)
    return EdgeLinear(R, t, e, np.linalg.norm(off, axis=1))


def _refuse_degenerate(poses: FlangePoses, groups: list[np.ndarray]) -> None:
    if len(groups) < MINIMUM_GROUPS:
        raise TooFewRotations(
            f"{len(groups)} orientations of the flange are too few: take {MINIMUM_GROUPS} or more, turned about"
            " different axes."
        )
    if min(len(g) for g in groups) < MINIMUM_TRANSLATIONS:
        raise TooFewTranslations(
            f"Each orientation needs {MINIMUM_TRANSLATIONS} positions or more: one has {min(len(g) for g in groups)}."
        )
    # along a line in every group the equations of Eq. 24 say nothing, and noise hides that from their rank
    flat = 0
    for g in groups:
        s = np.linalg.svd(poses.translation[g] - poses.translation[g].mean(axis=0), compute_uv=False)
        flat += bool(s[1] < max(PLANAR * s[0], SMALL_M * np.sqrt(len(g))))
    if len(groups) - flat < MINIMUM_GROUPS:
        raise DegenerateMotion(
            "The positions of the flange lie on a line, or within a millimetre, in (nearly) every orientation: move"
            " along an arc or in a plane."
        )
    if rotation_axes_spread(poses.rotation[[g[0] for g in groups]]) < ONE_AXIS:
        raise DegenerateMotion(
            "The flange turns about one axis only, which leaves the translation along it open: tilt it as well."
        )


def _refuse_two_edges(off: Floats, groups: list[np.ndarray]) -> None:
    middles = np.array([off[g].mean(axis=0) for g in groups])
    within = np.concatenate([off[g] - off[g].mean(axis=0) for g in groups])
    between = float(np.sqrt((middles**2).sum(axis=1).mean()))
    if between > max(ONE_EDGE_M, ONE_EDGE * float(np.sqrt((within**2).sum(axis=1).mean()))):
        raise InconsistentData(
            f"The orientations do not see one edge: they differ by {1e3 * between:.1f} mm (rms). Take one straight edge"
            " that stays in place, and the flange poses of these profiles."
        )


def _rotation(poses: FlangePoses, p_S: Floats, groups: list[np.ndarray]) -> Floats:
    rows, right = [], []
    for g in groups:
        R_BF = poses.rotation[g[0]]
        u_s, u_t = p_S[g[1:]] - p_S[g[0]], poses.translation[g[1:]] - poses.translation[g[0]]
        i, j = np.triu_indices(len(u_s), 1)
        B1, B2, B3 = (_kron(v, R_BF) for v in (np.cross(u_s[i], u_s[j]), u_s[i], u_s[j]))
        # Eq. 17 is the transposed cross product matrix: a x b = [b]x^T a
        A = B1 - skew(u_t[j]) @ B2 + skew(u_t[i]) @ B3
        rows.append(A.reshape(-1, 9))
        right.append(-np.cross(u_t[i], u_t[j]).ravel())
    r = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    return nearest_rotation(r.reshape(3, 3, order="F"))


def _kron(v: Floats, R: Floats) -> Floats:
    """Kronecker products v^T (x) R (m, 3, 9) for vectors (m, 3)."""
    return np.asarray(np.einsum("mk,ab->makb", v, R).reshape(len(v), 3, 9))


def _direction(poses: FlangePoses, p_S: Floats, groups: list[np.ndarray], R: Floats) -> Floats:
    """Eq. 5 and principal components of all vectors from the first point of a group to its others."""
    vectors = []
    for g in groups:
        u = (p_S[g[1:]] - p_S[g[0]]) @ (poses.rotation[g[0]] @ R).T + poses.translation[g[1:]] - poses.translation[g[0]]
        vectors.append(u)
    return np.asarray(np.linalg.svd(np.vstack(vectors))[2][0])


def _translation(poses: FlangePoses, p_S: Floats, R: Floats, e: Floats) -> tuple[Floats, Floats]:
    """p_FS and how far each point (n, 3) is off the edge, across it.

    Eq. 34 over all pairs is the centred system: rows less their mean (shown in docs/profiler.md), and n^2 times faster.
    """
    P = np.eye(3) - np.outer(e, e)
    A = P @ poses.rotation
    b = -(np.einsum("nij,nj->ni", poses.rotation, p_S @ R.T) + poses.translation) @ P
    A_c, b_c = A - A.mean(axis=0), b - b.mean(axis=0)
    t = np.linalg.lstsq(A_c.reshape(-1, 3), b_c.ravel(), rcond=None)[0]
    return t, np.asarray(A_c @ t - b_c)
