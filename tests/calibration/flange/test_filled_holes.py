"""A hole pattern with filled holes leads to no wrong rotation about the flange axis."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from pydrake.math import RigidTransform

from tests.worlds.flange_frames import flange_frame
from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.holes import HolePattern, find_holes
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.models.scanners import get_scanner

FLANGE = "iso9409-1-50-4-m6"
SCANNER = get_scanner("phoxi_m", 1032)
WRONG_RAD = float(np.radians(10.0))  # half of the least symmetry that a pattern has is more


def turn_of(standard: FlangeStandard, filled: Sequence[int], rng: list[int]) -> str:
    """Find the hole pattern's turn with these openings filled: "none", "open", "right" or "wrong"."""
    frame = flange_frame(SCANNER, with_filled(standard, filled), np.random.default_rng(rng))
    assert frame.X_CR is not None
    try:
        pattern = find_holes(frame.points_C, fit_flange(frame.points_C, standard), standard)
    except FlangeNotFound:
        return "none"
    if pattern is None or not pattern.turn_known:
        return "none" if pattern is None else "open"
    return "right" if abs(turn_error(pattern, frame.X_CR)) < WRONG_RAD else "wrong"


def with_filled(standard: FlangeStandard, filled: Sequence[int]) -> FlangeStandard:
    """Return the flange without these of its openings (threads in order, then the dowel hole)."""
    threads = tuple(a for k, a in enumerate(standard.hole_angles_rad) if k not in filled)
    pin = 0.0 if standard.n_holes in filled else standard.pin_m
    return replace(standard, n_holes=len(threads), hole_angles_rad=threads, pin_m=pin)


def turn_error(pattern: HolePattern, X_CR: RigidTransform) -> float:
    """Error (rad) of the pattern's rotation about the flange axis."""
    R = (X_CR.rotation().inverse() @ pattern.X_CR.rotation()).matrix()
    return float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))


def fillings(standard: FlangeStandard) -> Iterator[tuple[str, list[tuple[int, ...]]]]:
    """Names and the openings that each fills, by turns."""
    n = standard.n_holes
    names = [*(f"thread {k + 1}" for k in range(n)), *(["dowel hole"] if standard.pin_m > 0.0 else [])]
    yield "nothing", [()]
    for k, name in enumerate(names):
        yield name, [(k,)]
    yield "two", list(combinations(range(len(names)), 2))


def test_no_filled_holes_lead_to_a_wrong_rotation() -> None:
    standard = get_flange(FLANGE)
    found = {
        name: Counter(turn_of(standard, choices[k % len(choices)], [4, c, k]) for k in range(2))
        for c, (name, choices) in enumerate(fillings(standard))
    }
    assert list(found) == ["nothing", *(f"thread {k}" for k in (1, 2, 3, 4)), "dowel hole", "two"]
    assert sum(count["wrong"] for count in found.values()) == 0
    assert found["nothing"]["right"] > 0
    assert found["dowel hole"]["right"] == 0
    assert found["dowel hole"]["open"] > 0
