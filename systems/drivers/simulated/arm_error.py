"""Draws the true kinematics of a simulated arm, which differs a little from the model that its controller reports
by."""

from dataclasses import replace

import numpy as np

from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.models.arms.kinematics import ArmModel, link_frames
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

_LENGTH_M = 0.5  # a link's length error is this times its angle error: machined parts of half a metre
_LARGEST_MM = 5.0  # more is another arm


def draw_true_arm(arm: ArmModel, error_mm: float, q: Array, rng: np.random.Generator) -> ArmModel:
    """The arm with random errors in each link transform: three angles and three lengths, normal and independent.

    ``error_mm`` is the rms distance of the true flange from the reported one at ``q`` (6,) rad, over all draws. About a
    quarter of it remains between poses after the best rigid fit; the rest looks like a shift of the robot's base.
    Zero returns the arm as it is and draws nothing.

    Raises:
        InputError: the error is negative or larger than 5 mm.
    """
    if not 0.0 <= error_mm <= _LARGEST_MM:
        raise InputError(f"robot.kinematic_error_mm must be from 0 to {_LARGEST_MM:g}, and it is {error_mm:g}.")
    if error_mm == 0.0:
        return arm
    frames = link_frames(arm, q)
    flange = frames[-1].translation()
    levers = [float(np.sum((flange - X.translation()) ** 2)) for X in frames[:-1]]
    # two of the three angles move the flange by the lever
    gain = float(np.sqrt(sum(2.0 * square + 3.0 * _LENGTH_M**2 for square in levers)))
    sigma = 1e-3 * error_mm / gain
    stack = arm.stack.copy()
    for k in range(len(stack)):
        error = np.eye(4)
        error[:3, :3] = exp_rotation(sigma * rng.standard_normal(3))
        error[:3, 3] = _LENGTH_M * sigma * rng.standard_normal(3)
        stack[k] = error @ stack[k]
    return replace(arm, stack=stack)
