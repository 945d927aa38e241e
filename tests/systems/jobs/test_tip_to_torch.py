"""Errors of an arm between tip and torch at the same place: as large as arms drawn with such errors have them, and
larger in a bend."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.geometry.se3 import exp_rotation, pose
from weldcal.calibration.refinement.kinematics_fit import FactoryPrior, arm_errors
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, load_arm, with_link_transforms
from weldcal.models.arrays import Array
from weldcal.models.tool import WeldingTool
from weldcal.systems.jobs.weld.tip_to_torch import tip_to_torch
from weldcal.welding.seam.curve import SeamCurve

ARM, TOOL = load_arm("ur10e"), WeldingTool()
Q_HOME = np.radians([190.0, -120.0, 135.0, -105.0, -90.0, 90.0])
LENGTH_M = 0.17
PRIOR = FactoryPrior()
UP = np.array([0.0, 0.0, 1.0])


def fillet(radius_m: float) -> SeamCurve:
    """A seam round a pipe that stands on a plate 0.65 m before the robot, its bisector 45 deg up and away from the
    pipe."""
    angle = (np.linspace(0.0, LENGTH_M, 80) - 0.5 * LENGTH_M) / radius_m
    out = np.column_stack([-np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    middle = np.array([0.65 + radius_m, 0.0, 0.02])
    return SeamCurve.from_points(middle + radius_m * out, up=(out + UP) / math.sqrt(2.0))


STRAIGHT = SeamCurve.from_points(
    np.column_stack([np.full(40, 0.65), np.linspace(-0.085, 0.085, 40), np.full(40, 0.02)]), up=(-1.0, 0.0, 1.0)
)


def drawn(radius_m: float, arms: int) -> Array:
    """(arms,) m: rms distance of the torch from the line that the tip felt on the pipe, for arms with the prior's
    errors.

    By the forward kinematics of each arm, at postures on a circle about which the whole tool turns.
    """
    rng = np.random.default_rng(7)
    middle = np.array([0.65 + radius_m, 0.0, 0.02])
    chord_rad = 2.0 * math.asin(0.5 * TOOL.chord_m / radius_m)
    per_chord = 4
    angles = np.arange(-per_chord, round(LENGTH_M / radius_m / chord_rad * per_chord) + 1) * chord_rad / per_chord
    angles = angles - 0.5 * LENGTH_M / radius_m  # of the torch

    def outward(a: float) -> Array:
        return np.array([-math.cos(a), math.sin(a), 0.0])

    tips, joints, q = [], [], Q_HOME
    for a in angles:
        up = (outward(a) + UP) / math.sqrt(2.0)
        tip = middle + radius_m * outward(a + chord_rad)
        x = (tip - middle - radius_m * outward(a)) / TOOL.chord_m
        y = np.cross(up, x) / np.linalg.norm(np.cross(up, x))
        X_BT = RigidTransform(RotationMatrix(np.column_stack([x, y, np.cross(x, y)])), tip)
        found = nearest_solution(ARM, X_BT @ TOOL.X_FT.inverse(), q)
        assert found is not None
        q = found
        tips.append(X_BT)
        joints.append(q)
    sigma = np.array([PRIOR.turn_rad, PRIOR.turn_rad, PRIOR.offset_rad, *[PRIOR.length_m] * 3])
    off = []
    for _ in range(arms):
        errors = sigma * rng.standard_normal((6, 6))
        stack = np.array([X @ pose(exp_rotation(e[:3]), e[3:]) for X, e in zip(ARM.stack, errors, strict=True)])
        true = with_link_transforms(ARM, stack, "", "drawn")
        X_FT = [forward_kinematics(true, q) @ TOOL.X_FT for q in joints]
        by_tip = np.array([X.translation() - at.translation() for X, at in zip(X_FT, tips, strict=True)])
        by_torch = np.array([X @ TOOL.p_TW - at @ TOOL.p_TW for X, at in zip(X_FT, tips, strict=True)])
        # the tip was at the torch's place as many steps before as the chord has
        apart = by_torch[per_chord:] - by_tip[:-per_chord]
        t = np.array([[math.sin(a), math.cos(a), 0.0] for a in angles[per_chord:]])
        apart = apart - np.sum(apart * t, axis=1, keepdims=True) * t
        off.append(math.sqrt(float(np.mean(np.sum(apart**2, axis=1)))))
    return np.array(off)


def test_it_is_as_large_as_arms_with_such_errors_have_it() -> None:
    """300 arms: their rms scatters by 3 %."""
    found = tip_to_torch(ARM, TOOL, fillet(0.080), Q_HOME)
    arms = drawn(0.080, 300)
    assert found.sigma_m == pytest.approx(float(np.sqrt(np.mean(arms**2))), rel=0.1)
    # the chord of 60 mm subtends this at the pipe's axis, and the tool turns by as much about it
    assert found.turn_rad == pytest.approx(2.0 * math.asin(0.5 * TOOL.chord_m / 0.080), abs=0.03)


def test_it_grows_with_the_curvature() -> None:
    sigma = [tip_to_torch(ARM, TOOL, seam, Q_HOME).sigma_m for seam in (STRAIGHT, *map(fillet, (0.3, 0.16, 0.08)))]
    assert sigma == sorted(sigma)
    assert sigma[-1] > 2.0 * sigma[0]


def test_of_an_arm_whose_links_are_known_only_the_unseen_turn_of_the_flange_is_left() -> None:
    """The first joint moves tip and torch alike; the last one's zero, which no flange shows, turns the torch about the
    tip."""
    which = arm_errors(ARM, "links").which
    size = 6 + len(which)  # X_BC first
    known = {"which": which.tolist(), "covariance": np.zeros((size, size)).tolist()}
    found = tip_to_torch(ARM, TOOL, STRAIGHT, Q_HOME, known)
    assert found.sigma_m == pytest.approx(TOOL.chord_m * PRIOR.offset_rad, rel=0.01)
    assert found.turn_rad < 1e-6


def test_out_of_reach_nothing_is_predicted() -> None:
    away = STRAIGHT.transformed(RigidTransform([2.0, 0.0, 0.0]))
    found = tip_to_torch(ARM, TOOL, away, Q_HOME)
    assert math.isnan(found.sigma_m)
    assert math.isnan(found.turn_rad)
