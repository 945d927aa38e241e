"""What the servo makes of a late frame: the progress at its time, its weight, and whether contact was lost."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.welding.seam.curve import SeamFrame
from weldcal.welding.servo.contact import contact_lost, freshness, progress_at, with_frame, with_progress
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import DeflectionSample, ServoSample, WeldingState

DT = 0.008


def driven(speeds: list[float]) -> WeldingState:
    """The state after ticks of 8 ms at these speeds (m/s)."""
    state = WeldingState()
    for k, v in enumerate(speeds):
        state = with_progress(state, (k + 1) * DT, v, DT)
    return state


def test_progress_between_two_ticks_is_interpolated() -> None:
    """A frame is taken at any time: a tick at 10 mm/s is 80 um, and a tip that turns back in between counts with its
    sign."""
    speeds = [0.01, 0.012, 0.008, -0.004, 0.01]
    state = driven(speeds)
    ends, at = np.arange(1, 6) * DT, np.cumsum(speeds) * DT
    for time in np.linspace(DT, 5 * DT, 33):
        assert progress_at(state, float(time)) == pytest.approx(float(np.interp(time, ends, at)), abs=1e-12)


def test_progress_before_the_first_tick_goes_back_at_the_tips_speed() -> None:
    state = driven([0.01])
    assert state.v_tip == 0.0
    assert progress_at(state, 0.0) == pytest.approx(0.01 * DT)
    assert progress_at(WeldingState(progress=0.02), 5.0) == 0.02


def test_a_frame_counts_whole_for_three_camera_periods_and_not_after_six() -> None:
    state = WeldingState(frame_time=1.0)
    assert [round(freshness(state, 1.0 + age), 9) for age in (0.0, 0.1, 0.15, 0.2, 0.5)] == [1.0, 1.0, 0.5, 0.0, 0.0]


def test_both_springs_unload_at_a_loss_of_contact() -> None:
    config = ServoConfig()
    drop = 2.0 * config.contact.drop_m
    before = WeldingState(proven=True, delta_n=0.01, delta_axial=0.01)
    one = WeldingState(proven=True, delta_n=0.01 - drop, delta_axial=0.01)
    both = WeldingState(proven=True, delta_n=0.01 - drop, delta_axial=0.01 - drop)
    assert not contact_lost(before, one, config)
    assert contact_lost(before, both, config)


def test_a_tip_pushed_back_and_up_is_deflected_to_the_left_and_axially() -> None:
    """The tool presses to the left and down; the wall holds the tip 0.4 mm to the right of its rest and 0.3 mm above
    it."""
    x, y, z = np.eye(3)
    seam = SeamFrame(np.zeros(3), x, y, z, 0.0)
    X_BT = RigidTransform(RollPitchYaw(0.0, 0.0, 0.5), [0.4, 0.1, 0.2])
    off_T = X_BT.rotation().matrix().T @ np.array([0.0, -0.4e-3, 0.3e-3])
    frame = DeflectionSample(0.1, X_BT, off_T, True)
    state = with_frame(WeldingState(), ServoSample(0.1, X_BT, frame), seam, ServoConfig())
    assert (state.delta_n, state.delta_axial) == pytest.approx((0.4e-3, 0.3e-3))
    assert state.measurement is not None
    np.testing.assert_allclose(state.measurement.point, [0.4, 0.1 - 0.4e-3, 0.2 + 0.3e-3])
