"""Guards that keep motion bounded: seam conditioning, arm singularity and joint slew limits."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array, dot, within


class GuardError(InputError):
    """A limit or a Jacobian that cannot be used as it is."""


class SeamConditioning(NamedTuple):
    """Conditioning of the chord on the seam.

    Attributes:
        cos_tip, cos_torch: t_s . u at the two ends; cos_torch is the paper's n_d . n_t.
        value: sqrt(cos_tip^2 + cos_torch^2). The paper's law needs cos_torch away from 0, the guarded one only this.
        tip_ratio: tip speed per torch speed, cos_torch/cos_tip, held inside +-1e6.
    """

    cos_tip: float
    cos_torch: float
    value: float
    tip_ratio: float


def seam_conditioning(chord: Array, tangent_tip: Array, tangent_torch: Array) -> SeamConditioning:
    """Conditioning of n_d . n_t from the unit chord u and the unit seam tangents, each (3,); weld_law.md, section 3."""
    cos_tip, cos_torch = dot(tangent_tip, chord), dot(tangent_torch, chord)
    off_zero = cos_tip if abs(cos_tip) > 1e-6 else (1e-6 if cos_tip >= 0.0 else -1e-6)
    value = (cos_tip * cos_tip + cos_torch * cos_torch) ** 0.5
    return SeamConditioning(cos_tip, cos_torch, value, cos_torch / off_zero)


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
    jacobian, velocity = np.asarray(J, dtype=float), np.asarray(V, dtype=float)
    bound = np.asarray(q_dot_limit, dtype=float)
    rest = np.zeros(jacobian.shape[-1])
    if not (np.isfinite(jacobian).all() and np.isfinite(velocity).all() and np.isfinite(bound).all()):
        return GuardedVelocity(rest, 0.0, 0.0, True, "The arm was stopped: the commanded velocity is not finite.")
    row_scale = limits.row_scale
    U, sigma, Vt = np.linalg.svd(row_scale[:, None] * jacobian)
    sigma_min = float(sigma[-1])
    if sigma_min <= limits.sigma_stop:
        text = f"The arm was stopped {sigma_min:.3f} from a singularity; start from another arm configuration."
        return GuardedVelocity(rest, sigma_min, 0.0, True, text)
    scale = min(1.0, (sigma_min - limits.sigma_stop) / (limits.sigma_slow - limits.sigma_stop))
    # Not damped, which would turn the twist: sigma is above sigma_stop here, and the scale ends at zero there.
    q_dot = scale * (Vt.T @ ((U.T @ (row_scale * velocity)) / sigma))
    reason = f"Near a singularity: the arm moves at {scale:.0%}." if scale < 1.0 else None
    excess = float(np.max(np.abs(q_dot) / np.maximum(bound, 1e-9)))
    if excess > 1.0:
        q_dot, scale = q_dot / excess, scale / excess
        reason = reason or f"A joint is at its speed limit: the arm moves at {scale:.0%}."
    return GuardedVelocity(q_dot, sigma_min, scale, False, reason)


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


def command_is_finite(v_des: ArrayLike) -> bool:
    """Whether every number of a command is finite; `slew_limit` brings the arm to rest when one is not."""
    return bool(np.isfinite(np.asarray(v_des, dtype=float)).all())


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
    wanted = np.asarray(v_des, dtype=float)
    if not np.isfinite(wanted).all():
        wanted = np.zeros_like(v_prev)
    speed, top = np.asarray(limits.speed, dtype=float), np.asarray(limits.acceleration, dtype=float)
    step = np.asarray(limits.jerk, dtype=float) * dt
    gap = within(wanted, -speed, speed) - v_prev
    # With m whole jerk steps to undo afterwards, a tick at `a` and the fall gain dt((m+1)a - step m(m+1)/2) = |gap|.
    m = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * np.abs(gap) / (step * dt)) - 1.0))
    a_wish = np.sign(gap) * (np.abs(gap) / dt + 0.5 * step * m * (m + 1.0)) / (m + 1.0)
    a = within(within(a_wish, -top, top), a_prev - step, a_prev + step)
    return v_prev + a * dt, a
