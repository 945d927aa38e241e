"""Detection rate of the flange in ray-cast frames with clutter, false detections, and the centre's error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import fit_flange
from weldcal.models.flanges import FlangeStandard
from weldcal.models.scanners import ScannerPreset
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.studies.flange.frames import Frame, empty_frame, flange_frame

Array = NDArray[np.float64]

SAME_PLACE_M = 0.001  # a flange reported farther from where it is, is another thing taken for it


@dataclass(frozen=True, eq=False)
class Found:
    """Of ``frames`` with the flange and as many without: numbers of those found, mistaken (elsewhere) and imagined, centre
    errors (k,) m and their sizes in stated sigmas per axis (k,) of those found, and the reasons given for the missed."""

    frames: int
    found: int
    mistaken: int
    imagined: int
    errors_m: Array
    normalised: Array
    missed: tuple[tuple[int, str], ...]

    @property
    def rms_mm(self) -> float:
        """Root mean square (3-D) of the centre errors, mm."""
        return rms_mm(self.errors_m)


class FrameFit(NamedTuple):
    """The centre's error (m), its square per axis in units of the stated covariance, and the share of the edge that was seen."""

    error_m: float
    normalised: float
    coverage: float


def fit_frame(frame: Frame, standard: FlangeStandard) -> FrameFit:
    """Fit the flange of a frame and compare with the truth. Raises FlangeNotFound."""
    assert frame.X_CR is not None
    fit = fit_flange(frame.points_C, standard)
    e_C = fit.center_C - frame.X_CR.translation()
    normalised = float(e_C @ np.linalg.solve(fit.center_covariance, e_C)) / 3.0
    return FrameFit(float(np.linalg.norm(e_C)), normalised, fit.coverage)


def rms_mm(errors_m: Array) -> float:
    """Root mean square in mm; NaN for none."""
    return float(1e3 * np.sqrt(np.mean(errors_m**2))) if len(errors_m) else float("nan")


def study_frames(
    scanner: ScannerPreset,
    standard: FlangeStandard,
    frames: int,
    *,
    empty: int | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
) -> Found:
    """Look for the flange in ``frames`` frames that show it and ``empty`` (as many) that do not. Deterministic for ``seed``."""
    empty = frames if empty is None else empty
    errors, normalised, missed = [], [], []
    mistaken, imagined = 0, 0
    for k in range(frames):
        progress("frames with a flange", k / max(frames + empty, 1))
        frame = flange_frame(scanner, standard, np.random.default_rng([seed, k]))
        try:
            fit = fit_frame(frame, standard)
        except FlangeNotFound as e:
            missed.append((k, e.reason))
            continue
        if fit.error_m > SAME_PLACE_M:
            mistaken += 1
            continue
        errors.append(fit.error_m)
        normalised.append(float(np.sqrt(fit.normalised)))
    for k in range(empty):
        progress("frames without one", (frames + k) / max(frames + empty, 1))
        try:
            fit_flange(empty_frame(scanner, standard, np.random.default_rng([seed, 1, k])).points_C, standard)
            imagined += 1
        except FlangeNotFound:
            pass
    return Found(frames, len(errors), mistaken, imagined, np.array(errors), np.array(normalised), tuple(missed))
