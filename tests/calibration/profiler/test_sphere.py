"""A profiler calibrated by a sphere and touches of it: the paper's method, the joint one, its sigma, and what is
refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.places import SHARED_DATA, needs
from tests.worlds.profiler import CLEAN, RADIUS_M, SphereTrial, SphereWorld, sphere_trial
from weldcal.calibration.errors import ArcNotFound, DegenerateMotion, InconsistentData, RadiusError, TooFewTranslations
from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.profiler.arm_errors import ARM_ERRORS, DhArm, ProfilerArmErrors
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.sphere.arc import find_arc, fit_circle
from weldcal.calibration.profiler.sphere.joint import SphereEstimate, choose_model, leave_one_out_m, sphere_joint
from weldcal.calibration.profiler.sphere.linear import (
    SphereLinear,
    compensate,
    fit_touch_sphere,
    sphere_center,
    sphere_linear,
    wrong_sides,
)
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.errors import InputError

DATA = SHARED_DATA / "profiler"
MM = 1e-3
SIGMAS = SphereSigmas(sensor_m=0.05 * MM, robot_m=0.04 * MM, touch_m=0.04 * MM)
needs_data = needs(DATA)


@cache
def clean() -> tuple[SphereWorld, SphereTrial, SphereEstimate]:
    world = SphereWorld.made(5, CLEAN)
    trial = sphere_trial(world, 200, touches=20, views=0)
    return world, trial, sphere_joint(trial.data, "rigid", SIGMAS)


def centres(data: SphereData, sign: np.ndarray, radius_m: float = RADIUS_M) -> list[np.ndarray]:
    return [sphere_center(fit_circle(p)[0], radius_m, s) for p, s in zip(data.profiles, sign, strict=True)]


def linear(data: SphereData, sign: np.ndarray, translated: np.ndarray) -> SphereLinear:
    return sphere_linear(data.poses.rotation, data.poses.translation, centres(data, sign), translated)


def off(world: SphereWorld, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(world.rotation @ rotation.T).as_rotvec()
    return np.concatenate([turn, world.translation - translation])


def test_without_noise_both_methods_are_exact() -> None:
    world = SphereWorld.made(1, replace(CLEAN, repeatability_m=0.0, noise_m=0.0))
    trial = sphere_trial(world, 1, touches=12, views=0)
    lin = linear(trial.data, trial.sign, trial.translated)
    assert np.abs(off(world, lin.rotation, lin.translation)).max() < 1e-8
    joint = sphere_joint(trial.data, "rigid", SIGMAS)
    # least squares over a robust loss ends at its tolerance of 1e-8 of what it started from
    assert np.abs(off(world, joint.rotation, joint.translation)).max() < 1e-6
    assert joint.tip is not None
    assert np.abs(joint.tip - world.tip).max() < 1e-6


@pytest.mark.parametrize("model", ["rigid", "affine"])
def test_its_covariance_is_what_it_scatters_by(model: str) -> None:
    world, _, start = clean()
    nees, chi2 = [], []
    for k in range(16):
        trial = sphere_trial(world, 300 + k, translations=4, touches=20, views=0)
        e = sphere_joint(trial.data, model, SIGMAS, init=start)  # type: ignore[arg-type]
        error = off(world, e.rotation, e.translation)
        nees.append(error @ np.linalg.solve(e.covariance, error))
        chi2.append(e.reduced_chi2)
    # 16 draws of chi-square with 6 degrees: mean 6, sigma sqrt(12/16) = 0.87
    assert 6.0 - 3 * 0.87 < np.mean(nees) < 6.0 + 3 * 0.87
    # each of about 1700 residuals: sigma sqrt(2/1700) = 0.034 of one trial, 0.0086 of the mean
    assert np.mean(chi2) == pytest.approx(1.0, abs=4 * 0.0086)


def test_sixteen_scans_more_make_it_surer() -> None:
    world, _, start = clean()
    few, many = (
        sphere_joint(sphere_trial(world, 400, translations=4, free=n, touches=20, views=0).data, "rigid", SIGMAS, start)
        for n in (6, 22)
    )
    variance = []
    for found in (few, many):  # of where the profile point (0, 0.2) m lies in F
        J = np.hstack([-skew(found.rotation @ np.array([0.0, 0.0, 0.2])), np.eye(3)])
        variance.append(np.trace(J @ found.covariance @ J.T))
    assert variance[1] < 0.5 * variance[0]


def test_one_wrong_side_ruins_the_papers_method_and_not_the_joint_one_which_takes_no_sides() -> None:
    world, trial, joint = clean()
    good = linear(trial.data, trial.sign, trial.translated)
    sign = trial.sign.copy()
    sign[14] *= -1.0
    bad = linear(trial.data, sign, trial.translated)
    error_good, error_bad = (np.linalg.norm(off(world, e.rotation, e.translation)[3:]) for e in (good, bad))
    assert error_bad > 2 * MM > 2 * error_good
    assert np.linalg.norm(off(world, joint.rotation, joint.translation)[3:]) < 1 * MM
    R, t = trial.data.poses.rotation, trial.data.poses.translation
    assert wrong_sides(R, t, centres(trial.data, sign), trial.translated) == (14,)
    assert wrong_sides(R, t, centres(trial.data, trial.sign), trial.translated) == ()


def test_a_scan_of_something_else_is_named() -> None:
    _, trial, start = clean()
    profiles = list(trial.data.profiles)
    profiles[3] = profiles[3] + np.array([0.0, 1.5 * MM])
    e = sphere_joint(replace(trial.data, profiles=profiles), "rigid", SIGMAS, init=start)
    assert e.wrong_poses == (3,)
    assert e.reduced_chi2 == pytest.approx(1.0, abs=0.15)  # it is excluded, and the rest agrees


def test_the_arms_errors_move_the_flange_as_their_derivatives_say() -> None:
    world, trial, _ = clean()
    q = trial.data.q
    assert q is not None
    values = 1e-3 * np.random.default_rng(9).standard_normal(ARM_ERRORS)
    loads, point, h = world.cell.arm.loads(q), np.array([0.1, -0.2, 0.3]), 1e-6

    def at(v: np.ndarray) -> np.ndarray:
        X = world.cell.arm.with_errors(q, ProfilerArmErrors.of(v), loads)
        return X.rotation @ point + X.translation

    w, v = world.cell.arm.twists(q, ProfilerArmErrors.of(values), loads)
    for k in range(ARM_ERRORS):
        step = h * np.eye(ARM_ERRORS)[k]
        found = (at(values + step) - at(values - step)) / (2.0 * h)
        np.testing.assert_allclose(np.cross(w[:, k], at(values)) + v[:, k], found, atol=1e-7)


def test_touches_of_one_spot_or_one_circle_leave_the_centre_open() -> None:
    world, trial, _ = clean()
    felt = trial.data.touches
    assert felt is not None
    turn = np.linspace(0.0, 2.0 * np.pi, 20)
    for lean in (0.0, 0.1, 10.0):  # the top, a ring around it, the equator
        n = np.column_stack([lean * np.cos(turn), lean * np.sin(turn), np.ones(20)])
        p = world.cell.center + RADIUS_M * n / np.linalg.norm(n, axis=1, keepdims=True)
        p_BF = p - felt.rotation @ world.tip + 4e-5 * np.random.default_rng(10).standard_normal((20, 3))
        with pytest.raises(DegenerateMotion, match="one spot or one circle"):
            fit_touch_sphere(felt.rotation, p_BF, world.tip, RADIUS_M)


def test_a_radius_that_is_not_the_spheres_is_told_by_the_profiles() -> None:
    _, trial, start = clean()
    wrong = sphere_joint(
        replace(trial.data, touches=None, tip=None, radius_m=RADIUS_M + 0.3 * MM), "rigid", SIGMAS, start
    )
    assert wrong.radius_change_m == pytest.approx(-0.3 * MM, abs=5 * wrong.radius_sigma_m)
    assert wrong.radius_sigma_m < 0.03 * MM


def test_positions_on_a_line_are_refused() -> None:
    _, trial, _ = clean()
    t = trial.data.poses.translation.copy()
    t[:10] = t[0] + np.outer(np.linspace(0, 0.02, 10), [0.6, 0.7, 0.3])
    with pytest.raises(DegenerateMotion, match="on a line"):
        sphere_linear(trial.data.poses.rotation, t, centres(trial.data, trial.sign), trial.translated)
    with pytest.raises(TooFewTranslations):
        sphere_linear(trial.data.poses.rotation, t, centres(trial.data, trial.sign), np.arange(20) < 3)


def test_one_axis_of_turning_leaves_a_translation_open_for_the_joint_method() -> None:
    world, trial, start = clean()
    R = np.array(
        [
            trial.data.poses.rotation[0] @ Rotation.from_rotvec([0.0, 0.0, a]).as_matrix()
            for a in np.linspace(-0.4, 0.4, 20)
        ]
    )
    p_S = np.column_stack([np.zeros(20), np.linspace(-0.012, 0.012, 20), np.full(20, 0.21)])
    t = world.cell.center - np.einsum("nij,nj->ni", R, p_S @ world.rotation.T + world.translation)
    r = np.sqrt(RADIUS_M**2 - p_S[:, 1] ** 2)
    a = np.linspace(-1.0, 1.0, 40)
    profiles = [np.column_stack([q * np.sin(a), 0.21 - q * np.cos(a)]) for q in r]
    with pytest.raises(DegenerateMotion, match="translation along"):
        sphere_joint(
            SphereData(poses=FlangePoses(R, t), profiles=profiles, radius_m=RADIUS_M), "rigid", SIGMAS, init=start
        )


def test_a_wrong_radius_is_named() -> None:
    _, trial, start = clean()
    data = trial.data
    assert data.touches is not None
    assert data.tip is not None
    with pytest.raises(RadiusError, match=r"no cut of a sphere of 15\.00 mm"):
        centres(data, trial.sign, 15 * MM)
    felt = [data.touches.rotation, data.touches.translation, data.tip]
    free = fit_touch_sphere(*felt, RADIUS_M, solve_radius=True)  # type: ignore[arg-type]
    assert free.radius_m == pytest.approx(RADIUS_M, abs=0.1 * MM)
    with pytest.raises(RadiusError, match="fit a sphere"):
        fit_touch_sphere(*felt, RADIUS_M + 0.5 * MM, solve_radius=True)  # type: ignore[arg-type]
    with pytest.raises(InconsistentData, match="check the radius"):
        sphere_joint(replace(data, radius_m=RADIUS_M + 3 * MM), "rigid", SIGMAS, init=start)


def test_the_tip_is_asked_of_touches_that_tell_it() -> None:
    world, trial, _ = clean()
    felt = trial.data.touches
    assert felt is not None
    found = fit_touch_sphere(felt.rotation, felt.translation, world.tip + 3 * MM, RADIUS_M, solve_tip=True)
    assert np.linalg.norm(found.tip - world.tip) < 1 * MM
    same = np.broadcast_to(felt.rotation[0], felt.rotation.shape)
    with pytest.raises(DegenerateMotion, match="one orientation in all touches"):
        fit_touch_sphere(same, felt.translation, world.tip, RADIUS_M, solve_tip=True)


def test_what_cannot_be_used_is_said_in_one_sentence() -> None:
    _, trial, _ = clean()
    data = trial.data
    with pytest.raises(TooFewTranslations, match="4 scans"):
        sphere_joint(replace(data, poses=data.poses[:4], profiles=data.profiles[:4]))
    with pytest.raises(InputError, match="20 poses need 20 profiles"):
        sphere_joint(replace(data, profiles=data.profiles[:9]))
    with pytest.raises(InputError, match="tip needs touches"):
        sphere_joint(replace(data, touches=None))
    with pytest.raises(InputError, match="joints at every scan"):
        sphere_joint(replace(data, arm=None), "affine+joints")
    with pytest.raises(InputError, match="Profile 2 has fewer"):
        sphere_joint(replace(data, profiles=[*data.profiles[:2], np.full((9, 2), np.nan), *data.profiles[3:]]))


def test_an_arc_is_found_between_table_and_spikes_or_not_at_all() -> None:
    rng = np.random.default_rng(8)
    x = np.linspace(-0.03, 0.03, 400)
    z = np.where(np.abs(x - 0.004) < 0.016, 0.1 - np.sqrt(np.clip(0.018**2 - (x - 0.004) ** 2, 0, None)), 0.1)
    p = np.column_stack([x, z + 0.05 * MM * rng.standard_normal(400)])
    p[rng.random(400) < 0.03] = np.nan
    mask, circle, rms = find_arc(p, RADIUS_M)
    assert circle == pytest.approx([0.004, 0.1, 0.018], abs=0.05 * MM)
    assert rms < 0.07 * MM
    upside_down, _, _ = find_arc(p * [1.0, -1.0], RADIUS_M)  # a sensor whose z grows towards it
    assert (upside_down == mask).all()
    assert not mask[np.abs(x - 0.004) > 0.0165].any()
    with pytest.raises(ArcNotFound):
        find_arc(np.column_stack([x, np.full(400, 0.1)]), RADIUS_M)


def poses(T: np.ndarray) -> FlangePoses:
    return FlangePoses(T[..., :3, :3], T[..., :3, 3] * MM)


@cache
def published() -> dict[str, np.ndarray]:
    return dict(np.load(DATA / "sphere.npz"))


def published_data(w: int) -> SphereData:
    d = published()
    arm = DhArm.checked(d["dh_nominal"] * [MM, np.radians(1.0), MM, np.radians(1.0)])
    profiles = [p * MM for p in d["scan_prof"][w].astype(float)]
    return SphereData(
        poses=poses(d["scan_T"][w]),
        profiles=profiles,
        radius_m=float(d["radius"]) * MM,
        touches=poses(d["touch_T"][w]),
        tip=d["tip_nominal"][w] * MM,
        arm=arm,
        q=d["scan_q"][w],
        touch_q=d["touch_q"][w],
    )


def published_error_mm(w: int, points_F: np.ndarray, tip: np.ndarray, arm: SphereEstimate | None = None) -> float:
    """Mean distance between the points that were sensed and the tip that touched them."""
    d = published()
    view, touch = poses(d["test_T_view"][w]), poses(d["test_T_touch"][w])
    if arm is not None:
        table = published_data(w).arm
        assert table is not None
        view, touch = (arm.flange(table, q) for q in (d["test_q_view"][w], d["test_q_touch"][w]))
    sensed = np.einsum("nij,nj->ni", view.rotation, points_F) + view.translation
    return float(np.linalg.norm(sensed - touch.rotation @ tip - touch.translation, axis=1).mean() / MM)


@needs_data
def test_on_the_fixed_files_the_papers_compensation_is_reproduced() -> None:
    d = published()
    before, after, with_tip = [], [], []
    for w in range(8):
        data = published_data(w)
        assert data.touches is not None
        assert data.tip is not None
        lin = linear(data, d["scan_sign"][w], d["scan_kind"][w] == 0)
        m = d["test_m"][w] * MM
        m = np.column_stack([m[:, 0], np.zeros(len(m)), m[:, 1]])
        before.append(published_error_mm(w, m @ lin.rotation.T + lin.translation, data.tip))
        for solve_tip, found in ((False, after), (True, with_tip)):
            felt = fit_touch_sphere(
                data.touches.rotation, data.touches.translation, data.tip, data.radius_m, solve_tip=solve_tip
            )
            c = compensate(
                lin,
                data.poses.rotation,
                data.poses.translation,
                centres(data, d["scan_sign"][w], data.radius_m),
                felt.center,
            )
            found.append(published_error_mm(w, m @ c.rotation.T + c.translation, felt.tip))
    assert np.mean(before) == pytest.approx(4.523, abs=0.01)
    assert np.mean(after) == pytest.approx(0.840, abs=0.01)
    assert np.mean(with_tip) == pytest.approx(0.326, abs=0.01)


@needs_data
def test_on_the_fixed_files_the_joint_method_keeps_its_targets() -> None:
    without, with_joints = [], []
    for w in range(8):
        data, m = published_data(w), published()["test_m"][w] * MM
        e = sphere_joint(data, "affine")
        assert e.tip is not None
        without.append(published_error_mm(w, e.points_F(m), e.tip))
        k = sphere_joint(data, "affine+joints", init=e)
        assert k.tip is not None
        with_joints.append(published_error_mm(w, k.points_F(m), k.tip, k))
    assert np.mean(without) <= 0.141
    assert np.mean(with_joints) <= 0.110


@needs_data
def test_on_real_profiles_what_is_left_out_is_foretold_and_no_more_model_is_taken_than_helps() -> None:
    z = np.load(DATA / "real_sphere15_a.npz")
    parts = np.split(z["xz"] * MM, np.cumsum(z["n"])[:-1])
    data = SphereData(poses=poses(z["T_base_flange"]), profiles=[p[::8] for p in parts], radius_m=40 * MM)
    assert leave_one_out_m(data, "rigid").mean() <= 0.152 * MM
    choice = choose_model(data)
    assert choice.model == "rigid"
    assert choice.left_out_m["rigid"] < choice.left_out_m["affine"]
    assert "affine is not clearly better than rigid" in choice.reason
