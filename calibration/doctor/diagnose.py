"""Name the causes that the scans give evidence of, misread data among them, the likeliest first.

Every model of a disturbance is fitted to the same scans and compared with the undisturbed one by the difference of the
Bayesian information criterion (fit.py). The difference must exceed a threshold for each cause, and the disturbance a
size that matters. The thresholds were fixed on simulated sets (tests/worlds/doctor.py), other ones than those that its
false alarms are counted on.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.doctor.case import FEWEST, DoctorCase
from weldcal.calibration.doctor.fit import NU, CauseFit, fit
from weldcal.calibration.doctor.models import Explained, explanations, with_arm_errors
from weldcal.calibration.geometry.robust import f_tail
from weldcal.calibration.geometry.se3 import as_transform, inverse, log_rotation, pose
from weldcal.calibration.planning.observability import turn_deg
from weldcal.models.arrays import Array

UNITS = (1e3, 1e-3, 25.4, 1.0 / 25.4, 10.0, 0.1, 100.0, 0.01)
"""Millimetres, inches, decimetres and centimetres for metres, and the reverse."""
_WITHIN = 0.5  # of the logarithm of a unit's factor: a TCP or a quaternion's order changes spreads, too
_REACH_M = (0.02, 9.0)
WORN = 0.25  # of a soft tip's gain: four times the spread of a good one (servo settings, gain_sigma)
LOOKS_WRONG_M, LOOKS_WRONG_RAD = 3e-3, 0.03  # residuals of no arm and scanner that work
_Order = Literal["xyz", "zyx", "XYZ", "ZYX", "zyz", "ZYZ", "yxz", "YXZ"]
_ORDERS: tuple[_Order, ...] = ("xyz", "zyx", "XYZ", "ZYX", "zyz", "ZYZ", "yxz", "YXZ")
_LEAST_GAIN = 3.0  # a reading must bring the residuals down by this factor: nothing less is a misreading

_GROSS = 6.0  # spreads of a scan's distance beyond which it disagrees
_ODD, _GROSS_M = 1e-3, 2e-3  # false alarms a set, and the least error that matters
_MOST = 0.34  # of the scans that may be single bad ones
_LEAST_SEEN = 0.55  # of the edge; less is a partial view
_REFUSED = 0.2  # of the scans without a flange
_FLAT_M = 0.02  # rms of the centres across their longest direction that does not fix the camera
_NOISE_FACTOR = 2.0  # between the noisiest and the quietest third, the usual growth taken off
_NOISE_CHANCE = 1e-5  # a choice: ten false alarms in a million data sets; a factor of two is 0.15 sigma


@dataclass(frozen=True, eq=False)
class Reading:
    """Hold another reading of the poses: the cause's name, its description, the case in that reading and its fit."""

    cause: str
    words: str
    case: DoctorCase
    fit: CauseFit


def _rotations(R: Array) -> Iterator[tuple[str, str, Array]]:
    """Other rotations (n, 3, 3) that the same numbers may mean: cause, words, rotations."""
    turn = Rotation.from_matrix(R)
    yield "poses inverted", "the rotations are transposed", np.swapaxes(R, 1, 2)
    for first, order, other in ((True, "x, y, z, w", "w, x, y, z"), (False, "w, x, y, z", "x, y, z, w")):
        q = Rotation.from_quat(turn.as_quat(scalar_first=first), scalar_first=not first)
        words = f"the quaternions' order is ({order}), and they were read as ({other})"
        yield "wrong quaternion order", words, np.asarray(q.as_matrix())
    vector = turn.as_rotvec()
    found = [("angles are radians, and they were read as degrees", Rotation.from_rotvec(np.degrees(vector)))]
    for read in _ORDERS:
        angles = turn.as_euler(read)
        name = f"Euler angles in the order {read}"
        found += [
            (
                f"rotations are Euler angles in the order {order}, and they were read in the order {read}",
                Rotation.from_euler(order, angles),
            )
            for order in _ORDERS
            if order != read
        ]
        found += [
            (f"rotations are rotation vectors, and they were read as {name}", Rotation.from_rotvec(angles)),
            (f"rotations are {name}, and they were read as rotation vectors", Rotation.from_euler(read, vector)),
            ("angles are radians, and they were read as degrees", Rotation.from_euler(read, np.degrees(angles))),
        ]
    for words, other_turn in found:
        yield "wrong rotation convention", f"the {words}", np.asarray(other_turn.as_matrix())


def _misreadings(case: DoctorCase) -> Iterator[tuple[str, str, DoctorCase, DoctorCase]]:
    """Cause, words, the scans as given, and the same scans in another reading."""
    for cause, words, R in _rotations(case.X_BF[:, :3, :3]):
        yield cause, words, case, case.with_poses(pose(R, case.X_BF[:, :3, 3]))
    words = "the poses are the base in the flange, the inverse of what is expected"
    yield "poses inverted", words, case, case.with_poses(inverse(case.X_BF))
    for first, second in ((0, 1), (0, 2), (1, 2)):
        swapped = case.X_BF.copy()
        swapped[:, [first, second], 3] = swapped[:, [second, first], 3]
        words = f"the columns {'xyz'[first]} and {'xyz'[second]} of the poses are exchanged"
        yield "position columns exchanged", words, case, case.with_poses(swapped)
    flip = np.array([-1.0, 1.0, 1.0])  # one mirror stands for all: the others are turned ones
    words = "the scanner's frame is left-handed: one of its axes is mirrored"
    yield "scanner axes mirrored", words, case, replace(case, c=case.c * flip, m=case.m * flip)
    text = np.array(sorted(range(case.n), key=lambda k: str(k + 1)))
    for words, order in (
        ("the scans stand in the reverse order of the poses", np.arange(case.n)[::-1]),
        ("the scans are sorted as text (1, 10, 11, 2) and the poses by number", text),
        ("the poses are sorted as text (1, 10, 11, 2) and the scans by number", np.argsort(text)),
    ):
        yield "scans and poses in different orders", words, case, case.with_poses(case.X_BF[order])
    if case.n > 6:
        for shift, words in ((1, "before"), (-1, "after")):
            rows = np.arange(max(shift, 0), case.n + min(shift, 0))
            inside = case.pick(rows)
            words = f"each scan belongs to the pose {words} its own"
            yield "scans and poses shifted by one", words, inside, inside.with_poses(case.X_BF[rows - shift])


def looks_wrong(one: CauseFit) -> bool:
    """Whether residuals are larger than those of any arm and scanner that works, in the centres or in the normals."""
    tilted = bool(np.isfinite(one.tilt).any()) and float(np.nanmedian(one.tilt)) > LOOKS_WRONG_RAD
    return one.rms > LOOKS_WRONG_M or tilted


def best_reading(case: DoctorCase, null: CauseFit) -> Reading | None:
    """Return the misreading whose correction lowers the criterion most, if what remains looks like a working cell's.

    Else None.
    """
    found: list[Reading] = []
    for cause, words, given, other in _misreadings(case):
        one = fit(other)
        # with a scan fewer it is compared on the same scans
        if given is case or fit(given).bic > one.bic:
            found.append(Reading(cause, words, other, one))
    found = [r for r in found if not looks_wrong(r.fit)]
    found.sort(key=lambda r: r.fit.bic / r.case.n)
    best = found[0] if found else None
    if best is None or best.fit.bic / best.case.n >= null.bic / case.n:
        return None
    tilts = [float(np.nanmedian(f.tilt)) if np.isfinite(f.tilt).any() else 0.0 for f in (null, best.fit)]
    better = null.rms > _LEAST_GAIN * max(best.fit.rms, 2e-4) or tilts[0] > _LEAST_GAIN * max(tilts[1], 0.02)
    return best if better else None


def mixed_units(case: DoctorCase) -> tuple[DoctorCase, float, tuple[str, ...]] | None:
    """Return the case in one unit, the factor and the scans that were in another one; None where all are in one.

    Distances of poses from the base, or of scans from the camera, in two groups that a unit's factor separates: those
    within the reach of an arm are in metres. Else one factor between the spreads of both sides.
    """
    for name, points in (("poses", case.X_BF[:, :3, 3]), ("scans", case.c)):
        size = np.linalg.norm(points, axis=1)
        near = (size > _REACH_M[0]) & (size < _REACH_M[1])
        for unit in (1e3, 1e-3):
            off = ~near & (size / unit > _REACH_M[0]) & (size / unit < _REACH_M[1])
            if off.any() and (near | off).all():
                return _scaled(case, name, np.where(off, 1.0 / unit, 1.0)), unit, tuple(np.array(case.ids)[off])
    if case.n >= FEWEST:
        spreads = [float(np.sqrt(((v - v.mean(axis=0)) ** 2).sum(axis=1).mean())) for v in (case.b, case.c)]
        ratio = spreads[0] / max(spreads[1], 1e-12)
        for unit in UNITS:
            if abs(np.log(ratio / unit)) < _WITHIN:
                other = _scaled(case, "poses", np.full(case.n, 1.0 / unit))
                if fit(other).rms < 0.05 * spreads[1]:
                    return other, unit, case.ids
    return None


def _scaled(case: DoctorCase, what: str, factor: Array) -> DoctorCase:
    if what == "scans":
        return replace(case, c=case.c * factor[:, None])
    X = case.X_BF.copy()
    X[:, :3, 3] *= factor[:, None]
    return case.with_poses(X)


@dataclass(frozen=True, eq=False)
class DirectCause:
    """A cause that shows without a model of the residuals.

    Its name, its weight (twice a log-likelihood ratio) and its numbers.
    """

    cause: str
    score: float
    numbers: dict[str, float]
    where: tuple[str, ...] = ()


def outliers(case: DoctorCase, null: CauseFit) -> Explained | None:
    """Single scans that disagree with all others, each of them anywhere.

    Uniform in the ball that holds their errors.
    """
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


def sure_outliers(case: DoctorCase, null: CauseFit) -> DirectCause | None:
    """Find single scans whose errors are far too large for scans that agree.

    Such errors would show once in a thousand sets, by Student's t of the residuals.
    """
    r = np.linalg.norm(null.e, axis=1)
    chance = f_tail((r / null.sigma_m) ** 2 / 3.0, 3, NU)
    bad = (chance * case.n < _ODD) & (r > _GROSS_M)
    m = int(bad.sum())
    if m == 0 or m > _MOST * case.n or case.n - m < 5:
        return None
    numbers = {"worst_mm": 1e3 * float(r[bad].max()), "others_mm": 1e3 * float(np.median(r[~bad]))}
    score = float(-2.0 * np.log(chance[bad] * case.n).sum())
    return DirectCause("outlier scans or partial views", score, numbers, tuple(np.array(case.ids)[bad]))


def _centre_errors(case: DoctorCase, one: CauseFit) -> Array:
    q = case.c @ one.R[0].T + one.p[0] - case.b
    return np.asarray(np.linalg.norm(q, axis=1))


def partial_views(case: DoctorCase) -> DirectCause | None:
    """Scans that show little of the flange's edge, or none of it."""
    few = np.zeros(case.n, dtype=bool) if case.coverage is None else np.nan_to_num(case.coverage, nan=1.0) < _LEAST_SEEN
    lost = [i for i, _ in case.refused]
    share = (int(few.sum()) + len(lost)) / max(case.n + len(lost), 1)
    if share < _REFUSED or int(few.sum()) + len(lost) < 2:
        return None
    return DirectCause(
        "outlier scans or partial views",
        40.0 * share + 12.0,
        {"share": share, "refused": float(len(lost))},
        (*tuple(np.array(case.ids)[few]), *lost),
    )


def noise_growth(case: DoctorCase) -> DirectCause | None:
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
    return DirectCause("scanner out of focus or range", float(score), numbers, tuple(worst))


def too_alike(case: DoctorCase) -> DirectCause | None:
    """Poses that differ too little to fix the camera.

    One orientation alone is no fault where the places differ enough.
    """
    b = case.b - case.b.mean(axis=0)
    width = np.linalg.svd(b, compute_uv=False) / np.sqrt(case.n)
    R = case.X_BF[:, :3, :3]
    turn = np.degrees(np.linalg.norm(log_rotation(np.swapaxes(R[:1], 1, 2) @ R), axis=1))
    middle = float(np.max(turn))
    if width[1] >= _FLAT_M:
        return None
    numbers = {"spread_mm": 1e3 * float(width[0]), "second_mm": 1e3 * float(width[1]), "turn_deg": middle}
    return DirectCause("poses too alike", 60.0, numbers)


def installation(case: DoctorCase, one: CauseFit) -> DirectCause | None:
    """Compare the camera's place with a measured one, beyond the measurement's stated error, while all scans agree."""
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
    return DirectCause(
        "robot in another installation", float(min(10.0 * (off / case.guess_radius) ** 2, 400.0)), numbers
    )


_WRONG_RAD = 0.05  # normals disagree with the poses as they are


def _off(u: Array, z: Array) -> float:
    """Median angle (rad) between two lists of directions."""
    return float(np.median(np.arctan2(np.linalg.norm(np.cross(u, z), axis=1), (u * z).sum(axis=1))))


def rotations_disagree(case: DoctorCase) -> dict[str, float] | None:
    """Return the figures where the centres agree and the normals do not: wrong rotations of an unknown kind.

    None where both agree.
    """
    seen = np.asarray(np.isfinite(case.m).all(axis=1))
    if seen.sum() < 5:
        return None
    by_centres = fit(case, normals=False)
    off = _off(case.m[seen] @ by_centres.R[0].T, case.z[seen])
    if by_centres.rms > 3e-3 or off < _WRONG_RAD:
        return None
    return {"centres_mm": 1e3 * by_centres.rms, "normals_deg": float(np.degrees(off))}


THRESHOLDS = {
    "scanner moved": 20.0,
    "TCP set at the controller": 20.0,
    "warm-up drift": 20.0,
    "slack flange or loose mount": 20.0,
    "wrong kinematics file": 20.0,
    "outlier scans or partial views": 20.0,
    "scanner scale error": 20.0,
}
"""Least difference of the criterion at which each is named; the evidence of a difference of 10 is called very strong
(Raftery 1995)."""
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
_ASKED = 0.8  # a choice: the motion asks for it at 99 %, but an error of the arm can look the same
_SURE = 1e5  # of misreadings, which explain by definition what they are named for
CLEAR = 1.2  # factor by which a cause must bring the median residual down


@dataclass(frozen=True, eq=False)
class Cause:
    """A named cause with the evidence for it.

    ``confidence`` 0 to 1 is its weight among the models that were compared, ``score`` twice the log-likelihood ratio
    less the cost of its numbers. ``numbers`` are the evidence, ``words`` those of a misreading, and ``where`` the scans
    that show it.
    """

    name: str
    confidence: float
    score: float
    numbers: dict[str, float]
    where: tuple[str, ...] = ()
    words: str = ""


ALIKE_DEG = 3.0  # as in the warning of calibrate: orientations closer than this are one orientation


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The causes, likeliest first, the number of scans, and the spread (m) of their centres about the best explanation.

    ``alike_deg``: the largest rotation between poses of nearly one orientation, which show no wrong TCP; else NaN.
    """

    causes: tuple[Cause, ...]
    n: int
    spread_m: float
    alike_deg: float = float("nan")


def diagnose(case: DoctorCase) -> Diagnosis:
    """Return the causes of a case, likeliest first; none where the scans are as good as scans are. Deterministic."""
    causes: list[Cause] = []
    asked = [Cause("scanner scale error", _ASKED, 1.0, {}, (), case.asked)] if case.asked else []
    if case.fits_flange and case.fits_flange != case.flange:
        causes.append(Cause("wrong flange size", 0.99, 1e8, {}, (), case.fits_flange))
    if case.n >= FEWEST and (mixed := mixed_units(case)) is not None:
        case, factor, where = mixed
        causes.append(Cause("unit mix", 0.99, 1e9, {"factor": factor}, where))
    partial = partial_views(case)
    if case.n < FEWEST:
        if partial is not None:
            causes.append(Cause(partial.cause, 0.9, partial.score, partial.numbers, partial.where))
        causes += asked
        if not causes:
            causes.append(Cause("too few scans", 0.9, 1.0, {"n": float(case.n)}))
        return Diagnosis(tuple(causes), case.n, float("nan"))
    bare, case = case, with_arm_errors(case)
    null = fit(case)
    models = _ranked(case, null)
    winner = next((m for m in models if _named(m, null)), None)
    if looks_wrong(null):
        reading = best_reading(bare, fit(bare))
        rival = winner.bic if winner is not None else null.bic
        if reading is not None and reading.fit.bic / reading.case.n < rival / case.n:
            score = 1e6 + null.bic - reading.fit.bic
            causes.append(Cause(reading.cause, 0.99, score, _residuals(null, reading.fit), (), reading.words))
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
    causes += [cause for cause in asked if cause.name not in named]
    causes.sort(key=lambda c: -c.score)
    turned = turn_deg([as_transform(X) for X in case.X_BF]) if case.oriented else 0.0
    spread = float(np.median(np.linalg.norm(best.e, axis=1)))
    return Diagnosis(tuple(causes), case.n, spread, turned if turned < ALIKE_DEG else float("nan"))


def _ranked(case: DoctorCase, null: CauseFit) -> list[Explained]:
    found = [*explanations(case, null)]
    single = outliers(case, null)
    return sorted([*found, *([] if single is None else [single])], key=lambda m: m.bic)


def _named(m: Explained, null: CauseFit) -> bool:
    shows = m.cause.startswith("outlier") or null.rms > CLEAR * m.fit.rms
    return shows and null.bic - m.bic > THRESHOLDS[m.cause] and m.effect_m > LEAST_EFFECT_M[m.cause]


def _unexplained(case: DoctorCase, best: CauseFit) -> Cause | None:
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


def _weight(winner: Explained, models: list[Explained], null: CauseFit) -> float:
    """Share of the winner in the weights of all models, exp(-bic / 2)."""
    lead = [0.5 * (winner.bic - m.bic) for m in models] + [0.5 * (winner.bic - null.bic)]
    return float(1.0 / np.exp(np.minimum(lead, 0.0)).sum())


def _residuals(null: CauseFit, best: CauseFit) -> dict[str, float]:
    """Return medians of centres (mm) and, given normals, of their angles (deg), without and with the cause."""
    out = {"without_mm": 1e3 * null.rms, "with_mm": 1e3 * best.rms}
    if np.isfinite(null.tilt).any() and np.isfinite(best.tilt).any():
        out |= {
            "without_deg": float(np.degrees(np.nanmedian(null.tilt))),
            "with_deg": float(np.degrees(np.nanmedian(best.tilt))),
        }
    return out
