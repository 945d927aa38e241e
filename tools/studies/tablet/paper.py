"""Data of the tablet paper (Tables 2 and 3) and its results (Tables 7 to 12).

J. Sato, "Hand-Eye Calibration Using a Tablet Computer", Math. Comput. Appl. 2023, 28(1), 22, doi 10.3390/mca28010022, CC BY 4.0.
The tablet's grid and the turn at the first landmark are not printed; both are inferred from the printed results.
"""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.tablet.published.chain import DH_NAMES, HTM_NAMES, Model
from weldcal.calibration.tablet.published.two_stage import AFFINE_NAMES
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.models.arrays import Array

# Table 2: u, v (px), depth (mm), hand x, y (mm), touching error (px)
TABLE_2 = np.array(
    [
        [119, 105, 168.2, 289, 1, -3, 1], [339, 108, 168.6, 347, 8, -2, 3], [558, 109, 167.7, 403, 14, -1, 5],
        [556, 246, 167.5, 395, -20, -1, 4], [338, 244, 169.2, 327, -17, -3, -1], [119, 242, 168.7, 257, -16, 3, 3],
        [118, 379, 168.6, 249, -59, 2, 0], [337, 379, 170.2, 305, -67, -1, 3], [554, 381, 168.9, 363, -77, 1, 2],
    ]
)  # fmt: skip
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
    """The results table of one stage of one chain."""
    return (STAGE_1 if stage == 1 else STAGE_2)[model]


def published_touches() -> TabletTouches:
    """The paper's nine touches, SI units."""
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
