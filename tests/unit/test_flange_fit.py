"""The flange fit against a ray-cast flange whose place is known: unbiased, precise, honest about both, and able to refuse."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.flange_fit import FlangeFit, FlangeGuess, fit_flange
from weldcal.models.depth_noise import DepthNoise, noisy_depth
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.models.scanners import get_scanner

Array = NDArray[np.float64]

STANDARD = get_flange("iso9409-1-50-4-m6")
SCANNER = get_scanner("phoxi_m", 824).noise


def facing_pose(p_CR: tuple[float, float, float], tilt_deg: float, azimuth_deg: float) -> RigidTransform:
    """X_CR of a feature whose outward normal leans ``tilt_deg`` away from the line of sight."""
    to_scanner = -np.array(p_CR) / np.linalg.norm(p_CR)
    x = np.cross([0.0, 1.0, 0.0], to_scanner)
    x /= np.linalg.norm(x)
    facing = RotationMatrix(np.column_stack([x, np.cross(to_scanner, x), to_scanner]))
    lean = RollPitchYaw(0.0, np.radians(tilt_deg), 0.0).ToRotationMatrix()
    turn = RollPitchYaw(0.0, 0.0, np.radians(azimuth_deg)).ToRotationMatrix()
    return RigidTransform(facing @ turn @ lean, np.array(p_CR))


def render(
    X_CR: RigidTransform,
    rng: np.random.Generator,
    *,
    standard: FlangeStandard = STANDARD,
    width: int = 206,
    height: int = 154,
    focal: float = 908.0,
    scanner: DepthNoise = SCANNER,
    plate_below: float | None = 0.008,
    hidden_half: bool = False,
) -> Array:
    """Organised cloud (H, W, 3) of a face with bore, holes and chamfers, a plate close below and a table far behind.

    A window of a PhoXi-M-like grid of 824 pixels across (0.7 to 1.1 mm pitch) about the feature, with that scanner's noise,
    flying pixels and lost edges.
    """
    center = X_CR.translation()
    u0, v0 = np.round(focal * center[:2] / center[2]) + rng.integers(-3, 4, 2)
    u, v = np.meshgrid(np.arange(width) - width // 2 + u0, np.arange(height) - height // 2 + v0)
    ray = np.stack([(u + 0.37) / focal, (v - 0.21) / focal, np.ones(u.shape)], axis=-1)
    inverse = X_CR.inverse()
    origin, direction = inverse.translation(), ray @ inverse.rotation().matrix().T

    def at_height(z: float) -> tuple[Array, Array, Array]:
        t = (z - origin[2]) / direction[..., 2]
        return t, origin[0] + t * direction[..., 0], origin[1] + t * direction[..., 1]

    t, x, y = at_height(0.0)
    rho = np.hypot(x, y)
    face = (rho < standard.face_outer_radius_m) & (rho > standard.face_inner_radius_m)
    for hx, hy, hr in standard.openings():
        face &= np.hypot(x - hx, y - hy) > hr
    depth = np.where(face, t, np.inf)
    for z in np.linspace(-standard.chamfer_m, 0.0, 21)[:-1]:  # 45 degree chamfers as a stack of ever wider rings
        t, x, y = at_height(float(z))
        rho = np.hypot(x, y)
        ring = (rho < standard.face_outer_radius_m - z) & (rho > standard.face_inner_radius_m + z)
        for hx, hy, hr in standard.openings():
            ring &= np.hypot(x - hx, y - hy) > hr
        depth = np.minimum(depth, np.where(ring, t, np.inf))
    if plate_below is not None:
        t, x, y = at_height(-plate_below)
        plate = (np.abs(x + 0.03) < 0.075) & (np.abs(y) < 0.045) & (np.hypot(x, y) > standard.bore_radius_m)
        depth = np.minimum(depth, np.where(plate, t, np.inf))
    t, _, _ = at_height(-0.3)
    depth = np.minimum(depth, t)
    measured = noisy_depth(
        depth.astype(np.float32), scanner, focal, focal, -float(u[0, 0]) - 0.37, -float(v[0, 0]) + 0.21, rng
    ).astype(float)
    cloud = ray * np.where(measured > 0.0, measured, np.nan)[..., None]
    if hidden_half:
        cloud[:, : width // 2 + 12] = np.nan
    return cloud


def fit(X_CR: RigidTransform, cloud: Array, rng: np.random.Generator) -> FlangeFit:
    offset = rng.uniform(-0.012, 0.012, 3)
    return fit_flange(cloud, STANDARD, guess=FlangeGuess(X_CR.translation() + offset, 0.085, X_CR.rotation().col(2)))


def poses(n: int, seed: int) -> list[RigidTransform]:
    rng = np.random.default_rng(seed)
    out = []
    for k in range(n):
        p = (rng.uniform(-0.15, 0.15), rng.uniform(-0.12, 0.12), rng.uniform(0.55, 0.9))
        out.append(facing_pose(p, 30.0 * k / max(n - 1, 1), rng.uniform(0, 360)))
    return out
