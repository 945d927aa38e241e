"""A rotation of one rotation vector is SciPy's at every angle, and no solver that runs away ends in another error."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from weldcal.calibration.geometry.se3 import exp_rotation


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-12, 1e-6, 1e-3, 0.1, 1.0, np.pi, 6.0, 50.0])
def test_one_vector_gives_the_rotation_that_scipy_gives(angle: float) -> None:
    axes = np.random.default_rng(0).normal(size=(50, 3))
    for w in angle * axes / np.linalg.norm(axes, axis=1)[:, None]:
        np.testing.assert_allclose(exp_rotation(w), Rotation.from_rotvec(w).as_matrix(), rtol=0.0, atol=2e-15)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("number", [np.nan, np.inf, 1e200])
def test_a_vector_without_a_finite_angle_ends_as_in_scipy(number: float) -> None:
    w = np.array([number, 0.1, 0.2])
    np.testing.assert_array_equal(exp_rotation(w), Rotation.from_rotvec(w).as_matrix())
