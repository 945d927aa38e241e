"""The result of `weldcal monitor` on a recording, and its JSON object."""

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import CalibrationResult, matrix4
from weldcal.calibration.motion.drift.sequential import WARM_UP, DriftEvent
from weldcal.calibration.motion.drift.watch import Watched
from weldcal.models.arrays import Array
from weldcal.tools.outcomes.first_screen import Expected, Findings, FirstScreen, Next, ShownPose, Tolerance
from weldcal.tools.outcomes.poses import SCANNER

CALM, DRIFTED, WARMED = "no drift found", "the scanner has moved", "the scanner warms up"


@dataclass(frozen=True, eq=False, kw_only=True)
class MonitorReport:
    """What was watched, the calibration, the recalibrated result where it was asked for, and the folder."""

    watched: Watched
    calibration: CalibrationResult
    recalibrated: CalibrationResult | None
    cause: str
    false_alarms_per_hour: float
    warnings: tuple[str, ...]
    seconds: float
    out: Path

    @property
    def first(self) -> FirstScreen:
        """The first screen. The tolerance is the test's threshold, which --false-alarms sets; there is no work point in a watch."""
        w = self.watched
        largest = float(np.nanmax(w.statistic)) if len(w.statistic) else float("nan")
        source = f"--false-alarms {self.false_alarms_per_hour:g} per hour"
        against = [f"{self.verdict[:1].upper()}{self.verdict[1:]}: {self.change}"] if self.moves else []
        concerns = [*self.warnings]
        if self.verdict == WARMED:
            concerns = [f"The scanner warms up: {self.change}", *concerns]
        found = Findings(
            against=against,
            tolerance=None if w.events else Tolerance("The largest test statistic", largest, w.threshold, source, ""),
            no_tolerance=f"The test at {source} has found a change.",
            unseen=len(w.ids),
            concerns=concerns,
        )
        errors = 1e3 * np.linalg.norm(w.residuals, axis=1)
        errors = errors[np.isfinite(errors)]
        expected = Expected(
            "error of the tracked flange, 95 %",
            f"{np.percentile(errors, 95):.3f} mm" if len(errors) else "not known",
            f"of {len(w.ids)} frames, which the calibration did not use; rms {1e3 * w.rms_m:.3f} mm",
        )
        return FirstScreen(found, expected, self._next(), (ShownPose("X_BC", self._words, w.X_BC),))

    @property
    def _words(self) -> str:
        if not self.moves:
            return f"{SCANNER['X_BC']}, as calibrated"
        return f"{SCANNER['X_BC']}, after the last change, estimated from the frames since"

    def _next(self) -> Next:
        if self.recalibrated is not None and self.moves:
            folder = self.out / "recalibrated"
            return Next(
                "Verify the pose after the change with new scans before you use it.",
                f"weldcal verify {folder} NEW_SCANS",
            )
        if self.moves:
            return Next(
                "Find what moved and fix it, then calibrate again; --recalibrate writes the pose after the change."
            )
        if self.verdict == WARMED:
            return Next("Let the scanner warm up until its scale stands still, then watch again.")
        return Next("Go on; watch again after any knock, and after work at the robot or the scanner.")

    @property
    def change(self) -> str:
        """The last change that was found, in a sentence; empty where there is none."""
        if not self.watched.events:
            return ""
        e = self.watched.events[-1]
        d = drift_document(e)
        if not self.moves:
            return f"from {e.time_s:.1f} s on its scale changed by {1e6 * e.scale:.0f} ppm; the pose is unchanged."
        return (
            f"at {e.time_s:.2f} s (robot clock) by {d['translation_mm']:.3f} mm and {d['rotation_deg']:.4f} degrees, "
            f"found {max(e.found_s - e.time_s, 0.0):.1f} s later. {self.cause[:1].upper()}{self.cause[1:]}".rstrip(". ")
            + "."
        )

    @property
    def moves(self) -> tuple[DriftEvent, ...]:
        """Changes of the pose, without warm-ups of the scanner."""
        return tuple(e for e in self.watched.events if e.kind != WARM_UP)

    @property
    def verdict(self) -> str:
        """What was found, in some words."""
        if self.moves:
            return DRIFTED
        return WARMED if self.watched.events else CALM

    def summary(self) -> dict[str, Any]:
        """The JSON object of `monitor`; drift and what it is measured by stand last."""
        w = self.watched
        clock = w.clock
        delay = clock.delay_s
        warm = [e for e in w.events if e.kind == WARM_UP]
        return {
            "state": "done",
            "verdict": self.verdict,
            "cause": self.cause,
            "clock": clock.clock.kind,
            "clock_source": clock.source if delay is not None else None,
            "delay_ms": None if delay is None else 1e3 * delay,
            "delay_sigma_ms": None if clock.sigma_s is None else 1e3 * clock.sigma_s,
            "jitter_ms": 1e3 * w.noise.jitter_s,
            "false_alarms_per_hour": self.false_alarms_per_hour,
            "X_BC": matrix4(w.X_BC),
            "covariance": w.covariance.tolist(),
            "since_s": w.since_s,
            "recalibrated": None if self.recalibrated is None else str(self.out / "recalibrated"),
            "warm_up": [{"time_s": e.time_s, "found_s": e.found_s, "scale": e.scale} for e in warm],
            "warnings": list(self.warnings),
            "dropped_for": [
                {"reason": r, "frames": n} for r, n in Counter(_kind(r) for _, r in w.dropped).most_common()
            ],
            "gross": [id for id, g in zip(w.ids, w.gross, strict=True) if g],
            "rms_before_synchronisation_mm": _rms_mm(w.before),
            "rms_after_drift_mm": 1e3 * w.rms_after_m,
            "rms_mm": 1e3 * w.rms_m,
            "frames": len(w.ids),
            "dropped": len(w.dropped),
            "drift": [drift_document(e) for e in self.moves],
        }


def drift_document(e: DriftEvent) -> dict[str, Any]:
    """A change of the scanner's pose as plain values: mm, degrees, axes of the robot's base, seconds of its clock."""
    sigma = np.sqrt(np.diag(e.covariance))
    size, angle = float(np.linalg.norm(e.translation_m)), float(np.linalg.norm(e.rotation_rad))
    return {
        "time_s": e.time_s,
        "translation_mm": 1e3 * size,
        "rotation_deg": float(np.degrees(angle)),
        "time_sigma_s": e.time_sigma_s,
        "found_s": e.found_s,
        "kind": e.kind,
        "significant": e.model,
        "translation_B_mm": (1e3 * e.translation_m).tolist(),
        "translation_sigma_mm": (1e3 * sigma[3:]).tolist(),
        "rotation_B_deg": np.degrees(e.rotation_rad).tolist(),
        "rotation_sigma_deg": np.degrees(sigma[:3]).tolist(),
        "since_start": e.since_start,
        "cause": e.cause,
    }


def _kind(reason: str) -> str:
    """A reason without its figures: what comes before a colon, a semicolon or a number."""
    return re.split(r"[:;]|\s-?\d", reason)[0].rstrip(". ") + "."


def _rms_mm(residuals: Array) -> float | None:
    known = residuals[np.isfinite(residuals).all(axis=1)]
    return 1e3 * float(np.sqrt((known**2).sum(axis=1).mean())) if len(known) else None
