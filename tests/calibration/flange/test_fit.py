"""The flange fit against a ray-cast flange whose place is known: unbiased, precise, honest about both, and able to
refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.eye_on_base.solve import estimate_eye_on_base
from weldcal.calibration.flange.face import IN_MOTION
from weldcal.calibration.flange.fit import FlangeFit, FlangeGuess, fit_flange
from weldcal.calibration.flange.observation import observation_from_fit
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.depth_noise import DepthNoise, noisy_depth
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.models.scanners import get_scanner

Array = NDArray[np.float64]

STANDARD = get_flange("iso9409-1-50-4-m6")
SCANNER = get_scanner("phoxi_m", 824).noise


def facing_pose(p_CR: tuple[float, float, float], tilt_deg: float, azimuth_deg: float) -> RigidTransform:
    """X_CR of a feature whose outward normal leans ``tilt_deg`` away from the line of sight."""
    to_scanner = -np.array(p_CR) / np.linalg.norm(p_CR)
    x = np.cross([0.0, 1.0, 0.0], to_scanner)
    x /= np.linalg.norm(x)
    facing = RotationMatrix(np.column_stack([x, np.cross(to_scanner, x), to_scanner]))
    lean = RollPitchYaw(0.0, np.radians(tilt_deg), 0.0).ToRotationMatrix()
    turn = RollPitchYaw(0.0, 0.0, np.radians(azimuth_deg)).ToRotationMatrix()
    return RigidTransform(facing @ turn @ lean, np.array(p_CR))


def render(
    X_CR: RigidTransform,
    rng: np.random.Generator,
    *,
    standard: FlangeStandard = STANDARD,
    width: int = 206,
    height: int = 154,
    focal: float = 908.0,
    scanner: DepthNoise = SCANNER,
    plate_below: float | None = 0.008,
    wall: bool = False,
    hidden: float = 0.0,
) -> Array:
    """Organised cloud (H, W, 3) of a face with bore, holes and chamfers, a plate close below and a table far behind.

    A window of a PhoXi-M-like grid of 824 pixels across (0.7 to 1.1 mm pitch) about the feature, with that scanner's
    noise, flying pixels and lost edges.
    """
    center = X_CR.translation()
    u0, v0 = np.round(focal * center[:2] / center[2]) + rng.integers(-3, 4, 2)
    u, v = np.meshgrid(np.arange(width) - width // 2 + u0, np.arange(height) - height // 2 + v0)
    ray = np.stack([(u + 0.37) / focal, (v - 0.21) / focal, np.ones(u.shape)], axis=-1)
    inverse = X_CR.inverse()
    origin, direction = inverse.translation(), ray @ inverse.rotation().matrix().T

    def at_height(z: float) -> tuple[Array, Array, Array]:
        t = (z - origin[2]) / direction[..., 2]
        return t, origin[0] + t * direction[..., 0], origin[1] + t * direction[..., 1]

    t, x, y = at_height(0.0)
    rho = np.hypot(x, y)
    face = (rho < standard.face_outer_radius_m) & (rho > standard.face_inner_radius_m)
    for hx, hy, hr in standard.openings():
        face &= np.hypot(x - hx, y - hy) > hr
    depth = np.where(face, t, np.inf)
    for z in np.linspace(-standard.chamfer_m, 0.0, 21)[:-1]:  # 45 degree chamfers as a stack of ever wider rings
        t, x, y = at_height(float(z))
        rho = np.hypot(x, y)
        ring = (rho < standard.face_outer_radius_m - z) & (rho > standard.face_inner_radius_m + z)
        for hx, hy, hr in standard.openings():
            ring &= np.hypot(x - hx, y - hy) > hr
        depth = np.minimum(depth, np.where(ring, t, np.inf))
    for z in np.linspace(-0.008, -standard.chamfer_m, 60) if wall else ():  # a body, where a face alone is a thin ring
        t, x, y = at_height(float(z))
        rho = np.hypot(x, y)
        body = (rho < standard.outer_radius_m) & (rho > standard.bore_radius_m)
        depth = np.minimum(depth, np.where(body, t, np.inf))
    if plate_below is not None:
        t, x, y = at_height(-plate_below)
        plate = (np.abs(x + 0.03) < 0.075) & (np.abs(y) < 0.045) & (np.hypot(x, y) > standard.bore_radius_m)
        depth = np.minimum(depth, np.where(plate, t, np.inf))
    t, _, _ = at_height(-0.3)
    depth = np.minimum(depth, t)
    measured = noisy_depth(
        depth.astype(np.float32), scanner, focal, focal, -float(u[0, 0]) - 0.37, -float(v[0, 0]) + 0.21, rng
    ).astype(float)
    cloud = ray * np.where(measured > 0.0, measured, np.nan)[..., None]
    if hidden > 0.0:  # that share of the face's width
        cloud[x_of(X_CR, cloud) < (hidden - 0.5) * standard.outer_m] = np.nan
    return cloud


def x_of(X_CR: RigidTransform, cloud: Array) -> Array:
    """Each point's coordinate (H, W) along the feature's x axis."""
    return (cloud - X_CR.translation()) @ X_CR.rotation().matrix()[:, 0]


def fit(X_CR: RigidTransform, cloud: Array, rng: np.random.Generator) -> FlangeFit:
    offset = rng.uniform(-0.012, 0.012, 3)
    return fit_flange(
        cloud, STANDARD, guess=FlangeGuess(X_CR.translation() + offset, 0.085, X_CR.rotation().matrix()[:, 2])
    )


def poses(n: int, seed: int) -> list[RigidTransform]:
    rng = np.random.default_rng(seed)
    out = []
    for k in range(n):
        p = (rng.uniform(-0.15, 0.15), rng.uniform(-0.12, 0.12), rng.uniform(0.55, 0.9))
        out.append(facing_pose(p, 30.0 * k / max(n - 1, 1), rng.uniform(0, 360)))
    return out


def errors(n: int, seed: int, **scene: object) -> tuple[Array, Array, Array, Array]:
    """Centre errors in R (n, 3) m, their normalised squares per axis, normal errors rad and theirs."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[Array, float, float, float]] = []
    for X_CR in poses(n, seed):
        found = fit(X_CR, render(X_CR, rng, **scene), rng)  # type: ignore[arg-type]
        e = found.center_C - X_CR.translation()
        lean = np.cross(found.normal_C, X_CR.rotation().matrix()[:, 2])
        normalised = float(e @ np.linalg.solve(found.center_covariance, e)) / 3.0
        tilt = float(np.linalg.norm(lean))
        rows.append((X_CR.rotation().matrix().T @ e, normalised, tilt, tilt**2 / 2.0 / found.normal_sigma**2))
    centre, normalised_c, normal, normalised_n = (np.array(c) for c in zip(*rows, strict=True))
    return centre, normalised_c, normal, normalised_n


def test_centre_is_within_a_twentieth_of_a_millimetre_up_to_thirty_degrees_of_tilt() -> None:
    centre, normalised, normal, normalised_n = errors(24, 11)
    # 0.05 mm rms is what X_BC needs to be within 0.15 mm at 0.75 m from a dozen scans; pixels are 0.7 to 1.1 mm wide
    assert np.sqrt((centre**2).sum(axis=1).mean()) < 5e-5
    # no pull towards or away from the tilt: three standard errors of the mean of 24
    assert (np.abs(centre.mean(axis=0)) < 3.0 * centre.std(axis=0, ddof=1) / np.sqrt(24) + 1e-6).all()
    # chi-square with 72 and 48 degrees of freedom over its mean, 99.9 % on either side, and a factor 1.5 for the model
    assert 0.3 < normalised.mean() < 2.3
    assert 0.4 < normalised_n.mean() < 2.3
    assert np.degrees(np.sqrt((normal**2).mean())) < 0.03


def test_perfect_scan_gives_the_centre_to_a_fiftieth_of_a_pixel() -> None:
    # only the pixel grid is left: about 600 edge pixels of 0.9 mm, 0.29 pixels rms each, would give 0.012 mm by
    # averaging
    centre, _, _, _ = errors(10, 3, scanner=DepthNoise(), standard=STANDARD)
    assert np.sqrt((centre**2).sum(axis=1).mean()) < 3e-5


@pytest.mark.parametrize("wall", [True, False])
@pytest.mark.parametrize("sigma_mm", [0.8, 1.2, 1.6])
def test_a_rough_face_at_a_slant_is_not_pulled_to_the_side_that_shows_its_wall(wall: bool, sigma_mm: float) -> None:
    """Its thickness, three sigmas of 0.4 to 0.8 mm, is more than the chamfer is deep."""
    noise = replace(get_scanner("motioncam_3d_stream").noise, sigma_m=1e-3 * sigma_mm, reference_m=1.0)
    rng, along = np.random.default_rng(8), []
    for _ in range(12):
        X_CR = facing_pose((rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 0.7), 20.0, rng.uniform(0, 360))
        guess = FlangeGuess(X_CR.translation(), 0.085, X_CR.rotation().matrix()[:, 2])
        found = fit_flange(render(X_CR, rng, scanner=noise, wall=wall), STANDARD, guess=guess, config=IN_MOTION)
        assert found.plane_rms_m > 3.5e-4
        view = found.center_C / np.linalg.norm(found.center_C)
        slide = view - (view @ found.normal_C) * found.normal_C
        along.append((found.center_C - X_CR.translation()) @ slide / np.linalg.norm(slide))
    # a sixth of a pixel of 0.77 mm; one thickness, 1.2 to 2.4 mm, would be 0.4 to 0.9 mm at this slant
    assert np.sqrt(np.mean(np.square(along))) < 1.2e-4


def test_radii_are_those_of_the_flat_face() -> None:
    rng = np.random.default_rng(0)
    X_CR = facing_pose((0.02, -0.03, 0.6), 10.0, 40.0)
    found = fit(X_CR, render(X_CR, rng), rng)
    # a chamfered edge ends up to one plane thickness (0.3 mm) outside the flat face
    assert found.outer_radius_m == pytest.approx(STANDARD.face_outer_radius_m + 2e-4, abs=3e-4)
    assert found.bore_radius_m == pytest.approx(STANDARD.face_inner_radius_m - 2e-4, abs=3e-4)
    assert found.coverage > 0.95
    assert float(found.normal_C @ found.center_C) < 0.0


def test_same_scan_gives_the_same_numbers() -> None:
    X_CR = facing_pose((0.0, 0.0, 0.7), 20.0, 10.0)
    cloud = render(X_CR, np.random.default_rng(1))
    guess = FlangeGuess(X_CR.translation(), 0.08)
    a, b = (fit_flange(cloud, STANDARD, guess=guess) for _ in range(2))
    assert (a.center_C == b.center_C).all()
    assert (a.center_covariance == b.center_covariance).all()


def test_flange_is_found_in_a_whole_scene_without_a_guess() -> None:
    rng = np.random.default_rng(2)
    X_CR = facing_pose((0.05, 0.04, 0.75), 15.0, 100.0)
    found = fit_flange(render(X_CR, rng, width=500, height=400), STANDARD)
    # the tail of the 0.05 mm rms of a single scan
    assert np.linalg.norm(found.center_C - X_CR.translation()) < 2e-4


def test_points_without_a_grid_are_fitted_too() -> None:
    rng = np.random.default_rng(4)
    X_CR = facing_pose((0.0, 0.02, 0.6), 8.0, 200.0)
    cloud = render(X_CR, rng).reshape(-1, 3)
    found = fit(X_CR, cloud[np.isfinite(cloud).all(axis=1)], rng)
    # outermost points per sector: a fifth of the 0.66 mm pitch
    assert np.linalg.norm(found.center_C - X_CR.translation()) < 1.4e-4


def test_millimetres_for_metres_are_named() -> None:
    X_CR = facing_pose((0.0, 0.0, 0.6), 5.0, 0.0)
    cloud = render(X_CR, np.random.default_rng(5), plate_below=None, width=110, height=110)
    flange_only = cloud.reshape(-1, 3)
    flange_only = flange_only[np.abs(flange_only[:, 2] - 0.6) < 0.02]
    fit_flange(flange_only, STANDARD)
    with pytest.raises(FlangeNotFound, match="1000 times too large: the coordinates are millimetres"):
        fit_flange(flange_only * 1e3, STANDARD)


def test_a_half_hidden_face_is_fitted_and_says_how_much_less_it_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    # what real edges are out of round is stated too; these here are round, and their noise alone must account for the
    # errors
    with monkeypatch.context() as plain:
        plain.setattr("weldcal.calibration.flange.fit._OUT_OF_ROUND_M", 0.0)
        centre, normalised, _, _ = errors(20, 6, hidden=0.5)
    # half an arc leaves a centre 2.3 times as uncertain along the axis of symmetry as a whole circle's 0.05 mm
    assert np.sqrt((centre**2).sum(axis=1).mean()) < 2.3 * 5e-5 * 1.5
    # chi-square with 60 degrees of freedom over its mean, 99.9 % on either side, and a factor 1.5 for the model
    assert 0.3 < normalised.mean() < 2.4
    _, cautious, _, _ = errors(4, 6, hidden=0.5)
    assert cautious.mean() < normalised[:4].mean()


def test_a_face_of_which_a_quarter_shows_is_refused_with_the_share_of_its_edge() -> None:
    rng = np.random.default_rng(6)
    X_CR = facing_pose((0.0, 0.0, 0.7), 5.0, 0.0)
    with pytest.raises(FlangeNotFound, match=r"of the flange's edge was seen|has no circular edge|mm across"):
        fit(X_CR, render(X_CR, rng, hidden=0.75), rng)


def test_plate_alone_is_not_a_flange() -> None:
    rng = np.random.default_rng(7)
    X_CR = facing_pose((0.0, 0.0, 0.7), 5.0, 0.0)
    wide = get_flange("iso9409-1-100-6-m8")
    with pytest.raises(FlangeNotFound, match="63 mm"):
        fit(X_CR, render(X_CR, rng, standard=wide, plate_below=None), rng)


def test_nothing_near_the_guess_is_said_so() -> None:
    cloud = render(facing_pose((0.0, 0.0, 0.7), 5.0, 0.0), np.random.default_rng(8))
    with pytest.raises(FlangeNotFound, match="valid points lie within 60 mm of the expected flange"):
        fit_flange(cloud, STANDARD, guess=FlangeGuess(np.array([0.0, 0.0, 0.3]), 0.06))


def test_a_dozen_scans_place_the_scanner_within_a_sixth_of_a_millimetre() -> None:
    rng = np.random.default_rng(9)
    X_BC = RigidTransform(RollPitchYaw(3.0, 0.1, 0.5), [-0.6, -0.2, 1.3])
    observations = []
    for k, X_CR in enumerate(poses(12, 9)):
        found = fit(X_CR, render(X_CR, rng), rng)
        observations.append(observation_from_fit(f"p{k}", X_BC @ X_CR, found))
    X = estimate_eye_on_base(observations).X_BC
    turn = rotation_vector(X.rotation() @ X_BC.rotation().inverse())
    # at the camera's own origin, 0.75 m from the flange, where a rotation counts most
    assert np.linalg.norm(X.translation() - X_BC.translation()) < 1.5e-4
    assert np.degrees(np.linalg.norm(turn)) < 0.03
