"""The torch stands while the arc starts at the seam's start, and while the crater fills at its end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.worlds.weld.budgets import PERFECT
from tests.worlds.weld.plant import StudyRun, simulate
from tests.worlds.weld.seams import TrueSeam
from weldcal.welding.servo.settings import ServoConfig, TorchControl
from weldcal.welding.servo.state import Phase

LENGTH_M = 0.03
LAGS = replace(PERFECT, lag_s=ServoConfig().lag_s)
STANDING_M_S = 1e-4


def straight(torch: TorchControl) -> StudyRun:
    points = np.column_stack([np.linspace(0.0, LENGTH_M, 60), np.zeros(60), np.zeros(60)])
    seam = TrueSeam("straight", points, np.array([0.0, 0.0, 1.0]))
    return simulate(seam, LAGS, replace(ServoConfig(), torch=torch), 1, time_limit_s=40.0)


def places_and_speeds(run: StudyRun) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, x of the true torch, its true speed, and whether the torch is on, at each tick."""
    t, x = run.column("time_s"), run.points("torch")[:, 0]
    return t, x, np.gradient(x, t), run.column("torch_on") > 0.5


def test_the_torch_stands_on_the_seams_start_before_it_is_on() -> None:
    run = straight(TorchControl(from_rest=True))
    assert run.phase == Phase.DONE
    _, x, v, on = places_and_speeds(run)
    first = int(np.argmax(on))
    assert np.abs(v[first - 2 : first + 1]).max() < STANDING_M_S
    assert x[first] == pytest.approx(0.0, abs=2e-4)


def test_without_it_the_torch_moves_when_it_is_switched_on() -> None:
    _, _, v, on = places_and_speeds(straight(TorchControl()))
    assert v[int(np.argmax(on))] > 5e-3


def test_the_torch_stands_for_the_hot_start_and_for_the_crater() -> None:
    torch = TorchControl(from_rest=True, start_s=0.5, crater_s=0.8)
    run = straight(torch)
    assert run.phase == Phase.DONE
    _, x, v, on = places_and_speeds(run)
    standing = on & (np.abs(v) < STANDING_M_S)
    begin, end = standing & (x < 0.5 * LENGTH_M), standing & (x > 0.5 * LENGTH_M)
    assert 0.008 * begin.sum() == pytest.approx(0.5, abs=0.06)
    # the lag of the arm before the crater is no time of filling
    assert 0.8 <= 0.008 * end.sum() <= 0.95
    assert x[end] == pytest.approx(LENGTH_M, abs=3e-4)
    last = np.flatnonzero(on)[-1]
    assert x[last:].max() < LENGTH_M + 5e-4, "nothing moves on after the crater"
