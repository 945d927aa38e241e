"""Tables 1 to 3 of the sphere paper: points, seam and frustum, by the paper's method and by the joint method."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from weldcal.calibration.profiler.arm_errors import DhArm
from weldcal.calibration.profiler.features.frustum import fit_frustum, without_spikes
from weldcal.calibration.profiler.features.groove import groove_features
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.arc import fit_circle
from weldcal.calibration.profiler.sphere.joint import sphere_joint
from weldcal.calibration.profiler.sphere.linear import compensate, fit_touch_sphere, sphere_center, sphere_linear
from weldcal.tools.worlds.profiler_parts import WorldData

MM = 1e-3
METHODS = ("linear", "compensated", "joint, affine", "joint, affine+joints")
# as printed: mean deviations before and after (Table 1), after (Table 2), frustum length and angle (Table 3)
PRINTED_POINTS = {"linear": (4.3132, 4.5731, 4.0331), "compensated": (0.8183, 0.7069, 0.6371)}
PRINTED_SEAM = (0.4567, 0.6374, 0.4856)
PRINTED_BOSS = (0.5071, 0.2145)
TARGET_POINTS = {"joint, affine": 0.141, "joint, affine+joints": 0.110}
TARGET_SEAM = (0.122, 0.219, 0.146)
TARGET_BOSS = (0.042, 0.10)
SEAM_FEATURES = ("first edge", "root", "second edge")
HIP_MM, SLOPE_DEG = 50.0, float(np.degrees(np.arctan2(4.0, 3.0)))


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldResult:
    """One world and method: mean |sensed - touched| (3,) mm of the points and of the seam's features, and of the
    frustum the mean error (2,) of the slanted edges (mm) and of the slopes (deg)."""

    world: int
    method: str
    points_mm: Floats
    seam_mm: Floats | None
    boss: Floats | None


def sphere_targets() -> list[tuple[str, str, float]]:
    """(what, unit, limit) of points, seam and frustum."""
    return [
        *((f"sphere, {method}", "mm", limit) for method, limit in TARGET_POINTS.items()),
        *((f"seam, {name}", "mm", limit) for name, limit in zip(SEAM_FEATURES, TARGET_SEAM, strict=True)),
        ("frustum, length (worst)", "mm", TARGET_BOSS[0]),
        ("frustum, angle (worst)", "deg", TARGET_BOSS[1]),
    ]


def sphere_figures(results: Sequence[WorldResult]) -> dict[str, float]:
    """The joint methods' figures over the worlds, by the names of their targets."""
    points = {m: float(np.mean([r.points_mm.mean() for r in results if r.method == m])) for m in TARGET_POINTS}
    best = [r for r in results if r.method == METHODS[3]]
    return named_figures(
        points, [r.seam_mm for r in best if r.seam_mm is not None], [r.boss for r in best if r.boss is not None]
    )


def named_figures(points: Mapping[str, float], seams: Sequence[Floats], bosses: Sequence[Floats]) -> dict[str, float]:
    """Figures by the names of their targets: points by method, the mean of the seams, the worst of the frustums."""
    values = [*points.values(), *np.mean(seams, axis=0), *np.max(bosses, axis=0)]
    return {what: float(value) for (what, _, _), value in zip(sphere_targets(), values, strict=True)}


def calibrations(world: WorldData) -> dict[str, ProfilerRecord]:
    """The four methods on one world's scans and touches."""
    data = world.trial.data
    assert data.touches is not None
    assert data.tip is not None
    R, t = data.poses.rotation, data.poses.translation
    centers = np.array(
        [
            sphere_center(fit_circle(p)[0], data.radius_m, s)
            for p, s in zip(data.profiles, world.trial.sign, strict=True)
        ]
    )
    linear = sphere_linear(R, t, centers, world.trial.translated)
    felt = fit_touch_sphere(data.touches.rotation, data.touches.translation, data.tip, data.radius_m)
    best = compensate(linear, R, t, centers, felt.center)
    return {
        METHODS[0]: ProfilerRecord(
            method=METHODS[0], rotation=linear.rotation, translation=linear.translation, tip=data.tip
        ),
        METHODS[1]: ProfilerRecord(
            method=METHODS[1], rotation=best.rotation, translation=best.translation, tip=data.tip
        ),
        **joint_records(world),
    }


def joint_records(world: WorldData) -> dict[str, ProfilerRecord]:
    """The joint methods on one world's scans and touches."""
    data = world.trial.data
    affine = sphere_joint(data, "affine", world.sigmas)
    joints = sphere_joint(data, "affine+joints", world.sigmas, init=affine)
    return {
        METHODS[2]: ProfilerRecord.of(METHODS[2], affine, {}, ""),
        METHODS[3]: ProfilerRecord.of(METHODS[3], joints, {}, "", data.arm),
    }


def measure(k: int, world: WorldData) -> list[WorldResult]:
    """All methods on one world."""
    features = seam_features(world)
    return [measured(k, method, record, world, features) for method, record in calibrations(world).items()]


def seam_features(world: WorldData) -> Floats | None:
    """Features (n, 3, 2) m in the groove's profiles; None without a groove."""
    return None if world.groove is None else np.array([groove_features(p).points for p in world.groove.profiles])


def measured(
    k: int, method: str, record: ProfilerRecord, world: WorldData, features: Floats | None, *, boss: bool = True
) -> WorldResult:
    """Points, seam and frustum of one world by one calibration; features (n, 3, 2) m from `seam_features`."""
    arm, tests = world.trial.data.arm, world.trial.tests
    assert arm is not None
    assert tests is not None
    off = _off(record, arm, tests.q_view, tests.seen, tests.q_touch)
    points = np.array([off[tests.point == j].mean() for j in range(3)])
    seam = error = None
    if world.groove is not None and features is not None:
        g = world.groove
        seam = np.column_stack([_off(record, arm, g.q, features[:, j], g.q_touch[:, j]) for j in range(3)]).mean(axis=0)
    if world.boss is not None and boss:
        found = fit_frustum(cloud_of(record, arm, *world.boss))
        length = np.abs(found.hips_m / MM - HIP_MM).mean()
        error = np.array([length, np.abs(np.degrees(found.dihedrals_rad) - SLOPE_DEG).mean()])
    return WorldResult(world=k, method=method, points_mm=points, seam_mm=seam, boss=error)


def _flange(record: ProfilerRecord, arm: DhArm, q: Floats) -> FlangePoses:
    X = arm.frames(q)[:, 6]
    return record.flange(FlangePoses(X[:, :3, :3], X[:, :3, 3]), q)


def _off(record: ProfilerRecord, arm: DhArm, q: Floats, seen: Floats, q_touch: Floats) -> Floats:
    """Distances (n,) mm from where a point is sensed to where the tip touched it."""
    X, touch = _flange(record, arm, q), _flange(record, arm, q_touch)
    assert record.tip is not None
    sensed = np.einsum("nij,nj->ni", X.rotation, record.points_F(seen)) + X.translation
    return np.asarray(np.linalg.norm(sensed - touch.rotation @ record.tip - touch.translation, axis=1) / MM)


def cloud_of(record: ProfilerRecord, arm: DhArm, q: Floats, profiles: Floats) -> Floats:
    """A frustum's profiles (n, m, 2) m as points in B by a calibration, (k, 3) m."""
    X = _flange(record, arm, q)
    parts = [record.points_F(without_spikes(p)) @ X.rotation[k].T + X.translation[k] for k, p in enumerate(profiles)]
    return np.vstack(parts)
