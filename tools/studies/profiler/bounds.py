"""Predicts the errors of a calibration by a sphere and touches in a simulated world from the Cramer-Rao bound.

The bound is that of the whole model (pose, tip, sensor, arm) with each prior as wide as the errors really are; a draw from it is
carried to the points, the seam and the frustum that are measured afterwards, with the sensor's and the robot's own noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.arm_errors import ArmErrors, DhArm
from weldcal.calibration.profiler.features.frustum import fit_frustum
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.joint import SphereEstimate, sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereSigmas
from weldcal.tools.studies.profiler.sphere import MM, WorldData, cloud_of

# of the fixed files' worlds: what each error's sigma really is
REAL = SphereSigmas(
    sensor_m=0.05e-3, robot_m=0.04e-3, touch_m=0.04e-3, affine=0.01, joint_rad=np.radians(0.015), length_m=0.125e-3,
    twist_rad=np.radians(0.01), tip_m=3.54e-3,
)  # fmt: skip
DRAWS, BOSS_DRAWS = 300, 6


def changed(e: SphereEstimate, x: Floats) -> SphereEstimate:
    """The estimate with all its unknowns (39,) moved."""
    assert e.tip is not None
    errors = ArmErrors.of(x[15:])
    return replace(
        e,
        rotation=Rotation.from_rotvec(x[:3]).as_matrix() @ e.rotation,
        translation=e.translation + x[3:6],
        tip=e.tip + x[9:12],
        affine=e.affine + x[12:15],
        arm_errors=ArmErrors(
            e.arm_errors.offsets + errors.offsets, e.arm_errors.sag + errors.sag, e.arm_errors.table + errors.table
        ),
    )


def _apart(e: SphereEstimate, arm: DhArm, q: Floats, seen: Floats, q_touch: Floats) -> tuple[Floats, FlangePoses]:
    """Vectors (n, 3) m from where the tip touches to where the sensor sees; and the flange at the views."""
    assert e.tip is not None
    X, touch = e.flange(arm, q), e.flange(arm, q_touch)
    sensed = np.einsum("nij,nj->ni", X.rotation, e.points_F(seen)) + X.translation
    return sensed - touch.rotation @ e.tip - touch.translation, X


def predicted_mm(
    e: SphereEstimate, arm: DhArm, q: Floats, seen: Floats, q_touch: Floats, rng: np.random.Generator
) -> float:
    """Mean distance that points seen and touched will have, by the bound and by the noise of seeing them."""
    at, X = _apart(e, arm, q, seen, q_touch)
    steps = 1e-3 * np.sqrt(np.diag(e.whole))
    J = np.stack(
        [(_apart(changed(e, h * u), arm, q, seen, q_touch)[0] - at) / h for h, u in zip(steps, np.eye(len(steps)), strict=True)],
        axis=2,
    )  # fmt: skip
    R_BS = X.rotation @ e.rotation
    plane = R_BS[:, :, [0, 2]]
    C = J @ e.whole @ np.swapaxes(J, 1, 2)
    C = C + REAL.sensor_m**2 * plane @ np.swapaxes(plane, 1, 2) + REAL.robot_m**2 * np.eye(3)
    draws = np.linalg.cholesky(C)[:, None] @ rng.standard_normal((len(C), DRAWS, 3, 1))
    return float(np.linalg.norm(draws[..., 0], axis=2).mean() / MM)


def world_bounds(world: WorldData, features: Floats | None, seed: int) -> dict[str, Floats]:
    """`points` (), `seam` (3,) mm and `boss` (2,) mm and deg that the bound predicts; the last two where the world has them."""
    data, tests = world.trial.data, world.trial.tests
    assert data.arm is not None
    assert tests is not None
    rng = np.random.default_rng([seed, 76])
    e = sphere_joint(data, "affine+joints", REAL)
    found = {"points": np.array(predicted_mm(e, data.arm, tests.q_view, tests.seen, tests.q_touch, rng))}
    if world.groove is not None and features is not None:
        g = world.groove
        found["seam"] = np.array(
            [predicted_mm(e, data.arm, g.q, features[:, j], g.q_touch[:, j], rng) for j in range(3)]
        )
    if world.boss is not None:
        arm = data.arm
        L = np.linalg.cholesky(e.whole)

        def measured(estimate: SphereEstimate) -> Floats:
            record = ProfilerRecord.of("", estimate, {}, "", arm)
            assert world.boss is not None
            b = fit_frustum(cloud_of(record, arm, *world.boss))
            return np.array([b.hips_m / MM, np.degrees(b.dihedrals_rad)])

        here = measured(e)
        off = [
            np.abs(measured(changed(e, L @ rng.standard_normal(len(L)))) - here).mean(axis=1) for _ in range(BOSS_DRAWS)
        ]
        found["boss"] = np.mean(off, axis=0)
    return found
