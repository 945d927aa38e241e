"""The paper's circle search: of 10 000 random triples of face points the one with the most points at its radius."""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.errors import FlangeNotFound
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

SAMPLE_SIZE = 3
_BLOCK = 64  # circles judged at once: keeps the distances of a 20 000-point face within a few megabytes


@dataclass(frozen=True)
class CircleParameters:
    """Section 3.2.2: R = 31 mm, e_d = 0.3 mm, e_r = 1 mm, k_max = 10 000; m. ``only_smaller`` is the authors' program, which
    takes radii from R - e_r to R, where the text says a tolerance."""

    R: float = 0.031
    e_d: float = 0.0003
    e_r: float = 0.001
    k_max: int = 10_000
    only_smaller: bool = False

    def __post_init__(self) -> None:
        if not (0.0 < self.e_r < self.R and self.e_d > 0.0 and self.k_max > 0):
            raise InputError("The circle search needs 0 < e_r < R, e_d > 0 and k_max > 0.")


@dataclass(frozen=True)
class PublishedCircle:
    """Centre (3,) m in C, radius m, points within e_d of it, and how many of the k_max triples passed the model check."""

    center_C: Array
    radius: float
    n_inliers: int
    n_verified: int


def search_circle(points_C: Array, parameters: CircleParameters | None = None, *, seed: int = 0) -> PublishedCircle:
    """Circle through three random points of a segmented face (N, 3) m that has the most points at its radius.

    Source: paper, section 2.1.4, second step, numbers of section 3.2.2. As published: no plane is fitted, "on the circle" is
    a distance from the centre within e_d of the radius (a shell), the winner is not refined, and inner points of the face
    draw as often as points of its edge. The authors' search has no seed: the centre it gives for the same cloud repeats
    to a few tenths of a millimetre only, which ``seed`` hides but does not correct. Raises FlangeNotFound when no triple
    passes the check of the radius.
    """
    p = parameters or CircleParameters()
    points = np.asarray(points_C, dtype=float).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < SAMPLE_SIZE:
        raise FlangeNotFound("The published circle search needs at least three points.")
    rng = np.random.default_rng(seed)
    triples = points[rng.integers(len(points), size=(p.k_max, SAMPLE_SIZE))]
    centers, radii = circumcircles(triples)
    smallest, largest = p.R - p.e_r, p.R if p.only_smaller else p.R + p.e_r
    good = np.isfinite(radii) & (radii >= smallest) & (radii <= largest)
    centers, radii = centers[good], radii[good]
    if len(radii) == 0:
        raise FlangeNotFound(
            f"None of {p.k_max} random circles has a radius from {1e3 * smallest:.0f} to {1e3 * largest:.0f} mm."
        )
    # |p - c| from the expanded square: one product of matrices, after moving the origin near to lose no digits
    origin = points.mean(axis=0)
    near, c = points - origin, centers - origin
    square = (near**2).sum(axis=1)
    counts = np.empty(len(c), dtype=int)
    for k in range(0, len(c), _BLOCK):
        block = slice(k, k + _BLOCK)
        d2 = square - 2.0 * c[block] @ near.T + (c[block] ** 2).sum(axis=1)[:, None]
        d = np.sqrt(np.maximum(d2, 0.0))
        counts[block] = (np.abs(d - radii[block, None]) < p.e_d).sum(axis=1)
    best = int(np.argmax(counts))
    return PublishedCircle(centers[best], float(radii[best]), int(counts[best]), len(radii))


def circumcircles(triples: Array) -> tuple[Array, Array]:
    """Centres (k, 3) and radii (k,) of the circles through point triples (k, 3, 3); radius NaN where the points are
    collinear or repeated."""
    A, u, v = triples[:, 0], triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    w = np.cross(u, v)
    uu, vv, ww = ((x * x).sum(axis=1) for x in (u, v, w))
    flat = ww <= 1e-18 * uu * vv
    ww = np.where(flat, 1.0, ww)
    to_center = (np.cross(w, u) * vv[:, None] + np.cross(v, w) * uu[:, None]) / (2.0 * ww[:, None])
    radii = np.where(flat, np.nan, np.linalg.norm(to_center, axis=1))
    return A + to_center, radii
