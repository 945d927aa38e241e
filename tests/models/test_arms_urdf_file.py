"""A URDF as an arm: the chain of our own URDF is the arm's, meshes and grippers do not matter, and what is no arm is
refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arms.shape import arm_capsules
from weldcal.models.arms.urdf import arm_urdf, link_solids
from weldcal.models.errors import InputError
from weldcal.models.robots import get_chain

# an arm with axes along x, -y and z, a mesh that does not exist, a base turned in the world, a gripper beside the
# flange
SMALL = """
<robot name="small">
  <link name="stand"/>
  <link name="base"><visual><geometry><mesh filename="package://none/base.dae"/></geometry></visual></link>
  <joint name="foot" type="fixed"><parent link="stand"/><child link="base"/><origin xyz="1 2 3" rpy="0 0 1.5"/></joint>
  <link name="a"/><link name="b"/><link name="c"/><link name="tool0"/><link name="finger"/>
  <joint name="one" type="revolute"><parent link="base"/><child link="a"/><origin xyz="0 0 0.3" rpy="0 0 0"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="2" velocity="3" effort="1"/></joint>
  <joint name="two" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0.4 0" rpy="0.2 0 0"/>
    <axis xyz="0 -1 0"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="three" type="continuous"><parent link="b"/><child link="c"/><origin xyz="0.1 0 0.2"/><axis xyz="0 0 1"/></joint>
  <joint name="face" type="fixed"><parent link="c"/><child link="tool0"/><origin xyz="0 0 0.1" rpy="0 0 0.5"/></joint>
  <joint name="grip" type="prismatic"><parent link="c"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" velocity="1" effort="1"/></joint>
</robot>
"""


def rotation(axis: list[float], angle: float) -> np.ndarray:
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def test_our_own_urdf_is_the_arm_again(tmp_path: Path) -> None:
    file = tmp_path / "mine.urdf"
    file.write_text(arm_urdf(load_arm("ur16e")))
    arm, chain = load_arm("ur16e"), get_chain(str(file))
    assert chain.joint_names == arm.joint_names
    assert chain.position_upper == pytest.approx(arm.position_upper)
    assert chain.velocity_limit == pytest.approx(arm.velocity_limit)
    for q in np.random.default_rng(0).uniform(-2.0, 2.0, (5, 6)):
        assert forward_kinematics(chain, q).IsNearlyEqualTo(forward_kinematics(arm, q), 1e-9)


def test_axes_bases_and_grippers_of_other_makers(tmp_path: Path) -> None:
    file = tmp_path / "small.urdf"
    file.write_text(SMALL)
    chain = load_chain(str(file))
    assert chain.joint_names == ("one", "two", "three")
    assert chain.position_lower == pytest.approx([-1.0, -2.0, -2.0 * np.pi])
    q = np.array([0.3, -0.7, 1.1])
    R, p = rotation([1, 0, 0], 0.3), np.array([0.0, 0.0, 0.3])
    p = p + R @ [0.0, 0.4, 0.0]
    R = R @ rotation([1, 0, 0], 0.2) @ rotation([0, -1, 0], -0.7)
    p = p + R @ [0.1, 0.0, 0.2]
    R = R @ rotation([0, 0, 1], 1.1)
    p, R = p + R @ [0.0, 0.0, 0.1], R @ rotation([0, 0, 1], 0.5)
    found = forward_kinematics(chain, q)
    assert found.translation() == pytest.approx(p)
    assert found.rotation().matrix() == pytest.approx(R)
    again = nearest_solution(chain, found, q + 0.05)
    assert again is not None
    assert forward_kinematics(chain, again).IsNearlyEqualTo(found, 1e-7)
    # three joints have one way or a few to a pose that they reach
    assert min(np.abs(one - q).max() for one in inverse_kinematics(chain, found)) < 1e-6


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<robot", "<robo", "is not XML"),
        (
            '<link name="stand"/>',
            '<link name="stand"/><m:include xmlns:m="http://www.ros.org/wiki/xacro"/>',
            "no URDF: make one of a xacro file",
        ),
        ('name="two" type="revolute"', 'name="two" type="prismatic"', "joint 'two' is prismatic"),
        ('name="tool0"/>', 'name="end"/>', "cannot be read as a URDF"),
        ('<child link="tool0"/>', '<child link="nowhere"/>', "cannot be read as a URDF"),
        (
            'type="revolute"><parent link="a"',
            'type="fixed"><parent link="a"',
            "2 revolute joints between 'base' and 'tool0'",
        ),
    ],
)
def test_what_is_no_arm_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    file = tmp_path / "small.urdf"
    assert old in SMALL
    file.write_text(SMALL.replace(old, new))
    with pytest.raises(InputError, match=said):
        load_chain(str(file))


def test_several_ends_need_a_name(tmp_path: Path) -> None:
    file = tmp_path / "small.urdf"
    file.write_text(SMALL.replace("tool0", "end"))
    with pytest.raises(InputError, match=r"has 2 ends .*: name the link of the flange tool0"):
        load_chain(str(file))
    with pytest.raises(InputError, match="There is no file"):
        load_chain("none.urdf")


def test_capsules_enclose_the_shapes_of_a_urdf(tmp_path: Path) -> None:
    file = tmp_path / "mine.urdf"
    file.write_text(arm_urdf(load_arm("ur5e")))
    arm, chain = load_arm("ur5e"), load_chain(str(file))
    capsules = arm_capsules(chain)
    assert {c.link_index for c in capsules} == set(range(7))
    for link in range(7):
        for solid in link_solids(arm, link):
            far = np.inf
            for c in (c for c in capsules if c.link_index == link):
                axis = c.p_end - c.p_start
                share = np.clip((solid.vertices - c.p_start) @ axis / max(float(axis @ axis), 1e-12), 0.0, 1.0)
                far = min(
                    far,
                    float(
                        (np.linalg.norm(solid.vertices - c.p_start - share[:, None] * axis, axis=1) - c.radius).max()
                    ),
                )
            assert far < 1e-9
    assert sum(c.radius for c in capsules) < 0.08 * len(capsules)
