"""The robots by name: each chain against a second source of the same numbers, each flange found in the table."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from typer.testing import CliRunner

from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, jacobian, load_arm
from weldcal.models.errors import InputError
from weldcal.models.robots import FACTS, ROBOTS, get_robot
from weldcal.models.scanners import SCANNERS

Array = NDArray[np.float64]

# Universal Robots, "DH parameters for calculations of kinematics and dynamics" (m): d1, a2, a3, d4, d5, d6
UR_DH = {
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5": (0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10": (0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "ur7e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur12e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "ur16e": (0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
    "ur20": (0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543),
    "ur30": (0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543),
}


def standard_dh(rows: list[tuple[float, float, float, float]]) -> Array:
    """Product of Rz(theta) Tz(d) Tx(a) Rx(alpha) over rows (a, d, alpha, theta)."""
    X = np.eye(4)
    for a, d, alpha, theta in rows:
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        X = X @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return X


def craig_dh(rows: list[tuple[float, float, float, float]]) -> Array:
    """Product of Rx(alpha) Tx(a) Rz(theta) Tz(d) over rows (a, d, alpha, theta): the form of the FCI documentation."""
    X = np.eye(4)
    for a, d, alpha, theta in rows:
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        X = X @ np.array([[c, -s, 0, a], [s * ca, c * ca, -sa, -sa * d], [s * sa, c * sa, ca, ca * d], [0, 0, 0, 1.0]])
    return X


@pytest.mark.parametrize("name", UR_DH)
def test_a_ur_arm_stands_where_its_published_dh_table_puts_it(name: str) -> None:
    d1, a2, a3, d4, d5, d6 = UR_DH[name]
    half = np.pi / 2
    arm = load_arm(name)
    for q in np.random.default_rng(0).uniform(-np.pi, np.pi, (5, 6)):
        a, d, alpha = (0, a2, a3, 0, 0, 0), (d1, 0, 0, d4, d5, d6), (half, 0, 0, half, -half, 0)
        wanted = standard_dh(list(zip(a, d, alpha, q, strict=True)))
        assert np.abs(forward_kinematics(arm, q).GetAsMatrix4() - wanted).max() < 1e-12
        assert np.abs(forward_kinematics(load_chain(name), q).GetAsMatrix4() - wanted).max() < 1e-12
    assert (arm.dh.d1, arm.dh.a2, arm.dh.a3, arm.dh.d4, arm.dh.d5, arm.dh.d6) == UR_DH[name]


@pytest.mark.parametrize("name", UR_DH)
def test_a_ur_arm_returns_to_a_pose_by_every_branch(name: str) -> None:
    arm = load_arm(name)
    q = np.array([0.3, -1.2, 1.4, -1.0, -1.3, 0.5])
    X = forward_kinematics(arm, q)
    found = inverse_kinematics(arm, X)
    assert len(found) >= 4
    assert min(np.abs(f - q).max() for f in found) < 1e-8
    for f in found:
        assert np.abs(forward_kinematics(arm, f).GetAsMatrix4() - X.GetAsMatrix4()).max() < 1e-8
    masses = float(arm.masses.sum())
    assert 0.5 * ROBOTS[name].payload_kg < masses < 6.0 * ROBOTS[name].payload_kg
    for tensor in arm.inertias:
        a, b, c = np.linalg.eigvalsh(tensor)
        assert a > 0.0
        # the triangle inequality, which any body fulfils; UR's rounded numbers miss it by their last digit
        assert a + b >= c * (1.0 - 0.02)


@pytest.mark.parametrize("name", ["franka_panda", "franka_fr3"])
def test_a_franka_stands_where_the_fci_documentation_puts_it(name: str) -> None:
    half = np.pi / 2
    a, d = (0, 0, 0, 0.0825, -0.0825, 0, 0.088, 0), (0.333, 0, 0.316, 0, 0.384, 0, 0, 0.107)
    alpha = (0, -half, half, half, -half, half, half, 0)
    chain = load_chain(name)
    for q in np.random.default_rng(1).uniform(chain.position_lower, chain.position_upper, (5, 7)):
        wanted = craig_dh(list(zip(a, d, alpha, (*q, 0.0), strict=True)))
        assert np.abs(forward_kinematics(chain, q).GetAsMatrix4() - wanted).max() < 1e-12
    # upright, all links in one line but for the offset of the last wrist: 0.333 + 0.316 + 0.384 - 0.107
    assert np.allclose(forward_kinematics(chain, np.zeros(7)).translation(), [0.088, 0.0, 0.926], atol=1e-12)


def test_the_aubo_stands_where_its_lengths_put_it() -> None:
    chain = load_chain("aubo_i5")
    # upright at zero: the lengths of tubes and wrists add up, the joints' offsets lie sideways
    p = forward_kinematics(chain, np.zeros(6)).translation()
    assert p[2] == pytest.approx(0.122 + 0.408 + 0.376 + 0.1025, abs=1e-9)
    assert np.hypot(p[0], p[1]) == pytest.approx(0.1215 + 0.094, abs=1e-9)
    # the maker's reach is that of tubes and first wrist: a second source for the three lengths
    assert ROBOTS["aubo_i5"].reach_m == pytest.approx(0.408 + 0.376 + 0.1025, abs=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_nothing_reaches_much_farther_or_less_far_than_its_maker_says(name: str) -> None:
    robot = ROBOTS[name]
    chain = robot.chain
    rng = np.random.default_rng(2)
    shoulder = chain.stack[0, :3, 3]
    far = max(
        float(np.linalg.norm(forward_kinematics(chain, q).translation() - shoulder))
        for q in rng.uniform(chain.position_lower, chain.position_upper, (800, chain.n))
    )
    # the makers' radius is to the wrist or less, the flange hangs up to two wrists farther out
    assert 0.9 * robot.reach_m < far < 1.45 * robot.reach_m
    assert chain.n == robot.joints


@pytest.mark.parametrize("name", ["franka_fr3", "aubo_i5", "ur5e"])
def test_the_jacobian_is_the_derivative_and_the_numeric_solver_arrives(name: str) -> None:
    chain = load_chain(name)
    rng = np.random.default_rng(3)
    middle = 0.5 * (np.maximum(chain.position_lower, -2) + np.minimum(chain.position_upper, 2))
    q = middle + 0.4 * rng.standard_normal(chain.n)
    J, h = jacobian(chain, q), 1e-6
    for k in range(chain.n):
        e = h * np.eye(chain.n)[k]
        a, b = forward_kinematics(chain, q - e), forward_kinematics(chain, q + e)
        turn = (b.rotation() @ a.rotation().inverse()).ToAngleAxis()
        assert np.allclose(turn.axis() * turn.angle() / (2 * h), J[:3, k], atol=1e-6)
        assert np.allclose((b.translation() - a.translation()) / (2 * h), J[3:, k], atol=1e-6)
    X = forward_kinematics(chain, q)
    found = inverse_kinematics(chain, X)[0]
    assert np.abs(forward_kinematics(chain, found).GetAsMatrix4() - X.GetAsMatrix4()).max() < 1e-8
    assert (found >= chain.position_lower).all()
    assert (found <= chain.position_upper).all()
    near = nearest_solution(chain, X, q + 0.02)
    assert near is not None
    assert np.abs(near - q).max() < 0.2


def test_a_pose_out_of_reach_has_no_joint_angles() -> None:
    assert not len(inverse_kinematics(load_chain("aubo_i5"), RigidTransform(RotationMatrix(), [3.0, 0.0, 0.0])))
    with pytest.raises(InputError, match="finite"):
        inverse_kinematics(load_chain("aubo_i5"), RigidTransform([np.inf, 0.0, 0.0]))


def test_every_robot_has_a_flange_and_known_names_are_told() -> None:
    for robot in ROBOTS.values():
        large = robot.name in ("ur20", "ur30")
        assert robot.standard.designation == ("iso9409-1-80-6-m8" if large else "iso9409-1-50-4-m6")
        assert (robot.inverse == "all") == (not robot.name.startswith("franka"))
    assert get_robot("franka").name == "franka_panda"
    assert get_robot("UR10e").payload_kg == 12.5
    with pytest.raises(InputError, match="use one of ur3e"):
        get_robot("ur99")
    with pytest.raises(InputError, match="no arm 'ur99'"):
        load_chain("ur99")


def test_the_scanners_of_the_recorded_data_are_presets() -> None:
    wanted = ("phoxi_s", "phoxi_m", "motioncam_3d_static", "motioncam_3d_motion", "azure_kinect")
    assert set(wanted) <= set(SCANNERS)
    # section 3.2.1: 384 to 520 mm and 458 to 1118 mm
    assert [(SCANNERS[n].near_m, SCANNERS[n].far_m) for n in wanted[:2]] == [(0.384, 0.520), (0.458, 1.118)]


def test_the_command_lists_them() -> None:
    from weldcal.tools.cli.app import app

    result = CliRunner().invoke(app, ["robots", "--json"])
    assert result.exit_code == 0
    rows = json.loads(result.stdout.strip().splitlines()[-1])["robots"]
    assert [r["name"] for r in rows] == list(ROBOTS)
    assert all(a["name"] != b["name"] for a, b in itertools.combinations(rows, 2))
    one = CliRunner().invoke(app, ["robots", "fr3"])
    assert "fr3_joint7" in one.stdout
    assert CliRunner().invoke(app, ["robots", "ur99"]).exit_code == 1


def test_each_number_has_a_source() -> None:
    for robot in ROBOTS.values():
        stated = {
            "dowel": robot.dowel_deg is not None,
            "repeatability": robot.repeatability_m is not None,
            "TCP": bool(robot.tcp),
        }
        assert set(robot.sources) == {fact for fact in FACTS if stated.get(fact, True)}, robot.name
        assert all(len(source) > 8 for source in robot.sources.values()), robot.name


def test_a_robot_is_shown_with_its_sources() -> None:
    from weldcal.tools.cli.app import app

    shown = " ".join(CliRunner().invoke(app, ["robots", "ur5e"]).output.split())
    for source in ROBOTS["ur5e"].sources.values():
        assert source in shown
    assert "?" not in shown
    assert "not in a public source" not in shown
    lines = {line.split(" ")[0]: line for line in CliRunner().invoke(app, ["robots"]).output.splitlines()}
    assert "?" not in "".join(lines.values())
    assert lines["ur30"].split()[5] == "-"  # its repeatability
    assert "repeatability not in a public source" in " ".join(
        CliRunner().invoke(app, ["robots", "ur30"]).output.split()
    )
