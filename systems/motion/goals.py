"""Checks whether an arm is at a joint goal."""

import numpy as np
from numpy.typing import NDArray

AT_HOME_RAD = 0.01  # within this distance of home the job starts without a move


def stands_at(q: NDArray[np.float64], q_home: NDArray[np.float64]) -> bool:
    """Whether each joint (6,) rad is within AT_HOME_RAD of home."""
    return bool(np.max(np.abs(q - q_home)) <= AT_HOME_RAD)
