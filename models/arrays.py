"""The type of the arrays: double precision, any shape; docstrings say shapes, units and frames."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
