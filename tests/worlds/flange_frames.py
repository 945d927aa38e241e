"""Ray-cast scanner frames with a flange at a known pose, with a sphere on it, or with objects that resemble one."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import open3d as o3d
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.flange.fit import FlangeFit, fit_flange
from weldcal.calibration.flange.observation import Observation, observation_from_fit
from weldcal.calibration.touch.touches import around, fit_touched_sphere
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.models.flanges import FlangeStandard, flange_mesh, flange_ring, get_flange
from weldcal.models.mesh import TriMesh, merge, revolve
from weldcal.models.scanners import ScannerPreset, apply_noise, depth_to_points, get_scanner
from weldcal.systems.drivers.simulated.ur import draw_true_arm
from weldcal.systems.runner import Progress, no_progress

WAYS = ("plate", "border", "missing")
"""How a part of a flange is hidden."""
_THICK_M = 0.012
_SEGMENTS = 96  # of bodies that are no flange


@dataclass(frozen=True, eq=False)
class FlangeScan:
    """Hold a scan (H, W, 3) m and the pose X_CR of the flange in it.

    NaN where nothing was measured; None without a flange.
    """

    points_C: Array
    X_CR: RigidTransform | None


def facing(p_CR: Array, tilt_rad: float, azimuth_rad: float, turn_rad: float) -> RigidTransform:
    """A feature pose whose outward normal leans ``tilt_rad`` from the line of sight, turned about its own axis."""
    to_scanner = -p_CR / np.linalg.norm(p_CR)
    x = np.cross([0.0, 1.0, 0.0], to_scanner)
    x /= np.linalg.norm(x)
    R = RotationMatrix(np.column_stack([x, np.cross(to_scanner, x), to_scanner]))
    lean = RollPitchYaw(0.0, tilt_rad, 0.0).ToRotationMatrix()
    return RigidTransform(
        R @ RotationMatrix.MakeZRotation(azimuth_rad) @ lean @ RotationMatrix.MakeZRotation(turn_rad), p_CR
    )


def random_place(
    scanner: ScannerPreset, standard: FlangeStandard, rng: np.random.Generator, *, max_tilt_deg: float = 32.0
) -> RigidTransform:
    """Return a feature pose X_CR in the middle of the working range and wholly inside the image."""
    z = rng.uniform(scanner.near_m + 0.06, min(scanner.far_m - 0.1, 1.5 * scanner.optimum_m))
    margin = 0.5 * standard.outer_m + 0.01
    half = [0.5 * size * z / f - margin for size, f in ((scanner.width, scanner.fx), (scanner.height, scanner.fy))]
    p = np.array([rng.uniform(-half[0], half[0]), rng.uniform(-half[1], half[1]), z])
    return facing(p, np.radians(rng.uniform(0.0, max_tilt_deg)), *rng.uniform(0.0, 2.0 * np.pi, 2))


def flange_frame(
    scanner: ScannerPreset,
    standard: FlangeStandard,
    rng: np.random.Generator,
    *,
    X_CR: RigidTransform | None = None,
    clutter: int = 6,
    before: tuple[TriMesh, ...] = (),
) -> FlangeScan:
    """A frame with the flange on an arm's wrist, a table behind, and ``clutter`` things about it that do not hide it.

    ``before`` holds bodies (in the camera frame) that may.
    """
    X_CR = random_place(scanner, standard, rng) if X_CR is None else X_CR
    bodies = [m.transformed(X_CR) for m in (flange_mesh(standard, _THICK_M), *_wrist(standard, rng))]
    bodies += _surroundings(scanner, standard, rng, clutter, clear_of=X_CR)
    return FlangeScan(cast([*bodies, *before], scanner, rng), X_CR)


def sphere_frame(
    scanner: ScannerPreset,
    standard: FlangeStandard,
    rng: np.random.Generator,
    X_CF: RigidTransform,
    p_FS: Array,
    radius_m: float,
) -> Array:
    """Make a scan (H, W, 3) m of a flange at X_CF on its wrist, over a table.

    It carries a ball of this radius at p_FS (3,) m.
    """
    ball = _ball(radius_m, 121).transformed(X_CF @ RigidTransform(p_FS))
    bodies = [m.transformed(X_CF) for m in (flange_mesh(standard, _THICK_M), *_wrist(standard, rng))]
    bodies += _surroundings(scanner, standard, rng, 0, clear_of=X_CF)
    return cast([*bodies, ball], scanner, rng)


def empty_frame(scanner: ScannerPreset, standard: FlangeStandard, rng: np.random.Generator) -> FlangeScan:
    """Return a frame without the flange.

    A table, things, and lookalikes (discs, rings and flanges of other sizes, tube ends).
    """
    bodies = _surroundings(scanner, standard, rng, 9, clear_of=None)
    for k in range(3):
        bodies.append(_lookalike(standard, rng, k).transformed(random_place(scanner, standard, rng)))
    return FlangeScan(cast(bodies, scanner, rng), None)


class FrameFit(NamedTuple):
    """Hold the figures of a fit.

    The centre's error (m), its square per axis in units of the stated covariance, and the share of the edge that was
    seen.
    """

    error_m: float
    normalised: float
    coverage: float


def fit_frame(frame: FlangeScan, standard: FlangeStandard) -> FrameFit:
    """Fit the flange of a frame and compare with the truth. Raises FlangeNotFound."""
    assert frame.X_CR is not None
    fit = fit_flange(frame.points_C, standard)
    e_C = fit.center_C - frame.X_CR.translation()
    normalised = float(e_C @ np.linalg.solve(fit.center_covariance, e_C)) / 3.0
    return FrameFit(float(np.linalg.norm(e_C)), normalised, fit.coverage)


def hidden_frame(
    way: str, scanner: ScannerPreset, standard: FlangeStandard, rng: np.random.Generator, *, share: float = 0.5
) -> FlangeScan:
    """Return a frame that hides ``share`` of the flange's width in one of the ``WAYS``, from a random side."""
    X_CR = random_place(scanner, standard, rng, max_tilt_deg=25.0)
    beyond = (0.5 - share) * standard.outer_m  # from the centre to where the hidden part begins
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    if way == "plate":
        height, wide = rng.uniform(0.03, 0.08), 3.0 * standard.outer_m
        turned = RigidTransform(RollPitchYaw(0.0, 0.0, azimuth), [0.0, 0.0, 0.0])
        plate = box(wide, wide, 0.004).transformed(
            X_CR @ turned @ RigidTransform([beyond + 0.5 * wide + height * _lean(X_CR, turned), 0.0, height])
        )
        return flange_frame(scanner, standard, rng, X_CR=X_CR, before=(plate,))
    if way == "border":
        p = X_CR.translation().copy()
        side = int(rng.integers(4))
        axis, sign = side % 2, 1.0 if side < 2 else -1.0
        size, focal, middle = ((scanner.width, scanner.fx, scanner.cx), (scanner.height, scanner.fy, scanner.cy))[axis]
        edge = (size - 0.5 - middle if sign > 0.0 else -0.5 - middle) / focal
        p[axis] = edge * p[2] - sign * beyond
        return flange_frame(scanner, standard, rng, X_CR=RigidTransform(X_CR.rotation(), p))
    frame = flange_frame(scanner, standard, rng, X_CR=X_CR)
    in_R = (X_CR.inverse() @ frame.points_C.reshape(-1, 3).T).T.reshape(frame.points_C.shape)
    with np.errstate(invalid="ignore"):
        lost = in_R[..., 0] * np.cos(azimuth) + in_R[..., 1] * np.sin(azimuth) > beyond
        lost &= np.hypot(in_R[..., 0], in_R[..., 1]) < 1.5 * standard.outer_m
    return replace(frame, points_C=np.where(lost[..., None], np.nan, frame.points_C))


def _lean(X_CR: RigidTransform, turned: RigidTransform) -> float:
    """How far, per metre above the face, the line of sight to its centre runs along the plate's x axis."""
    sight = (X_CR @ turned).inverse() @ np.zeros(3)
    return float(sight[0] / sight[2])


def _wrist(standard: FlangeStandard, rng: np.random.Generator) -> list[TriMesh]:
    """Return the last links of an arm behind the flange: a housing wider than it, and a tube across."""
    r, step = standard.outer_radius_m, -_THICK_M + rng.uniform(0.0, 0.005)
    housing = _solid([(1.43 * r, step), (1.43 * r, step - 0.06)])
    across = _solid([(1.3 * r, -0.09), (1.3 * r, 0.09)])
    X = RigidTransform(RollPitchYaw(np.pi / 2, 0.0, rng.uniform(0, np.pi)), [0.0, 0.0, step - 0.06 - 1.3 * r])
    return [housing, across.transformed(X)]


def _lookalike(standard: FlangeStandard, rng: np.random.Generator, kind: int) -> TriMesh:
    """What a flange must not be taken for."""
    r = standard.outer_radius_m
    if kind == 0:  # a plain disc of just that size, or nearly
        return _solid([(r * rng.uniform(0.9, 1.1), 0.0), (r, -_THICK_M)])
    if kind == 1:  # a ring of another size
        factor = rng.choice([rng.uniform(0.6, 0.85), rng.uniform(1.18, 1.6)])
        return flange_mesh(flange_ring(2.0 * r * factor, 2.0 * r * factor * 0.5), _THICK_M, segments=_SEGMENTS)
    wall = rng.uniform(0.08, 0.2) * r  # a tube's end, of just that size outside
    return flange_mesh(flange_ring(2.0 * r, 2.0 * (r - wall) - 0.002, chamfer_m=0.0005), 0.1, segments=_SEGMENTS)


def _surroundings(
    scanner: ScannerPreset,
    standard: FlangeStandard,
    rng: np.random.Generator,
    count: int,
    clear_of: RigidTransform | None,
) -> list[TriMesh]:
    """Return a table and loose things, none of which is between the scanner and the flange."""
    far = scanner.far_m
    while True:
        X_CT = RigidTransform(RollPitchYaw(*rng.uniform(-0.4, 0.4, 2), 0.0), [0.0, 0.0, rng.uniform(0.9, 1.15) * far])
        # the flange stands clear before the table
        if clear_of is None or float((X_CT.inverse() @ clear_of.translation())[2]) < -0.15:
            break
    out = [box(4.0 * far, 4.0 * far, 0.02).transformed(X_CT)]
    while len(out) < count + 1:
        size = rng.uniform(0.02, 0.12, 3)
        kind = int(rng.integers(3))
        radius = 0.5 * size[0]
        thing = (box(*size), _solid([(radius, 0.0), (radius, -size[1])]), _ball(radius))[kind]
        z = rng.uniform(scanner.near_m + 0.05, far)
        half = 0.5 * z * np.array([scanner.width / scanner.fx, scanner.height / scanner.fy])
        p = np.array([rng.uniform(-half[0], half[0]), rng.uniform(-half[1], half[1]), z])
        if clear_of is not None:
            q = clear_of.translation()
            apart = float(np.linalg.norm(p[:2] / p[2] - q[:2] / q[2]))
            if apart < (0.7 * standard.outer_m + 0.6 * float(np.linalg.norm(size))) / min(p[2], q[2]):
                continue
        out.append(thing.transformed(RigidTransform(RollPitchYaw(*rng.uniform(-np.pi, np.pi, 3)), p)))
    return out


def box(x: float, y: float, z: float) -> TriMesh:
    """Return a box (m) about its middle."""
    corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]) * [x, y, z]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))]
    return TriMesh(corners, np.array(triangles))


def _solid(outline: list[tuple[float, float]]) -> TriMesh:
    """A turned body closed at both ends: (radius, z) from the top down."""
    profile = [(0.0, outline[0][1]), *outline, (0.0, outline[-1][1])]
    return revolve(np.array(profile), _SEGMENTS)


def _ball(radius: float, rings: int = 25) -> TriMesh:
    a = np.linspace(0.5 * np.pi, -0.5 * np.pi, rings)
    profile = np.column_stack([radius * np.cos(a), radius * np.sin(a)])
    profile[[0, -1], 0] = 0.0
    return revolve(profile, max(_SEGMENTS, 2 * rings))


def cast(bodies: list[TriMesh], scanner: ScannerPreset, rng: np.random.Generator) -> Array:
    """Return the frame that the scanner returns of these bodies."""
    scene = merge(*bodies).scene
    rays = np.zeros((scanner.height, scanner.width, 6), dtype=np.float32)
    rays[..., 3] = ((np.arange(scanner.width) - scanner.cx) / scanner.fx)[None, :]
    rays[..., 4] = ((np.arange(scanner.height) - scanner.cy) / scanner.fy)[:, None]
    rays[..., 5] = 1.0
    depth = scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)["t_hit"].numpy()
    depth = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    return depth_to_points(apply_noise(depth, scanner, rng), scanner.fx, scanner.fy, scanner.cx, scanner.cy)


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
    """``n`` scans of a flange that carries a sphere, by one arm and one scanner whose errors no estimate is given.

    Links 0.4 mm (rms at the flange), repeatability 0.035 mm, scale 0.2 %, gradient 0.13 % per 100 mm, a warp of 0.1 mm.
    """
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
    for count in range(6 * n):
        if len(scans) == n:
            break
        rng = np.random.default_rng([seed, count])  # each its own: rays at edges differ between processors
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
    """Centre of the ball beside the fitted flange.

    What stands proud of the face, on the ring where the ball must lie.
    """
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
