"""Information of a patch of the flange's surface on an error of its pose, and the components it leaves unobservable."""

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

COMPONENTS = (
    "tilt about x",
    "tilt about y",
    "rotation about the flange axis",
    "in the flange plane, x",
    "in the flange plane, y",
    "along the flange normal",
)
"""Names of the six components of an error at the flange, [rotation; translation] in frame R."""

UNOBSERVABLE_SHARE = 0.01
"""A component is called unobservable where less than one point in a hundred speaks for it: the chamfers of a whole ISO 9409-1-50
face hold one in six, at 45 degrees, and speak for a shift with 4 %; stray points at an edge make half a per cent."""


def surface_normals(points_R: Array, standard: FlangeStandard) -> Array:
    """Outward normals (n, 3) of the flange's face or chamfer, whichever is nearest to each point (n, 3) m in R.

    From the standard itself, not from samples of it: the nearest sample of a flat point beside the edge may lie on the
    chamfer and would lend it a slope that it does not have.
    """
    rho = np.maximum(np.linalg.norm(points_R[:, :2], axis=1), 1e-12)
    radial = points_R[:, :2] / rho[:, None]
    c, inner, outer = standard.chamfer_m, standard.face_inner_radius_m, standard.face_outer_radius_m
    profile = [((inner, 0.0), (outer, 0.0)), ((outer, 0.0), (outer + c, -c)), ((inner - c, -c), (inner, 0.0))]
    at = np.column_stack([rho, points_R[:, 2]])
    distance = np.array([_to_segment(at, np.array(a), np.array(b)) for a, b in profile])
    slope = np.array([0.0, 1.0, -1.0])[np.argmin(distance, axis=0)]
    return np.asarray(np.column_stack([slope[:, None] * radial, np.ones(len(rho))]) / np.hypot(slope, 1.0)[:, None])


def information(points_R: Array, normals_R: Array) -> Array:
    """Information matrix (6, 6), order [rotation; translation], about the origin of R, of points (n, 3) m that each measure
    their distance along their normal (n, 3), in units of one measurement (1 for each point)."""
    J = np.hstack([np.cross(points_R, normals_R), normals_R])
    return np.asarray(J.T @ J)


def sigmas(matrix: Array, noise_m: float) -> Array:
    """Standard deviation (6,), rad and m, of each component, the others unknown as well; infinite where unobservable."""
    values, vectors = np.linalg.eigh(_scaled(matrix))
    variance = np.where(values > 1e-9 * max(float(values[-1]), 1e-30), 1.0 / np.maximum(values, 1e-30), np.inf)
    share = vectors**2
    with np.errstate(invalid="ignore"):
        total = np.where(share > 1e-9, share * variance, 0.0).sum(axis=1)
    out = noise_m * np.sqrt(total) / _units(matrix)
    return np.asarray(np.where(_shares(matrix) < UNOBSERVABLE_SHARE, np.inf, out))


def unobservable_components(matrix: Array) -> tuple[str, ...]:
    """Names of the components along which a displacement of the flange changes the surface (nearly) not at all."""
    return tuple(name for name, s in zip(COMPONENTS, _shares(matrix), strict=True) if s < UNOBSERVABLE_SHARE)


def _shares(matrix: Array) -> Array:
    """Share (6,) of the points that speak for each component when the other five are free (Schur complement)."""
    A = _scaled(matrix)
    n = max(float(np.trace(matrix[3:, 3:])), 1e-30)  # each unit normal adds one
    out = np.zeros(6)
    for k in range(6):
        rest = [i for i in range(6) if i != k]
        cross = A[k, rest]
        out[k] = max(float(A[k, k] - cross @ np.linalg.pinv(A[np.ix_(rest, rest)], rcond=1e-9) @ cross), 0.0) / n
    return out


def _units(matrix: Array) -> Array:
    """Metres that each component moves the surface by: 1, and the rms lever of the tilts for the rotations."""
    lever = np.sqrt(max(float(np.trace(matrix[:2, :2])) / 2.0, 0.0) / max(float(matrix[5, 5]), 1e-30))
    return np.array([max(lever, 1e-6)] * 3 + [1.0] * 3)


def _scaled(matrix: Array) -> Array:
    u = _units(matrix)
    return np.asarray(matrix / np.outer(u, u))


def _to_segment(at: Array, a: Array, b: Array) -> Array:
    t = np.clip((at - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-30), 0.0, 1.0)
    return np.asarray(np.linalg.norm(at - a - t[:, None] * (b - a), axis=1))
