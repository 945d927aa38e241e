"""Takes the returns of a raw profile, for the modules that look for a feature in one."""

import numpy as np
from numpy.typing import ArrayLike

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.profiler.motion import Floats
from weldcal.models.errors import InputError


def returns_of(profile: ArrayLike, fewest: int, what: str) -> Floats:
    """Return the points (n, 2) [x, z] m of a profile where something returned, by rising x.

    Raises:
        FeatureNotFound: fewer than ``fewest``; ``what`` is the object. InputError: not a profile.
    """
    p = np.asarray(profile, float)
    if p.ndim != 2 or p.shape[1] != 2:
        raise InputError(f"A profile is an array (n, 2) of [x, z], not {p.shape}.")
    p = p[np.isfinite(p).all(axis=1)]
    if len(p) < fewest:
        raise FeatureNotFound(f"The profile has {len(p)} returns only: bring the {what} into the scanner's range.")
    return np.asarray(p[np.argsort(p[:, 0], kind="stable")])
