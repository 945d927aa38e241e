"""Measures how often a hole pattern with filled holes is given a wrong rotation about the flange axis."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.holes import HolePattern, find_holes
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard
from weldcal.models.scanners import ScannerPreset
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.studies.flange.frames import flange_frame

_WRONG_RAD = float(np.radians(10.0))  # half of the least symmetry that a pattern has is more


@dataclass(frozen=True, kw_only=True)
class HoleTurn:
    """Of ``scans`` with these holes filled: with no pattern found, with its rotation left open, and with one rotation stated:
    ``right`` or ``wrong`` (more than 10 degrees off), and the mean square of the right ones' errors in stated sigmas."""

    filled: str
    scans: int
    no_pattern: int
    left_open: int
    right: int
    wrong: int
    mean_normalised: float


def with_filled(standard: FlangeStandard, filled: Sequence[int]) -> FlangeStandard:
    """The flange without these of its openings (threads in order, then the dowel hole)."""
    threads = tuple(a for k, a in enumerate(standard.hole_angles_rad) if k not in filled)
    pin = 0.0 if standard.n_holes in filled else standard.pin_m
    return replace(standard, n_holes=len(threads), hole_angles_rad=threads, pin_m=pin)


def turn_error(pattern: HolePattern, X_CR: RigidTransform) -> float:
    """Error (rad) of the pattern's rotation about the flange axis."""
    R = (X_CR.rotation().inverse() @ pattern.X_CR.rotation()).matrix()
    return float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))


def study_hole_turn(
    scanner: ScannerPreset,
    standard: FlangeStandard,
    scans: int,
    *,
    seed: int = 0,
    progress: Progress = no_progress,
) -> list[HoleTurn]:
    """A row for the open pattern, for each opening filled alone and for all pairs of them together. Deterministic for ``seed``.

    Raises InputError for a flange without holes.
    """
    if standard.n_holes == 0:
        raise InputError(f"The flange '{standard.designation}' has no holes to fill: give one of ISO 9409-1.")
    cases = list(_cases(standard))
    rows = []
    for c, (name, choices) in enumerate(cases):
        errors, none, left_open = [], 0, 0
        for k in range(scans):
            progress(f"{name} filled", (c + k / scans) / len(cases))
            rng = np.random.default_rng([seed, c, k])
            frame = flange_frame(scanner, with_filled(standard, choices[k % len(choices)]), rng)
            assert frame.X_CR is not None
            try:
                pattern = find_holes(frame.points_C, fit_flange(frame.points_C, standard), standard)
            except FlangeNotFound:
                pattern = None
            if pattern is None:
                none += 1
            elif not pattern.turn_known:
                left_open += 1
            else:
                errors.append((turn_error(pattern, frame.X_CR), pattern.turn_sigma))
        e = np.array(errors).reshape(-1, 2)
        right = np.abs(e[:, 0]) < _WRONG_RAD
        square = np.square(e[right, 0] / e[right, 1])
        mean = float(square.mean()) if right.any() else float("nan")
        rows.append(
            HoleTurn(
                filled=name,
                scans=scans,
                no_pattern=none,
                left_open=left_open,
                right=int(right.sum()),
                wrong=int((~right).sum()),
                mean_normalised=mean,
            )
        )
    return rows


def _cases(standard: FlangeStandard) -> Iterator[tuple[str, list[tuple[int, ...]]]]:
    """Names of cases and the openings that each fills, by turns."""
    n = standard.n_holes
    names = [*(f"thread {k + 1}" for k in range(n)), *(["dowel hole"] if standard.pin_m > 0.0 else [])]
    yield "nothing", [()]
    for k, name in enumerate(names):
        yield name, [(k,)]
    yield "two", list(combinations(range(len(names)), 2))
