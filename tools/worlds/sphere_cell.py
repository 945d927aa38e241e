"""A simulated cell whose flange carries a calibration sphere, seen with the flange in the same scans."""

from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.flange.fit import FlangeFit, fit_flange
from weldcal.calibration.flange.observation import Observation, observation_from_fit
from weldcal.calibration.touch.touches import around, fit_touched_sphere
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner
from weldcal.systems.drivers.simulated.ur import draw_true_arm
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.worlds.flange_frames import facing, sphere_frame

SPHERE_RADIUS_M = 0.025
P_FS = np.array([0.085, 0.0, 0.02])
"""Centre of the sphere on the flange, as it was meant to be mounted, m."""
_MOUNTED_M = 1e-3  # by which the sphere lies elsewhere than meant, per axis
_REPEAT_M = 2e-5
_ARM_MM = 0.4
_HOME = np.radians([10.0, -80.0, 110.0, -120.0, -90.0, 0.0])


@dataclass(frozen=True, eq=False)
class SphereScan:
    """One scan with both: the flange's observation, the sphere's centre (3,) m in the camera, and the stated X_BF."""

    flange: Observation
    sphere: Array
    X_BF: RigidTransform


def cell_scans(n: int, seed: int, progress: Progress = no_progress) -> list[SphereScan]:
    """``n`` scans of a flange that carries a sphere, by one arm and one scanner whose errors no estimate is given:
    links 0.4 mm (rms at the flange), repeatability 0.035 mm, scale 0.2 %, gradient 0.13 % per 100 mm, a warp of 0.1
    mm."""
    rng = np.random.default_rng(seed)
    arm, standard = load_arm("ur10e"), get_flange("iso9409-1-50-4-m6")
    true = draw_true_arm(arm, _ARM_MM, _HOME, rng)
    scanner = get_scanner("phoxi_m", 824)
    noise = replace(
        scanner.noise, scale_error=-2e-3, gradient_per_m=(0.013, 0.0), warp_m=1e-4, device=int(rng.integers(2**31))
    )
    scanner = replace(scanner, noise=noise)
    X_BC = RigidTransform(RollPitchYaw(np.radians([180.0, 0.0, -90.0])), [-0.65, 0.1, 1.25])
    p_FS = P_FS + _MOUNTED_M * rng.normal(size=3)
    scans: list[SphereScan] = []
    for _ in range(6 * n):
        if len(scans) == n:
            break
        z = rng.uniform(0.58, 0.85)
        p = np.array([rng.uniform(-0.16, 0.16), rng.uniform(-0.12, 0.12), z])
        X_CF = facing(p, np.radians(rng.uniform(0.0, 25.0)), *rng.uniform(0.0, 2.0 * np.pi, 2))
        q = nearest_solution(arm, X_BC @ X_CF, _HOME)
        if q is None:
            continue
        stated = forward_kinematics(arm, q)
        real = forward_kinematics(true, q)
        real = RigidTransform(real.rotation(), real.translation() + _REPEAT_M * rng.normal(size=3))
        X_CF = X_BC.inverse() @ real
        points = sphere_frame(scanner, standard, rng, X_CF, p_FS, SPHERE_RADIUS_M)
        try:
            fit = fit_flange(points, standard)
            sphere = _sphere(points, fit)
        except WeldcalError:
            continue
        scans.append(SphereScan(observation_from_fit(f"s{len(scans)}", stated, fit), sphere, stated))
        progress("scans", len(scans) / n)
    return scans


def _sphere(points_C: Array, fit: FlangeFit) -> Array:
    """Centre of the ball beside the fitted flange: what stands proud of the face, on the ring where the ball must
    lie."""
    p = points_C.reshape(-1, 3)
    p = p[np.isfinite(p).all(axis=1)]
    away = p - fit.center_C
    height = away @ fit.normal_C
    aside = np.linalg.norm(away - height[:, None] * fit.normal_C, axis=1)
    reach = float(np.hypot(P_FS[0], P_FS[1]))
    seen = p[
        (np.abs(aside - reach) < 0.8 * SPHERE_RADIUS_M)
        & (height > P_FS[2])
        & (height < P_FS[2] + 1.2 * SPHERE_RADIUS_M)
    ]
    middle = np.median(seen, axis=0) if len(seen) else fit.center_C
    near = around(p, middle, 0.9 * SPHERE_RADIUS_M, "sphere")
    first, _ = fit_touched_sphere(near, SPHERE_RADIUS_M)
    cap = p[np.abs(np.linalg.norm(p - first, axis=1) - SPHERE_RADIUS_M) < 1e-3]
    return fit_touched_sphere(around(cap, first, 1.1 * SPHERE_RADIUS_M, "sphere"), SPHERE_RADIUS_M)[0]
