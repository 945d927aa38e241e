"""The paper's law beside the guarded one, in the same world: what each step of mending it does."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worlds.weld.budgets import KINEMATIC, NOMINAL, Budget
from tests.worlds.weld.case import RunMetrics, WeldCase, judge, study_config
from tests.worlds.weld.laws import LAWS, UnknownLaw, get_law, literal_tangent, steering
from tests.worlds.weld.plant import simulate
from tests.worlds.weld.seams import TrueSeam, arcs, corner
from weldcal.welding.numerics import Array
from weldcal.welding.seam.refinement import RefinedSeam

STRAIGHT = arcs((0.10, 0.0), spacing=2e-3)
CORNER = corner(0.020, 90.0, 1.0, legs=0.07)
BEND = arcs((0.03, 0.0), (0.06, 1.0 / 0.06), spacing=2e-3)


def welded(points: Array, law: str, budget: Budget = NOMINAL) -> RunMetrics:
    """One short weld under a law, as in the study."""
    case = WeldCase("short", law=law)
    with steering(law):
        run = simulate(TrueSeam("short", points, np.array([0.0, 0.0, 1.0])), budget, study_config(case), 0)
    return judge(run, case.speed_m_s, case.chord_m)


def test_an_unknown_law_is_named_with_the_known_ones() -> None:
    with pytest.raises(UnknownLaw, match="guarded"):
        get_law("magic")
    assert get_law("printed").sign == -LAWS["open"].sign


def test_as_printed_the_torch_is_thrown_off_the_seam() -> None:
    printed = welded(BEND, "printed")
    assert not printed.completed
    # Section B.5: lost within 20 mm of travel.
    assert printed.max_mm > 10.0


def test_with_its_sign_corrected_it_keeps_the_offset_it_starts_with() -> None:
    corrected = welded(STRAIGHT, "open", KINEMATIC)
    assert corrected.completed
    # Touch-on pushes the rest point delta_d to the side, and the torch with it; nothing takes that back.
    # Touch-on is over once the tip leans by nine tenths of it.
    assert 0.9 * 2.0 - 0.02 <= corrected.mean_mm <= 2.0 + 0.02
    fed_back = welded(STRAIGHT, "fixed", KINEMATIC)
    assert fed_back.mean_mm < 0.02


def test_at_a_corner_only_the_guarded_law_keeps_the_torchs_speed() -> None:
    fixed = welded(CORNER, "fixed")
    guarded = welded(CORNER, "guarded")
    # Section B.2: holding the tip's speed swings the torch's from 2.8 to 22 mm/s.
    assert fixed.cv_percent > 20.0
    assert guarded.cv_percent < 1.0
    assert guarded.max_mm <= 0.15
    assert fixed.completed
    assert guarded.completed


def test_the_literal_normal_comes_from_the_neighbours_of_the_nearest_point() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [3.0, 3.0, 0.0]])
    seam = RefinedSeam(points, np.arange(4.0))
    t = literal_tangent(seam, np.array([2.1, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(t, np.array([2.0, 3.0, 0.0]) / np.sqrt(13.0))
    otherwise = np.array([0.0, 1.0, 0.0])
    assert literal_tangent(RefinedSeam.empty(), points[0], otherwise) is otherwise
