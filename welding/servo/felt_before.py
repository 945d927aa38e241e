"""Begins a weld behind a crater: the points of the earlier run lead the torch until it reaches newly felt ones."""

import math
from dataclasses import replace

import numpy as np

from weldcal.welding.numerics import Array, changed, dot
from weldcal.welding.seam.plan_fit import add_point
from weldcal.welding.seam.refinement import PendingPoint, RefinedSeam
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import ServoSample, TouchOnState, WeldingState

MOVED_M = 0.5e-3  # a choice: ten sigma of the tag's noise, and half of what costs a fillet its root
_NEAR_M = 4.0e-3  # to both sides of the tip: the points that it is compared with
_LEAST = 4  # of them
_STEP_M = 0.03e-3  # below the tag's noise of 0.05 mm: nearer points give the path no direction


def start_state(felt: Array | None) -> WeldingState:
    """The servo's first state, with the points (N, 4) m in B that an earlier run felt, each with its lag."""
    if felt is None:
        return WeldingState()
    return WeldingState(touch=TouchOnState(felt=tuple(PendingPoint(row[:3], float(row[3])) for row in felt)))


def with_felt_before(state: WeldingState, sample: ServoSample, config: ServoConfig) -> tuple[WeldingState, str | None]:
    """The state of a seated tip with the path of the earlier run behind it, and the plan registered to that path.

    Returns:
        (state, fault sentence where the tip is not on that path: the part was moved since).
    """
    assert state.plan_fit is not None
    assert state.measurement is not None
    fit, tip = state.plan_fit, state.measurement.point
    points, lag = (np.array([q[k] for q in state.touch.felt]) for k in (0, 1))
    window = config.tool.torch_offset_m
    at = fit.curve.nearest(tip, state.s_tip)
    s = fit.curve.project(points, at - 0.5 * window, window)
    near = np.abs(s - at) < _NEAR_M
    if np.count_nonzero(near) >= _LEAST:
        seam, off = fit.curve.frame(at), tip - points[near].mean(axis=0)
        # the mean of the points beside the tip stands for the path there
        off = off - (at - float(s[near].mean())) * seam.tangent
        aside, above = dot(off, seam.normal), dot(off, seam.up)
        if math.hypot(aside, above) > MOVED_M:
            return state, (
                f"The part was moved since it was welded: the tip touches the seam {1e3 * math.hypot(aside, above):.1f}"
                f" mm beside the path that it felt before (limit {1e3 * MOVED_M:g} mm). Weld it anew, or by hand."
            )
    rest = fit.curve.nearest(np.asarray(sample.X_BT.translation()), at)
    rows, last = [], -math.inf
    for k in np.argsort(s + lag):
        if last + _STEP_M < s[k] + lag[k] < rest:
            rows.append(k)
            last = s[k] + lag[k]
    if not rows:
        return state, None
    points, lag, s = points[rows], lag[rows], s[rows]
    spaced, far = [0], config.plan_fit.spacing_m
    for k in range(1, len(s)):
        if s[k] - s[spaced[-1]] >= far:
            spaced.append(k)
    fit = replace(fit, points=points[spaced[:-1]], s=s[spaced[:-1]])
    fit = add_point(fit, points[spaced[-1]], float(s[spaced[-1]]), config.plan_fit)
    arc = fit.curve.project(points, at - 0.5 * window, window) + lag
    keep = np.concatenate([[True], np.diff(arc) > 0.0])
    # Registering the plan may move it along itself; the crater stays where it is.
    start = np.asarray(fit.plan.position(0.0))
    return changed(state, plan_fit=fit, refined=RefinedSeam(points[keep], arc[keep]), start_point=start), None
