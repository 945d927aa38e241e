"""A ray caster of its own for flange scans: disc, bore, holes, chamfers, wrist, shoulder and floor, by rays and
formulas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Array = NDArray[np.float64]

# ISO 9409-1-50-4-M6, in m, written out here: outside, bore, chamfer, thread circle, thread, dowel, depths
OUTER, BORE, CHAMFER, CIRCLE, HOLE, PIN = 0.0315, 0.01575, 0.001, 0.025, 0.003, 0.003
BORE_DEPTH, HOLE_DEPTH, THICK = 0.006, 0.008, 0.014
WRIST, WRIST_LENGTH, ELBOW = 0.0375, 0.09, 0.055
HOLES = [(CIRCLE * np.cos(a), CIRCLE * np.sin(a), HOLE) for a in np.radians([45.0, 135.0, 225.0, 315.0])]
HOLES.append((0.0, CIRCLE, PIN))


@dataclass(frozen=True)
class Camera:
    """A pinhole with one radial coefficient: rays are ideal ones, moved outwards by the square of their length."""

    width: int = 960
    height: int = 720
    focal: float = 1200.0
    bend: float = 0.0

    def rays(self) -> Array:
        u, v = np.meshgrid(
            (np.arange(self.width) - 0.5 * self.width) / self.focal,
            (np.arange(self.height) - 0.5 * self.height) / self.focal,
        )
        further = 1.0 + self.bend * (u * u + v * v)
        return np.stack([u * further, v * further, np.ones_like(u)], axis=-1)


def scan(
    X_CR: Array,
    rng: np.random.Generator,
    camera: Camera,
    *,
    sigma: float = 0.0001,
    correlation_px: float = 0.0,
    floor: float = 1.2,
    wrist: bool = True,
) -> Array:
    """An organised scan (H, W, 3) m, NaN without return, of a flange at X_CR (4, 4): z outward, face at z = 0.

    ``sigma`` m of noise along z, correlated over ``correlation_px`` pixels; ``floor`` m is its distance along the
    camera's axis.
    """
    rays = camera.rays()
    R, p = X_CR[:3, :3], X_CR[:3, 3]
    origin, d = -R.T @ p, rays @ R  # in R's frame
    best = np.full(rays.shape[:2], np.inf)

    def hit(t: Array, keep: Array) -> None:
        np.copyto(best, t, where=keep & (t > 0.05) & (t < best))

    with np.errstate(divide="ignore", invalid="ignore"):
        for height, test in _discs(wrist):
            t = (height - origin[2]) / d[..., 2]
            x, y = (origin[k] + t * d[..., k] for k in (0, 1))
            hit(t, test(x, y))
        for r0, r1, z0, z1 in _cones(wrist):
            # radius r0 at height z0, r1 at z1: (x^2 + y^2) = (r0 + k (z - z0))^2
            k = (r1 - r0) / (z1 - z0)
            at = r0 + k * (origin[2] - z0)
            a = d[..., 0] ** 2 + d[..., 1] ** 2 - (k * d[..., 2]) ** 2
            b = origin[0] * d[..., 0] + origin[1] * d[..., 1] - k * at * d[..., 2]
            c = origin[0] ** 2 + origin[1] ** 2 - at**2
            root = np.sqrt(b * b - a * c)
            for sign in (-1.0, 1.0):
                t = (-b + sign * root) / a
                z = origin[2] + t * d[..., 2]
                hit(t, (z >= min(z0, z1)) & (z <= max(z0, z1)))
        hit(np.full(best.shape, floor), np.ones(best.shape, dtype=bool))
    noise = rng.normal(size=best.shape)
    if correlation_px > 0.0:
        noise = gaussian_filter(noise, correlation_px)
        noise /= noise.std()
    best = np.where(np.isfinite(best), best + sigma * noise, np.nan)
    return np.asarray(rays * best[..., None])


def _discs(wrist: bool):  # type: ignore[no-untyped-def]
    def face(x: Array, y: Array) -> Array:
        rho = np.hypot(x, y)
        on = (rho < OUTER - CHAMFER) & (rho > BORE + CHAMFER)
        for a, b, r in HOLES:
            on &= np.hypot(x - a, y - b) > r
        return np.asarray(on)

    yield 0.0, face
    yield -BORE_DEPTH, lambda x, y: np.hypot(x, y) < BORE
    for a, b, r in HOLES:
        yield -HOLE_DEPTH, lambda x, y, a=a, b=b, r=r: np.hypot(x - a, y - b) < r
    if wrist:
        yield -THICK, lambda x, y: np.hypot(x, y) < WRIST
        yield -THICK - WRIST_LENGTH, lambda x, y: np.hypot(x, y) < ELBOW


def _cones(wrist: bool):  # type: ignore[no-untyped-def]
    yield OUTER - CHAMFER, OUTER, 0.0, -CHAMFER
    yield OUTER, OUTER + 1e-9, -CHAMFER, -THICK
    yield BORE + CHAMFER, BORE, 0.0, -CHAMFER
    yield BORE, BORE + 1e-9, -CHAMFER, -BORE_DEPTH
    if wrist:
        yield WRIST, WRIST + 1e-9, -THICK, -THICK - WRIST_LENGTH
        yield ELBOW, ELBOW + 1e-9, -THICK - WRIST_LENGTH, -THICK - 3.0 * WRIST_LENGTH


def facing(p: Array, tilt: float, azimuth: float, turn: float) -> Array:
    """X_CR (4, 4) of a flange at p (3,) whose normal leans ``tilt`` rad away from the line of sight, about
    ``azimuth``."""
    z = -p / np.linalg.norm(p)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    z = np.cos(tilt) * z + np.sin(tilt) * (np.cos(azimuth) * x + np.sin(azimuth) * y)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    X = np.eye(4)
    X[:3, :3] = np.column_stack([np.cos(turn) * x + np.sin(turn) * y, -np.sin(turn) * x + np.cos(turn) * y, z])
    X[:3, 3] = p
    return X


def random_flange(rng: np.random.Generator, near: float = 0.45, far: float = 0.75, tilt_deg: float = 30.0) -> Array:
    """X_CR (4, 4) in front of a camera of 44 degrees."""
    z = rng.uniform(near, far)
    p = np.array([rng.uniform(-0.2, 0.2) * z, rng.uniform(-0.15, 0.15) * z, z])
    return facing(p, np.radians(rng.uniform(0.0, tilt_deg)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi))


def forms(cloud: Array, rng: np.random.Generator, p: Array) -> dict[str, Array]:
    """The same scan as people have it."""
    flat = cloud.reshape(-1, 3)
    known = np.isfinite(flat[:, 2])
    points = flat[known]
    return {
        "organised": cloud,
        "zeros": np.where(known[:, None], flat, np.nan),
        "dropped": points,
        "shuffled": rng.permutation(points),
        "cropped": points[np.abs(points - p).max(axis=1) < 0.08],
        "thinned": points[::3],
    }
