"""When an arm counts as standing at a joint goal."""

import numpy as np
from numpy.typing import NDArray

AT_HOME_RAD = 0.01  # an arm that stands this near to home begins the job from where it is


def stands_at(q: NDArray[np.float64], q_home: NDArray[np.float64]) -> bool:
    """Whether each joint (6,) rad is where it should be."""
    return bool(np.max(np.abs(q - q_home)) <= AT_HOME_RAD)
