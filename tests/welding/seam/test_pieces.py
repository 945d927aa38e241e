"""A seam with things in the tool's way is split where neither the tip nor the torch, a chord behind it, meets them."""

from __future__ import annotations

import numpy as np
import pytest

from weldcal.welding.seam.clearance import clear_pieces
from weldcal.welding.seam.curve import SeamCurve

SEAM = SeamCurve.from_points(np.outer(np.linspace(0.0, 0.5, 60), [1.0, 0.0, 0.0]))
CHORD_M, RUN_UP_M, STEP_M = 0.06, 0.016, 0.005


def met(pieces: list[tuple[float, float, float]], low: float, high: float) -> bool:
    """Whether a tip that comes down and runs to the end of each piece, or its torch, is in a thing between two
    places."""
    for start, end, down in pieces:
        tips = np.arange(down, end + CHORD_M if end < SEAM.length else SEAM.length, 1e-4)
        torch = tips - CHORD_M
        if ((tips > low) & (tips < high)).any() or ((torch > low) & (torch < high)).any():
            return True
        assert torch[0] <= start, "the torch is behind the start when the tip comes down"
    return False


@pytest.mark.parametrize("at", np.linspace(0.08, 0.45, 12))
def test_no_piece_runs_tip_or_torch_into_the_thing(at: float) -> None:
    low, high = at - 0.006, at + 0.006
    tips = np.arange(0.0, 0.5, STEP_M)
    stops = [float(s) for s in tips if low <= s <= high or low <= s - CHORD_M <= high]
    pieces = clear_pieces(SEAM, stops, CHORD_M, RUN_UP_M)
    assert not met(pieces, low, high)
    welded = sum(end - start for start, end, _ in pieces)
    # the chord, the thing, two steps at its sides and the run-up; what is too short to begin on is left out, too
    if CHORD_M + 0.03 < at < 0.5 - 2.0 * CHORD_M:
        assert welded > 0.5 - (CHORD_M + 0.012 + 4.0 * STEP_M + RUN_UP_M) - 1e-9


def test_a_clear_seam_is_one_piece() -> None:
    assert clear_pieces(SEAM, [], CHORD_M, RUN_UP_M) == [(0.0, SEAM.length, 0.0)]


def test_where_everything_is_blocked_nothing_is_left() -> None:
    assert clear_pieces(SEAM, list(np.arange(0.0, 0.5, STEP_M)), CHORD_M, RUN_UP_M) == []
