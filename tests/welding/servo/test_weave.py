"""The torch weaves across the seam while the tip keeps to its own path."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from weldcal.tools.worlds.weld.budgets import NOMINAL
from weldcal.tools.worlds.weld.plant import simulate
from weldcal.tools.worlds.weld.seams import TrueSeam, arcs
from weldcal.welding.record.process import path_error
from weldcal.welding.servo.settings import (
    ServoConfig,
    ServoConfigError,
    ToolGeometry,
    WeaveConfig,
    WeaveError,
    weave_at,
)
from weldcal.welding.servo.state import Phase

MM = 1e-3


def test_the_rate_is_the_derivative_of_the_offset() -> None:
    weave = WeaveConfig(2.0 * MM, 1.5, 0.1, 0.2)
    for since in np.linspace(0.013, 4.0, 400):
        h = 1e-6
        ahead, behind = weave_at(weave, since + h)[0], weave_at(weave, since - h)[0]
        # Central differences: a kink of the growth or of a dwell's end may lie between the two.
        assert (ahead - behind) / (2.0 * h) == pytest.approx(weave_at(weave, since)[1], abs=0.4 * MM)


def test_it_rests_at_its_sides_and_reaches_its_amplitude() -> None:
    weave = WeaveConfig(2.0 * MM, 1.0, 0.3, 0.1)
    t = np.linspace(2.0, 2.0 + 10 * 1.4, 14001)
    offset = np.array([weave_at(weave, x)[0] for x in t])
    assert offset.max() == pytest.approx(2.0 * MM)
    assert offset.min() == pytest.approx(-2.0 * MM)
    # 0.3 s of every 1.4 s on the left, 0.1 s on the right; the cosine itself is at its top for no time at all.
    assert np.mean(offset > 2.0 * MM - 1e-9) == pytest.approx(0.3 / 1.4, abs=0.02)
    assert np.mean(offset < -2.0 * MM + 1e-9) == pytest.approx(0.1 / 1.4, abs=0.02)


def test_it_begins_in_the_middle_without_a_step() -> None:
    weave = WeaveConfig(3.0 * MM, 1.0)
    assert weave_at(weave, 0.0) == (0.0, 0.0)
    assert abs(weave_at(weave, 0.008)[0]) < 0.05 * MM
    assert weave_at(WeaveConfig(), 5.0) == (0.0, 0.0)


@pytest.mark.parametrize(
    "bad", [{"amplitude_m": -1.0}, {"frequency_hz": 0.0}, {"amplitude_m": math.nan}, {"amplitude_m": 0.02}]
)
def test_a_weave_that_cannot_be_swung_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(WeaveError):
        WeaveConfig(**bad)


def test_a_weave_beyond_the_tools_turning_is_refused() -> None:
    with pytest.raises(ServoConfigError, match="weave"):
        ServoConfig(weave=WeaveConfig(4.0 * MM, 3.0), tool=ToolGeometry(torch_offset_m=0.04))


def test_only_the_torch_weaves() -> None:
    seam = TrueSeam("short", arcs((0.120, 0.0), spacing=2e-3), np.array([0.0, 0.0, 1.0]))
    config = ServoConfig(tool=ToolGeometry(torch_offset_m=0.040))
    still = simulate(seam, NOMINAL, config, 3)
    woven = simulate(seam, NOMINAL, replace(config, weave=WeaveConfig(2.0 * MM, 1.0)), 3)
    assert woven.phase == Phase.DONE
    assert abs(woven.column("omega_rad_s")).max() <= 0.8
    on = woven.column("torch_on") > 0.5
    side = path_error(woven.points("torch")[on], woven.torch_line).lateral
    settled = side[len(side) // 4 :]
    # Within a tenth of the amplitude: the lag is looked ahead for, tag and gain leave their 0.1 mm.
    assert settled.max() == pytest.approx(2.0 * MM, abs=0.25 * MM)
    assert settled.min() == pytest.approx(-2.0 * MM, abs=0.25 * MM)
    track = woven.column("phase") == 1
    tip = path_error(woven.points("tip")[track], woven.torch_line)
    assert abs(tip.lateral[tip.s < 0.120]).max() <= 0.02 * MM
    quiet = still.column("phase") == 1
    assert (
        abs(np.std(woven.column("delta_n_m")[track][300:]) - np.std(still.column("delta_n_m")[quiet][300:])) < 0.05 * MM
    )
