"""Fits a square frustum to a point cloud: six planes, the slanted edges between them, and their angles."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.profiler.motion import Floats
from weldcal.models.errors import InputError

NEIGHBOURS = 24
SIDE_COSINE = 0.9  # normals within 26 deg of the base's or top's belong to it; sides are inclined by more
ROUNDS = 12
TUKEY = 4.0  # sigmas of the biweight: keeps 91 % of least squares' information (4.685: 95 %)
MINIMUM_POINTS = 30
EDGE_MARGIN_M = 0.8e-3  # points nearer to a neighbouring plane are mixed of both


@dataclass(frozen=True, eq=False, kw_only=True)
class Frustum:
    """Planes n . p = d.

    Attributes:
        normals: (6, 3) outwards: base, top, then the four sides around the top; distances_m: (6,).
        hips_m: (4,) lengths of the slanted edges.
        dihedrals_rad: (4,) between each side and the top, as the slope of the side; labels: (n,) plane of each point,
            -1 none.
        rms_m: of the points off their planes.
    """

    normals: Floats
    distances_m: Floats
    hips_m: Floats
    dihedrals_rad: Floats
    labels: NDArray[np.intp]
    rms_m: float


def fit_frustum(points: ArrayLike) -> Frustum:
    """Fit the frustum in a cloud (n, 3) m that shows its base plate, its top and its four sides.

    Its orientation may be any.

    Raises:
        FeatureNotFound: fewer planes, or not like a frustum. InputError: not a cloud.

    Source: sphere and touch paper, section 3.3 and Table 3.
    """
    p = np.asarray(points, float)
    if p.ndim != 2 or p.shape[1] != 3:
        raise InputError(f"A cloud is an array (n, 3), not {p.shape}.")
    if not np.isfinite(p).all() or len(p) < 6 * MINIMUM_POINTS:
        raise InputError(
            f"The frustum needs {6 * MINIMUM_POINTS} finite points or more: remove samples that did not return."
        )
    n_p = _normals(p)
    up = _main_direction(n_p)
    labels = _split(p, n_p, up)
    planes = _refined(p, labels)
    base, top, sides = planes[0], planes[1], planes[2:]
    away = up * np.sign(up @ (p[labels == 1].mean(axis=0) - p[labels == 0].mean(axis=0)))
    around = np.argsort(_azimuth(np.array([s[:3] * np.sign(s[:3] @ away) for s in sides]), up))
    ordered = [base, top, *(sides[k] for k in around)]
    renumbered = np.array([-1, 0, 1, *(2 + np.argsort(around))])[labels + 1]
    return _measured(p, renumbered, np.array(ordered))


def _normals(p: Floats) -> Floats:
    """Unit normal (n, 3) at each point from its neighbours, by Open3D."""
    from weldcal.models.mesh import o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    return np.asarray(cloud.normals)


def _main_direction(normals: Floats) -> Floats:
    """Return the direction that most normals have: base and top are parallel.

    The sides' mean outward direction says which way is up.
    """
    outer = normals.T @ normals
    _, vectors = np.linalg.eigh(outer)
    up = vectors[:, 2]
    for _ in range(ROUNDS):
        near = normals[np.abs(normals @ up) > SIDE_COSINE]
        if len(near) < 2 * MINIMUM_POINTS:
            raise FeatureNotFound(
                "The cloud shows no base and top: scan the whole frustum and some of the plate around it."
            )
        _, vectors = np.linalg.eigh(near.T @ near)
        up = vectors[:, 2]
    return np.asarray(up)


def _azimuth(normals: Floats, up: Floats) -> Floats:
    a = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    a /= np.linalg.norm(a)
    return np.asarray(np.arctan2(normals @ np.cross(up, a), normals @ a))


def _split(p: Floats, normals: Floats, up: Floats) -> NDArray[np.intp]:
    """Return a first label (n,) for each point: 0 base, 1 top, 2 to 5 the sides, -1 not clear."""
    labels = np.full(len(p), -1, dtype=np.intp)
    flat = np.abs(normals @ up) > SIDE_COSINE
    height = p @ up
    low, high = np.percentile(height[flat], [2.0, 98.0])
    middle = 0.5 * (low + high)
    two = [np.median(height[flat & (height < middle)]), np.median(height[flat & (height >= middle)])]
    spread = [
        np.median(np.linalg.norm(_across(p[flat & (np.abs(height - h) < 0.1 * (high - low))], up), axis=1)) for h in two
    ]
    base, top = (0, 1) if spread[0] > spread[1] else (1, 0)
    if abs(two[1] - two[0]) < 2e-3:
        raise FeatureNotFound("Base and top of the frustum lie at one height: scan the whole frustum.")
    for label, which in ((0, base), (1, top)):
        labels[flat & (np.abs(height - two[which]) < 0.1 * abs(two[1] - two[0]))] = label
    away = up * np.sign(two[top] - two[base])
    steep = ~flat & (np.abs(normals @ up) > 0.15)
    outward = normals[steep] * np.sign(normals[steep] @ away)[:, None]
    angle = _azimuth(outward, up)
    # four sides a quarter turn apart: the phase of the fourth harmonic is where they point
    phase = np.angle(np.mean(np.exp(4j * angle))) / 4.0
    sector = np.round((angle - phase) / (0.5 * np.pi)).astype(int) % 4
    clear = np.abs((angle - phase + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi) < np.radians(20.0)
    labels[np.flatnonzero(steep)[clear]] = 2 + sector[clear]
    counts = [(labels == k).sum() for k in range(6)]
    if min(counts) < MINIMUM_POINTS:
        raise FeatureNotFound("The cloud does not show the frustum's six planes: scan all four sides, top and plate.")
    return labels


def _across(p: Floats, up: Floats) -> Floats:
    q = p - p.mean(axis=0) if len(p) else p
    return np.asarray(q - np.outer(q @ up, up))


def _refined(p: Floats, labels: NDArray[np.intp]) -> list[Floats]:
    """Planes (4,) [normal, d] by Tukey's weights.

    Labels of points near a neighbouring plane are taken away, in place.
    """
    planes = [_plane(p[labels == k]) for k in range(6)]
    for _ in range(3):
        distance = np.abs(np.column_stack([p @ q[:3] - q[3] for q in planes]))
        near = distance < EDGE_MARGIN_M
        own = np.zeros_like(near)
        own[labels >= 0, labels[labels >= 0]] = True
        mixed = (near & ~own).any(axis=1)
        planes = [_plane(p[(labels == k) & ~mixed]) for k in range(6)]
    labels[mixed] = -1
    return planes


def _plane(p: Floats) -> Floats:
    if len(p) < MINIMUM_POINTS:
        raise FeatureNotFound("A plane of the frustum has too few points: scan it more densely.")
    weight = np.ones(len(p))
    for _ in range(ROUNDS):
        mean = weight @ p / weight.sum()
        _, vectors = np.linalg.eigh((weight[:, None] * (p - mean)).T @ (p - mean))
        n = vectors[:, 0]
        r = (p - mean) @ n
        sigma = max(MAD * float(np.median(np.abs(r))), 1e-7)
        weight = np.clip(1.0 - (r / (TUKEY * sigma)) ** 2, 0.0, None) ** 2
    return np.array([*n, n @ mean])


def _measured(p: Floats, labels: NDArray[np.intp], planes: Floats) -> Frustum:
    middle = p[labels == 1].mean(axis=0)
    foot = p[labels == 0].mean(axis=0)
    n, d = planes[:, :3].copy(), planes[:, 3].copy()
    inside = 0.5 * (middle + foot)
    for k in range(6):
        towards = 1.0 if k == 0 else np.sign(d[k] - n[k] @ inside)
        if k == 0:
            towards = np.sign(n[0] @ (middle - foot))
        n[k], d[k] = n[k] * towards, d[k] * towards
    top: list[Floats] = []
    base: list[Floats] = []
    for a, b in pairwise([2, 3, 4, 5, 2]):
        for corners, face in ((top, 1), (base, 0)):
            A = n[[a, b, face]]
            if np.linalg.cond(A) > 1e3:
                raise FeatureNotFound("Two sides of the frustum came out parallel: scan all four sides.")
            corners.append(np.asarray(np.linalg.solve(A, d[[a, b, face]]), float))
    slopes = np.arccos(np.clip(n[2:] @ n[1], -1.0, 1.0))
    used = labels >= 0
    off = np.einsum("ni,ni->n", p[used], n[labels[used]]) - d[labels[used]]
    return Frustum(
        normals=n,
        distances_m=d,
        hips_m=np.linalg.norm(np.array(top) - np.array(base), axis=1),
        dihedrals_rad=np.asarray(slopes),
        labels=labels,
        rms_m=float(np.sqrt(np.median(off**2) / 0.455)),
    )


def without_spikes(profile: ArrayLike, limit_m: float = 1e-3) -> Floats:
    """Return the samples of a profile (n, 2) m that returned and do not stand out of their neighbours by the limit."""
    p = np.asarray(profile, float)
    p = p[np.isfinite(p).all(axis=1)]
    return np.asarray(p[np.abs(p[:, 1] - median_filter(p[:, 1], 7, mode="nearest")) < limit_m])
