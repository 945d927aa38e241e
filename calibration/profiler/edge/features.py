"""Extracts the point of a straight edge from a raw profile: end of a bar or step, or apex of a blade."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.profiler.motion import Floats
from weldcal.calibration.profiler.returns import returns_of

MEDIAN = 5  # samples: takes out single spikes
RUN_M = 6e-3  # of the face beside an edge that is looked at
FLANK_M = 15e-3  # the same of a blade's flank
MINIMUM_RUN = 8  # samples
MINIMUM_FACE = 3  # samples that give the direction of a face
TUKEY = 4.0  # robust sigmas beyond which a sample has no weight in a line
GAP = 4.0  # pitches without a return that end a plateau

Kind = Literal["bar", "step", "apex"]
MINIMUM_JUMP_M = {"bar": 5e-3, "step": 0.5e-3}


def extract_edge(profile: ArrayLike, kind: Kind, side: Literal["left", "right"] = "left") -> tuple[Floats, Floats]:
    """Return the edge's point in a profile and its sigma, both (2,) [x, z] m.

    Args:
        profile: (n, 2) [x, z] m, z growing away from the sensor; NaN where nothing returned.
        kind: `bar` (a jump of 5 mm or more), `step` (0.5 mm or more), `apex` (two flanks meeting nearest to the
            sensor).
        side: at which end of the near face the edge is; for an apex, which flank is the steep one (either will do).

    Raises:
        FeatureNotFound: the profile does not show it. InputError: not a profile.
    """
    p = returns_of(profile, 2 * MINIMUM_RUN, "object")
    if side == "right":
        point, sigma = extract_edge(p * [-1.0, 1.0], kind, "left")
        return point * [-1.0, 1.0], sigma
    pitch = float(np.median(np.diff(p[:, 0])))
    return _apex(p, pitch) if kind == "apex" else _end(p, pitch, MINIMUM_JUMP_M[kind])


def near_face(profile: ArrayLike, point: Floats, side: Literal["left", "right"] = "left") -> Floats:
    """Return the direction (2,) [x, z] in a profile of the near face beside an edge, away from the edge.

    Raises:
        FeatureNotFound: too few samples.
    """
    p, sign = returns_of(profile, MINIMUM_RUN, "object"), 1.0 if side == "left" else -1.0
    beyond = sign * (p[:, 0] - point[0])
    face = p[(beyond > 0.25 * RUN_M) & (beyond < RUN_M)]
    if len(face) < MINIMUM_FACE:
        raise FeatureNotFound("The near face is too short: bring more of it into the laser line.")
    return sign * np.array([1.0, robust_line(face[:, 0], face[:, 1])[1]])


def _end(p: Floats, pitch: float, jump_m: float) -> tuple[Floats, Floats]:
    """Return the first sample of the near face, less half a pitch; its height from a line through the face."""
    x, z = p[:, 0], median_filter(p[:, 1], MEDIAN, mode="nearest")
    drop = z[: -MEDIAN + 1] - z[MEDIAN - 1 :]  # across the filter's own length
    for k in np.argsort(-drop):
        if drop[k] < jump_m:
            break
        begin = int(k) + int(np.argmax(z[k : k + MEDIAN - 1] - z[k + 1 : k + MEDIAN])) + 1
        face = (x >= x[begin] + 2.0 * pitch) & (x <= x[begin] + RUN_M)
        if face.sum() < MINIMUM_RUN:
            continue
        a, b, sigma, good = robust_line(x[face], p[face, 1])
        if good < 0.6 * face.sum():
            continue
        near = np.abs(p[:, 1] - (a + b * x)) < max(5.0 * sigma, 0.2 * jump_m)
        first = begin + 2
        while (
            first > 0 and (near[first - 1] or (first > 1 and near[first - 2])) and x[first] - x[first - 1] < GAP * pitch
        ):
            first -= 1
        while not near[first]:
            first += 1
        at = float(x[first] - 0.5 * pitch)
        return np.array([at, a + b * at]), np.array([pitch / np.sqrt(12.0), 2.0 * sigma / np.sqrt(good)])
    raise FeatureNotFound(
        f"No edge of {1e3 * jump_m:.1f} mm or more in the profile: move until the laser line crosses it."
    )


def _apex(p: Floats, pitch: float) -> tuple[Floats, Floats]:
    """Where the lines through both flanks meet."""
    x, z = p[:, 0], median_filter(p[:, 1], MEDIAN, mode="nearest")
    at = float(x[int(np.argmin(z))])
    result = None
    for _ in range(6):
        lines = []
        for sign in (-1.0, 1.0):
            reach = sign * (x - at)
            flank = (reach > pitch) & (reach < FLANK_M)
            if flank.sum() < MINIMUM_RUN:
                raise FeatureNotFound(
                    "The profile does not show both flanks of the blade: move until both are visible."
                )
            lines.append(robust_line(x[flank], p[flank, 1]))
        (a1, b1, s1, n1), (a2, b2, s2, n2) = lines
        if not (b1 < b2 and abs(b2 - b1) > 0.2):
            raise FeatureNotFound("The two sides of the profile's nearest point do not make a blade's apex.")
        new = (a1 - a2) / (b2 - b1)
        spread = np.hypot(2.0 * s1 / np.sqrt(n1), 2.0 * s2 / np.sqrt(n2)) / abs(b2 - b1)
        flat = min((abs(b1), s1, n1), (abs(b2), s2, n2))
        result = np.array([new, a1 + b1 * new]), np.array([spread, 2.0 * flat[1] / np.sqrt(flat[2]) + flat[0] * spread])
        if abs(new - at) < 1e-3 * pitch:
            break
        at = float(np.clip(new, at - 2e-3, at + 2e-3))
    assert result is not None
    return result


def robust_line(x: Floats, z: Floats) -> tuple[float, float, float, int]:
    """z = a + b x by Tukey's weights: a, b, sigma of a sample, number of samples that count."""
    pairs = np.triu_indices(len(x), 1)
    across = (x[None, :] - x[:, None])[pairs]
    slopes = (z[None, :] - z[:, None])[pairs][across != 0.0] / across[across != 0.0]
    b = float(np.median(slopes)) if len(slopes) else 0.0
    a = float(np.median(z - b * x))
    weight: NDArray[np.float64] = np.ones(len(x))
    # a sensor that rounds makes half of the residuals of a level line equal: their median says nothing below its step
    step = np.diff(np.unique(z))
    step_z = float(np.median(step)) if step.size else 0.0
    level = abs(b) * float(np.median(np.diff(x))) < step_z
    least = max(0.5 * step_z if level else 0.0, 1e-9)
    sigma = least
    for _ in range(8):
        r = z - a - b * x
        sigma = max(MAD * float(np.median(np.abs(r))), least)
        weight = np.clip(1.0 - (r / (TUKEY * sigma)) ** 2, 0.0, None) ** 2
        root = np.sqrt(weight)
        a, b = (float(v) for v in np.linalg.lstsq(np.column_stack([root, root * x]), root * z, rcond=None)[0])
    return a, b, sigma, max(int((weight > 0.0).sum()), 1)
