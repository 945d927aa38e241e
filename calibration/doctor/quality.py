"""Tests of the scans themselves: single bad ones, noise that grows with distance, poses that are too much alike, another installation."""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.doctor.case import Case
from weldcal.calibration.doctor.fit import NU, Fit, fit
from weldcal.calibration.doctor.models import Explained
from weldcal.calibration.geometry.quantiles import f_tail
from weldcal.calibration.geometry.se3 import log_rotation
from weldcal.models.arrays import Array

_GROSS = 6.0  # spreads of a scan's distance beyond which it disagrees
_ODD, _GROSS_M = 1e-3, 2e-3  # false alarms a set, and the least error that matters
_MOST = 0.34  # of the scans that may be single bad ones
_LEAST_SEEN = 0.55  # of the edge; less is a partial view
_REFUSED = 0.2  # of the scans without a flange
_FLAT_M = 0.02  # rms of the centres across their longest direction that does not fix the camera
_NOISE_FACTOR = 2.0  # between the noisiest and the quietest third, the usual growth taken off
_NOISE_CHANCE = 1e-5


@dataclass(frozen=True, eq=False)
class Finding:
    """A cause that shows without a model of the residuals: its name, its weight (twice a log-likelihood ratio) and its numbers."""

    cause: str
    score: float
    numbers: dict[str, float]
    where: tuple[str, ...] = ()


def outliers(case: Case, null: Fit) -> Explained | None:
    """Single scans that disagree with all others, each of them anywhere (uniform in the ball that holds their errors)."""
    r = np.linalg.norm(null.e, axis=1)
    scale = max(float(np.median(r)) / 1.5382, 2e-5)
    bad = r > _GROSS * scale
    tilt_scale = max(float(np.nanmedian(null.tilt)) / 1.177, 3e-4) if np.isfinite(null.tilt).any() else 1.0
    bad |= np.nan_to_num(null.tilt) > 8.0 * tilt_scale
    m = int(bad.sum())
    if m == 0 or m > _MOST * case.n or case.n - m < 5:
        return None
    one = fit(case.pick(~bad), start=null)
    e = _centre_errors(case, one)
    ball = 4.0 / 3.0 * np.pi * (1.5 * float(e[bad].max())) ** 3
    sphere = 4.0 * np.pi if np.isfinite(case.m).all(axis=1).any() else 1.0
    cost = m * (2.0 * np.log(ball) + 2.0 * np.log(sphere) + 2.0 * np.log(case.n))
    numbers = {"worst_mm": 1e3 * float(e[bad].max()), "others_mm": 1e3 * float(np.median(e[~bad]))}
    return Explained(
        "outlier scans or partial views",
        one.bic + cost,
        one,
        float(e[bad].max()),
        numbers,
        tuple(np.array(case.ids)[bad]),
    )


def sure_outliers(case: Case, null: Fit) -> Finding | None:
    """Single scans whose errors scans that agree would show once in a thousand sets, by Student's t of the residuals."""
    r = np.linalg.norm(null.e, axis=1)
    chance = f_tail((r / null.sigma_m) ** 2 / 3.0, 3, NU)
    bad = (chance * case.n < _ODD) & (r > _GROSS_M)
    m = int(bad.sum())
    if m == 0 or m > _MOST * case.n or case.n - m < 5:
        return None
    numbers = {"worst_mm": 1e3 * float(r[bad].max()), "others_mm": 1e3 * float(np.median(r[~bad]))}
    score = float(-2.0 * np.log(chance[bad] * case.n).sum())
    return Finding("outlier scans or partial views", score, numbers, tuple(np.array(case.ids)[bad]))


def _centre_errors(case: Case, one: Fit) -> Array:
    q = case.c @ one.R[0].T + one.p[0] - case.b
    return np.asarray(np.linalg.norm(q, axis=1))


def partial_views(case: Case) -> Finding | None:
    """Scans that show little of the flange's edge, or none of it."""
    few = np.zeros(case.n, dtype=bool) if case.coverage is None else np.nan_to_num(case.coverage, nan=1.0) < _LEAST_SEEN
    lost = [i for i, _ in case.refused]
    share = (int(few.sum()) + len(lost)) / max(case.n + len(lost), 1)
    if share < _REFUSED or int(few.sum()) + len(lost) < 2:
        return None
    return Finding(
        "outlier scans or partial views", 40.0 * share + 12.0, {"share": share, "refused": float(len(lost))},
        (*tuple(np.array(case.ids)[few]), *lost),
    )  # fmt: skip


def noise_growth(case: Case) -> Finding | None:
    """Noise of the faces that grows away from a distance faster than triangulation's square law."""
    z = np.linalg.norm(case.c, axis=1)
    if case.noise is None or case.n < 8:
        return None
    known = np.isfinite(case.noise) & (case.noise > 0.0)
    if known.sum() < 8:
        return None
    y = np.log(case.noise[known]) - 2.0 * np.log(z[known])
    x = (z[known] - z[known].mean()) / max(float(z[known].std()), 1e-6)
    A = np.column_stack([np.ones(len(x)), x, x**2])
    left = y - A @ np.linalg.lstsq(A, y, rcond=None)[0]
    free = len(x) - 3
    inside = float(left @ left)
    total = float(((y - y.mean()) ** 2).sum())
    value = (total - inside) / 2.0 / max(inside / free, 1e-12)
    chance = float(f_tail(value, 2, free))
    model = y - left
    order = np.argsort(model)
    third = max(len(x) // 3, 2)
    factor = float(np.exp(np.median(y[order[-third:]]) - np.median(y[order[:third]])))
    if chance > _NOISE_CHANCE or factor < _NOISE_FACTOR:
        return None
    worst = np.array(case.ids)[known][order[-third:]]
    score = len(x) * np.log(total / max(inside, 1e-12)) - 2.0 * np.log(len(x))
    at = float(np.median(z[known][order[-third:]]))
    numbers = {"factor": factor, "at_mm": 1e3 * at, "chance": chance}
    if case.near_far is not None:
        numbers |= {"near_mm": 1e3 * case.near_far[0], "far_mm": 1e3 * case.near_far[1]}
    return Finding("scanner out of focus or range", float(score), numbers, tuple(worst))


def too_alike(case: Case) -> Finding | None:
    """Poses that differ too little to fix the camera. One orientation alone is no fault where the places differ enough."""
    b = case.b - case.b.mean(axis=0)
    width = np.linalg.svd(b, compute_uv=False) / np.sqrt(case.n)
    R = case.X_BF[:, :3, :3]
    turn = np.degrees(np.linalg.norm(log_rotation(np.swapaxes(R[:1], 1, 2) @ R), axis=1))
    middle = float(np.max(turn))
    if width[1] >= _FLAT_M:
        return None
    numbers = {"spread_mm": 1e3 * float(width[0]), "second_mm": 1e3 * float(width[1]), "turn_deg": middle}
    return Finding("poses too alike", 60.0, numbers)


def installation(case: Case, one: Fit) -> Finding | None:
    """The camera is elsewhere than somebody measured it, by more than the measurement's stated error, while all scans agree."""
    if case.guess is None:
        return None
    seen = case.c @ one.R[0].T + one.p[0]
    expected = case.c @ case.guess[:3, :3].T + case.guess[:3, 3]
    off = float(np.median(np.linalg.norm(seen - expected, axis=1)))
    turn = float(np.degrees(np.linalg.norm(log_rotation((one.R[0] @ case.guess[:3, :3].T)[None])[0])))
    if off < 2.0 * case.guess_radius:
        return None
    X = np.eye(4)
    X[:3, :3] = one.R[0] @ case.guess[:3, :3].T
    shift = one.p[0] - X[:3, :3] @ case.guess[:3, 3]
    numbers = {
        "off_mm": 1e3 * off,
        "turn_deg": turn,
        "shift_mm": 1e3 * float(np.linalg.norm(shift)),
        "stated_mm": 1e3 * case.guess_radius,
    }
    return Finding("robot in another installation", float(min(10.0 * (off / case.guess_radius) ** 2, 400.0)), numbers)
