"""Simulated tablet, camera and pen: touches with the paper's noise, and queries for validation."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.models.arrays import Array
from weldcal.tools.studies.tablet.paper import (
    CENTRE_PX,
    FOCAL_PX,
    GRID_PX,
    HAND_CAPTURE_MM,
    THETA_DEG,
    published_touches,
)


@dataclass(frozen=True, kw_only=True)
class TabletNoise:
    """Noise of the simulated devices, as the paper's data suggest it: a depth camera that reads 1.5 % short and 0.8 mm
    noisy, blobs of 0.15 px read to whole pixels, hands read to whole millimetres, touches 2.5 px off the dot, a table level within 0.7 deg."""

    depth_scale: float = 0.985
    depth_m: float = 0.8e-3
    depth_step_m: float = 1e-4
    pixel: float = 0.15
    pixel_step: float = 1.0
    hand_step_m: float = 1e-3
    touch_px: float = 2.5
    tilt_deg: float = 0.7


@dataclass(frozen=True)
class TabletTrial:
    """Nine touches to calibrate from, and q unseen queries: pixel (q, 2), turn (q,) rad, true hand (q, 2) m."""

    touches: TabletTouches
    query_uv_px: Array
    query_depth_m: Array
    query_theta_rad: Array
    query_hand_m: Array

    @property
    def query_rays(self) -> Array:
        """Viewing rays (q, 2) of the queries."""
        return (self.query_uv_px - self.touches.centre_px) / self.touches.focal_px


def simulate_trial(seed: tuple[int, ...], noise: TabletNoise | None = None, queries: int = 16) -> TabletTrial:
    """One trial with a mounting, a pen and a tablet drawn from the seed; the camera hangs about 172 mm over the tablet."""
    noise = noise or TabletNoise()
    rng = np.random.default_rng(seed)
    pitch = published_touches().pitch_m

    def degrees(span: float) -> float:
        return float(np.radians(rng.uniform(-span, span)))

    camera_up = 1e-3 * rng.uniform(5.0, 15.0)
    X_HC = RigidTransform(
        RollPitchYaw(degrees(2.0), degrees(2.0), degrees(4.0)),
        [1e-3 * rng.uniform(-6, 6), 1e-3 * rng.uniform(28, 40), camera_up],
    ) @ RigidTransform(RotationMatrix.MakeZRotation(np.pi))
    # Eq. 2 turns by 180 deg about x and about y, which is 180 deg about z; the hand itself looks down (Eq. 1)
    R_BH = RotationMatrix.MakeYRotation(np.pi)
    X_BH = RigidTransform(R_BH, 1e-3 * np.array(HAND_CAPTURE_MM))
    pen = 1e-3 * np.array([rng.uniform(-3, 3), rng.uniform(-26, -18)])
    height = X_BH.translation()[2] - camera_up - 0.172 + 1e-3 * rng.uniform(-2, 2)
    middle_B = np.array([0.322 + 1e-3 * rng.uniform(-5, 5), -0.037 + 1e-3 * rng.uniform(-5, 5), height])
    screen = RotationMatrix(
        RollPitchYaw(degrees(noise.tilt_deg), degrees(noise.tilt_deg), degrees(3.0))
    ) @ RotationMatrix.MakeXRotation(np.pi)
    middle_px = GRID_PX.mean(axis=0)

    def in_base(points_px: Array) -> Array:
        flat = np.c_[pitch * (points_px - middle_px), np.zeros(len(points_px))]
        return np.asarray(flat @ screen.matrix().T + middle_B)

    def seen(points_B: Array) -> tuple[Array, Array]:
        X_CB = (X_BH @ X_HC).inverse()
        p_C = points_B @ X_CB.rotation().matrix().T + X_CB.translation()
        exact = FOCAL_PX * p_C[:, :2] / p_C[:, 2:] + CENTRE_PX
        uv = _rounded(exact + rng.normal(0.0, noise.pixel, exact.shape), noise.pixel_step)
        depth = noise.depth_scale * p_C[:, 2] + rng.normal(0.0, noise.depth_m, len(p_C))
        return uv, _rounded(depth, noise.depth_step_m)

    def hand(points_B: Array, theta: Array) -> Array:
        turned = np.stack(
            [pen[0] * np.cos(theta) - pen[1] * np.sin(theta), pen[0] * np.sin(theta) + pen[1] * np.cos(theta)]
        )
        return np.asarray(points_B[:, :2] - (R_BH.matrix()[:2, :2] @ turned).T)

    theta = np.radians(THETA_DEG)
    delta = rng.normal(0.0, noise.touch_px, GRID_PX.shape).round()
    uv, depth = seen(in_base(GRID_PX.astype(float)))
    touches = TabletTouches(
        uv_px=uv,
        depth_m=depth,
        hand_m=_rounded(hand(in_base(GRID_PX - delta), theta), noise.hand_step_m),
        theta_rad=theta,
        delta_px=delta,
        landmark_px=GRID_PX.astype(float),
        pitch_m=pitch,
        focal_px=np.full(2, FOCAL_PX),
        centre_px=np.array(CENTRE_PX),
        hand_capture_m=1e-3 * np.array(HAND_CAPTURE_MM),
    )
    asked_px = rng.uniform(GRID_PX.min(axis=0), GRID_PX.max(axis=0), (queries, 2))
    asked = in_base(asked_px)
    turns = rng.uniform(-np.pi / 2, np.pi / 2, queries)
    query_uv, query_depth = seen(asked)
    return TabletTrial(touches, query_uv, query_depth, turns, hand(asked, turns))


def _rounded(values: Array, step: float) -> Array:
    return np.round(values / step) * step if step > 0.0 else values
