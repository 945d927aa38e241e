"""The steering laws by name: the paper's as printed, its corrections step by step, and the guarded law.

The product has the guarded law alone; `steering` puts one of the paper's in its place, for the comparison.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal
from unittest.mock import patch

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array, changed, clip, cross, dot, unit
from weldcal.welding.seam.curve import SeamFrame
from weldcal.welding.seam.refinement import RefinedSeam
from weldcal.welding.servo import contact, step
from weldcal.welding.servo.guards import seam_conditioning
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase, WeldingState
from weldcal.welding.servo.tool_axes import height_share, roll_rate, tool_axes
from weldcal.welding.servo.track import TickMotion, TorchTarget, guarded_motion

_OMEGA_CEILING = 100.0  # rad/s; an unguarded law may command thousands, which no robot reaches

MotionLaw = Callable[
    [WeldingState, RigidTransform, SeamFrame, TorchTarget, tuple[float, float], ServoConfig, float], TickMotion
]


class UnknownLaw(InputError):
    """No steering law has this name."""


@dataclass(frozen=True, kw_only=True)
class SteeringLaw:
    """One steering law and how it differs from the paper's.

    Attributes:
        name: of LAWS; summary: what it is, for tables.
        guarded: the law with phases for gaps and ends, which the paper's does not have.
        sign: of omega; -1 as printed. fitted: normal from a local fit, else from the two points beside the nearest.
        feedback: whether the torch's offset is fed back.
        damping: of the division by n_d . n_t (0: as printed); omega_limit: clip, rad/s.
        lost: what the deformation servo does without contact: keep seeking delta_d, or zero it (Section 3.3).
    """

    name: str
    summary: str
    guarded: bool = False
    sign: float = 1.0
    fitted: bool = True
    feedback: bool = True
    damping: float = 0.0
    omega_limit: float = _OMEGA_CEILING
    lost: Literal["kept", "zeroed"] = "kept"


LAWS: dict[str, SteeringLaw] = {
    law.name: law
    for law in (
        SteeringLaw(name="guarded", summary="guarded: torch speed first, box-constrained, with phases", guarded=True),
        SteeringLaw(name="printed", summary="Algorithm 2 as printed", sign=-1.0, feedback=False),
        SteeringLaw(
            name="literal", summary="sign corrected, normal from neighbouring points", fitted=False, feedback=False
        ),
        SteeringLaw(name="open", summary="sign corrected, fitted normal, no feedback", feedback=False),
        SteeringLaw(name="fixed", summary="sign corrected, fitted normal, torch position fed back"),
        SteeringLaw(name="fixed_zeroed", summary="as fixed; delta_d set to zero where contact is lost", lost="zeroed"),
        SteeringLaw(
            name="dls", summary="as fixed; division damped (0.2) and omega clipped", damping=0.2, omega_limit=0.8
        ),
    )
}


def get_law(name: str) -> SteeringLaw:
    """The law of that name.

    Raises:
        UnknownLaw: naming the known ones.
    """
    if name not in LAWS:
        raise UnknownLaw(f"Unknown steering law '{name}'; use one of {', '.join(LAWS)}.")
    return LAWS[name]


def motion_law(law: SteeringLaw) -> MotionLaw:
    """The function that computes one tick's motion under a law."""
    return guarded_motion if law.guarded else partial(paper_motion, law)


def paper_motion(
    law: SteeringLaw,
    state: WeldingState,
    X_BT: RigidTransform,
    tip: SeamFrame,
    target: TorchTarget,
    servo: tuple[float, float],
    config: ServoConfig,
    dt: float,
) -> TickMotion:
    """Algorithm 2, lines 8-14: V_r = V_const t + servo, omega from V_t . n_t = 0 (weld_law.md, section 2).

    The paper is planar; as in the guarded law, pitch keeps the torch's height and roll the work angle.
    """
    del dt  # the published law bounds no rate
    limits, torch = config.limits, config.torch
    axes = tool_axes(X_BT, tip.up, target.up, config)
    u, m, a, d = axes.along, axes.across, axes.yaw, axes.d
    n, t = target.normal, target.tangent
    if not law.fitted:
        t = literal_tangent(state.refined, axes.torch, target.tangent)
        n = unit(cross(target.up, t), target.normal)
    v = config.weld_speed_m_s
    V_tip = v * tip.tangent + servo[0] * tip.normal + servo[1] * tip.up
    e = axes.torch - target.point
    back = torch.k_b * dot(e, n) if law.feedback else 0.0
    c = dot(m, n)
    wanted = law.sign * dot(V_tip, n) + back
    slope = c / (c * c + law.damping**2) if law.damping else 1.0 / math.copysign(max(abs(c), 1e-9), c)
    omega = clip(wanted * slope / d, -law.omega_limit, law.omega_limit)

    b = target.up
    flat = V_tip - d * omega * m
    w_p = -(dot(flat, b) + torch.k_h * clip(dot(e, b), -torch.feedback_limit_m, torch.feedback_limit_m))
    w_p /= d * height_share(axes, b)
    w_p = clip(w_p, -limits.pitch_rate_max_rad_s, limits.pitch_rate_max_rad_s)
    V = np.concatenate([omega * a + w_p * m + roll_rate(axes, b, config) * u, V_tip])
    return TickMotion(V, v, dot(flat, t), omega, seam_conditioning(u, tip.tangent, t))


def literal_tangent(seam: RefinedSeam, p_torch: Array, otherwise: Array) -> Array:
    """Line 10 taken literally: direction (3,) between the two points beside the one nearest to the torch."""
    if len(seam) < 3:
        return otherwise
    i = int(np.argmin(np.sum((seam.points - p_torch) ** 2, axis=1)))
    i = min(max(i, 1), len(seam) - 2)
    return unit(seam.points[i + 1] - seam.points[i - 1], otherwise)


@contextmanager
def steering(name: str) -> Iterator[None]:
    """Let the servo steer by the law of that name during the block.

    The paper appends every point, uses the plan's frame alone and detects neither contact nor the seam's end; the
    wanted deflection without contact is an interpretation.
    """
    law, lost, end = get_law(name), False, math.nan
    contacts, servo = step._contact, step._servo

    def every_point(before: WeldingState, state: WeldingState, config: ServoConfig) -> WeldingState:
        nonlocal lost, end
        if state.phase != Phase.TRACK:
            return contacts(before, state, config)
        lost, end = contact.contact_lost(before, state, config), state.s_end
        return contact.with_point(state, config)

    def seeking(state: WeldingState, off: Array, sample: Any, config: ServoConfig) -> tuple[float, float]:
        lateral, upward = servo(state, off, sample, config)
        if state.phase != Phase.TRACK or not lost:
            return lateral, upward
        deflection, fresh = config.deflection, contact.freshness(state, sample.time)
        seek = 0.0 if law.lost == "zeroed" else deflection.delta_d_m
        return fresh * deflection.k_p * (seek - state.delta_n), 0.0

    with ExitStack() as stack:
        if not law.guarded:
            for module, replaced, by in (
                (step, "guarded_motion", motion_law(law)),
                (step, "_contact", every_point),
                (step, "_servo", seeking),
                (step, "finish", lambda state: changed(state, s_end=end)),
                (contact, "felt_turn", lambda *_: 0.0),
                (contact, "_steering", lambda *_: 0.0),
            ):
                stack.enter_context(patch.object(module, replaced, by))
        yield
