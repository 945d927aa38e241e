"""Guards that keep motion bounded: seam conditioning, arm singularity and joint slew limits."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from weldcal.models.compiled import compiled
from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array, dot


class GuardError(InputError):
    """A limit or a Jacobian that cannot be used as it is."""


class SeamConditioning(NamedTuple):
    """Conditioning of the chord on the seam.

    Attributes:
        cos_torch: t_s . u at the torch, the paper's n_d . n_t.
        value: sqrt(cos_tip^2 + cos_torch^2), with t_s . u at the tip. The paper's law needs cos_torch away from 0, the
            guarded one only this.
    """

    cos_torch: float
    value: float


def seam_conditioning(chord: Array, tangent_tip: Array, tangent_torch: Array) -> SeamConditioning:
    """Conditioning of n_d . n_t from the unit chord u and the unit seam tangents, each (3,); weld_law.md, section 3."""
    cos_tip, cos_torch = dot(tangent_tip, chord), dot(tangent_torch, chord)
    return SeamConditioning(cos_torch, (cos_tip * cos_tip + cos_torch * cos_torch) ** 0.5)


@dataclass(frozen=True)
class ArmGuardConfig:
    """Thresholds at which the arm slows and stops near a singularity.

    Attributes:
        sigma_slow, sigma_stop: least singular value of the length-scaled Jacobian where slowing begins, and the stop.
        characteristic_length_m: what makes m/s and rad/s comparable: translations are divided by it.
    """

    sigma_slow: float = 0.08
    sigma_stop: float = 0.03
    characteristic_length_m: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma_stop < self.sigma_slow < math.inf:
            raise GuardError("The arm guard needs 0 < sigma_stop < sigma_slow.")
        if not 0.0 < self.characteristic_length_m < math.inf:
            raise GuardError("The arm guard needs a positive characteristic length.")

    @cached_property
    def row_scale(self) -> Array:
        """Scale factors (6,) of the rows of a Jacobian [omega; v]."""
        return np.array([1.0, 1.0, 1.0, *([1.0 / self.characteristic_length_m] * 3)])


GUARD = ArmGuardConfig()
"""The thresholds of every guarded motion, and of the check of its path before it starts."""
# Of the joints' speed limits, for guarded motions. A choice: a joint then stops in a quarter of its longest way (v^2).
SPEED_SHARE = 0.5


@dataclass(frozen=True)
class GuardedVelocity:
    """The joint velocity that the guard allows.

    Attributes:
        q_dot: (6,) rad/s, always finite.
        sigma_min: least singular value of the scaled Jacobian.
        scale: the share (0..1) of the wanted velocity that is left.
        stopped: True where the guard stopped the arm.
        reason: one sentence when stopped or slowed, else None.
    """

    q_dot: Array
    sigma_min: float
    scale: float
    stopped: bool
    reason: str | None


def guarded_joint_velocity(
    J: ArrayLike, V: ArrayLike, q_dot_limit: ArrayLike, config: ArmGuardConfig | None = None
) -> GuardedVelocity:
    """Joint velocity for a spatial velocity, slowed along its own direction near a singularity and stopped at it.

    Args:
        J: (6,6), [omega; v] of the moved point in B per joint rate.
        V: (6,), [omega rad/s; v m/s] of the same point in B.
        q_dot_limit: (6,) or one number, rad/s.
        config: thresholds; ArmGuardConfig() when None.
    """
    limits = config or ArmGuardConfig()
    # copies: the code is compiled anew for each kind of view
    jacobian, velocity = np.array(J, dtype=float), np.array(V, dtype=float)
    bound, rest = np.full(6, q_dot_limit, dtype=float), np.zeros(6)
    sigma_min, scale, slowed = _guarded(
        jacobian, velocity, bound, limits.row_scale, limits.sigma_stop, limits.sigma_slow, rest
    )
    reason: str | None = None
    if slowed < 0.0:
        reason = "The arm was stopped: the commanded velocity is not finite."
    elif scale == 0.0:
        reason = f"The arm was stopped {sigma_min:.3f} from a singularity; start from another arm configuration."
    elif slowed < 1.0:
        reason = f"Near a singularity: the arm moves at {slowed:.0%}."
    elif scale < 1.0:
        reason = f"A joint is at its speed limit: the arm moves at {scale:.0%}."
    return GuardedVelocity(rest, sigma_min, scale, scale == 0.0, reason)


@compiled()
def _guarded(
    J: Array, V: Array, bound: Array, row_scale: Array, stop: float, slow: float, q_dot: Array
) -> tuple[float, float, float]:
    """Fill q_dot (6,), which is zero.

    Returns sigma_min, the share of the wanted velocity that is left (0: stopped), and that near a singularity (below 0:
    an input is not finite).
    """
    if not (np.isfinite(J).all() and np.isfinite(V).all() and np.isfinite(bound).all()):
        return 0.0, 0.0, -1.0
    scaled, wanted = J * row_scale.reshape(6, 1), V * row_scale
    U, sigma, Vt = np.linalg.svd(scaled)
    sigma_min = sigma[5]
    if sigma_min <= stop:
        return sigma_min, 0.0, 0.0
    slowed = min(1.0, (sigma_min - stop) / (slow - stop))
    # Not damped, which would turn the twist: sigma is above sigma_stop here, and the scale ends at zero there.
    excess = 0.0
    for i in range(6):
        part = 0.0
        for r in range(6):
            part += U[r, i] * wanted[r]
        part *= slowed / sigma[i]
        for k in range(6):
            q_dot[k] += Vt[i, k] * part
    for k in range(6):
        excess = max(excess, abs(q_dot[k]) / max(bound[k], 1e-9))
    if excess > 1.0:
        q_dot /= excess
        return sigma_min, slowed / excess, slowed
    return sigma_min, slowed, slowed


@dataclass(frozen=True)
class SlewLimits:
    """Per-joint bounds, each (n,) or one number: speed rad/s, acceleration rad/s^2, jerk rad/s^3."""

    speed: Array | float = 1.0
    acceleration: Array | float = 4.0
    jerk: Array | float = 80.0

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration", "jerk"):
            value = np.asarray(getattr(self, name), dtype=float)
            if not (np.isfinite(value).all() and (value > 0.0).all()):
                raise GuardError(f"The slew limit '{name}' must be positive and finite.")

    def rows(self, n: int) -> tuple[Array, Array, Array]:
        """Speed, acceleration and jerk of each joint, (n,) each."""

        def row(bound: Array | float) -> Array:
            whole = isinstance(bound, np.ndarray) and bound.shape == (n,) and bound.dtype == np.float64
            return np.asarray(bound) if whole else np.full(n, bound, dtype=float)

        return row(self.speed), row(self.acceleration), row(self.jerk)


def slew_limit(v_des: ArrayLike, v_prev: Array, a_prev: Array, limits: SlewLimits, dt: float) -> tuple[Array, Array]:
    """One tick towards v_des within speed, acceleration and jerk; (v, a), each (n,).

    The acceleration chosen is the largest from which jerk-limited ticks can still bring it to zero before the target
    is passed. Inductive proof that no bound is ever exceeded: let r(a) be the speed still gained while a falls to zero
    by jerk*dt a tick. The choice keeps |v| + r(a) <= speed, and the lowest acceleration reachable next tick is exactly
    the first step of that fall, so the same holds a tick later whatever is then wanted.

    Args:
        v_des: (n,) rad/s; a value that is not finite brings every joint to rest.
        v_prev, a_prev: (n,), what this function returned a tick ago (zeros at the start).
        limits: bounds.
        dt: tick in s.
    """
    speed, top, jerk = limits.rows(len(v_prev))
    v, a = np.array(v_prev, dtype=float), np.array(a_prev, dtype=float)
    _slew(np.array(v_des, dtype=float), v, a, speed, top, jerk, dt)
    return v, a


@compiled()
def _slew(wanted: Array, v: Array, a: Array, speed: Array, top: Array, jerk: Array, dt: float) -> None:
    """One tick of each joint, in place; see slew_limit."""
    finite = np.isfinite(wanted).all()
    for k in range(len(v)):
        step = jerk[k] * dt
        gap = min(max(wanted[k] if finite else 0.0, -speed[k]), speed[k]) - v[k]
        # With m whole jerk steps to undo afterwards, a tick at `a` and the fall gain dt((m+1)a - step m(m+1)/2) =
        # |gap|.
        m = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * abs(gap) / (step * dt)) - 1.0))
        wish = np.sign(gap) * (abs(gap) / dt + 0.5 * step * m * (m + 1.0)) / (m + 1.0)
        a[k] = min(max(min(max(wish, -top[k]), top[k]), a[k] - step), a[k] + step)
        v[k] += a[k] * dt
