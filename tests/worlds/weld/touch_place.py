"""Where the tip comes down first: beside a seam that starts in a bend, on its first straight stretch."""

import math
from dataclasses import replace

import numpy as np

from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig

_STRAIGHT_RAD = math.radians(10.0)  # a bend turns by more than this
_BESIDE_M = 4.0e-3  # the tip must not touch down within this distance of a bend
_REACH_M = 0.030  # nor farther than this from the start


def with_touch_place(plan: SeamCurve, config: ServoConfig) -> ServoConfig:
    """The settings with the touch position moved to the first straight stretch where the seam starts in a bend.

    Next to a bend of about the touch's offset it is unknown which part of the seam the tip meets. Only a tip that
    then measures the start backwards (`touch.feel_start`) may start so far along the seam.
    """
    touch = config.touch
    if not touch.feel_start:
        return config
    s = np.arange(touch.arc_m, max(min(_REACH_M, plan.length - config.gap.end_window_m), touch.arc_m + 1e-6), 1e-3)
    turn = np.sum(plan.tangent(s - _BESIDE_M) * plan.tangent(s + _BESIDE_M), axis=1)
    straight = np.flatnonzero(turn > math.cos(_STRAIGHT_RAD))
    place = float(s[straight[0] if len(straight) else np.argmax(turn)])
    return replace(config, touch=replace(touch, arc_m=place))
