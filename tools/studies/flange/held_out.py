"""Compares the held-out error and its interval that one half of recorded scans states with the error on the other half."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.eye_on_base.nested import calibrate_by_choice, mean_interval, nested_errors
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.refinement.local_field import choose_local
from weldcal.models.errors import InputError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.studies.flange.recorded import usable_scans

LEAST = 16
"""Scans of a recording from which on its halves are calibrated; eight are the least with a choice of the scanner's correction."""


@dataclass(frozen=True)
class Halves:
    """Of ``draws`` random halves: means of the stated held-out error and of the error on the other half (mm), and how many of
    the latter lie in the interval (95 %) that the first half states. ``skipped`` halves fixed no calibration."""

    draws: int
    scans: int
    stated_mm: float
    new_mm: float
    inside: int
    skipped: int


def study_halves(
    folder: Path, draws: int = 20, seed: int = 0, progress: Progress = no_progress, *, local: bool = False
) -> Halves:
    """Calibrate from ``draws`` random halves of a dataset, choices included, and measure on the others. Deterministic for ``seed``.

    ``local``: from two thirds, with the choice of a local field (--refine local).

    Raises InputError for a folder that is none, TooFewPoses for fewer than sixteen usable scans.
    """
    good, patterns, _ = usable_scans(folder, LEAST, f"Halves need {LEAST} usable scans and more", seed, progress, 0.1)
    half, rows, skipped = 2 * len(good) // 3 if local else len(good) // 2, [], 0
    for k in range(draws):
        progress("halves", 0.1 + 0.9 * k / draws)
        order = np.random.default_rng([seed, k]).permutation(len(good))
        ours, others = ([good[i] for i in part] for part in (order[:half], order[half:]))
        try:
            X_BC, correction = calibrate_by_choice(ours, patterns, seed=seed)
            new_scans = [corrected_observation(correction, o) for o in others]
            if local:
                choice = choose_local(ours, patterns, X_BC, correction, seed=seed)
                errors = choice.local_m if choice.accepted else choice.plain_m
                new_scans = choice.field.applied(X_BC, new_scans) if choice.accepted else new_scans
            else:
                errors, _ = nested_errors(ours, patterns, seed=seed)
        except InputError:
            skipped += 1
            continue
        interval = mean_interval(errors)
        new = float(np.mean(position_errors(X_BC, new_scans)))
        inside = interval is not None and interval[0] < new < interval[1]
        rows.append((float(np.nanmean(errors)), new, float(inside)))
    table = np.array(rows).reshape(-1, 3)
    stated, new = (float(1e3 * table[:, k].mean()) if len(table) else float("nan") for k in (0, 1))
    return Halves(draws, half, stated, new, int(table[:, 2].sum()), skipped)
