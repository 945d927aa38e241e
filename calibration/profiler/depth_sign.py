"""Find where z grows in profiles: away from the sensor, or towards it as in heights (Gocator, Keyence LJ)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from weldcal.calibration.errors import FeatureNotFound, InconsistentData
from weldcal.calibration.geometry.robust import f_tail
from weldcal.calibration.profiler.motion import Floats
from weldcal.models.errors import WeldcalError

SIGNS = {"away": 1.0, "towards": -1.0}
"""What multiplies z so that it grows away from the sensor, by where the z of the profiles grows."""
WORDS = {"away": "away from the sensor", "towards": "towards the sensor"}
CHANCE = (1e-4, 1e-6)  # choices: that the right sign is rejected for one with as many profiles, or with fewer
FEWER = 0.6  # a choice: of the other sign's profiles, the least that explain it


@dataclass(frozen=True, eq=False, kw_only=True)
class SignFit:
    """What the profiles show with one sign of z.

    Attributes:
        shown: profiles that show the feature; kept: those of them that one result explains, 0 where none does.
        variance, freedom: of the residuals, outliers at their limit, in any unit that both signs share.
        error: why no result explains them.
    """

    shown: int
    kept: int = 0
    variance: float = np.inf
    freedom: int = 0
    error: WeldcalError | None = None


def signs_to_try(stated: str) -> tuple[str, ...]:
    """Return the stated sign, or both."""
    return (stated,) if stated else tuple(SIGNS)


def with_sign(
    profiles: Sequence[Floats], extract: Callable[[Floats], Floats], grows: str
) -> tuple[list[Floats], list[int]]:
    """Extract a feature with z turned to grow away from the sensor: its points in the file's own frame.

    Args:
        profiles: (m, 2) [x, z] each.
        extract: returns points (..., 2) of a profile whose z grows away from the sensor, or raises FeatureNotFound.
        grows: of SIGNS.

    Returns:
        the points of the profiles that show the feature, and the numbers of the others.
    """
    turn, points, lost = np.array([1.0, SIGNS[grows]]), [], []
    for k, p in enumerate(profiles):
        try:
            points.append(extract(p * turn) * turn)
        except FeatureNotFound:
            lost.append(k)
    return points, lost


def choose_sign(fits: Mapping[str, SignFit], total: int, what: str, alike: Callable[[], bool]) -> tuple[str, str]:
    """Return the sign with which more profiles show the feature and one result explains them, and a sentence on it.

    Args:
        fits: of each sign that was tried.
        total: number of profiles; what: the feature, for the sentences.
        alike: whether the results of both signs agree, so that either is right.

    Raises:
        WeldcalError: the error of the sign that shows more, where no result explains the profiles.
        InconsistentData: both signs explain the profiles, and the results differ.
    """
    order = sorted(fits, key=lambda g: (-fits[g].kept, fits[g].variance if fits[g].kept else -fits[g].shown))
    counts = " and ".join(
        f"with z {WORDS[g]} {fits[g].shown} of {total} profiles show the {what}"
        + (f" and {fits[g].kept} agree" if fits[g].shown else "")
        for g in order
    )
    first = fits[order[0]]
    if not first.kept:
        if first.error is None or not first.shown:
            raise FeatureNotFound(f"No profile shows the {what}: {counts}.")
        raise type(first.error)(f"{str(first.error).rstrip('.')}. Of the profiles, {counts}.")
    chosen = order[0]
    if len(order) > 1:
        second = fits[order[1]]
        if beats(first, second):
            pass
        elif beats(second, first, CHANCE[1]) or (second.kept and alike() and second.variance < first.variance):
            chosen = order[1]
        elif not (second.kept and alike()):
            raise InconsistentData(
                f"The profiles do not show where z grows: {counts}. The results differ. State it with --as z=away or"
                " --as z=towards; heights (Gocator, Keyence) grow towards the sensor."
            )
    return chosen, f"z of the profiles grows {WORDS[chosen]}: {counts}."


def beats(one: SignFit, other: SignFit, chance: float = CHANCE[0]) -> bool:
    """Test whether twice as many profiles agree with one sign, or its residuals are smaller than by chance."""
    if not one.kept or 2 * one.kept < other.shown:
        return False
    if one.kept >= 2 * other.kept:
        return True
    ratio = other.variance / max(one.variance, 1e-300)
    return one.kept >= FEWER * other.kept and float(f_tail(ratio, other.freedom, one.freedom)) < chance
