"""The search for the groove: a ball that rests leaning above its plan is in the root of a guiding joint, and on a wall elsewhere."""

import re
from dataclasses import replace

import pytest

from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import WeldingState
from weldcal.welding.servo.touch import _search

CONFIG = ServoConfig()
REST = WeldingState(delta_n=CONFIG.deflection.delta_d_m, delta_axial=CONFIG.deflection.axial_d_m)


def searched(offset_m: float, above_m: float, frames: int = 20) -> tuple[str | None, bool, int]:
    """The fault, whether the tip is seated, and after how many frames, of a ball that rests above its planned line."""
    config = replace(CONFIG, touch=replace(CONFIG.touch, offset_m=offset_m))
    state = replace(REST, touch=replace(REST.touch, step="search", face_height=above_m, start_left=0.0))
    for frame in range(1, frames + 1):
        state, _, _, problem, seated = _search(state, True, 0.0, above_m, 0.0, 1.0, config, 0.03 * frame)
        if problem or seated:
            return problem, seated, frame
    return None, False, frames


def test_a_ball_in_a_guiding_joint_is_seated_above_a_plan_that_is_too_deep() -> None:
    """A scanner that measures 0.2 % too far puts a fillet 1.9 mm too low: its root then lies above the plan."""
    problem, seated, frames = searched(0.0, 2.2e-3)
    assert (problem, seated) == (None, True)
    assert frames >= 10, "a ball that still slides down its wall leans too"


def test_a_ball_far_above_its_plan_or_beside_a_narrow_joint_is_at_a_wall() -> None:
    for offset_m, above_m in ((0.0, 3.5e-3), (-5e-3, 2.2e-3)):
        problem, seated, _ = searched(offset_m, above_m)
        assert not seated
        assert re.search("the tip met a wall but no groove", str(problem))


@pytest.mark.parametrize("offset_m", [0.0, -5e-3])
def test_a_ball_that_rests_where_it_is_planned_is_seated_at_once(offset_m: float) -> None:
    assert searched(offset_m, 1e-4)[1:] == (True, 3)
