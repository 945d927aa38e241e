"""Planar kinematics of the rigid torch-to-tip chord: Eq. 14-18 of the paper, the corrected law and the projective law."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from weldcal.welding.numerics import Array


@dataclass(frozen=True)
class ChordMotion:
    """Planar motion of the tool: velocity of the tip's rest point (2,) m/s and angular velocity rad/s."""

    v_tip: Array
    omega: float


def chord_axes(alpha: float) -> tuple[Array, Array]:
    """(t_d, n_d), each (2,): along the chord from torch to tip, and to its left (Section 2.2.2 of the paper)."""
    return np.array([math.cos(alpha), math.sin(alpha)]), np.array([-math.sin(alpha), math.cos(alpha)])


def torch_position(p_tip: Array, alpha: float, d: float) -> Array:
    """Eq. 14: P_t = P_r - |d| t_d, (2,) m. The torch trails."""
    return p_tip - d * chord_axes(alpha)[0]


def torch_velocity(motion: ChordMotion, alpha: float, d: float) -> Array:
    """The derivative of Eq. 14: V_t = V_r - omega |d| n_d, (2,) m/s. Eq. 17 prints a plus."""
    return motion.v_tip - motion.omega * d * chord_axes(alpha)[1]


def conditioning(th_tip: float, th_torch: float) -> float:
    """sqrt(cos^2 th_r + cos^2 th_t), 0..sqrt 2: zero only where the chord is square to both ends of the seam."""
    return math.hypot(math.cos(th_tip), math.cos(th_torch))


@dataclass(frozen=True)
class ProjectiveMotion:
    """The guarded feed-forward: tip speed and torch speed m/s, angular velocity rad/s."""

    v_tip: float
    v_torch: float
    omega: float


def projective_law(
    psi_tip: float,
    psi_torch: float,
    alpha: float,
    d: float,
    weld_speed: float,
    tip_speed_limit: float = 0.040,
    omega_limit: float = 0.8,
) -> ProjectiveMotion:
    """(v_r, v_t, omega) = L (cos th_t, cos th_r, sin(psi_r - psi_t)/|d|), with the largest L that keeps every limit.

    Rigid: v_r cos th_r = v_t cos th_t and |d| omega = v_r sin th_r + v_t sin th_t. Nothing is divided by n_d . n_t, so
    every geometry has a finite answer; where n_d is square to n_t the tip stops and the tool pivots about it.

    Args:
        psi_tip, psi_torch: seam tangent angles in rad at the two ends.
        alpha: chord angle in rad.
        d: chord length in m.
        weld_speed: wanted torch speed, m/s.
        tip_speed_limit, omega_limit: m/s, rad/s.
    """
    cos_tip, cos_torch = math.cos(psi_tip - alpha), math.cos(alpha - psi_torch)
    turn = math.sin(psi_tip - psi_torch)
    scale = weld_speed / max(abs(cos_tip), 1e-9)
    scale = min(scale, tip_speed_limit / max(abs(cos_torch), 1e-9), omega_limit * d / max(abs(turn), 1e-9))
    return ProjectiveMotion(scale * cos_torch, scale * cos_tip, scale * turn / d)


def paper_as_printed(v_tip: Array, n_torch: Array, alpha: float, d: float, e_torch: float = 0.0) -> float:
    """Line 13 of Algorithm 2 as printed: omega = -(V_r . n_t)/(|d| n_d . n_t), rad/s. It diverges.

    Args:
        v_tip: (2,) m/s.
        n_torch: (2,) normal of the refined path at the torch.
        e_torch: not used; the printed law has no position feedback.
    """
    del e_torch
    return -float(v_tip @ n_torch) / (d * _off_zero(float(chord_axes(alpha)[1] @ n_torch)))


def paper_corrected(
    v_tip: Array, n_torch: Array, alpha: float, d: float, e_torch: float = 0.0, k: float = 2.5
) -> float:
    """The same, with its sign corrected and position fed back: omega = (V_r . n_t + k e_t)/(|d| n_d . n_t), rad/s.

    Args:
        v_tip: (2,) m/s.
        n_torch: (2,) normal of the refined path at the torch.
        e_torch: torch position less path, along n_torch, m.
        k: feedback gain, 1/s.
    """
    return (float(v_tip @ n_torch) + k * e_torch) / (d * _off_zero(float(chord_axes(alpha)[1] @ n_torch)))


def _off_zero(value: float) -> float:
    """Never exactly zero, so that the paper's division is huge rather than undefined."""
    return value if abs(value) > 1e-12 else math.copysign(1e-12, value)
