"""Detection rate of the flange in ray-cast frames: with clutter, without a flange, and half hidden."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import fit_flange
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard
from weldcal.models.scanners import ScannerPreset
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.studies.flange.frames import Frame, box, empty_frame, flange_frame, random_place

WAYS = ("plate", "border", "missing")
SAME_PLACE_M = 0.001  # a flange reported farther from where it is, is another thing taken for it


@dataclass(frozen=True, eq=False, kw_only=True)
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
    return Found(
        frames=frames,
        found=len(errors),
        mistaken=mistaken,
        imagined=imagined,
        errors_m=np.array(errors),
        normalised=np.array(normalised),
        missed=tuple(missed),
    )


@dataclass(frozen=True, eq=False)
class Hidden:
    """Of ``frames`` half-hidden flanges: how many were found, centre errors (k,) m, squares of the normalised errors per
    axis (k,), shares (k,) of the edge that were seen, and the reasons of the others."""

    way: str
    frames: int
    errors_m: Array
    normalised: Array
    coverage: Array
    missed: tuple[str, ...]

    @property
    def rms_mm(self) -> float:
        """Root mean square (3-D) of the centre errors, mm."""
        return rms_mm(self.errors_m)

    @property
    def mean_normalised(self) -> float:
        """Mean square of the normalised errors: 1 where the stated covariance is right."""
        return float(np.mean(self.normalised)) if len(self.normalised) else float("nan")

    @property
    def mean_coverage(self) -> float:
        """Mean share of the edge that was seen."""
        return float(np.mean(self.coverage)) if len(self.coverage) else 0.0

    def summary(self) -> dict[str, object]:
        """The row as one JSON object."""
        return {
            "way": self.way,
            "frames": self.frames,
            "found": len(self.errors_m),
            "centre_rms_mm": self.rms_mm,
            "normalised": self.mean_normalised,
            "coverage": self.mean_coverage,
            "missed": list(self.missed),
        }


def hidden_frame(
    way: str, scanner: ScannerPreset, standard: FlangeStandard, rng: np.random.Generator, *, share: float = 0.5
) -> Frame:
    """A frame that hides ``share`` of the flange's width in one of the ``WAYS``, from a random side."""
    X_CR = random_place(scanner, standard, rng, max_tilt_deg=25.0)
    beyond = (0.5 - share) * standard.outer_m  # from the centre to where the hidden part begins
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    if way == "plate":
        height, wide = rng.uniform(0.03, 0.08), 3.0 * standard.outer_m
        turned = RigidTransform(RollPitchYaw(0.0, 0.0, azimuth), [0.0, 0.0, 0.0])
        plate = box(wide, wide, 0.004).transformed(
            X_CR @ turned @ RigidTransform([beyond + 0.5 * wide + height * _lean(X_CR, turned), 0.0, height])
        )
        return flange_frame(scanner, standard, rng, X_CR=X_CR, before=(plate,))
    if way == "border":
        p = X_CR.translation().copy()
        side = int(rng.integers(4))
        axis, sign = side % 2, 1.0 if side < 2 else -1.0
        size, focal, middle = ((scanner.width, scanner.fx, scanner.cx), (scanner.height, scanner.fy, scanner.cy))[axis]
        edge = (size - 0.5 - middle if sign > 0.0 else -0.5 - middle) / focal
        p[axis] = edge * p[2] - sign * beyond
        return flange_frame(scanner, standard, rng, X_CR=RigidTransform(X_CR.rotation(), p))
    frame = flange_frame(scanner, standard, rng, X_CR=X_CR)
    in_R = (X_CR.inverse() @ frame.points_C.reshape(-1, 3).T).T.reshape(frame.points_C.shape)
    with np.errstate(invalid="ignore"):
        lost = in_R[..., 0] * np.cos(azimuth) + in_R[..., 1] * np.sin(azimuth) > beyond
        lost &= np.hypot(in_R[..., 0], in_R[..., 1]) < 1.5 * standard.outer_m
    return replace(frame, points_C=np.where(lost[..., None], np.nan, frame.points_C))


def _lean(X_CR: RigidTransform, turned: RigidTransform) -> float:
    """How far, per metre above the face, the line of sight to its centre runs along the plate's x axis."""
    sight = (X_CR @ turned).inverse() @ np.zeros(3)
    return float(sight[0] / sight[2])


def study_hidden(
    way: str,
    scanner: ScannerPreset,
    standard: FlangeStandard,
    frames: int,
    *,
    share: float = 0.5,
    seed: int = 0,
    progress: Progress = no_progress,
) -> Hidden:
    """Fit ``frames`` half-hidden flanges. Deterministic for ``seed``."""
    fits, missed = list[FrameFit](), []
    for k in range(frames):
        progress(f"half hidden: {way}", k / frames)
        frame = hidden_frame(way, scanner, standard, np.random.default_rng([seed, k]), share=share)
        try:
            fit = fit_frame(frame, standard)
        except FlangeNotFound as e:
            missed.append(e.reason)
            continue
        if fit.error_m > SAME_PLACE_M:
            missed.append(f"found {1e3 * fit.error_m:.1f} mm off")
            continue
        fits.append(fit)
    errors, normalised, coverage = (np.array([f[i] for f in fits]) for i in range(3))
    return Hidden(way, frames, errors, normalised, coverage, tuple(missed))
