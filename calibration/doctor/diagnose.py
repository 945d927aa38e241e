"""Names the causes that the scans give evidence of, the likeliest first.

Every model of a disturbance is fitted to the same scans and compared with the undisturbed one by the difference of the Bayesian
information criterion (fit.py); the difference must exceed a threshold for each cause, and the disturbance a size that matters. The
thresholds were fixed on simulated sets (tools/worlds/doctor.py), other ones than those that its false alarms are counted on.
"""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.doctor.case import Case
from weldcal.calibration.doctor.fit import Fit, fit
from weldcal.calibration.doctor.models import Explained, explanations, with_arm_errors
from weldcal.calibration.doctor.quality import (
    installation,
    noise_growth,
    outliers,
    partial_views,
    sure_outliers,
    too_alike,
)
from weldcal.calibration.doctor.readings import (
    FEWEST,
    LOOKS_WRONG_M,
    LOOKS_WRONG_RAD,
    best_reading,
    looks_wrong,
    mixed_units,
)  # fmt: skip
from weldcal.calibration.doctor.rotations import mirrored, misread_rotations, reordered, rotations_disagree

THRESHOLDS = {
    "scanner moved": 20.0,
    "TCP set at the controller": 20.0,
    "warm-up drift": 20.0,
    "slack flange or loose mount": 20.0,
    "wrong kinematics file": 20.0,
    "outlier scans or partial views": 20.0,
    "scanner scale error": 20.0,
}
"""Least difference of the criterion at which each is named; the evidence of a difference of 10 is called very strong (Raftery 1995)."""
LEAST_EFFECT_M = {
    "scanner moved": 3e-4,
    "TCP set at the controller": 2e-3,
    "warm-up drift": 1.5e-4,
    "slack flange or loose mount": 5e-4,
    "wrong kinematics file": 1e-3,
    "outlier scans or partial views": 2e-3,
    "scanner scale error": 8e-3,  # no length: four usual sigmas of a scanner's scale (fit.py)
}
"""Smaller ones are what arms and scanners are off anyway."""
UNEXPLAINED = "unexplained"
_SURE = 1e5  # of misreadings, which explain by definition what they are named for
CLEAR = 1.2  # factor by which a cause must bring the median residual down


@dataclass(frozen=True, eq=False)
class Cause:
    """A named cause: ``confidence`` 0 to 1 (its weight among the models that were compared), ``score`` (twice the log-likelihood ratio
    less the cost of its numbers), the ``numbers`` of the evidence, ``words`` of a misreading and the scans ``where`` it shows."""

    name: str
    confidence: float
    score: float
    numbers: dict[str, float]
    where: tuple[str, ...] = ()
    words: str = ""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The causes, likeliest first; the number of scans, and the spread (m) of their centres about what explains them best."""

    causes: tuple[Cause, ...]
    n: int
    spread_m: float


def diagnose(case: Case) -> Diagnosis:
    """The causes of a case, likeliest first; none where the scans are as good as scans are. Deterministic."""
    causes: list[Cause] = []
    if case.fits_flange and case.fits_flange != case.flange:
        causes.append(Cause("wrong flange size", 0.99, 1e8, {}, (), case.fits_flange))
    if case.n >= FEWEST and (mixed := mixed_units(case)) is not None:
        case, factor, where = mixed
        causes.append(Cause("unit mix", 0.99, 1e9, {"factor": factor}, where))
    partial = partial_views(case)
    if case.n < FEWEST:
        if partial is not None:
            causes.append(Cause(partial.cause, 0.9, partial.score, partial.numbers, partial.where))
        if not causes:
            causes.append(Cause("too few scans", 0.9, 1.0, {"n": float(case.n)}))
        return Diagnosis(tuple(causes), case.n, float("nan"))
    bare, case = case, with_arm_errors(case)
    null = fit(case)
    wrong = looks_wrong(null)
    models = _ranked(case, null)
    winner = next((m for m in models if _named(m, null)), None)
    if wrong:
        plain = fit(bare)
        reading = (
            best_reading(bare, plain)
            or misread_rotations(bare, plain)
            or mirrored(bare, plain)
            or reordered(bare, plain)
        )
        rival = winner.bic if winner is not None else null.bic
        if reading is not None and reading.fit.bic / reading.case.n < rival / case.n:
            causes.append(
                Cause(
                    reading.cause,
                    0.99,
                    1e6 + null.bic - reading.fit.bic,
                    _residuals(null, reading.fit),
                    (),
                    reading.words,
                )
            )
            case = with_arm_errors(reading.case)
            null = fit(case)
            models = _ranked(case, null)
            winner = next((m for m in models if _named(m, null)), None)
    best = null if winner is None else winner.fit
    if winner is not None:
        numbers = winner.numbers | _residuals(null, winner.fit)
        causes.append(Cause(winner.cause, _weight(winner, models, null), null.bic - winner.bic, numbers, winner.where))
    named = {c.name for c in causes}
    # a moved or mirrored scanner is elsewhere anyway
    alone = named.isdisjoint({"scanner moved", "scanner axes mirrored"})
    single = sure_outliers(case, null) if winner is None else None
    findings = [partial, single, noise_growth(case), too_alike(case), installation(case, best) if alone else None]
    for found in findings:
        if found is not None and found.cause not in named:
            named.add(found.cause)
            causes.append(
                Cause(found.cause, float(1.0 - np.exp(-found.score / 20.0)), found.score, found.numbers, found.where)
            )
    left = _unexplained(bare, best) if not any(c.score > _SURE for c in causes) else None
    if left is not None:
        causes = [left]
    causes.sort(key=lambda c: -c.score)
    return Diagnosis(tuple(causes), case.n, float(np.median(np.linalg.norm(best.e, axis=1))))


def _ranked(case: Case, null: Fit) -> list[Explained]:
    found = [*explanations(case, null)]
    single = outliers(case, null)
    return sorted([*found, *([] if single is None else [single])], key=lambda m: m.bic)


def _named(m: Explained, null: Fit) -> bool:
    shows = m.cause.startswith("outlier") or null.rms > CLEAR * m.fit.rms
    return shows and null.bic - m.bic > THRESHOLDS[m.cause] and m.effect_m > LEAST_EFFECT_M[m.cause]


def _unexplained(case: Case, best: Fit) -> Cause | None:
    """What remains after the best model and is too large for any arm and scanner; None where nothing does."""
    turned = rotations_disagree(case)
    tilt = float(np.degrees(np.nanmedian(best.tilt))) if np.isfinite(best.tilt).any() else 0.0
    if turned is not None and tilt > np.degrees(LOOKS_WRONG_RAD):
        return Cause(UNEXPLAINED, 0.5, 1.0, turned)
    if best.rms > LOOKS_WRONG_M or tilt > np.degrees(LOOKS_WRONG_RAD):
        r = np.linalg.norm(best.e, axis=1)
        worst = tuple(case.ids[k] for k in np.argsort(-r)[:3])
        numbers = {"with_mm": 1e3 * best.rms, "worst_mm": 1e3 * float(r.max()), "tilt_deg": tilt}
        return Cause(UNEXPLAINED, 0.5, 1.0, numbers, worst)
    return None


def _weight(winner: Explained, models: list[Explained], null: Fit) -> float:
    """Share of the winner in the weights of all models, exp(-bic / 2)."""
    lead = [0.5 * (winner.bic - m.bic) for m in models] + [0.5 * (winner.bic - null.bic)]
    return float(1.0 / np.exp(np.minimum(lead, 0.0)).sum())


def _residuals(null: Fit, best: Fit) -> dict[str, float]:
    """Medians of centres (mm) and, where normals were seen, of their angles (deg), without and with the cause."""
    out = {"without_mm": 1e3 * null.rms, "with_mm": 1e3 * best.rms}
    if np.isfinite(null.tilt).any() and np.isfinite(best.tilt).any():
        out |= {
            "without_deg": float(np.degrees(np.nanmedian(null.tilt))),
            "with_deg": float(np.degrees(np.nanmedian(best.tilt))),
        }
    return out
