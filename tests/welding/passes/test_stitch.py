"""Stitches: the true torch is on along the ordered pieces only, and what cannot be welded is refused."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.worlds.weld.budgets import NOMINAL
from tests.worlds.weld.plant import StudyRun, simulate
from tests.worlds.weld.seams import TrueSeam, s_curve
from weldcal.welding.passes.stitch import StitchConfig, StitchError
from weldcal.welding.record.process import PathError, path_error
from weldcal.welding.servo.settings import ServoConfig, TorchControl
from weldcal.welding.servo.state import Phase

UP = np.array([0.0, 0.0, 1.0])
STITCH = StitchConfig(on_m=0.030, off_m=0.045, from_m=0.015)  # on 300 mm: the last one is left out
CUT = StitchConfig(on_m=0.040, off_m=0.050)  # on 300 mm: the last one is cut at the end


def stitched(stitch: StitchConfig, torch: TorchControl) -> tuple[StudyRun, PathError, np.ndarray]:
    """The run, where the true torch was beside the true seam, and when it was on."""
    config = ServoConfig(stitch=stitch, torch=torch, weld_speed_m_s=0.016)
    run = simulate(TrueSeam("s", s_curve(), UP), NOMINAL, config, seed=4)
    return run, path_error(run.points("torch"), run.torch_line), run.column("torch_on") > 0.5


@pytest.mark.parametrize(
    ("stitch", "torch", "pieces"),
    [
        (STITCH, TorchControl(), [(15, 45), (90, 120), (165, 195), (240, 270)]),
        (STITCH, TorchControl(from_rest=True, crater_s=0.3), [(15, 45), (90, 120), (165, 195), (240, 270)]),
        (CUT, TorchControl(crater_s=0.3), [(0, 40), (90, 130), (180, 220), (270, 300)]),
    ],
)
def test_the_torch_is_on_along_the_ordered_pieces(
    stitch: StitchConfig, torch: TorchControl, pieces: list[tuple[float, float]]
) -> None:
    run, off, on = stitched(stitch, torch)
    assert run.phase == Phase.DONE, run.reason
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int))).reshape(-1, 2)
    found = 1e3 * np.array([(off.s[a], off.s[b - 1]) for a, b in edges])
    # the plan is up to 2 mm off along the seam, until a bend has been felt
    ordered = np.array(pieces, dtype=float)
    assert found == pytest.approx(ordered, abs=2.0)
    assert np.diff(found)[1:] == pytest.approx(np.diff(ordered)[1:], abs=0.5)
    assert off.distance_m[on].max() < 0.3e-3
    if torch.from_rest:
        v = np.abs(np.gradient(off.s, run.column("time_s")))
        assert v[edges[:, 0]].max() < 1e-3, "each piece starts from rest"
        assert v[edges[:, 1] - 1].max() < 1e-3, "and ends in its crater"


def test_stitches_that_are_too_short_for_the_speed_are_refused() -> None:
    with pytest.raises(StitchError, match=r"at least 4\.8 mm long at 16 mm/s"):
        ServoConfig(stitch=StitchConfig(on_m=0.004, off_m=0.05), weld_speed_m_s=0.016)
    with pytest.raises(StitchError, match="both above zero"):
        StitchConfig(on_m=0.03)


def test_a_stitch_whose_torch_is_off_the_seam_is_a_fault() -> None:
    """A later piece may be missed as little as the first one."""
    torch = TorchControl(ignition_error_m=1e-9)
    config = ServoConfig(stitch=STITCH, torch=torch)
    run = simulate(TrueSeam("s", s_curve(), UP), NOMINAL, replace(config, weld_speed_m_s=0.016), seed=4)
    assert run.phase == Phase.FAULT
    assert "arc is not lit" in str(run.reason)


@pytest.mark.parametrize("length", [0.02, 0.04, 0.1, 0.2, 0.3, 0.61])
def test_from_the_middle_outwards_no_side_is_ahead_by_more_than_a_piece(length: float) -> None:
    along = StitchConfig(on_m=0.03, off_m=0.045, from_m=0.005).pieces(length)
    assert along == sorted(along)
    ordered = StitchConfig(on_m=0.03, off_m=0.045, from_m=0.005, order="middle_out").pieces(length)
    assert sorted(ordered) == along, "the same pieces"
    middle = 0.5 * (along[0].start + along[-1].end) if along else 0.0
    pitch = 0.075
    for k in range(1, len(ordered) + 1):
        # what is welded is one stretch, whose middle stays within half a pitch of the seam's
        done = sorted(ordered[:k])
        assert all(b.start - a.start == pytest.approx(pitch) for a, b in pairwise(done))
        assert abs(0.5 * (done[0].start + done[-1].end) - middle) < 0.5 * pitch + 0.015


def test_a_seam_without_stitches_is_one_piece() -> None:
    assert StitchConfig().pieces(0.2) == [(0.0, 0.2)]
