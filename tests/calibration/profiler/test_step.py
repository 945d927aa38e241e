"""A step target gives scale, shear and plane of light of a profiler; edge and sphere take it as what is known before."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tests.worlds.profiler import ABOUT, CLEAN, SphereWorld, sphere_trial
from tests.worlds.steps import StepScans, Triangulation, step_scans
from weldcal.calibration.errors import DegenerateMotion, FeatureNotFound, InconsistentData, TooFewRotations
from weldcal.calibration.geometry.robust import chi2_quantile
from weldcal.calibration.geometry.se3 import log_rotation
from weldcal.calibration.profiler.edge.joint import edge_joint, with_sensor
from weldcal.calibration.profiler.edge.model import EdgeState, predicted
from weldcal.calibration.profiler.features.step import step_faces
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.plan import sample_edge_poses
from weldcal.calibration.profiler.record import load_record
from weldcal.calibration.profiler.sensor import SensorCorrection, load_correction, save_correction
from weldcal.calibration.profiler.sphere.joint import sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.calibration.profiler.step_target import StepEstimate, shown_steps, step_sensor
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app

SETS = 100
SCALE, ANGLE_DEG = 0.005, 2.0  # what a set may be off
REGION = 0.95


def estimated(scans: StepScans) -> StepEstimate:
    return step_sensor(scans.poses.rotation, scans.profiles, shown_steps(scans.profiles, scans.heights_m))


@dataclass(frozen=True, eq=False)
class Set:
    """One sensor on a robot: the estimate, less the truth (3,), and the angle between the planes of light."""

    estimate: StepEstimate
    off: Floats
    plane_deg: float

    def within(self, factor: float) -> bool:
        """Return whether the region of 95 %, with sigmas so many times as wide, holds the truth."""
        C = factor**2 * self.estimate.correction.covariance
        return bool(self.off @ np.linalg.solve(C, self.off) < chi2_quantile(REGION, 3))


@cache
def sets() -> list[Set]:
    found = []
    for seed in range(SETS):
        rng = np.random.default_rng([seed, 91])
        sensor = Triangulation.made(rng)
        mount = Rotation.from_euler("ZYX", rng.uniform(-1, 1, 3) * [60.0, 15.0, 15.0], degrees=True).as_matrix()
        values, axes = sensor.truth()
        e = estimated(step_scans(rng, sensor.report, mount @ sensor.plane))
        angle = np.degrees(np.arccos(min(1.0, float(e.normal_F @ (mount @ axes)[:, 1]))))
        found.append(Set(e, e.correction.values - values, float(angle)))
    return found


def test_scales_and_tilts_of_a_hundred_sensors_are_right() -> None:
    off = np.array([one.off for one in sets()])
    print("rms and largest error of scales, %:", 100 * np.sqrt((off**2).mean(axis=0)), 100 * np.abs(off).max(axis=0))
    assert np.abs(off[:, :2]).max() < SCALE
    assert np.degrees(2.0 * np.abs(off[:, 2])).max() < ANGLE_DEG
    assert max(one.plane_deg for one in sets()) < ANGLE_DEG


@pytest.mark.parametrize(("factor", "right"), [(1.0, True), (4.0, False), (0.25, False)])
def test_the_region_holds_the_truth_as_often_as_it_says(factor: float, right: bool) -> None:
    inside = sum(one.within(factor) for one in sets())
    print(f"{inside} of {SETS} with sigmas times {factor}")
    assert (90 <= inside <= 98) is right


def test_the_plane_of_light_has_a_sigma_of_its_own() -> None:
    ratio = np.array([np.radians(one.plane_deg) / one.estimate.normal_sigma_rad for one in sets()])
    assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.4


def turned_over(scans: StepScans) -> StepScans:
    """The same scans by a sensor whose z are heights."""
    return replace(scans, profiles=scans.profiles * [1.0, -1.0])


def three_faces(seed: int) -> tuple[StepScans, Floats]:
    rng = np.random.default_rng([seed, 93])
    sensor = Triangulation.made(rng)
    return step_scans(rng, sensor.report, np.eye(3), heights_mm=(5.0, 8.0)), sensor.truth()[0]


def test_a_staircase_and_heights_that_grow_towards_the_sensor_give_the_same() -> None:
    scans, values = three_faces(0)
    plain, over = estimated(scans).correction.values, estimated(turned_over(scans)).correction.values
    assert np.abs(plain - values).max() < SCALE
    np.testing.assert_allclose(over * [1.0, 1.0, -1.0], plain, atol=1e-9)


def test_a_profile_of_something_else_is_named_and_does_not_change_the_answer() -> None:
    scans, values = three_faces(1)
    wrong = scans.profiles.copy()
    wrong[3] = scans.profiles[7]
    e = estimated(replace(scans, profiles=wrong))
    assert e.wrong == (3,)
    assert np.abs(e.correction.values - values).max() < SCALE


@pytest.mark.parametrize(
    ("change", "error", "sentence"),
    [
        (lambda s: replace(s, heights_m=1e3 * s.heights_m), InputError, "does not fit into profiles of .* mm"),
        (lambda s: replace(s, heights_m=4.0 * s.heights_m), InputError, "does not fit|shows the step"),
        (
            lambda s: replace(s, heights_m=1.05 * s.heights_m),
            InconsistentData,
            "the steps look like 9[45].. % of --height",
        ),
        (lambda s: replace(s, heights_m=0.5 * s.heights_m), FeatureNotFound, "no two parallel faces 5 mm apart"),
        (lambda s: replace(s, poses=s.poses[:4], profiles=s.profiles[:4]), TooFewRotations, "4 of 4 profiles show"),
        (
            lambda s: replace(s, poses=FlangePoses(np.swapaxes(s.poses.rotation, 1, 2), s.poses.translation)),
            InconsistentData,
            "contradict one target",
        ),
    ],
)
def test_a_mistake_is_one_sentence(change: Any, error: type[Exception], sentence: str) -> None:
    rng = np.random.default_rng(5)
    scans = change(step_scans(rng, Triangulation.made(rng).report, np.eye(3)))
    with pytest.raises((error, FeatureNotFound), match=sentence):
        estimated(scans)


def test_profiles_without_a_step_or_all_at_one_tilt_are_refused() -> None:
    rng = np.random.default_rng(6)
    sensor = Triangulation.made(rng)
    level = step_scans(rng, sensor.report, np.eye(3), tilt_deg=0.5)
    with pytest.raises(DegenerateMotion, match=r"leave the sensor's (x scale|z scale|shear) open by .* about two axes"):
        estimated(level)
    flat = level.profiles[0][level.profiles[0][:, 0] > 4e-3]
    with pytest.raises(FeatureNotFound, match="no two parallel faces 10 mm apart"):
        step_faces(flat, level.heights_m)
    with pytest.raises(FeatureNotFound, match="None of the 6 profiles shows the step"):
        shown_steps([flat] * 6, level.heights_m)


EDGE = EdgeState(
    Rotation.from_euler("xyz", [170.0, -9.0, 52.0], degrees=True).as_matrix(),
    np.array([0.055, 0.021, 0.130]),
    np.array([0.9, -0.2, 0.25]),
    np.array([0.8, 0.58, 0.15]) / np.linalg.norm([0.8, 0.58, 0.15]),
)
FIELD = np.array([[-0.02, 0.08], [0.02, 0.2]])
LOOSE = SensorCorrection(values=np.zeros(3), covariance=np.diag([4e-3, 4e-3, 4e-3]) ** 2, field_m=FIELD)


def reported(p: Floats, values: Floats) -> Floats:
    """Points (n, 2) m that a sensor reports whose correction about the field's middle is `values`."""
    a, b, h = values
    return np.asarray((p - LOOSE.origin) @ np.linalg.inv([[1.0 + a, h], [h, 1.0 + b]]) + LOOSE.origin)


@pytest.mark.parametrize(("factor", "right"), [(1.0, True), (4.0, False), (0.25, False)])
def test_the_region_of_an_edge_holds_what_its_correction_leaves_open(factor: float, right: bool) -> None:
    inside = 0
    poses = sample_edge_poses(EDGE, 20, 3)
    xz = np.array([5e-5, 6e-5])
    for seed in range(SETS):
        rng = np.random.default_rng([seed, 94])
        values = np.array([0.01, -0.012, 0.006])
        told = replace(LOOSE, values=values + np.sqrt(np.diag(LOOSE.covariance)) * rng.standard_normal(3))
        p = reported(predicted(EDGE, poses)[0] + xz * rng.standard_normal((20, 2)), values)
        (a, b, h), u = told.values, p - told.origin
        right_p = u @ np.array([[1.0 + a, h], [h, 1.0 + b]]) + told.origin
        sigmas: dict[str, Any] = {"sigma_robot_m": 1e-6, "sigma_xz_m": xz}
        e = edge_joint(poses.rotation, poses.translation, right_p, **sigmas)
        C = with_sensor(e, told, poses, p, **sigmas)
        d = np.concatenate([log_rotation((EDGE.rotation @ e.rotation.T)[None])[0], EDGE.translation - e.translation])
        inside += bool(d @ np.linalg.solve(factor**2 * C, d) < chi2_quantile(REGION, 6))
    print(f"{inside} of {SETS} with sigmas times {factor}")
    assert (90 <= inside <= 98) is right


def sphere_errors(poses: int, seeds: range) -> Floats:
    """Mean true error (n, 2) mm in the field, of a sphere without and with the correction of a step.

    The arm is as it is believed but for its repeatability.
    """
    grid = np.stack(np.meshgrid(np.linspace(-0.02, 0.02, 5), np.linspace(0.18, 0.23, 5)), -1).reshape(-1, 2)
    found = []
    for seed in seeds:
        world = SphereWorld.made(seed, replace(CLEAN, affine=0.008))
        rng = np.random.default_rng([seed, 92])
        scans = sphere_trial(world, seed, translations=0, free=poses, touches=1, views=0).data
        data = SphereData(poses=scans.poses, profiles=scans.profiles, radius_m=scans.radius_m)
        sensor = estimated(step_scans(rng, lambda p: world.measured(p + ABOUT, rng), world.rotation, noise_m=0.0))  # noqa: B023
        still = replace(world, errors=replace(world.errors, noise_m=0.0))
        u = still.measured(grid, rng)
        true = np.column_stack([grid[:, 0], 0.0 * grid[:, 0], grid[:, 1]]) @ world.rotation.T + world.translation
        sigmas = SphereSigmas(sensor_m=0.05e-3, robot_m=0.04e-3)
        both = (data, replace(data, sensor=sensor.correction))
        off = [sphere_joint(one, "affine", sigmas).points_F(u) - true for one in both]
        found.append([1e3 * np.linalg.norm(d, axis=1).mean() for d in off])
    return np.array(found)


def test_a_sphere_of_few_poses_is_better_with_the_correction() -> None:
    for poses, share in ((6, 0.8), (8, 1.0)):  # of eight, the robot's repeatability leaves most
        error = sphere_errors(poses, range(12))
        without, with_it = np.sqrt((error**2).mean(axis=0))
        print(f"{poses} poses: rms of the true error {without:.3f} mm without, {with_it:.3f} mm with the correction")
        assert with_it < share * without


def called(*words: object) -> tuple[int, dict[str, Any], str]:
    """Exit code, JSON object and stderr of weldcal profiler."""
    ran = CliRunner().invoke(app, ["profiler", *map(str, words), "--json"])
    answer = json.loads(ran.stdout.strip().splitlines()[-1]) if ran.stdout.strip() else {}
    return ran.exit_code, answer, " ".join(ran.stderr.split())


def written(path: Path, poses: FlangePoses, **arrays: Any) -> Path:
    np.savez(path, unit="m", rotation=poses.rotation, translation=poses.translation, **arrays)
    return path


@cache
def world() -> tuple[SphereWorld, StepScans, SphereData]:
    """A sensor, and what it saw of a step and of a sphere."""
    rng, made = np.random.default_rng(7), SphereWorld.made(3, replace(CLEAN, affine=0.008))
    scans = step_scans(rng, lambda p: made.measured(p + ABOUT, rng), made.rotation, noise_m=0.0)
    return made, scans, sphere_trial(made, 3, translations=0, free=7, touches=1, views=0).data


def test_the_commands_write_a_correction_and_take_it(tmp_path: Path) -> None:
    _, scans, ball = world()
    file = written(tmp_path / "steps.npz", scans.poses, profiles=scans.profiles)
    code, answer, said = called("step", file, "--height", 10, "--out", tmp_path / "sensor")
    assert code == 0, said
    correction = load_correction(tmp_path / "sensor")
    assert answer["x_scale_percent"] == pytest.approx(100.0 * correction.values[0])
    assert correction.data_sha256
    assert answer["scans"] == 12
    sphere = written(tmp_path / "ball.npz", ball.poses, profiles=np.array(ball.profiles), radius=ball.radius_m)
    given = "sensor-correction=" + str(tmp_path / "sensor")
    code, answer, said = called("sphere", sphere, "--as", given, "--out", tmp_path / "calibration")
    assert code == 0, said
    assert answer["sensor_correction"] == correction.data_sha256
    away = load_record(tmp_path / "calibration").affine - correction.values
    assert (np.abs(away) < 3.0 * np.sqrt(np.diag(correction.covariance))).all()

    # the file itself, and another sensor
    (tmp_path / "other").mkdir()
    other = save_correction(replace(correction, values=correction.values + 0.05), tmp_path / "other")
    code, _, said = called("sphere", sphere, "--as", f"sensor-correction={other}", "--out", tmp_path / "no")
    assert code == 1
    assert "it is another sensor's. Run 'weldcal profiler step' with this sensor" in said
    far = written(tmp_path / "far.npz", ball.poses, profiles=4.0 * np.array(ball.profiles), radius=4 * ball.radius_m)
    code, _, said = called("sphere", far, "--as", given, "--out", tmp_path / "no")
    assert code == 1
    assert "The profiles cover x" in said
    assert not (tmp_path / "no").exists()


def test_an_edge_with_the_correction_is_where_it_is_not_without(tmp_path: Path) -> None:
    values, poses = np.array([0.01, -0.012, 0.006]), sample_edge_poses(EDGE, 20, 3)
    told = replace(LOOSE, values=values, covariance=1e-8 * np.eye(3), field_m=FIELD, data_sha256="of a step")
    save_correction(told, tmp_path)
    p = reported(predicted(EDGE, poses)[0] + 2e-5 * np.random.default_rng(8).standard_normal((20, 2)), values)
    file, off = written(tmp_path / "edge.npz", poses, points=p), []
    for words in ((), ("--as", f"sensor-correction={tmp_path}")):
        code, answer, said = called("edge", file, *words, "--out", tmp_path / f"out{len(words)}")
        assert code == 0, said
        off.append(np.linalg.norm(load_record(tmp_path / f"out{len(words)}").translation - EDGE.translation))
    print("off by", [1e3 * float(v) for v in off], "mm without and with the correction")
    assert answer["sensor_correction"] == "of a step"
    assert load_record(tmp_path / "out2").affine == pytest.approx(values)
    assert off[1] < 0.3 * off[0]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--height", "10000"), "A step of 10000 mm does not fit into profiles of"),
        (("--height", "0"), "Each step's height is above 0 mm."),
        (("--height", "ten"), "The heights are numbers in mm with commas between, as --height 10,5, not 'ten'."),
        (("--height", "3.3"), "None of the 12 profiles shows the step. The profile shows no two parallel faces 3.3 mm"),
    ],
)
def test_a_mistake_at_the_command_is_one_sentence(words: tuple[str, ...], sentence: str, tmp_path: Path) -> None:
    _, scans, _ = world()
    file = written(tmp_path / "steps.npz", scans.poses, profiles=scans.profiles)
    code, _, said = called("step", file, *words, "--out", tmp_path / "out")
    assert code == 1
    assert sentence in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, "There is no sensor correction at"),
        ("schema: 1\n", "is no correction of a profiler: run 'weldcal profiler step' again."),
    ],
)
def test_what_is_no_correction_is_named(text: str | None, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "sensor.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=sentence):
        load_correction(path)
