"""Solves for one mounting from the scans of several features, with the arm's error, and tests whether they agree.

The arm's error is a twist of the flange that varies with its pose: a linear function of the entries of R_BF and of the
position, which a wrong length or angle of any link is to first order. Its coefficients are random, of one variance that
the adjustment estimates. What is constant in the flange cannot be told from X_FS and stays in the covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from weldcal.calibration.adjustment import Adjusted, Kind, Observed, Remainder, Unknowns, adjust, helmert, huber, plain
from weldcal.calibration.errors import DegenerateMotion, InconsistentData
from weldcal.calibration.geometry.robust import f_tail
from weldcal.calibration.geometry.se3 import difference, moved, skew
from weldcal.calibration.profiler.combined.scans import EXACT, FeatureScans
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.result import LEVER_M, VAGUE_M, ProfilerEstimate, worst_direction

REPEATED_M = 0.03e-3  # one sigma per axis of a repeatability of 0.05 mm (ISO 9283), as for the sphere alone
ARM_M = 0.03e-3  # prior sigma of a coefficient: arms that are off by 0.1 to 0.3 mm (rms) have 0.02 to 0.04
ARM_NUMBERS = 3.0  # a choice: so many numbers the prior of the arm's variance counts as
SCANS_MOST_M = 1e-3  # a choice: scans that fit worse belong to no one mounting
ARM_MOST_M = 0.3e-3  # a choice: of a coefficient, of an arm that is off by a millimetre or more
ARM_REACH_M = 1.0  # the flange turns by its error over this: an arm's angles act at about its reach
_FREE_M, _FREE_RAD = 0.05, 0.2  # a choice: what a wrong tool may differ by; beyond, parts are compared before
_FREE_RADIUS_M = 1e-3  # the same of a radius
LEVEL = 0.01  # chance that parts that agree are said to differ
OUTLIER = 5.0  # sigmas of a scan's numbers
_LIKELY = 0.05  # a choice: another cause is named as well where it is this likely against the first
_STEPS = 60


@dataclass(frozen=True, eq=False, kw_only=True)
class Disagreement:
    """A cause that could make parts differ, fitted with all the rest.

    Attributes:
        name: shift, turn or sphere radius; part: whose.
        words: its size; advice: what to do.
        value: (n,) m or rad in the flange's axes; covariance: (n, n) of it.
        chance: of a value this large where nothing differs.
    """

    name: str
    part: str
    words: str
    advice: str
    value: Floats
    covariance: Floats
    chance: float

    @property
    def square(self) -> float:
        """Squared Mahalanobis distance of the value from nothing."""
        return float(self.value @ np.linalg.solve(self.covariance, self.value))


@dataclass(frozen=True, eq=False, kw_only=True)
class JointEstimate(ProfilerEstimate):
    """X_FS from all parts; residuals (n,) m of all scans' numbers.

    Attributes:
        sensor: (3,) scale and shear about the origin; edge_radius_m: of its break and its sigma, where there is one.
        arm_m: the arm's error at the flange per axis, without what a constant offset takes up.
        by_arm: (6, 6) the part of the covariance that the arm's error makes.
        tested: every cause that was tested, the likeliest first.
        odd: scans of each part that are off by more than five sigmas.
    """

    sensor: Floats
    arm_m: float
    by_arm: Floats
    edge_radius_m: tuple[float, float] | None
    tested: tuple[Disagreement, ...] = ()
    odd: tuple[tuple[int, ...], ...] = ()

    @property
    def causes(self) -> tuple[Disagreement, ...]:
        """The likeliest cause of a disagreement, and another that is hardly less likely; none where the parts agree."""
        if not any(cause.chance < LEVEL / len(self.tested) for cause in self.tested):
            return ()
        first, *others = self.tested
        return first, *[cause for cause in others if cause.chance * _LIKELY <= first.chance][:1]


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
        features = [Kind(rank=float(part.own.shape[1]), loss=huber, spread=_scans, sigma=REPEATED_M) for part in parts]
        arm = Kind(rank=1.0, loss=plain, spread=_arm if arm_m is None else None, sigma=arm_m or ARM_M)
        self.kinds = [*features, arm]

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

    def solved(self, start: Unknowns, at: slice | None = None, free: float = 0.0) -> Adjusted:
        """Adjust, with some of the numbers free to a sigma."""
        sigma = self.sigma.copy()
        if at is not None:
            sigma[at] = free
        prior = np.diag(1.0 / sigma**2)
        prior[self.sensor, self.sensor] = self.sensor_information
        return adjust(start, self.rows, self.kinds, prior=prior, mean=self.start, steps=_STEPS)

    def tested(self, best: Adjusted, part: int, name: str, at: slice, free: float) -> Disagreement:
        """Solve with some numbers of a part free, and return how likely they are as large by chance."""
        found = self.solved(best.at, at, free)
        x, k, C = found.at.numbers[at] - self.start[at], slice(6 + at.start, 6 + at.stop), found.covariance
        W = np.linalg.inv(C[k, k])
        square = float(x @ W @ x)
        # Yao, Biometrika 52 (1965): each spread counts as it contributes to this distance
        shares = [float(x @ W @ (C @ N @ C)[k, k] @ W @ x) / max(square, 1e-300) for N in found.of]  # 1e-300: no zero
        spare = [*found.spare[:-1], found.spare[-1] + ARM_NUMBERS]
        few = sum(share**2 / s for share, s in zip(shares, spare, strict=True))
        who, scale, unit = self.parts[part].name, 1e3, "mm"
        if name == "turn":
            scale, unit = float(np.degrees(1.0)), "deg"
        sign = "" if name == "radius" else "+"
        size = ", ".join(
            f"{scale * (v if sign else abs(v)):{sign}.3f} +- {scale * s:.3f}"
            for v, s in zip(x, np.sqrt(np.diag(C)[k]), strict=True)
        )
        if name == "radius":
            words = f"the sphere's radius is {size} mm {'larger' if x[0] > 0.0 else 'smaller'} than stated"
            advice = "measure the sphere's diameter"
        else:
            pair = len(self.parts) == 2
            who_else = f"the {self.parts[0].name}" if pair else "the other parts"
            about = " about the profiler's origin" if name == "turn" else ""
            words = (
                f"the {who} differs from {who_else} by a {name}{about} of ({size}) {unit} along x, y, z of the flange"
            )
            advice = (
                f"check which tool (TCP) was active for {'both' if pair else f'the {who}'}, and whether the profiler's"
                " bracket moved between them"
            )
        return Disagreement(
            name=name,
            part=who,
            words=words,
            advice=advice,
            value=x,
            covariance=C[k, k],
            chance=float(f_tail(square / len(x), len(x), 1.0 / max(few, 1e-6))),  # 1e-6: as good as known spreads
        )


def arm_terms(poses: FlangePoses, middle: Floats) -> Floats:
    """Return twists [turn; shift] of the flange (n, 6, 78) in its own axes by each coefficient, in m.

    A constant, the nine entries of R_BF and the position (m) about ``middle`` (3,), for each axis of the twist.
    """
    n = len(poses)
    varies = np.column_stack([np.ones(n), poses.rotation.reshape(n, 9), poses.translation - middle])
    unit = np.diag([*[1.0 / ARM_REACH_M] * 3, 1.0, 1.0, 1.0])
    return np.asarray(np.einsum("ab,nk->nabk", unit, varies).reshape(n, 6, -1))


def _scans(left: Remainder) -> float:
    """Halfway to Helmert's estimate: in whole steps this spread and the arm's take turns."""
    return float(np.sqrt(left.sigma * min(helmert(left), SCANS_MOST_M)))


def _arm(left: Remainder) -> float:
    """Halfway to the estimate by the coefficients' squares and the prior, each by the numbers that it knows."""
    square = left.sigma**2 * left.weighted + ARM_NUMBERS * ARM_M**2
    found = min(float(np.sqrt(square / (left.spare + ARM_NUMBERS))), ARM_MOST_M)
    return float(np.sqrt(left.sigma * found))


def solve_joint(parts: Sequence[FeatureScans], sensor: Floats, arm_m: float | None = None) -> JointEstimate:
    """Return the mounting from the scans of one or more features, and whether they agree.

    Args:
        parts: each with a start; one of them at least determines X_FS.
        sensor: covariance (3, 3) of the profiler's scale and shear, of which the points are corrected.
        arm_m: one sigma of a coefficient of the arm's error, where it is known; else it is estimated.

    Raises:
        DegenerateMotion: the scans leave a direction open. InconsistentData: the parts' mountings are far apart.
    """
    starts = [(part.name, part.X_FS) for part in parts if part.X_FS is not None]
    first, X = starts[0]
    for name, Y in starts[1:]:
        _refuse_far(first, X, name, Y)
    problem = _Problem(parts, sensor, arm_m)
    try:
        best = problem.solved(Unknowns((X,), problem.start))
    except np.linalg.LinAlgError:
        raise InconsistentData(
            "No mounting explains these scans together: calibrate by each part alone, and compare the results."
        ) from None
    problem.kinds = [replace(kind, sigma=s) for kind, s in zip(problem.kinds, best.sigmas, strict=True)]
    X = best.at.poses[0]
    tested = _tested(problem, best)
    C = best.covariance[:6, :6]
    _refuse_open(C, best)
    residual, odd, squares = [], [], 0.0
    for row, sigma in zip(best.rows[:-1], best.sigmas, strict=False):
        W = np.linalg.inv(row.own + sigma**2 * np.eye(row.e.shape[1]))
        square = np.einsum("ni,nij,nj->n", row.e, W, row.e)
        odd.append(tuple(int(k) for k in np.flatnonzero(square > OUTLIER**2 * row.e.shape[1])))
        residual.append(row.e.ravel())
        squares += float(square.sum())
    e = np.concatenate(residual)
    values = best.at.numbers
    edge = next((own for part, own in zip(parts, problem.own, strict=True) if part.name == "edge"), None)
    broken = None
    if edge is not None and problem.sigma[edge.stop - 1] > EXACT:
        broken = float(values[edge.stop - 1]), float(np.sqrt(best.covariance[5 + edge.stop, 5 + edge.stop]))
    moves = np.concatenate([terms @ values[problem.arm] for terms in problem.terms])
    made = JointEstimate(
        rotation=X[:3, :3],
        translation=X[:3, 3],
        covariance=C,
        residuals=e,
        inliers=np.ones(len(e), bool),
        rms_m=float(np.sqrt(np.mean(e**2))),
        reduced_chi2=squares / max(sum(best.spare[:-1]), 1.0),
        condition=float(1.0 / np.linalg.cond(_unit(C))),
        sensor=values[problem.sensor],
        by_arm=(best.covariance @ best.of[-1] @ best.covariance)[:6, :6],
        arm_m=float(np.sqrt(np.mean((moves - moves.mean(axis=0))[:, 3:] ** 2))),
        edge_radius_m=broken,
        tested=tuple(tested),
        odd=tuple(odd),
    )
    # what the parts contradict each other by is in the region as well
    return replace(made, covariance=C * tested[0].square / len(tested[0].value)) if made.causes else made


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
            f"These scans leave the {worst_direction(np.asarray(np.linalg.pinv(C), float))} open: tilt the flange about"
            " two axes by 15 to 30 deg, and add planes of other normals or another feature."
        )


def _tested(problem: _Problem, best: Adjusted) -> list[Disagreement]:
    """Return every cause that is tested, the likeliest first: another tool of a part, another radius of a sphere."""
    n, found = len(problem.parts), []
    for k, part in enumerate(problem.parts):
        if n > 2 or k:  # of two, either may be the one that is off: both are one test
            middle = problem.change[k].start + 3
            found.append(problem.tested(best, k, "shift", slice(middle, middle + 3), _FREE_M))
            found.append(problem.tested(best, k, "turn", slice(middle - 3, middle), _FREE_RAD))
        if part.name == "sphere" and n > 1:
            last = problem.own[k].stop
            found.append(problem.tested(best, k, "radius", slice(last - 1, last), _FREE_RADIUS_M))
    # another tool is mostly a shift: a turn must be clearly likelier
    return sorted(found, key=lambda cause: cause.chance / (_LIKELY if cause.name == "turn" else 1.0))
