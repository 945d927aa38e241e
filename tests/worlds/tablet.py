"""The tablet paper's data and results (Tables 2, 3, 7 to 12), and simulated trials with its noise.

J. Sato, "Hand-Eye Calibration Using a Tablet Computer", Math. Comput. Appl. 2023, 28(1), 22, doi 10.3390/mca28010022,
CC BY 4.0. The tablet's grid and the turn at the first landmark are not printed; both are inferred from the printed
results.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.tablet.published import AFFINE_NAMES, DH_NAMES, HTM_NAMES, Model
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.models.arrays import Array

# Table 2: u, v (px), depth (mm), hand x, y (mm), touching error (px)
TABLE_2 = np.array(
    [
        [119, 105, 168.2, 289, 1, -3, 1],
        [339, 108, 168.6, 347, 8, -2, 3],
        [558, 109, 167.7, 403, 14, -1, 5],
        [556, 246, 167.5, 395, -20, -1, 4],
        [338, 244, 169.2, 327, -17, -3, -1],
        [119, 242, 168.7, 257, -16, 3, 3],
        [118, 379, 168.6, 249, -59, 2, 0],
        [337, 379, 170.2, 305, -67, -1, 3],
        [554, 381, 168.9, 363, -77, 1, 2],
    ]
)
# Table 3; the hand's turn is printed as 22.5 m, but only 90 - 22.5 m reproduces any of the results
HAND_CAPTURE_MM = (320.0, -70.0, 290.0)
FOCAL_PX = 617.7
CENTRE_PX = (316.5, 242.3)
PPI, DISPLAY_SCALE = 267.0, 2.0
THETA_DEG = 90.0 - 22.5 * np.arange(9)
# Inferred: the grid that the printed parameters map the landmarks back to; the middle row runs from right to left
GRID_PX = np.array(
    [[x, y] for y, xs in ((150, (400, 720, 1040)), (350, (1040, 720, 400)), (550, (400, 720, 1040))) for x in xs]
)


@dataclass(frozen=True)
class PrintedStage:
    """One results table: F, f1, f2 (mm), and seed 1's parameters by name, mm and degrees."""

    fitness: tuple[float, float, float]
    names: tuple[str, ...]
    parameters: Array


# Table 7 prints the last seven rows under shifted labels (x_p 193.33 is x_t, and so on); here under their own.
STAGE_1: dict[Model, PrintedStage] = {
    "htm": PrintedStage(
        (1.68, 0.64, 1.04),
        HTM_NAMES,
        np.array([-2.09, 33.99, -0.46, 0.50, 0.72, 193.33, 31.62, 1.51, -11.93, -1.26, -0.46, -22.27]),
    ),
    "dh": PrintedStage(
        (7.10, 4.86, 2.24),
        DH_NAMES,
        np.array([11.79, 91.02, 10.25, -0.51, -13.07, 20.18, 94.79, 35.09, -5.33, -26.08, -0.86, -24.49]),
    ),
}
STAGE_2: dict[Model, PrintedStage] = {
    "htm": PrintedStage(
        (1.00, 0.19, 0.82), AFFINE_NAMES, np.array([-0.11, 0, 1.00, 1.02, 0.03, 0.06, -0.11, 1.02, 0.99, -0.03])
    ),
    "dh": PrintedStage(
        (4.27, 1.73, 2.54), AFFINE_NAMES, np.array([-0.18, -0.28, 1.03, 0.89, 3.77, 0.41, 2.58, 0.98, 1.14, -4.51])
    ),
}
TABLE_NUMBER = {("htm", 1): 7, ("dh", 1): 8, ("htm", 2): 10, ("dh", 2): 11}
# Tables 9 and 12: mean touching error of the robot, mm, five trials (an experiment: nothing here can repeat it)
TOUCHING_MM = {9: (1.23, 1.29, 1.26, 1.21, 1.26), 12: (0.98, 1.02, 0.99, 1.03, 1.03)}


def printed_stage(model: Model, stage: int) -> PrintedStage:
    """Return the results table of one stage of one chain."""
    return (STAGE_1 if stage == 1 else STAGE_2)[model]


def published_touches() -> TabletTouches:
    """Return the paper's nine touches, SI units."""
    return TabletTouches(
        uv_px=TABLE_2[:, 0:2],
        depth_m=1e-3 * TABLE_2[:, 2],
        hand_m=1e-3 * TABLE_2[:, 3:5],
        theta_rad=np.radians(THETA_DEG),
        delta_px=TABLE_2[:, 5:7],
        landmark_px=GRID_PX.astype(float),
        pitch_m=0.0254 / PPI * DISPLAY_SCALE,
        focal_px=np.full(2, FOCAL_PX),
        centre_px=np.array(CENTRE_PX),
        hand_capture_m=1e-3 * np.array(HAND_CAPTURE_MM),
    )


@dataclass(frozen=True, kw_only=True)
class TabletNoise:
    """Noise of the simulated devices, as the paper's data suggest it.

    A depth camera that reads 1.5 % short and 0.8 mm noisy, blobs of 0.15 px read to whole pixels, hands read to whole
    millimetres, touches 2.5 px off the dot, a table level within 0.7 deg.
    """

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
    """One trial with a mounting, a pen and a tablet drawn from the seed.

    The camera hangs about 172 mm over the tablet.
    """
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
