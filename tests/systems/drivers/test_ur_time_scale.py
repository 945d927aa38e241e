"""A cell that gives no new velocity slows the arm, and one that comes back lets it go on without a jerk."""

from __future__ import annotations

from itertools import pairwise

import pytest

from weldcal.systems.drivers.ur.worker import FRESH_S, RISE_PER_S, ZERO_S, TimeScale

PASS_S = 0.004


def factors(ages_s: list[float], pace: float = 1.0) -> list[float]:
    scale, now = TimeScale(pace), 50.0
    found = []
    for age in ages_s:
        now += PASS_S / pace
        found.append(scale.step(now, age / pace))
    return found


@pytest.mark.parametrize("pace", [1.0, 0.25])
def test_a_fresh_velocity_is_sent_as_it_is_and_a_late_one_falls_to_rest(pace: float) -> None:
    ages = [k * PASS_S for k in range(16)]
    found = factors(ages, pace)
    assert [f for f, age in zip(found, ages, strict=True) if age <= FRESH_S] == [1.0] * 4
    assert all(b <= a for a, b in pairwise(found))
    assert all(f == 0.0 for f, age in zip(found, ages, strict=True) if age >= ZERO_S)
    assert 0.0 < found[8] < 1.0


def test_after_a_delay_the_arm_is_not_jerked() -> None:
    found = factors([0.0, 0.1, *[0.0] * 60])
    assert found[1] == 0.0
    assert max(b - a for a, b in pairwise(found)) == pytest.approx(RISE_PER_S * PASS_S)
    assert found[-1] == 1.0
