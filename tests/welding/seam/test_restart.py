"""The rest of a broken seam begins before its crater, and only where the part still is."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.restart import BEHIND_M, MOVED_M, SPARE_M, NoRoomBehindCrater, PartMoved, Restart

SEAM = SeamCurve.from_points(np.column_stack([np.linspace(0.0, 0.2, 41), np.zeros(41), np.zeros(41)]))
CHORD_M, RUN_UP_M, WINDOW_M = 0.060, 0.016, 0.006
HERE = RigidTransform(np.array([0.5, 0.1, 0.0]))


def broken_at(s_m: float, **more: object) -> Restart:
    return Restart(seam=0, p_BCrater=np.array([s_m, 0.4e-3, -4e-3]), **more)  # type: ignore[arg-type]


def test_the_rest_begins_an_overlap_before_the_crater() -> None:
    cut = broken_at(0.1).cut(SEAM, CHORD_M, RUN_UP_M, WINDOW_M)
    assert cut.start_m == pytest.approx(0.092, abs=1e-6)
    assert cut.line.position(0.0) == pytest.approx([0.092, 0.0, 0.0], abs=1e-6)
    assert cut.line.length == pytest.approx(0.108, abs=1e-6)
    # the torch comes down as far before the start as it needs to follow the seam there
    assert cut.down_m == pytest.approx(CHORD_M - RUN_UP_M, abs=1e-6)
    assert cut.question(1) == "The arc will start 8 mm before the crater at 100 mm of seam 2. Start?"


def test_a_crater_near_the_start_begins_the_seam_anew() -> None:
    cut = broken_at(0.003).cut(SEAM, CHORD_M, RUN_UP_M, WINDOW_M)
    assert cut.start_m == 0.0
    assert "3 mm before the crater at 3 mm" in cut.question(0)
    assert (
        Restart(seam=2).cut(SEAM, CHORD_M, RUN_UP_M, WINDOW_M).question(2).startswith("The arc will start at the beg")
    )


def test_nothing_before_the_first_arc_is_welded() -> None:
    # a new scan places the seam's start 2 mm late, or 2 mm early
    for begin_m in (-0.002, 0.002):
        cut = broken_at(0.006, p_BBegin=np.array([begin_m, 0.4e-3, -4e-3])).cut(SEAM, CHORD_M, RUN_UP_M, WINDOW_M)
        assert cut.start_m == pytest.approx(begin_m, abs=1e-6)
        assert cut.line.position(0.0) == pytest.approx([begin_m, 0.0, 0.0], abs=1e-6)
        assert cut.line.length == pytest.approx(SEAM.length - begin_m, abs=1e-6)
    assert broken_at(0.1, p_BBegin=np.zeros(3)).cut(SEAM, CHORD_M, RUN_UP_M, WINDOW_M).start_m == pytest.approx(0.092)


def test_the_tip_touches_the_open_groove_or_nothing() -> None:
    last = SEAM.length - WINDOW_M - BEHIND_M - SPARE_M
    cut = broken_at(last - 1e-4).cut(SEAM, CHORD_M, RUN_UP_M, WINDOW_M)
    assert cut.down_m is not None
    assert cut.start_m + cut.down_m == pytest.approx(SEAM.length - WINDOW_M - SPARE_M, abs=1e-6)
    with pytest.raises(NoRoomBehindCrater, match="weld the rest by hand"):
        broken_at(last + 1e-4).cut(SEAM, CHORD_M, RUN_UP_M, WINDOW_M)


def test_a_groove_that_goes_on_is_touched_past_the_seams_end() -> None:
    short = SeamCurve.from_points(SEAM.position(np.linspace(0.0, 0.2, 41)), up=np.array([0.0, 0.0, 1.0]), length=0.12)
    cut = broken_at(0.115).cut(short, CHORD_M, RUN_UP_M, WINDOW_M)
    assert cut.line.length == pytest.approx(0.12 - 0.107, abs=1e-6)
    assert cut.down_m == pytest.approx(CHORD_M - RUN_UP_M, abs=1e-6)


@pytest.mark.parametrize(
    ("moved_m", "sigma_m", "goes_on"),
    [
        (0.9 * MOVED_M, 0.1e-3, True),
        (1.1 * MOVED_M, 0.1e-3, False),
        (1.1 * MOVED_M, 0.4e-3, True),  # three sigma of the difference of two scans: 1.7 mm
        (1.9e-3, 0.4e-3, False),
    ],
)
def test_a_part_that_was_moved_is_refused(moved_m: float, sigma_m: float, goes_on: bool) -> None:
    restart = broken_at(0.1, X_BP=HERE.GetAsMatrix4(), sigma_m=sigma_m)
    now = RigidTransform(HERE.translation() + moved_m * np.array([0.6, 0.8, 0.0]))
    if goes_on:
        restart.check_unmoved(SEAM, now, sigma_m)
    else:
        with pytest.raises(PartMoved, match=f"moved by {1e3 * moved_m:.1f} mm"):
            restart.check_unmoved(SEAM, now, sigma_m)


def test_a_turn_counts_where_the_seam_is() -> None:
    restart = broken_at(0.1, X_BP=np.eye(4), sigma_m=0.05e-3)
    turned = RigidTransform(RotationMatrix(AngleAxis(0.006, np.array([0.0, 0.0, 1.0]))), np.zeros(3))
    with pytest.raises(PartMoved):
        restart.check_unmoved(SEAM, turned, 0.05e-3)  # 1.2 mm at the far end
    restart.check_unmoved(SEAM, None, 0.05e-3)
