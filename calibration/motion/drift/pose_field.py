"""Sparse Gaussian-process features of a smooth error over the poses that a tracked flange visits."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from weldcal.models.arrays import Array


@dataclass(frozen=True)
class FieldConfig:
    """How a systematic error of scanner and arm varies: its sigma per axis (m, rad) and its lengths (m, and rad of the normal).

    ``novelty`` is the share of the variance that the features may leave unexplained before one more is added, up to
    ``largest`` features.
    """

    sigma_m: float = 1.5e-4
    sigma_rad: float = 8e-4
    length_m: float = 0.15
    length_rad: float = 0.5
    novelty: float = 0.01
    largest: int = 120


class PoseField:
    """Features phi(x) with k(x, y) ~ phi(x) . phi(y) for a squared-exponential kernel, grown where poses are new.

    The features are those of the inducing poses so far: phi(x) = L^-1 k(Z, x) with L L' = k(Z, Z). A new inducing pose
    appends one feature and leaves the others as they are, so that coefficients learnt before keep their meaning, and the new
    one is independent of them a priori (Csato and Opper 2002, with the basis of a Cholesky factor).
    """

    def __init__(self, config: FieldConfig) -> None:
        self.config = config
        self._scale = np.repeat([1.0 / config.length_m, 1.0 / config.length_rad], 3)
        self._poses = np.empty((0, 6))
        self._factor = np.empty((0, 0))

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def full(self) -> bool:
        """Whether no feature can be added."""
        return len(self) >= self.config.largest

    def copy(self) -> "PoseField":
        """A field that grows by itself from here on; its arrays are never changed in place."""
        out = PoseField(self.config)
        out._poses, out._factor = self._poses, self._factor
        return out

    def features(self, p_C: Array, n_C: Array) -> tuple[Array, float]:
        """Features (m,) at a centre (3,) m with normal (3,), grown by one where the pose is new, and the unexplained share."""
        x = np.concatenate([p_C, n_C]) * self._scale
        d = self._poses - x
        k = np.exp(-0.5 * np.einsum("ij,ij->i", d, d))
        phi = solve_triangular(self._factor, k, lower=True, check_finite=False) if len(k) else k
        left = max(1.0 - float(phi @ phi), 0.0)
        if left <= self.config.novelty or self.full:
            return np.asarray(phi), left
        m = len(self)
        root = np.sqrt(left)
        factor = np.zeros((m + 1, m + 1))
        factor[:m, :m], factor[m, :m], factor[m, m] = self._factor, phi, root
        self._poses, self._factor = np.vstack([self._poses, x]), factor
        return np.append(phi, root), 0.0
