"""The rigid chord under the laws as they are shipped: Eq. 17's wrong sign, and a singularity of the law, not of the
tool."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.worlds.weld.laws import get_law, motion_law
from weldcal.welding.numerics import Array
from weldcal.welding.seam.curve import SeamFrame
from weldcal.welding.servo.guards import seam_conditioning
from weldcal.welding.servo.settings import MotionLimits, ServoConfig
from weldcal.welding.servo.state import WeldingState
from weldcal.welding.servo.track import TickMotion, TorchTarget

# No rate limit hides what the law itself answers.
QUICK = MotionLimits(
    tip_acceleration_m_s2=1e6, omega_acceleration_rad_s2=1e6, tip_speed_max_m_s=1.0, turn_rate_max_rad_s=1e3
)
CONFIG = ServoConfig(limits=QUICK)
D, V, UP = CONFIG.tool.torch_offset_m, CONFIG.weld_speed_m_s, np.array([0.0, 0.0, 1.0])


def direction(angle: float) -> Array:
    """A level unit vector (3,)."""
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def seam_at(position: Array, angle: float) -> SeamFrame:
    """A straight level seam through a point."""
    t = direction(angle)
    return SeamFrame(position, t, np.cross(UP, t), UP, 0.0)


def tool(p_tip: Array, alpha: float) -> RigidTransform:
    """X_BT with the chord from torch to tip at an angle about up."""
    return RigidTransform(RotationMatrix(RollPitchYaw(0.0, 0.0, alpha)), p_tip)


def moved(name: str, p_tip: Array, alpha: float, psi_tip: float, psi_torch: float, offset: float = 0.0) -> TickMotion:
    """One tick of a law: seam tangents at psi_tip and psi_torch, the torch `offset` m to the left of its path."""
    torch = p_tip - D * direction(alpha)
    t = direction(psi_torch)
    n = np.cross(UP, t)
    target = TorchTarget(point=torch - offset * n, tangent=t, normal=n, up=UP, arc=0.0, s=0.0, residual=np.zeros(2))
    return motion_law(get_law(name))(
        WeldingState(), tool(p_tip, alpha), seam_at(p_tip, psi_tip), target, (0.0, 0.0), CONFIG, CONFIG.period_s
    )


def torch_velocity(motion: TickMotion, alpha: float) -> Array:
    """Velocity (3,) m/s of the torch point under the commanded twist of the tool."""
    arm = -D * direction(alpha)
    return np.asarray(motion.V_BT[3:] + np.cross(motion.V_BT[:3], arm))


def test_the_commanded_twist_moves_the_torch_as_eq_14_says() -> None:
    # P_t = P_r - |d| t_d differentiated numerically: the sign of omega |d| n_d is minus, where Eq. 17 prints plus.
    alpha, p, h = 0.7, np.array([0.1, -0.2, 0.0]), 1e-6
    motion = moved("open", p, alpha, 0.9, 0.4)
    omega, v = float(motion.V_BT[2]), motion.V_BT[3:]
    ahead, behind = ((p + s * v) - D * direction(alpha + s * omega) for s in (h, -h))
    n_d = np.cross(UP, direction(alpha))
    np.testing.assert_allclose((ahead - behind) / (2.0 * h), v - omega * D * n_d, atol=1e-9)
    np.testing.assert_allclose(torch_velocity(motion, alpha), v - omega * D * n_d, atol=1e-12)


def test_the_printed_law_gives_the_torch_twice_the_normal_velocity_it_should_remove() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        alpha, psi_torch, psi_tip = rng.uniform(-1.0, 1.0, 3)
        n = np.cross(UP, direction(psi_torch))
        printed, corrected = (moved(name, np.zeros(3), alpha, psi_tip, psi_torch) for name in ("printed", "open"))
        wanted = float(printed.V_BT[3:] @ n)
        assert torch_velocity(printed, alpha) @ n == pytest.approx(2.0 * wanted, rel=1e-6, abs=1e-12)
        assert torch_velocity(corrected, alpha) @ n == pytest.approx(0.0, abs=1e-12)


def follow(name: str, radius: float, offset: float = 0.0, travel: float = 0.040) -> float:
    """How far the torch is off an arc in the end, m: tip exactly on it, torch starting `offset` to the left of it."""
    dt = 1e-3
    centre = np.array([0.0, radius, 0.0])
    turn = 2.0 * math.asin(D / (2.0 * radius))
    psi = turn  # the torch starts at the arc's lowest point, the tip a chord ahead
    alpha, e = 0.5 * turn - offset / D, offset
    for _ in range(int(travel / V / dt)):
        tip = centre + radius * np.array([math.sin(psi), -math.cos(psi), 0.0])
        out = centre - (tip - D * direction(alpha))
        e = radius - float(np.linalg.norm(out))
        if abs(e) > 0.030:
            break
        # The arc's tangent where the torch is; its left normal points to the centre.
        motion = moved(name, tip, alpha, psi, math.atan2(out[1], out[0]) - 0.5 * math.pi, e)
        alpha += dt * float(motion.V_BT[2])
        psi += dt * V / radius
    return e


def test_as_printed_the_torch_leaves_an_arc_and_corrected_it_stays() -> None:
    assert abs(follow("printed", 0.100)) > 5e-3
    # Euler at 1 ms: local error (V dt)^2/2R a step, damped at k_b = 4/s: below a micrometre.
    assert abs(follow("fixed", 0.100)) < 5e-6


def test_only_position_feedback_takes_a_starting_offset_out() -> None:
    # 5 s at k = 4/s leave exp(-20) of 2 mm; at velocity level alone it stays.
    assert abs(follow("fixed", 0.100, offset=2e-3)) < 10e-6
    assert abs(follow("open", 0.100, offset=2e-3)) > 1.5e-3


def test_the_guarded_law_keeps_the_torch_on_its_path_at_its_speed_within_its_limits() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        alpha = rng.uniform(-math.pi, math.pi)
        psi_tip, psi_torch = alpha + rng.uniform(-1.2, 1.2, 2)
        motion = moved("guarded", np.zeros(3), alpha, psi_tip, psi_torch)
        torch, t = torch_velocity(motion, alpha), direction(psi_torch)
        assert abs(torch @ np.cross(UP, t)) <= 0.01 * V
        # The weights of tip speed and turning rate (section 4) pull its speed by a few per cent at most.
        assert torch @ t == pytest.approx(V, rel=0.05)
        assert torch @ t == pytest.approx(motion.v_torch, abs=1e-9)
        assert abs(motion.omega) <= CONFIG.limits.omega_max_rad_s + 1e-12


def test_at_a_right_angled_corner_the_papers_rate_is_unbounded_and_the_guarded_one_is_not() -> None:
    # n_d . n_t = 0: the tip already on the second leg, the torch on the first, the chord along the second.
    paper = moved("fixed", np.zeros(3), math.pi / 2 - 1e-4, math.pi / 2, 0.0)
    assert abs(paper.omega) > 50.0
    motion = moved("guarded", np.zeros(3), math.pi / 2 - 1e-4, math.pi / 2, 0.0)
    # The tool pivots: V/|d|, and the tip hardly moves.
    assert abs(motion.omega) == pytest.approx(V / D, rel=0.1)
    assert motion.v_torch == pytest.approx(V, rel=0.1)
    assert abs(motion.v_tip) <= 0.1 * V
    assert np.isfinite(motion.V_BT).all()


def test_only_a_u_turn_square_to_the_chord_is_ill_conditioned() -> None:
    chord = direction(0.3)
    square = (direction(0.3 + 0.5 * math.pi), direction(0.3 - 0.5 * math.pi))
    assert seam_conditioning(chord, *square).value == pytest.approx(0.0, abs=1e-12)
    for turn in np.linspace(0.0, math.radians(90.0), 10):
        for share in np.linspace(0.0, 1.0, 11):
            tip, torch = direction(0.3 + share * turn), direction(0.3 - (1.0 - share) * turn)
            assert seam_conditioning(chord, tip, torch).value >= 1.0 - 1e-9
