"""Checks what the motion determines: diversity before the solution, unobservable directions after it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from weldcal.calibration.errors import CoplanarPoses, PureTranslation, RepeatedPoses, TooFewPoses
from weldcal.calibration.geometry.se3 import log_rotation, nearest_rotation
from weldcal.calibration.hand_eye.problem import NAMES, RANK, Problem, State
from weldcal.models.arrays import Array

SAME_TURN_RAD = 2e-3  # 0.1 deg, a choice: above what arms repeat to (1e-4), below any turn taken on purpose
SAME_PLACE_SHARE = 2e-3  # of the extent of the motion
NO_TURN_RAD = float(np.radians(0.5))
OPEN = 0.1  # predicted standard deviation, rad or share of the extent, at which a direction counts as open
VAGUE = 0.01  # and at which it is worth a sentence
_OPEN_SIGMA = 10.0  # what the covariance says of an open direction, in the same units


@dataclass(frozen=True)
class Diversity:
    """How the poses differ: n and distinct; largest turn (deg) between poses.

    Spread (deg) of the turns along their three principal directions; spread of positions in units of length; smallest
    share of the turn off the main axis.
    """

    n: int
    distinct: int
    turn_deg: float
    turn_spread_deg: tuple[float, float, float]

    def sentence(self) -> str:
        """One line for an operator."""
        a, b, c = self.turn_spread_deg
        return (
            f"{self.n} poses, {self.distinct} distinct; largest turn {self.turn_deg:.1f} deg; spread of the turns "
            f"{a:.1f} / {b:.1f} / {c:.1f} deg along their principal directions."
        )


def turns(R: Array) -> Array:
    """Rotation vectors (n, 3) of rotations (n, 3, 3) from their mean, in the parent's axes."""
    return log_rotation(R @ nearest_rotation(R.sum(axis=0)).T)


def diversity(problem: Problem) -> Diversity:
    """How much the robot poses of a problem differ (both robots together where there are two)."""
    n = len(problem)
    stated = [problem.F] + ([problem.H] if float(np.abs(problem.H - problem.H[0]).max()) > 0.0 else [])
    vectors = np.concatenate([turns(X[:, :3, :3]) for X in stated], axis=1).reshape(-1, 3)
    p = np.concatenate([X[:, :3, 3] - X[:, :3, 3].mean(axis=0) for X in stated], axis=1).reshape(-1, 3)
    spread = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(vectors))
    places = np.linalg.svd(p, compute_uv=False) / np.sqrt(len(p))
    first = [log_rotation(X[:, :3, :3] @ X[0, :3, :3].T) for X in stated]
    largest = max(float(np.linalg.norm(v, axis=1).max()) for v in first)
    s = np.degrees(spread)
    return Diversity(
        n,
        _distinct(stated, float(np.sqrt((places**2).sum()))),
        float(np.degrees(largest)),
        (float(s[0]), float(s[1]), float(s[2])),
    )


def _distinct(stated: list[Array], extent: float) -> int:
    """Number of poses no two of which are the same within 0.1 deg and 0.2 % of the motion."""
    n = len(stated[0])
    limit = SAME_PLACE_SHARE * max(extent, 1e-12)
    near = cKDTree(np.concatenate([X[:, :3, 3] for X in stated], axis=1)).query_pairs(
        limit * np.sqrt(len(stated)), output_type="ndarray"
    )
    a, b = near[:, 0], near[:, 1]
    same = np.ones(len(near), dtype=bool)
    for X in stated:
        # chordal distance 2 sqrt(2) sin(angle / 2) of rotation matrices
        turned = np.linalg.norm((X[a, :3, :3] - X[b, :3, :3]).reshape(-1, 9), axis=1)
        moved = np.linalg.norm(X[a, :3, 3] - X[b, :3, 3], axis=1)
        same &= (turned < np.sqrt(2.0) * SAME_TURN_RAD) & (moved < limit)
    left = np.ones(n, dtype=bool)
    for i, j in near[same][np.argsort(a[same], kind="stable")]:
        if left[i]:  # the first of its like stands for them
            left[j] = False
    return int(left.sum())


def check_poses(problem: Problem, *, allow_coplanar: bool = False) -> Diversity:
    """Refuse poses that do not determine a solution, before any work.

    Raises TooFewPoses (fewer equations than unknowns and three to spare), RepeatedPoses, PureTranslation, and
    CoplanarPoses for points alone in one plane or on one line.
    """
    numbers = 3 * len(problem) + 3 * int(problem.full.sum()) + 2 * int(problem.normal.sum())
    each = numbers / max(len(problem), 1)
    least = int(np.ceil((problem.size + 3) / max(each, 1.0)))
    least = max(least, 2 if problem.tied else 3)
    if not problem.full.any() and not problem.normal.any():
        least = max(least, 4)
    what = "motions" if problem.tied else "poses"
    if len(problem) < least:
        raise TooFewPoses(
            f"{problem.size} unknown numbers need at least {least} different {what}, and there "
            f"{'is' if len(problem) == 1 else 'are'} {len(problem)}: add {what} that differ in orientation."
        )
    d = diversity(problem)
    if d.distinct < least:
        raise RepeatedPoses(
            f"The {d.n} {what} repeat only {d.distinct} (within {np.degrees(SAME_TURN_RAD):.1f} deg and 0.2 % of the "
            f"motion); {least} different ones are needed."
        )
    open_pair = problem.tied or sum(problem.free) > 1
    if open_pair and d.turn_deg < np.degrees(NO_TURN_RAD):
        raise PureTranslation(
            f"The robot turned by at most {d.turn_deg:.2f} deg between poses: the position of the camera is"
            " unobservable in every direction; turn the hand about at least two axes."
        )
    alone = ~problem.full & ~problem.normal
    if alone.all():
        _check_points(problem.G[:, :3, 3], allow_coplanar)
    return d


def _check_points(p: Array, allow_coplanar: bool) -> None:
    spread = np.linalg.svd(p - p.mean(axis=0), compute_uv=False) / np.sqrt(len(p))
    if spread[1] < 0.01 * spread[0]:
        raise CoplanarPoses(
            f"The {len(p)} measured points lie on one line as the camera sees them: the rotation about that line is "
            "unobservable; move the point sideways and in depth."
        )
    if spread[2] < 0.01 * spread[0] and not allow_coplanar:
        raise CoplanarPoses(
            f"The {len(p)} measured points lie in one plane as the camera sees them, so that an error along its normal"
            " is unobservable; move the point in depth too."
        )


@dataclass(frozen=True)
class Determinacy:
    """Directions of the unknowns (m,) that stay open, with their names.

    Besides: sentences on vague directions, and the condition number of the scaled information.
    """

    directions: tuple[Array, ...]
    names: tuple[str, ...]
    warnings: tuple[str, ...]
    condition: float


def determinacy(
    problem: Problem,
    state: State,
    information: Array,
    covariance: Array,
    length: float,
    noise_rad: float,
    labels: dict[str, str],
) -> Determinacy:
    """Name the directions that the observations leave open.

    ``information`` and ``covariance`` (m, m) of the unknowns; ``length``: extent of the data; ``noise_rad``: per axis.
    A direction is unobservable in three cases. Its information vanishes. Its predicted standard deviation exceeds a
    tenth of a radian or of the extent. Or, with one rotation axis, the turns off that axis drown in the rotation noise.
    """
    scale = np.tile([1.0, 1.0, 1.0, length, length, length], problem.size // 6)
    N = information * scale[:, None] * scale
    values, vectors = np.linalg.eigh(N)
    null = values < RANK * values[-1]
    directions = [vectors[:, k] * scale for k in np.nonzero(null)[0]]
    if not directions:
        C = covariance / scale[:, None] / scale
        variances, axes = np.linalg.eigh(C)
        directions = [axes[:, k] * scale for k in np.nonzero(variances > OPEN**2)[0]]
        vague = [axes[:, k] * scale for k in np.nonzero((variances > VAGUE**2) & (variances <= OPEN**2))[0]]
        sigmas = np.sqrt(variances[(variances > VAGUE**2) & (variances <= OPEN**2)])
    else:
        vague, sigmas = [], np.zeros(0)
    axis, off = _common_axis(problem)
    if problem.full.all() and not directions and 0 in problem.blocks and off < 3.0 * noise_rad:
        u = problem.F[:, :3, :3].mean(axis=0).T @ axis
        v = np.zeros(problem.size)
        v[3:6] = u / np.linalg.norm(u) * length
        if not problem.tied and 1 in problem.blocks:
            v[9:12] = axis * length
        directions = [v]
    names = tuple(dict.fromkeys(_name(problem, state, v, scale, axis, off, noise_rad, labels) for v in directions))
    warnings = []
    for v, sigma in zip(vague, sigmas, strict=True):
        name = _name(problem, state, v, scale, axis, off, noise_rad, labels)
        part = np.abs(v / scale)
        turning = float(part.reshape(-1, 6)[:, :3].max()) > float(part.reshape(-1, 6)[:, 3:].max())
        much = f"{np.degrees(sigma):.2f} deg" if turning else f"{100.0 * sigma:.1f} % of the extent of the motion"
        warnings.append(f"Known only to about {much} (1 sigma): {name}; rotate more about other axes.")
    condition = float(np.sqrt(values[-1] / values[0])) if values[0] > RANK * values[-1] else float("inf")
    return Determinacy(tuple(directions), names, tuple(dict.fromkeys(warnings)), condition)


def with_open_directions(covariance: Array, found: Determinacy, length: float) -> Array:
    """Covariance (m, m) with unobservable directions widened: ten radians or extents of standard deviation there."""
    out = covariance.copy()
    scale = np.tile([1.0, 1.0, 1.0, length, length, length], len(out) // 6)
    for v in found.directions:
        u = v / np.linalg.norm(v / scale)
        out = out + _OPEN_SIGMA**2 * np.outer(u, u)
    return out


def without_drift(problem: Problem, state: State, found: Determinacy) -> State:
    """Return the solution with the shortest positions along directions that carry no information."""
    for v in found.directions:
        blocks = v.reshape(-1, 6)
        if float(np.abs(blocks[:, :3]).max()) > 1e-6 * float(np.abs(blocks[:, 3:]).max()):
            continue
        t = np.concatenate([state[k][:3, 3] for k in problem.blocks])
        u = blocks[:, 3:].reshape(-1)
        state = problem.step(state, -v * float(u @ t) / float(u @ u))
    return state


def _common_axis(problem: Problem) -> tuple[Array, float]:
    """Direction (3,) in the parent of F that the turns share, and the rms turn (rad) off it."""
    w = turns(problem.F[:, :3, :3])
    if problem.tied:
        w = log_rotation(problem.F[:, :3, :3])
    _, s, Vt = np.linalg.svd(w, full_matrices=False)
    return np.asarray(Vt[0]), float(s[1]) / np.sqrt(len(w))


def _name(
    problem: Problem,
    state: State,
    v: Array,
    scale: Array,
    axis: Array,
    off: float,
    noise: float,
    labels: dict[str, str],
) -> str:
    blocks = (v / scale).reshape(-1, 6)
    sizes = np.linalg.norm(blocks.reshape(-1, 2, 3), axis=2)
    # the camera's pose first, where it moves about as much as another's
    row, kind = np.unravel_index(int(np.argmax(sizes > 0.5 * sizes.max())), sizes.shape)
    name = NAMES[problem.blocks[int(row)]]
    label = labels.get(name, name)
    u = blocks[int(row), 3 * int(kind) : 3 * int(kind) + 3]
    u = u / np.linalg.norm(u)
    u = u * np.sign(u[int(np.argmax(np.abs(u)))])
    where = "(" + ", ".join(f"{c + 0.0:+.2f}" for c in np.round(u, 2)) + ")"
    word = "translation" if kind == 1 else "rotation"
    # the axis as the frame that carries X sees it: turned by any of the poses, it is the same where it is common
    seen = problem.F[0, :3, :3].T @ axis if name == "X" else axis
    spread = off < max(0.05, 4.0 * noise)
    if spread and abs(float(seen @ u)) > 0.9 and name in ("X", "Y"):
        return f"{word} along the common rotation axis {where}: {label}"
    return f"{word} {'along' if kind == 1 else 'about'} {where}: {label}"
