"""Solves for one mounting from the scans of several features, with the arm's error, and tests whether they agree.

The arm's error is a twist of the flange that varies with its pose: a linear function of the entries of R_BF and of the
position, which a wrong length or angle of any link is to first order. Its coefficients are random, of one variance that
the adjustment estimates. What is constant in the flange cannot be told from X_FS and stays in the covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from weldcal.calibration.adjustment import (
    Adjusted,
    Kind,
    Observed,
    Remainder,
    Unknowns,
    adjust,
    helmert,
    huber,
    plain,
)
from weldcal.calibration.errors import DegenerateMotion, InconsistentData
from weldcal.calibration.geometry.robust import f_tail
from weldcal.calibration.geometry.se3 import difference, moved, skew
from weldcal.calibration.profiler.combined.scans import EXACT, FeatureScans
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.result import LEVER_M, VAGUE_M, ProfilerEstimate, worst_direction

REPEATED_M = 0.03e-3  # one sigma per axis of a repeatability of 0.05 mm (ISO 9283), as for the sphere alone
ARM_M = 0.05e-3  # a choice: one sigma of a coefficient; the flange's error is about twice as large per axis
ARM_NUMBERS = 4.0  # a choice: so many numbers the prior of the arm's variance counts as
ARM_REACH_M = 1.0  # the flange turns by its error over this: an arm's angles act at about its reach
_FREE_M, _FREE_RAD = 0.05, 0.2  # a choice: what a wrong tool may differ by; beyond, parts are compared before
_FREE_RADIUS_M = 1e-3
LEVEL = 0.01  # chance that parts that agree are said to differ
OUTLIER = 5.0  # sigmas of a scan's numbers
_LIKELY = 0.05  # a choice: another cause is named as well where it is this likely against the first
_STEPS = 60


@dataclass(frozen=True, kw_only=True)
class Cause:
    """What could make parts differ: its size in words, its chance if nothing differs, and the parts' names."""

    name: str
    words: str
    advice: str
    chance: float
    sigmas: float


@dataclass(frozen=True, eq=False, kw_only=True)
class JointEstimate(ProfilerEstimate):
    """X_FS from all parts; residuals (n,) m of all scans' numbers.

    Attributes:
        sensor: (3,) scale and shear about the origin; edge_radius_m: of its break and its sigma, where there is one.
        arm_m: the arm's error at the flange per axis, without what a constant offset takes up.
        causes: the likely causes of a disagreement, the likeliest first; none where the parts agree.
        odd: scans of each part that are off by more than five sigmas.
    """

    sensor: Floats
    arm_m: float
    edge_radius_m: tuple[float, float] | None
    causes: tuple[Cause, ...] = ()
    odd: tuple[tuple[int, ...], ...] = ()


class _Problem:
    """The unknowns: X_FS; each part's own numbers; each part's own change of X_FS; scale and shear; the arm."""

    def __init__(self, parts: Sequence[FeatureScans], sensor: Floats, arm_m: float | None) -> None:
        self.parts = parts
        middle = np.concatenate([part.poses.translation for part in parts]).mean(axis=0)
        self.terms = [arm_terms(part.poses, middle) for part in parts]
        sizes = [*(len(part.numbers) for part in parts), *[6] * len(parts), 3, self.terms[0].shape[2]]
        ends = np.cumsum(sizes)
        at = [slice(b - a, b) for a, b in zip(sizes, ends, strict=True)]
        n = len(parts)
        self.own, self.change, self.sensor, self.arm = at[:n], at[n : 2 * n], at[2 * n], at[2 * n + 1]
        self.size = int(ends[-1])
        self.start = np.zeros(self.size)
        self.sigma = np.full(self.size, np.inf)
        for part, own, change in zip(parts, self.own, self.change, strict=True):
            self.start[own], self.sigma[own], self.sigma[change] = part.numbers, part.known, EXACT
        self.sensor_information = np.linalg.inv(sensor)
        features = [Kind(rank=float(part.own.shape[1]), loss=huber, spread=helmert, sigma=REPEATED_M) for part in parts]
        self.kinds = [*features, Kind(rank=1.0, loss=plain, spread=_arm if arm_m is None else None, sigma=arm_m or ARM_M)]

    def rows(self, at: Unknowns) -> list[Observed]:
        """Return the rows of each part, and of the arm's coefficients."""
        found, numbers = [], at.numbers
        for part, terms, own, change in zip(self.parts, self.terms, self.own, self.change, strict=True):
            X = moved(at.poses[0], numbers[change])
            R, t = X[:3, :3], X[:3, 3]
            R_BS, p_BS = part.poses.rotation @ R, part.poses.rotation @ t + part.poses.translation
            placed = part.placed(R_BS, p_BS, numbers[own])
            by_pose = placed.twist @ np.kron(np.eye(2), R.T)
            by_flange = by_pose.copy()
            by_flange[:, :, :3] -= by_pose[:, :, 3:] @ skew(t)
            by_arm = by_flange @ terms
            J = np.zeros((*placed.e.shape, 6 + self.size))
            J[:, :, :6], numbered = by_pose, J[:, :, 6:]
            numbered[:, :, own], numbered[:, :, change] = placed.numbers, by_pose
            numbered[:, :, self.sensor], numbered[:, :, self.arm] = part.by_sensor, by_arm
            e = placed.e + part.by_sensor @ numbers[self.sensor] + by_arm @ numbers[self.arm]
            shift = by_flange[:, :, 3:]
            found.append(Observed(e, J, part.own + REPEATED_M**2 * shift @ np.swapaxes(shift, 1, 2)))
        coefficients = numbers[self.arm]
        J = np.zeros((len(coefficients), 1, 6 + self.size))
        J[:, 0, 6:][:, self.arm] = np.eye(len(coefficients))
        return [*found, Observed(coefficients[:, None], J)]

    def solved(self, X: Floats, free: tuple[slice, Floats] | None = None, numbers: Floats | None = None) -> Adjusted:
        """Adjust from X_FS (4, 4), with some numbers free to their sigmas."""
        sigma = self.sigma.copy()
        if free is not None:
            sigma[free[0]] = free[1]
        prior = np.diag(1.0 / sigma**2)
        prior[self.sensor, self.sensor] = self.sensor_information
        return adjust(
            Unknowns((X,), self.start if numbers is None else numbers),
            self.rows,
            self.kinds,
            prior=prior,
            mean=self.start,
            steps=_STEPS,
        )

    def tested(self, name: str, advice: str, solved: Adjusted, at: slice, words: str) -> Cause:
        """Return a cause with the chance that its numbers are as large as they are by chance."""
        x, k = solved.at.numbers[at] - self.start[at], slice(6 + at.start, 6 + at.stop)
        C = solved.covariance
        W = np.linalg.inv(C[k, k])
        square = float(x @ W @ x)
        # Yao, Biometrika 52 (1965): each spread counts as it contributes to this distance
        parts = [float(x @ W @ (C @ N @ C)[k, k] @ W @ x) / max(square, 1e-300) for N in solved.of]
        spare = [*solved.spare[:-1], solved.spare[-1] + ARM_NUMBERS]
        few = sum(part**2 / s for part, s in zip(parts, spare, strict=True))
        n = len(x)
        return Cause(
            name=name,
            words=words,
            advice=advice,
            chance=float(f_tail(square / n, n, 1.0 / max(few, 1e-6))),
            sigmas=float(np.sqrt(square)),
        )


def arm_terms(poses: FlangePoses, middle: Floats) -> Floats:
    """Return twists [turn; shift] of the flange (n, 6, 78) in its own axes by each coefficient, in m.

    A constant, the nine entries of R_BF and the position (m) about ``middle`` (3,), for each axis of the twist.
    """
    n = len(poses)
    varies = np.column_stack([np.ones(n), poses.rotation.reshape(n, 9), poses.translation - middle])
    unit = np.diag([*[1.0 / ARM_REACH_M] * 3, 1.0, 1.0, 1.0])
    return np.einsum("ab,nk->nabk", unit, varies).reshape(n, 6, -1)


def _arm(left: Remainder) -> float:
    """By the coefficients' squares and the prior, each as many numbers as it knows."""
    square = left.sigma**2 * left.weighted + ARM_NUMBERS * ARM_M**2
    return float(np.sqrt(square / (left.spare + ARM_NUMBERS)))


def solve_joint(parts: Sequence[FeatureScans], sensor: Floats, arm_m: float | None = None) -> JointEstimate:
    """Return the mounting from the scans of one or more features, and whether they agree.

    Args:
        parts: each with a start; one of them at least determines X_FS.
        sensor: covariance (3, 3) of the profiler's scale and shear, of which the points are corrected.
        arm_m: one sigma of a coefficient of the arm's error, where it is known; else it is estimated.

    Raises:
        DegenerateMotion: the scans leave a direction open. InconsistentData: the parts' mountings are far apart.
    """
    starts = [part.X_FS for part in parts if part.X_FS is not None]
    X = starts[0]
    for part in parts:
        if part.X_FS is not None:
            _refuse_far(parts[0].name, X, part.name, part.X_FS)
    problem = _Problem(parts, sensor, arm_m)
    best = problem.solved(X)
    X = best.at.poses[0]
    causes = _causes(problem, best) if len(parts) > 1 else []
    C = best.covariance[:6, :6]
    _refuse_open(C, best)
    widened = max(1.0, causes[0].sigmas ** 2 / 3.0) if causes else 1.0
    residual, odd, squares, numbers = [], [], 0.0, 0.0
    for row, sigma in zip(best.rows[:-1], best.sigmas, strict=False):
        W = np.linalg.inv(row.own + sigma**2 * np.eye(row.e.shape[1]))
        square = np.einsum("ni,nij,nj->n", row.e, W, row.e)
        odd.append(tuple(int(k) for k in np.flatnonzero(square > OUTLIER**2 * row.e.shape[1])))
        residual.append(row.e.ravel())
        squares, numbers = squares + float(square.sum()), numbers + square.size * row.e.shape[1]
    e = np.concatenate(residual)
    values = best.at.numbers
    edge = next((own for part, own in zip(parts, problem.own, strict=True) if part.name == "edge"), None)
    broken = None
    if edge is not None and problem.sigma[edge.stop - 1] > EXACT:
        broken = float(values[edge.stop - 1]), float(np.sqrt(best.covariance[5 + edge.stop, 5 + edge.stop]))
    moves = np.concatenate([terms @ values[problem.arm] for terms in problem.terms])
    return JointEstimate(
        rotation=X[:3, :3],
        translation=X[:3, 3],
        covariance=widened * C,
        residuals=e,
        inliers=np.ones(len(e), bool),
        rms_m=float(np.sqrt(np.mean(e**2))),
        reduced_chi2=squares / max(sum(best.spare[:-1]), 1.0),
        condition=float(1.0 / np.linalg.cond(_unit(C))),
        sensor=values[problem.sensor],
        arm_m=float(np.sqrt(np.mean((moves - moves.mean(axis=0))[:, 3:] ** 2))),
        edge_radius_m=broken,
        causes=tuple(causes),
        odd=tuple(odd),
    )


def _unit(C: Floats) -> Floats:
    s = np.sqrt(np.diag(C))
    return np.asarray(C / np.outer(s, s))


def _refuse_far(one: str, X: Floats, other: str, Y: Floats) -> None:
    """Refuse parts whose own mountings are further apart than a joint solution can bridge."""
    d = difference(X, Y)
    if np.linalg.norm(d[3:]) < 0.3 * _FREE_M and np.linalg.norm(d[:3]) < 0.3 * _FREE_RAD:
        return
    turn = float(np.degrees(np.linalg.norm(d[:3])))
    raise InconsistentData(
        f"The {other} puts the profiler ({', '.join(f'{1e3 * v:+.1f}' for v in d[3:])}) mm in the flange's axes, and"
        f" {turn:.1f} deg, from where the {one} does: the tool (TCP) that was active, or the mounting, was another."
        " Record both with the controller's TCP set to the flange, without touching the profiler between them."
    )


def _refuse_open(C: Floats, best: Adjusted) -> None:
    unit = np.diag([LEVER_M] * 3 + [1.0] * 3)
    sigma = float(np.sqrt(np.linalg.eigvalsh(unit @ C @ unit)[-1]))
    J = np.concatenate([row.J[:, :, :6].reshape(-1, 6) for row in best.rows])
    if sigma > VAGUE_M or not np.diag(C).min() > 0.0 or np.linalg.matrix_rank(J) < 6:
        raise DegenerateMotion(
            f"These scans leave the {worst_direction(np.linalg.pinv(C))} open: tilt the flange about two axes by 15 to"
            " 30 deg, and add planes of other normals or another feature."
        )


def _causes(problem: _Problem, best: Adjusted) -> list[Cause]:
    """Return the likely causes of a disagreement, each solved for with the rest; none where all agree."""
    parts, X, numbers = problem.parts, best.at.poses[0], best.at.numbers
    tried: list[Cause] = []
    # of two, either may be the one that is off: both are one test
    tested = range(len(parts)) if len(parts) > 2 else [1]
    for k in tested:
        name = parts[k].name
        who = f"the {name}" if len(parts) > 2 else f"{parts[0].name} or {name}"
        for what, at, free in (
            ("shift", slice(problem.change[k].start + 3, problem.change[k].stop), np.full(3, _FREE_M)),
            ("turn", slice(problem.change[k].start, problem.change[k].start + 3), np.full(3, _FREE_RAD)),
        ):
            found = problem.solved(X, (at, free), numbers)
            d = found.at.numbers[at]
            s = np.sqrt(np.diag(found.covariance)[6 + at.start : 6 + at.stop])
            scale, unit = (1e3, "mm") if what == "shift" else (np.degrees(1.0), "deg")
            size = ", ".join(f"{scale * v:+.2f} +- {scale * u:.2f}" for v, u in zip(d, s, strict=True))
            words = f"a {what} of the {name} by ({size}) {unit} along x, y, z of the flange"
            advice = f"check the tool (TCP) that was active for {who}, and whether the profiler was moved between them"
            tried.append(problem.tested("tool", advice, found, at, words))
    for part, own in zip(parts, problem.own, strict=True):
        if part.name == "sphere":
            at = slice(own.stop - 1, own.stop)
            found = problem.solved(X, (at, np.array([_FREE_RADIUS_M])), numbers)
            d, s = found.at.numbers[at] - problem.start[at], np.sqrt(found.covariance[6 + at.start, 6 + at.start])
            words = f"a sphere larger in radius by {1e3 * float(d[0]):+.3f} +- {1e3 * float(s):.3f} mm than stated"
            tried.append(problem.tested("sphere radius", "measure the sphere's diameter", found, at, words))
    tried.sort(key=lambda cause: cause.chance)
    if tried[0].chance > LEVEL / len(tried):
        return []
    return [cause for cause in tried if cause.chance * _LIKELY <= max(tried[0].chance, 1e-300)][:2]
