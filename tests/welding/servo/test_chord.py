"""The rigid chord: Eq. 17 of the paper has a wrong sign, and its singularity is one of the law, not of the tool."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from tests.welding.servo.planar_chord import (
    ChordMotion,
    chord_axes,
    conditioning,
    paper_as_printed,
    paper_corrected,
    projective_law,
    torch_position,
    torch_velocity,
)

D, V = 0.060, 0.008


def test_the_torch_velocity_is_the_derivative_of_the_torch_position() -> None:
    # Eq. 14 differentiated numerically: the sign of omega |d| n_d is minus, where Eq. 17 prints plus.
    alpha, motion, h = 0.7, ChordMotion(np.array([0.006, -0.003]), 0.4), 1e-6
    ahead = torch_position(h * motion.v_tip, alpha + h * motion.omega, D)
    behind = torch_position(-h * motion.v_tip, alpha - h * motion.omega, D)
    # Central differences of a smooth function: error h^2 |d| omega^3/6, rounding 1e-17/1e-6.
    np.testing.assert_allclose((ahead - behind) / (2.0 * h), torch_velocity(motion, alpha, D), atol=1e-9)


def test_the_printed_law_gives_the_torch_twice_the_normal_velocity_it_should_remove() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        alpha, psi = rng.uniform(-1.0, 1.0, 2)
        n = np.array([-math.sin(psi), math.cos(psi)])
        v = V * rng.normal(size=2)
        printed = torch_velocity(ChordMotion(v, paper_as_printed(v, n, alpha, D)), alpha, D)
        corrected = torch_velocity(ChordMotion(v, paper_corrected(v, n, alpha, D)), alpha, D)
        assert printed @ n == pytest.approx(2.0 * (v @ n), rel=1e-9)
        assert corrected @ n == pytest.approx(0.0, abs=1e-12)


def follow(omega_of: Callable[..., float], radius: float, offset: float = 0.0, travel: float = 0.040) -> float:
    """How far the torch is off an arc in the end, m: tip exactly on it, torch starting `offset` to the left of it."""
    dt = 1e-3
    centre = np.array([0.0, radius])
    turn = 2.0 * math.asin(D / (2.0 * radius))
    psi = turn  # the torch starts at the arc's lowest point, the tip a chord ahead
    alpha = 0.5 * turn - offset / D
    e = offset
    for _ in range(int(travel / V / dt)):
        tip = centre + radius * np.array([math.sin(psi), -math.cos(psi)])
        torch = torch_position(tip, alpha, D)
        out = centre - torch
        n = out / np.linalg.norm(out)
        e = radius - float(np.linalg.norm(out))
        v = V * np.array([math.cos(psi), math.sin(psi)])
        alpha += dt * omega_of(v, n, alpha, D, e)
        psi += dt * V / radius
        if abs(e) > 0.030:
            break
    return e


def test_as_printed_the_torch_leaves_an_arc_and_corrected_it_stays() -> None:
    assert abs(follow(paper_as_printed, 0.100)) > 5e-3
    # Euler at 1 ms: local error (V dt)^2/2R, damped at k_b = 2.5/s: below a micrometre.
    assert abs(follow(paper_corrected, 0.100)) < 5e-6


def test_only_position_feedback_takes_a_starting_offset_out() -> None:
    # 5 s at k = 2.5/s leave exp(-12.5) of 2 mm; at velocity level alone (k = 0) it would stay.
    assert abs(follow(paper_corrected, 0.100, offset=2e-3)) < 10e-6
    omega = paper_corrected(np.array([V, 0.0]), np.array([0.0, 1.0]), 0.0, D, 2e-3, k=0.0)
    assert omega == 0.0


def test_the_projective_law_keeps_both_ends_on_their_tangents() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        psi_r, psi_t, alpha = rng.uniform(-math.pi, math.pi, 3)
        motion = projective_law(psi_r, psi_t, alpha, D, V)
        tip = motion.v_tip * chord_axes(psi_r)[0]
        torch = torch_velocity(ChordMotion(tip, motion.omega), alpha, D)
        np.testing.assert_allclose(torch, motion.v_torch * chord_axes(psi_t)[0], atol=1e-12)
        assert abs(motion.omega) <= 0.8 + 1e-12
        assert abs(motion.v_tip) <= 0.040 + 1e-12
        assert abs(motion.v_torch) <= V + 1e-12


def test_at_a_right_angled_corner_the_tip_stops_and_the_tool_pivots() -> None:
    # n_d . n_t = 0: the paper's omega is unbounded, the projective one V/|d|, and nothing is ill-conditioned.
    motion = projective_law(math.pi / 2, 0.0, math.pi / 2 - 1e-9, D, V)
    assert motion.v_tip == pytest.approx(0.0, abs=1e-9)
    assert motion.v_torch == pytest.approx(V)
    assert motion.omega == pytest.approx(V / D)
    assert conditioning(0.0, math.pi / 2) == pytest.approx(1.0)
    n = np.array([0.0, 1.0])
    assert abs(paper_corrected(np.array([0.0, V]), n, math.pi / 2 - 1e-4, D)) > 1000.0
    assert math.isfinite(paper_corrected(np.array([0.0, V]), n, math.pi / 2, D))


def test_only_a_u_turn_square_to_the_chord_is_ill_conditioned() -> None:
    assert conditioning(math.pi / 2, -math.pi / 2) == pytest.approx(0.0, abs=1e-12)
    for turn in np.linspace(0.0, math.radians(90.0), 10):
        for share in np.linspace(0.0, 1.0, 11):
            assert conditioning(share * turn, (1.0 - share) * turn) >= 1.0 - 1e-9
