"""Checks the diversity of a set of poses and names the errors that they cannot show."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.errors import CoplanarPoses, RepeatedPoses, TooFewPoses
from weldcal.calibration.geometry.se3 import rotation_vector, skew
from weldcal.models.arrays import Array

SAME_PLACE_M = 0.002  # a choice: above what arms repeat to (0.1 mm), below any move on purpose
MIN_DEPTH_M = 0.002  # a choice: as SAME_PLACE_M, ten times the usual spread of 0.15 mm
MIN_DEPTH_SHARE = 0.01  # a choice: centres flatter than 1 : 100 fix what lies across them 100 times worse
HIDDEN_BIAS_M = 0.0005  # a bias known this well is not worth a sentence
SHIFT_LIKE_M = 0.005  # one known worse than this is as good as unknown


def check_diversity(
    p_B: Array, has_normal: NDArray[np.bool_], *, min_poses: int = 4, allow_coplanar: bool = False
) -> None:
    """Refuse sets of flange centres (n, 3) m that do not fix a calibration by the paper's rule (four, not coplanar).

    ``min_poses`` and ``allow_coplanar`` relax the rule: with face normals two poses are enough, without three that do
    not lie on one line. Raises TooFewPoses, RepeatedPoses (fewer than ``min_poses`` distinct places, 2 mm apart) and
    CoplanarPoses (rms distance from the best plane under 2 mm or under 1 % of the extent). Source: paper, after Eq.
    (12).
    """
    n = len(p_B)
    if n < min_poses:
        raise TooFewPoses(
            f"A calibration needs at least {min_poses} usable poses whose flange centres do not lie in one plane; "
            f"there {'is' if n == 1 else 'are'} {n}: add poses."
        )
    distinct: list[Array] = []
    for p in p_B:
        if len(distinct) < min_poses and all(float(np.linalg.norm(p - q)) > SAME_PLACE_M for q in distinct):
            distinct.append(p)
    if len(distinct) < min_poses:
        raise RepeatedPoses(
            f"The {n} poses repeat only {len(distinct)} place{'s' if len(distinct) > 1 else ''} (within 2 mm); scan "
            f"the flange at {min_poses} or more different places."
        )
    if n < 3 or (allow_coplanar and bool(has_normal.all())):
        return
    spread = np.linalg.svd(p_B - p_B.mean(axis=0), compute_uv=False) / np.sqrt(n)
    limit = max(MIN_DEPTH_M, MIN_DEPTH_SHARE * float(spread[0]))
    if spread[1] < limit:
        raise CoplanarPoses(
            f"The {n} flange centres lie on one line; move the flange sideways and towards the scanner between scans."
        )
    if spread[2] < limit and not allow_coplanar:
        raise CoplanarPoses(
            f"The {n} flange centres lie in one plane (within {1e3 * spread[2]:.1f} mm rms); move the flange towards "
            "and away from it between scans."
        )


def hidden_bias_sigma(poses: list[RigidTransform], sigma_position_m: float) -> Array:
    """Predict the standard deviation (3,) m with which the poses would show a constant bias of the centre.

    It is along x, y, z of the feature frame R.

    The bias b (in R) and the camera pose are estimated together: p_B + R_BR b = X_BC p_C; infinite where no pose
    differs in orientation, because the bias then is a mere shift of the camera.
    """
    p = np.array([X.translation() for X in poses])
    rows = np.concatenate(
        [
            np.concatenate([-skew(p - p.mean(axis=0)), np.broadcast_to(np.eye(3), (len(p), 3, 3))], axis=2),
            -np.array([X.rotation().matrix() for X in poses]),
        ],
        axis=2,
    ).reshape(-1, 9)
    rows[:, :3] /= max(float(np.abs(p - p.mean(axis=0)).max()), 1e-6)
    information = rows.T @ rows / max(sigma_position_m, 1e-9) ** 2
    pose, cross, bias = information[:6, :6], information[:6, 6:], information[6:, 6:]
    schur = bias - cross.T @ np.linalg.pinv(pose, rcond=1e-10) @ cross
    values, vectors = np.linalg.eigh(schur)
    variance = np.where(values > 1e-9 * float(np.trace(bias)), 1.0 / np.maximum(values, 1e-30), np.inf)
    share = vectors**2
    with np.errstate(invalid="ignore"):
        terms = np.where(share > 1e-6, share * variance, 0.0)
    return np.asarray(np.sqrt(terms.sum(axis=1)))


def turn_deg(poses: list[RigidTransform]) -> float:
    """Largest rotation (deg) of any pose from the first."""
    first = poses[0].rotation().inverse()
    return max(float(np.degrees(np.linalg.norm(rotation_vector(first @ X.rotation())))) for X in poses)


def has_orientations(poses: Sequence[RigidTransform]) -> bool:
    """Return whether orientations are given: pairs of centres without any carry the identity in every pose."""
    return any(not X.rotation().IsExactlyIdentity() for X in poses)


def unobservable_sentences(poses: list[RigidTransform], sigma_position_m: float, normals: bool) -> tuple[str, ...]:
    """Sentences that name the errors these poses cannot show; empty where there are none."""
    if len(poses) < 2:
        return ("All errors except those of the flange itself: one pose has nothing to compare with.",)
    # a calibration that fits to a few micrometres still cannot see a bias with a lever of a few degrees
    sigma = hidden_bias_sigma(poses, max(sigma_position_m, 5e-5))
    axes = [name for name, s in zip("xyz", sigma, strict=True) if not s < HIDDEN_BIAS_M]
    out = []
    if axes and float(sigma.max()) < SHIFT_LIKE_M:
        seen = ", ".join(f"{n} to {1e3 * s:.1f} mm" for n, s in zip("xyz", sigma, strict=True) if n in axes)
        out.append(
            "A small constant bias of the flange centre in the flange frame (equally a TCP offset): the orientations of"
            f" these poses show one only roughly, along {seen}."
        )
    elif axes:
        why = (
            f"the flange turned by only {turn_deg(poses):.1f} degrees between poses"
            if has_orientations(poses)
            else "no orientations are given"
        )
        out.append(
            f"A constant bias of the flange centre in the flange frame along {', '.join(axes)} (equally a TCP offset): "
            f"{why}, so it looks like a shift of the camera."
        )
    out.append("A rotation of the flange about its own axis: a circle does not show it.")
    if not normals:
        out.append("The tilt of the flange: only centres are given, no face normals.")
    return tuple(out)
