"""The costs of section 4.2 of the flange paper, besides the translation: a rotation counts at a work radius."""

from __future__ import annotations

import numpy as np

from weldcal.calibration.published.algorithm1 import Cost
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError


def translation_and_rotation_cost(work_radius_m: float) -> Cost:
    """Translation norm plus the rotation's displacement at ``work_radius_m`` from the flange centre, m.

    A bound on the error there, where the paper's is a norm of all six.
    """

    def cost(error: Array) -> float:
        return float(np.linalg.norm(error[3:]) + work_radius_m * np.linalg.norm(error[:3]))

    return cost


def axes_cost(axes: tuple[int, ...], work_radius_m: float) -> Cost:
    """Norm over chosen components of the error (0-2 rotation times ``work_radius_m``, 3-5 translation), m.

    Section 4.2's choice of axes: (3, 4) is its pick-and-place example, with an end-effector that gives way along z.
    """
    if not axes or any(not 0 <= a < 6 for a in axes):
        raise InputError("The axes of a cost are numbers from 0 to 5: 0-2 rotation, 3-5 translation.")

    def cost(error: Array) -> float:
        scaled = error * np.array([work_radius_m] * 3 + [1.0] * 3)
        return float(np.linalg.norm(scaled[list(axes)]))

    return cost
