"""Computes the 6x6 pose covariance of a plate's registration, and from it the sigma of the drawn seam.

Errors of neighbouring scan points are correlated, and so may be those of all points of one edge: which pixel is the
last on the plate repeats along an edge. Both are modelled; the figures were tuned on simulated scans and are tested on
others.
"""

import math

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform

from weldcal.models.workpieces.plate import Workpiece
from weldcal.welding.locate.planes import Floats

EDGE_PITCHES = 0.03  # error common to the points of an edge, in point distances
SCATTER_PITCHES = 0.20  # scatter of an edge's outermost points where their pixel phases are mixed
EDGE_NOISES = 0.25  # error of an edge per noise of the face: flying points increase with the scanner's noise
SLANT_PITCHES = 0.15  # error of an edge per tangent of the angle at which the face is seen
INSET_PITCHES = 0.25  # common to all edges
USUAL_SLANT_RAD = math.radians(8.0)
HEIGHT_FLOOR_M = 2e-6  # a plane's mean of any number of points; keeps the matrix regular


def outline_covariance(
    J: Floats,
    off: Floats,
    edges: npt.NDArray[np.int64],
    pitch: float,
    prior_weight: float,
    slant_rad: float | None,
    noise: float,
) -> Floats:
    """Compute the covariance (3,3) of x, y and turn of the outline fit.

    From its Jacobian J (M+1,4), whose last row is the inset's prior, and the distances `off` (M,) of the outermost
    points from their edges, m. slant_rad: between the face's normal and the sight; noise: of the face, m.
    """
    slant = math.tan(USUAL_SLANT_RAD if slant_rad is None else slant_rad)
    G = np.linalg.inv(J.T @ J) @ J.T
    middle = (G[:, :-1] * float(np.mean(np.square(off)))) @ G[:, :-1].T
    for edge in np.unique(edges):
        mine = edges == edge
        common = G[:, :-1][:, mine].sum(axis=1)
        # Along the pixel rows all points of an edge have one phase: they scatter little and share one error.
        hidden = max(0.0, (SCATTER_PITCHES * pitch) ** 2 - float(np.var(off[mine])))
        variance = hidden + pitch**2 * (EDGE_PITCHES**2 + (SLANT_PITCHES * slant) ** 2) + (EDGE_NOISES * noise) ** 2
        middle += np.outer(common, common) * variance
    middle += np.outer(G[:, -1], G[:, -1]) * (prior_weight * INSET_PITCHES * pitch) ** 2
    return np.asarray(middle[:3, :3])


def pose_covariance(face_P: Floats, in_plane: Floats, pitch: float) -> Floats:
    """(6,6), rotation then translation in P: the face's points (N,3) fix height and tilt, the outline the rest."""
    x, y, z = face_P.T
    A = np.column_stack([y, -x, np.ones(len(x))])  # height of a point under small turns about x and y and a lift
    variance = float(np.mean(np.square(z))) * points_per_independent(face_P, pitch)
    tilt = np.linalg.inv(A.T @ A) * variance
    out = np.zeros((6, 6))
    out[np.ix_([0, 1, 5], [0, 1, 5])] = tilt + np.diag([0.0, 0.0, HEIGHT_FLOOR_M**2])
    out[np.ix_([3, 4, 2], [3, 4, 2])] = in_plane
    return out


def points_per_independent(face_P: Floats, pitch: float) -> float:
    """Number of points per independent one, from the variance of means over patches against that of single points."""
    patch = np.floor(face_P[:, :2] / (6.0 * pitch)).astype(np.int64)
    patch -= patch.min(axis=0)
    number = patch[:, 0] * (int(patch[:, 1].max()) + 1) + patch[:, 1]
    count = np.bincount(number)
    mean = np.bincount(number, weights=face_P[:, 2])[count > 8] / count[count > 8]
    if len(mean) < 10:
        return 8.0
    expected = float(np.var(face_P[:, 2])) * float(np.mean(1.0 / count[count > 8]))
    return max(1.0, float(np.var(mean)) / max(expected, 1e-30))


def moved_covariance(covariance: Floats, X_PQ: RigidTransform) -> Floats:
    """The covariance expressed for frame Q, which is fixed in P."""
    R, p = X_PQ.rotation().matrix(), X_PQ.translation()
    cross = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
    A = np.zeros((6, 6))
    A[:3, :3] = R.T
    A[3:, 3:] = R.T
    A[3:, :3] = -R.T @ cross
    return np.asarray(A @ covariance @ A.T)


def seam_sigma(covariance: Floats, workpiece: Workpiece) -> float:
    """Rms over the drawn seam of the sigma of its sideways position in the face, m."""
    p, t = workpiece.seam_P[::20], workpiece.tangents_P[::20]
    n = np.cross(np.broadcast_to(workpiece.up_P, workpiece.seam_P.shape)[::20], t)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    row = np.column_stack([np.cross(p, n), n])
    return math.sqrt(float(np.mean(np.einsum("ij,jk,ik->i", row, covariance, row))))
