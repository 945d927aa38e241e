"""Scanner presets keep their geometry in every resolution, and the noise model does what its numbers say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    ClippingRange,
    DepthRange,
    DepthRenderCamera,
    GeometryInstance,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    RenderLabel,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraInfo

from weldcal.models.depth_noise import DepthNoise, device_warp, incidence_cosine, noisy_depth
from weldcal.models.errors import InputError
from weldcal.models.scanners import SCANNERS, ScannerPreset, apply_noise, depth_to_points, drake_intrinsics, get_scanner


def _plain(noise: DepthNoise, width: int = 400, height: int = 300) -> ScannerPreset:
    return ScannerPreset(
        name="test",
        width=width,
        height=height,
        fx=450.0,
        fy=450.0,
        cx=199.5,
        cy=149.5,
        near_m=0.3,
        far_m=2.0,
        optimum_m=0.65,
        noise=noise,
    )


def _flat(preset: ScannerPreset, z: float) -> np.ndarray:
    return np.full((preset.height, preset.width), z, dtype=np.float32)


def _tilted(preset: ScannerPreset, normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth of the plane normal . p = normal_z distance, seen by the preset."""
    u = (np.arange(preset.width) - preset.cx)[None, :] / preset.fx
    v = (np.arange(preset.height) - preset.cy)[:, None] / preset.fy
    return (normal[2] * distance / (normal[0] * u + normal[1] * v + normal[2])).astype(np.float32)


@pytest.mark.parametrize(
    ("name", "scan_width", "near", "optimum", "far"),
    [("phoxi_s", 0.360, 0.384, 0.442, 0.520), ("phoxi_m", 0.590, 0.458, 0.650, 1.118)],
)
def test_the_scan_area_is_that_of_the_data_sheet(
    name: str, scan_width: float, near: float, optimum: float, far: float
) -> None:
    scanner = get_scanner(name)
    assert (scanner.width, scanner.height) == (2064, 1544)
    assert (scanner.near_m, scanner.optimum_m, scanner.far_m) == (near, optimum, far)
    assert scanner.footprint_m(optimum)[0] == pytest.approx(scan_width)


@pytest.mark.parametrize("name", SCANNERS)
def test_another_resolution_sees_the_same_directions_at_the_image_corners(name: str) -> None:
    full = get_scanner(name)
    small = get_scanner(name, width=full.width // 3)
    for a, b in ((full, small), (small, full)):
        # The image corners are half a pixel outside the first and last pixel centres.
        left = [(-0.5 - s.cx) / s.fx for s in (a, b)]
        bottom = [(s.height - 0.5 - s.cy) / s.fy for s in (a, b)]
        assert left[0] == pytest.approx(left[1], abs=1e-12)
        assert bottom[0] == pytest.approx(bottom[1], abs=1e-12)


def test_unknown_scanners_and_sizes_are_refused() -> None:
    with pytest.raises(InputError, match="phoxi_m"):
        get_scanner("phoxi")
    with pytest.raises(InputError, match="width"):
        get_scanner("phoxi_m", height=100)
    with pytest.raises(InputError, match="shape"):
        apply_noise(np.ones((4, 4), dtype=np.float32), get_scanner("ideal", 64), np.random.default_rng(0))


def test_points_of_a_drake_depth_image_lie_on_the_plane_that_was_rendered() -> None:
    # A slope of 35 degrees: half a pixel of confusion (0.72 mm at this size) would show as 0.5 mm of distance.
    scanner = _plain(DepthNoise(), 400, 300)
    X_CP = RigidTransform(RollPitchYaw(0.5, -0.4, 0.2), np.array([0.02, -0.01, 0.65]))
    graph = SceneGraph()
    graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
    slab = GeometryInstance(X_CP @ RigidTransform(np.array([0.0, 0.0, 0.05])), Box(4.0, 4.0, 0.1), "slab")
    look = PerceptionProperties()
    look.AddProperty("label", "id", RenderLabel(1))
    slab.set_perception_properties(look)
    graph.RegisterAnchoredGeometry(graph.RegisterSource("test"), slab)
    core = RenderCameraCore("vtk", CameraInfo(*drake_intrinsics(scanner)), ClippingRange(0.05, 5.0), RigidTransform())
    query = graph.get_query_output_port().Eval(graph.CreateDefaultContext())
    camera = DepthRenderCamera(core, DepthRange(0.1, 4.0))
    depth = query.RenderDepthImage(camera, graph.world_frame_id(), RigidTransform()).data[:, :, 0]
    points = depth_to_points(depth, scanner.fx, scanner.fy, scanner.cx, scanner.cy).reshape(-1, 3)
    assert np.isfinite(points).all()
    off = (points - X_CP.translation()) @ X_CP.rotation().matrix()[:, 2]
    # The z buffer is good to a few micrometres at this range.
    assert np.abs(off).max() < 2e-5


def test_pixels_without_depth_have_no_point() -> None:
    depth = np.array([[0.0, 0.5, np.nan, np.inf]], dtype=np.float32)
    points = depth_to_points(depth, 100.0, 100.0, 1.0, 0.0)
    np.testing.assert_array_equal(np.isnan(points).all(axis=2), [[True, False, True, True]])
    np.testing.assert_allclose(points[0, 1], [0.0, 0.0, 0.5])


def test_a_perfect_scanner_changes_nothing_inside_its_range() -> None:
    scanner = _plain(DepthNoise())
    depth = _flat(scanner, 0.7)
    depth[0, 0], depth[0, 1] = 0.2, 2.5
    out = apply_noise(depth, scanner, np.random.default_rng(0))
    assert out.dtype == np.float32
    assert out[0, 0] == 0.0
    assert out[0, 1] == 0.0
    np.testing.assert_array_equal(out[1:], depth[1:])


def test_the_same_seed_gives_the_same_scan_and_another_seed_another() -> None:
    scanner = get_scanner("phoxi_m", 412)
    depth = _flat(scanner, 0.65)
    depth[100:200, 100:200] = 0.6
    first, again, other = (apply_noise(depth, scanner, np.random.default_rng(s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.count_nonzero(first != other) > 0.9 * first.size


@pytest.mark.parametrize("z", [0.65, 1.0])
@pytest.mark.parametrize("correlation", [0.0, 0.8, 2.0])
def test_noise_has_its_sigma_at_the_reference_and_grows_with_the_square_of_depth(z: float, correlation: float) -> None:
    scanner = _plain(DepthNoise(sigma_m=1e-4, reference_m=0.65, incidence=0.0, correlation_px=correlation))
    error = apply_noise(_flat(scanner, z), scanner, np.random.default_rng(5)) - np.float32(z)
    # 120000 pixels; a Gaussian of width 2 leaves about 1 / (4 pi 4) of them independent: 2400, so 1.4 % (1 sigma).
    assert error.std() == pytest.approx(1e-4 * (z / 0.65) ** 2, rel=0.06)


def test_correlated_noise_resembles_its_neighbours() -> None:
    def likeness(correlation: float) -> float:
        scanner = _plain(DepthNoise(sigma_m=1e-4, correlation_px=correlation))
        error = apply_noise(_flat(scanner, 0.65), scanner, np.random.default_rng(5)) - np.float32(0.65)
        return float(np.corrcoef(error[:, 1:].ravel(), error[:, :-1].ravel())[0, 1])

    assert abs(likeness(0.0)) < 0.02
    # A Gaussian of width s gives exp(-1 / (4 s^2)) one pixel away.
    assert likeness(2.0) == pytest.approx(math.exp(-1 / 16), abs=0.03)


def test_incidence_is_the_angle_between_ray_and_surface() -> None:
    scanner = _plain(DepthNoise())
    normal = np.array([math.sin(0.7), 0.0, math.cos(0.7)])
    depth = _tilted(scanner, normal, 0.8)
    cosine = incidence_cosine(depth, scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    points = depth_to_points(depth, scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    expected = (points @ normal) / np.linalg.norm(points, axis=2)
    # float32 depths: 4e-8 m over slopes of 1 mm a pixel.
    np.testing.assert_allclose(cosine, expected, rtol=0.004)


def test_a_jump_in_depth_does_not_tilt_the_surfaces_beside_it() -> None:
    scanner = _plain(DepthNoise())
    depth = _flat(scanner, 0.7)
    depth[:, 200:] = 0.6
    cosine = incidence_cosine(depth, scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    u = (np.arange(400) - scanner.cx) / scanner.fx
    np.testing.assert_allclose(cosine[150], 1.0 / np.sqrt(1.0 + u**2), rtol=1e-4)


def test_grazing_surfaces_are_noisier_and_beyond_the_limit_unseen() -> None:
    noise = DepthNoise(sigma_m=1e-4, growth=0.0, incidence=1.0, grazing_rad=math.radians(70))
    scanner = _plain(noise)
    rng = np.random.default_rng(0)
    for angle, seen in ((0.0, True), (60.0, True), (80.0, False)):
        a = math.radians(angle)
        depth = _tilted(scanner, np.array([math.sin(a), 0.0, math.cos(a)]), 0.8)
        patch = np.s_[140:160, 195:205]
        out = noisy_depth(depth, noise, scanner.fx, scanner.fy, scanner.cx, scanner.cy, rng)
        assert bool((out[patch] > 0).all()) is seen
        if seen:
            # 200 pixels: the sample sigma is good to 5 %.
            assert np.std(out[patch] - depth[patch]) == pytest.approx(1e-4 / math.cos(a), rel=0.2)


def test_flying_pixels_lie_between_the_two_depths_and_only_beside_the_jump() -> None:
    scanner = _plain(DepthNoise(flying=0.5, edge_dropout=0.25))
    depth = _flat(scanner, 0.8)
    depth[:, 200:] = 0.6
    out = apply_noise(depth, scanner, np.random.default_rng(0))
    moved = out != depth
    assert not moved[:, :199].any()
    assert not moved[:, 201:].any()
    border = out[:, 199:201]
    flying = (border > 0.6) & (border < 0.8)
    # 600 border pixels: standard deviations of 12 and 11.
    assert np.count_nonzero(flying) == pytest.approx(300, abs=60)
    assert np.count_nonzero(border == 0.0) == pytest.approx(150, abs=55)
    assert border[border > 0].min() >= np.float32(0.6)
    assert border.max() <= np.float32(0.8)


def test_dark_surfaces_drop_out_and_are_noisier() -> None:
    scanner = _plain(DepthNoise(sigma_m=1e-4, reference_m=0.65, incidence=0.0, dark_dropout=0.8, dark_gain=3.0))
    dark = np.zeros((300, 400))
    dark[:, 200:] = 0.5
    out = apply_noise(_flat(scanner, 0.65), scanner, np.random.default_rng(0), dark)
    assert (out[:, :200] > 0).all()
    assert np.mean(out[:, 200:] == 0) == pytest.approx(0.4, abs=0.02)
    seen = out[:, 200:][out[:, 200:] > 0] - 0.65
    assert seen.std() == pytest.approx(2.5e-4, rel=0.03)


def test_quantised_depths_come_in_steps() -> None:
    scanner = _plain(DepthNoise(sigma_m=1e-3, quantum_m=1e-3))
    out = apply_noise(_flat(scanner, 0.65), scanner, np.random.default_rng(0))
    steps = out[out > 0] / 1e-3
    # float32 holds 650 steps to 4e-5 of a step.
    np.testing.assert_allclose(steps, np.rint(steps), atol=2e-4)
    assert len(np.unique(out)) > 3


def test_the_warp_belongs_to_the_device_and_not_to_the_resolution() -> None:
    full, half = device_warp((800, 1000), 2e-4, 7), device_warp((400, 500), 2e-4, 7)
    # Its peak is looked for on a 33 x 33 grid of waves of at most one period.
    assert np.abs(full).max() == pytest.approx(2e-4, rel=0.01)
    np.testing.assert_allclose(full.reshape(400, 2, 500, 2).mean(axis=(1, 3)), half, atol=2e-8)
    assert np.abs(full - device_warp((800, 1000), 2e-4, 8)).max() > 2e-5


def test_the_warp_is_off_unless_asked_for_and_then_stays_from_scan_to_scan() -> None:
    assert all(s.noise.warp_m == 0.0 for s in SCANNERS.values())
    scanner = _plain(DepthNoise(warp_m=2e-4, reference_m=0.65, device=3))
    scans = [apply_noise(_flat(scanner, 0.65), scanner, np.random.default_rng(s)) for s in (0, 1)]
    np.testing.assert_array_equal(*scans)
    assert np.abs(scans[0] - 0.65).max() == pytest.approx(2e-4, rel=0.02)


def test_impossible_noise_is_refused() -> None:
    with pytest.raises(InputError, match="between 0 and 1"):
        DepthNoise(flying=1.5)
    with pytest.raises(InputError, match="negative"):
        replace(DepthNoise(), sigma_m=-1.0)
