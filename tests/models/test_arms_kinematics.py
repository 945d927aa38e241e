"""The arm's numbers: the published chain, its Jacobian, and calibration files that are read or refused."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_dump, yaml_load_file
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.models.arms import kinematics as module
from weldcal.models.arms.compiled_kinematics import tick_flange_pose, tick_jacobian
from weldcal.models.arms.kinematics import (
    LINKS,
    forward_kinematics,
    jacobian,
    kinematics_and_jacobian,
    link_frames,
    load_arm,
    sigma_min,
)
from weldcal.models.errors import InputError

Array = NDArray[np.float64]

NOMINAL = Path(module.__file__).parent / "ur10e/default_kinematics.yaml"
# Universal Robots, "DH parameters for calculations of kinematics and dynamics": UR10e (m).
D = (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
A = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)


def denavit_hartenberg(q: Array) -> Array:
    X = np.eye(4)
    for theta, d, a, alpha in zip(q, D, A, ALPHA, strict=True):
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        X = X @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return X


def nominal_numbers() -> dict[str, Any]:
    return dict(yaml_load_file(str(NOMINAL)))


def perturbed_numbers(seed: int = 3) -> dict[str, Any]:
    """What a factory calibration looks like: every number moved by about a millimetre or a milliradian."""
    data = nominal_numbers()
    rng = np.random.default_rng(seed)
    for link in LINKS:
        for key in data["kinematics"][link]:
            data["kinematics"][link][key] += float(rng.normal(0.0, 1e-3))
    data["kinematics"]["hash"] = "calib_1234"
    return data


def transforms(data: dict[str, Any]) -> list[RigidTransform]:
    rows = [data["kinematics"][link] for link in LINKS]
    return [RigidTransform(RollPitchYaw(r["roll"], r["pitch"], r["yaw"]), [r["x"], r["y"], r["z"]]) for r in rows]


def plain_chain(data: dict[str, Any], q: Array) -> RigidTransform:
    X = RigidTransform()
    for step, angle in zip(transforms(data), q, strict=True):
        X = X @ step @ RigidTransform(RotationMatrix.MakeZRotation(angle), [0, 0, 0])
    return X


def written(tmp_path: Path, data: dict[str, Any]) -> Path:
    path = tmp_path / "kinematics.yaml"
    yaml_dump(data, filename=str(path))
    return path


def test_flange_is_denavit_hartenberg_frame_6() -> None:
    arm = load_arm()
    for q in np.random.default_rng(0).uniform(-2 * np.pi, 2 * np.pi, (1000, 6)):
        X, X_dh = forward_kinematics(arm, q), denavit_hartenberg(q)
        np.testing.assert_allclose(X.translation(), X_dh[:3, 3], rtol=0, atol=1e-9)
        turn = RotationMatrix(X.rotation().matrix() @ X_dh[:3, :3].T).ToAngleAxis().angle()
        assert abs(turn) < 1e-9 or abs(turn - 2 * np.pi) < 1e-9


def test_stretched_upright_arm_points_up_and_its_flange_looks_along_minus_y() -> None:
    arm = load_arm()
    X_BF = forward_kinematics(arm, [0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0])
    np.testing.assert_allclose(
        X_BF.translation(), [0.0, -0.17415 - 0.11655, 0.1807 + 0.6127 + 0.57155 + 0.11985], atol=1e-12
    )
    np.testing.assert_allclose(X_BF.rotation().matrix()[:, 2], [0.0, -1.0, 0.0], atol=1e-12)


def test_the_two_files_of_nominal_numbers_agree() -> None:
    dh = load_arm().dh
    assert (dh.d1, dh.a2, dh.a3, dh.d4, dh.d5, dh.d6) == (D[0], A[1], A[2], D[3], D[4], D[5])


def test_limits_are_the_published_ones() -> None:
    arm = load_arm()
    np.testing.assert_allclose(np.rad2deg(arm.position_upper), [360, 360, 180, 360, 360, 360])
    np.testing.assert_array_equal(arm.position_lower, -arm.position_upper)
    np.testing.assert_allclose(np.rad2deg(arm.velocity_limit), [120, 120, 180, 180, 180, 180])
    np.testing.assert_array_equal(arm.effort_limit, [330, 330, 150, 54, 54, 54])
    assert (arm.acceleration_limit > 0).all()


def test_masses_are_the_published_ones_seen_from_the_link_frames() -> None:
    # The article lists centres of mass and inertias in the Denavit-Hartenberg frames, at the far end of each link.
    centers = [
        [0.021, 0, 0.027],
        [0.38, 0, 0.158],
        [0.24, 0, 0.068],
        [0, 0.007, 0.018],
        [0, 0.007, 0.018],
        [0, 0, -0.026],
    ]
    inertias = [
        [[0.03408, 0.00002, -0.00425], [0.00002, 0.03529, 0.00008], [-0.00425, 0.00008, 0.02156]],
        [[0.02814, 0.00005, -0.01561], [0.00005, 0.77068, 0.00002], [-0.01561, 0.00002, 0.76943]],
        [[0.01014, 0.00008, 0.00916], [0.00008, 0.30928, 0], [0.00916, 0, 0.30646]],
        [[0.00296, -0.00001, 0], [-0.00001, 0.00222, -0.00024], [0, -0.00024, 0.00258]],
        [[0.00296, -0.00001, 0], [-0.00001, 0.00222, -0.00024], [0, -0.00024, 0.00258]],
        [[0.00040, 0, 0], [0, 0.00041, 0], [0, 0, 0.00034]],
    ]
    arm = load_arm()
    for i, (a, alpha) in enumerate(zip(A, ALPHA, strict=True)):
        X = RigidTransform(RotationMatrix.MakeXRotation(alpha), [a, 0, 0])  # DH frame in the link frame
        np.testing.assert_allclose(X.inverse() @ arm.centers_of_mass[i], centers[i], atol=1e-12)
        R = X.rotation().matrix()
        np.testing.assert_allclose(R.T @ arm.inertias[i] @ R, inertias[i], atol=1e-12)


def test_inertias_are_those_of_possible_bodies() -> None:
    arm = load_arm()
    np.testing.assert_array_equal(arm.masses, [7.369, 13.051, 3.989, 2.1, 1.98, 0.615])
    for inertia in arm.inertias:
        principal = np.linalg.eigvalsh(inertia)
        assert principal[0] > 0
        assert principal[0] + principal[1] > principal[2]


def test_the_long_links_are_hard_to_turn_across_their_tubes_and_their_mass_lies_on_them() -> None:
    arm = load_arm()
    for link, length, offset in [(1, arm.dh.a2, arm.tube_offsets[0]), (2, arm.dh.a3, arm.tube_offsets[1])]:
        along, *across = np.diag(arm.inertias[link])
        assert min(across) > 10 * along
        x, y, z = arm.centers_of_mass[link]
        assert length < x < 0
        assert abs(y) < 1e-9
        assert abs(z - offset) < 0.04


def test_link_frames_start_at_the_base_and_end_at_the_flange() -> None:
    arm = load_arm()
    q = np.array([0.3, -1.1, 1.7, -0.9, 0.4, 2.0])
    frames = link_frames(arm, q)
    assert len(frames) == len(arm.link_names) == 7
    assert frames[0].IsExactlyIdentity()
    assert frames[-1].IsExactlyEqualTo(forward_kinematics(arm, q))
    np.testing.assert_allclose(frames[2].translation(), [0, 0, 0.1807], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(frames[3].translation() - frames[2].translation()), 0.6127, atol=1e-12)


def test_jacobian_is_the_derivative_of_the_kinematics() -> None:
    arm = load_arm()
    rng = np.random.default_rng(1)
    p_FP = np.array([0.05, -0.02, 0.17])
    h = 1e-5  # central differences: truncation ~ h^2 = 1e-10, rounding ~ 1e-16 / h = 1e-11
    for q in rng.uniform(-np.pi, np.pi, (30, 6)):
        J = jacobian(arm, q, p_FP)
        R, p, J_fast = kinematics_and_jacobian(arm, q, p_FP)
        X = forward_kinematics(arm, q)
        np.testing.assert_array_equal(J, J_fast)
        np.testing.assert_allclose(X @ p_FP, p, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(X.rotation().matrix(), R)
        for i, step in enumerate(h * np.eye(6)):
            X_plus, X_minus = forward_kinematics(arm, q + step), forward_kinematics(arm, q - step)
            v = (X_plus @ p_FP - X_minus @ p_FP) / (2 * h)
            dR = (X_plus.rotation().matrix() - X_minus.rotation().matrix()) / (2 * h) @ R.T
            np.testing.assert_allclose(J[:, i], [dR[2, 1], dR[0, 2], dR[1, 0], *v], rtol=0, atol=1e-9)


def test_a_control_ticks_kinematics_are_the_same() -> None:
    arm, p_FP = load_arm(), np.array([0.01, -0.02, 0.3])
    for q in np.random.default_rng(3).uniform(-np.pi, np.pi, (20, 6)):
        assert tick_flange_pose(arm, q).IsNearlyEqualTo(forward_kinematics(arm, q), 1e-14)
        assert tick_jacobian(arm, q, p_FP) == pytest.approx(jacobian(arm, q, p_FP), abs=1e-14)


def test_sigma_min_vanishes_where_the_arm_is_singular_and_only_there() -> None:
    arm = load_arm()
    ready = [0.2, -1.9, 1.9, -1.57, -1.57, 0.3]
    assert sigma_min(jacobian(arm, ready)) > 0.05
    wrist, stretched = [0.2, -1.9, 1.9, -1.57, 0.0, 0.3], [0.2, -1.9, 0.0, -1.57, -1.57, 0.3]
    for singular in (wrist, stretched):
        assert sigma_min(jacobian(arm, singular)) < 1e-12
        assert sigma_min(jacobian(arm, singular), length=0.3) < 1e-12
    J = jacobian(arm, ready)
    assert sigma_min(J, length=0.5) >= sigma_min(J, length=1.0)


def test_factory_calibration_is_the_plain_product_of_its_transforms(tmp_path: Path) -> None:
    data = perturbed_numbers()
    arm = load_arm(kinematics=written(tmp_path, data))
    assert arm.calibration == "calib_1234"
    nominal = load_arm()
    assert nominal.calibration is None
    moved = []
    for q in np.random.default_rng(2).uniform(-np.pi, np.pi, (50, 6)):
        X, X_plain = forward_kinematics(arm, q), plain_chain(data, q)
        assert X.IsNearlyEqualTo(X_plain, 1e-12)
        moved.append(np.linalg.norm(X.translation() - forward_kinematics(nominal, q).translation()))
    assert 5e-4 < np.median(moved) < 2e-2


def test_frames_hundreds_of_metres_away_change_nothing(tmp_path: Path) -> None:
    data = perturbed_numbers()
    far = copy.deepcopy(data)
    slides = [
        0.0,
        0.0,
        439.0,
        -7.0,
        0.0,
        0.0,
        0.0,
    ]  # of each link's frame along its own axis, as raw DH of a UR10e has them
    for X, before, after, link in zip(transforms(data), slides[:-1], slides[1:], LINKS, strict=True):
        p = X.translation() + X.rotation().matrix()[:, 2] * after - [0.0, 0.0, before]
        far["kinematics"][link].update(dict(zip("xyz", map(float, p), strict=True)))
    assert max(abs(far["kinematics"]["forearm"][k]) for k in "xyz") > 400
    arm, arm_far = load_arm(kinematics=written(tmp_path, data)), load_arm(kinematics=written(tmp_path, far))
    nominal = load_arm()
    for q in np.random.default_rng(4).uniform(-np.pi, np.pi, (50, 6)):
        # 446 m carry a rounding error of 446 * 2.2e-16 = 1e-13 m a step
        assert forward_kinematics(arm, q).IsNearlyEqualTo(forward_kinematics(arm_far, q), 2e-12)
    for X, X_nominal in zip(link_frames(arm_far, np.zeros(6)), link_frames(nominal, np.zeros(6)), strict=True):
        assert np.linalg.norm(X.translation() - X_nominal.translation()) < 0.02


def test_numbers_written_as_1e_05_are_numbers(tmp_path: Path) -> None:
    text = NOMINAL.read_text(encoding="utf-8").replace("roll: 0.0", "roll: 1e-05", 1)
    path = tmp_path / "kinematics.yaml"
    path.write_text(text, encoding="utf-8")
    np.testing.assert_allclose(load_arm(kinematics=path).stack[0, 2, 1], 1e-5, rtol=1e-9)


def test_an_unknown_arm_is_refused_with_the_known_names() -> None:
    with pytest.raises(InputError, match="ur10e"):
        load_arm("ur11")


def drop_link(data: dict[str, Any]) -> None:
    del data["kinematics"]["wrist_2"]


def drop_key(data: dict[str, Any]) -> None:
    del data["kinematics"]["wrist_2"]["yaw"]


def misspell(data: dict[str, Any]) -> None:
    data["kinematics"]["wrist_2"]["jaw"] = 0.0


def flatten(data: dict[str, Any]) -> None:
    data["kinematics"]["wrist_2"] = 3.0


def not_a_number(data: dict[str, Any]) -> None:
    data["kinematics"]["wrist_2"]["y"] = float("nan")


def infinite(data: dict[str, Any]) -> None:
    data["kinematics"]["wrist_2"]["y"] = float("inf")


def words(data: dict[str, Any]) -> None:
    data["kinematics"]["wrist_2"]["y"] = "-0.11985 m"


def no_section(data: dict[str, Any]) -> None:
    data["links"] = data.pop("kinematics")


def millimetres(data: dict[str, Any]) -> None:
    for link in LINKS:
        for key in "xyz":
            data["kinematics"][link][key] *= 1000.0


def degrees(data: dict[str, Any]) -> None:
    data["kinematics"]["upper_arm"]["roll"] = 90.0


def ur5e(data: dict[str, Any]) -> None:
    data["kinematics"]["forearm"]["x"], data["kinematics"]["wrist_1"]["x"] = -0.425, -0.3922


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (drop_link, "under kinematics"),
        (drop_key, "under kinematics.wrist_2"),
        (misspell, "under kinematics.wrist_2"),
        (flatten, "under kinematics.wrist_2"),
        (not_a_number, r"wrist_2\.y must be a finite number"),
        (infinite, r"wrist_2\.y must be a finite number"),
        (words, r"wrist_2\.y must be a finite number"),
        (no_section, "no section 'kinematics'"),
        (millimetres, "metres"),
        (degrees, "radians"),
        (ur5e, "calibration of a ur10e"),
    ],
)
def test_a_spoilt_calibration_is_refused(tmp_path: Path, spoil: Any, says: str) -> None:
    data = nominal_numbers()
    spoil(data)
    with pytest.raises(InputError, match=says):
        load_arm(kinematics=written(tmp_path, data))


@pytest.mark.parametrize("text", ["", "kinematics: [", "\x00", "just words"])
def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "kinematics.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"kinematics\.yaml"):
        load_arm(kinematics=path)


def test_a_missing_calibration_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_arm(kinematics=tmp_path / "none.yaml")
