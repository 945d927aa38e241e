"""What the doctor examines: the robot's poses and what the scanner measured of the flange, as arrays in recording
order."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array

Which = NDArray[np.bool_] | NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ArmDerivatives:
    """What joint zeros and link lengths of p numbers do: change D (n, 3, p) of p_CR's place in the base, change T (n,
    3, p) of the normals, and one sigma (p,) of the numbers for an arm as it leaves the factory."""

    D: Array
    T: Array
    sigma: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class DoctorCase:
    """n scans of a flange: X_BF (n, 4, 4) as the robot states it, X_FR (4, 4) of the feature, centres c (n, 3) m and
    outward normals m (n, 3) in the camera (NaN rows: not seen), ``time`` (n,) s or the order of the scans, ``noise``
    (n,) m rms of each face about its plane (NaN: unknown), ``coverage`` (n,) share of the edge that was seen.

    ``robot`` names the arm; ``guess`` is X_BC (4, 4) as somebody measured it, good to ``guess_radius`` m at the
    feature. ``flange`` is the stated designation, ``fits_flange`` the one that was found (empty: the stated one).
    ``refused`` lists (id, reason); ``near_far`` is the scanner's range, m; ``oriented`` is false for pairs that have
    positions only. Every fit holds the errors of the ``arm`` to their usual size (None: no fit has them).
    """

    ids: tuple[str, ...]
    X_BF: Array
    c: Array
    m: Array
    X_FR: Array = field(default_factory=lambda: np.eye(4))
    time: Array | None = None
    noise: Array | None = None
    coverage: Array | None = None
    robot: str = ""
    guess: Array | None = None
    guess_radius: float = 0.06
    flange: str = ""
    fits_flange: str = ""
    refused: tuple[tuple[str, str], ...] = ()
    near_far: tuple[float, float] | None = None
    oriented: bool = True
    arm: ArmDerivatives | None = None

    @property
    def n(self) -> int:
        """How many scans."""
        return len(self.c)

    @property
    def X_BR(self) -> Array:
        """Poses of the feature in the base (n, 4, 4)."""
        return np.asarray(self.X_BF @ self.X_FR)

    @property
    def b(self) -> Array:
        """The feature's centres in the base (n, 3) m."""
        return np.asarray(self.X_BR[:, :3, 3])

    @property
    def z(self) -> Array:
        """The feature's normals in the base (n, 3)."""
        return np.asarray(self.X_BR[:, :3, 2])

    @property
    def clock(self) -> Array:
        """Time of each scan from 0 (first) to 1 (last); by order where no times are known."""
        t = np.arange(self.n, dtype=float) if self.time is None or not np.isfinite(self.time).all() else self.time
        span = float(t.max() - t.min())
        return np.asarray((t - t.min()) / span if span > 0.0 else np.linspace(0.0, 1.0, self.n))

    def with_poses(self, X_BF: Array) -> Self:
        """The same scans with other robot poses, to which no errors of the arm are known."""
        return replace(self, X_BF=X_BF, arm=None)

    def pick(self, which: Which) -> Self:
        """Some of the scans."""
        kept = np.arange(self.n)[which]

        def some(v: Array | None) -> Array | None:
            return None if v is None else np.asarray(v[kept])

        return replace(
            self,
            ids=tuple(self.ids[k] for k in kept),
            X_BF=self.X_BF[kept],
            c=self.c[kept],
            m=self.m[kept],
            time=some(self.time),
            noise=some(self.noise),
            coverage=some(self.coverage),
            arm=None if self.arm is None else replace(self.arm, D=self.arm.D[kept], T=self.arm.T[kept]),
        )
