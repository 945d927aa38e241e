"""A simulated scanner and arm have errors of their own, of the size that the scenario says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.depth_noise import DepthNoise
from weldcal.models.errors import InputError
from weldcal.models.scanners import apply_noise, depth_to_points
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.drivers.simulated.ur import draw_true_arm

Q = np.deg2rad([190.0, -120.0, 135.0, -105.0, -90.0, 90.0])


def test_the_true_flange_is_off_by_the_stated_distance() -> None:
    arm = load_arm("ur10e")
    reported = forward_kinematics(arm, Q).translation()
    off = [
        forward_kinematics(draw_true_arm(arm, 0.4, Q, np.random.default_rng(k)), Q).translation() - reported
        for k in range(200)
    ]
    # the rms of 200 distances is known to 3 %
    assert np.sqrt(np.mean(np.sum(np.square(off), axis=1))) == pytest.approx(0.4e-3, rel=0.12)


def test_an_exact_arm_draws_nothing() -> None:
    arm, rng = load_arm("ur10e"), np.random.default_rng(1)
    assert draw_true_arm(arm, 0.0, Q, rng) is arm
    assert rng.random() == np.random.default_rng(1).random()
    with pytest.raises(InputError, match="kinematic_error_mm must be from 0 to 5"):
        draw_true_arm(arm, 50.0, Q, rng)


def test_a_scan_has_the_devices_errors_and_the_point_formula_says_the_same() -> None:
    config = RenderedScanner(preset="ideal", scale_error=-0.002, gradient_error_per_m=[0.013, -0.004], warp_mm=0.1)
    device = config.device(np.random.default_rng(4))
    device = replace(device, noise=replace(device.noise, reference_m=0.65))
    v, u = np.mgrid[: device.height, : device.width]
    depth = 0.65 + 0.1 * u / device.width + 0.05 * v / device.height
    k = (device.fx, device.fy, device.cx, device.cy)
    scan = depth_to_points(apply_noise(depth.astype(np.float32), device, np.random.default_rng(0)), *k)
    expected = device.measured(depth_to_points(depth, *k))
    assert np.nanmax(np.abs(scan - expected)) < 1e-6  # single precision of 0.8 m
    assert np.nanmax(np.abs(scan - depth_to_points(depth, *k))) > 2e-3


def test_the_warp_is_drawn_for_each_device() -> None:
    config = RenderedScanner(warp_mm=0.1)
    a, b = (config.device(np.random.default_rng(k)).noise.device for k in (1, 2))
    assert a != b
    assert not RenderedScanner().device(np.random.default_rng(1)).noise.distorts
    with pytest.raises(InputError, match="two numbers"):
        RenderedScanner(gradient_error_per_m=[0.1]).device(np.random.default_rng(1))
    with pytest.raises(InputError, match="scale error"):
        DepthNoise(scale_error=0.5)
