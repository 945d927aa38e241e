"""The paper's law beside the guarded one, in the same world: what each step of mending it does."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.tools.studies.weld_rows import Case
from weldcal.tools.studies.weld_study import run_case
from weldcal.welding.chord import UnknownLaw
from weldcal.welding.laws import LAWS, get_law, literal_tangent
from weldcal.welding.refinement import RefinedSeam


def test_an_unknown_law_is_named_with_the_known_ones() -> None:
    with pytest.raises(UnknownLaw, match="guarded"):
        get_law("magic")
    assert get_law("printed").sign == -LAWS["open"].sign


def test_as_printed_the_torch_is_thrown_off_the_seam() -> None:
    _, printed = run_case(Case("s_r60", law="printed"), 0)
    assert not printed.completed
    # Section B.5: lost within a tenth of the seam.
    assert printed.max_mm > 10.0


def test_with_its_sign_mended_it_keeps_the_offset_it_starts_with() -> None:
    _, mended = run_case(Case("straight", law="open"), 0)
    assert mended.completed
    # Touch-on pushes the rest point delta_d to the side, and the torch with it; nothing takes that back.
    assert mended.mean_mm == pytest.approx(2.0, abs=0.35)
    _, fed_back = run_case(Case("straight", law="fixed"), 0)
    assert fed_back.mean_mm < 0.05


def test_at_a_corner_only_the_guarded_law_keeps_the_torchs_speed() -> None:
    _, fixed = run_case(Case("l_r20_convex", law="fixed"), 0)
    _, guarded = run_case(Case("l_r20_convex"), 0)
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
