"""The simulated soft tip seats itself in a groove, and sits there as deep and as far aside as the tool's numbers
say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.math import RigidTransform, RotationMatrix

from tests.systems.cells import Q_HOME, TOOL, Drive, plain_station
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import kinematics_and_jacobian
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.rendered_finger_camera import RenderedFingerCamera
from weldcal.systems.jobs.weld.aruco_deformation_estimator import measure_deformation
from weldcal.welding.finger.deformation import TagModel

START_S = 0.05  # where along the straight groove, m
SPEED_M_S = 0.008
AXIAL_M, LATERAL_M = 0.003, 0.002  # how hard the job presses


class Groove:
    """The straight groove of the plain station: where a hard ball of the tip's size would rest in it, and its own
    axes."""

    def __init__(self) -> None:
        truth = plain_station().truth
        assert truth.workpiece is not None
        assert truth.X_BP is not None
        R = truth.X_BP.rotation().matrix()
        k = int(np.searchsorted(truth.workpiece.arc_length_m, START_S))
        self.p_BSeat = (
            truth.X_BP
            @ (truth.workpiece.seam_P + truth.workpiece.tip_height(TOOL.tip_radius_m) * truth.workpiece.up_P)[k]
        )
        self.tangent, self.up = R @ truth.workpiece.tangents_P[k], R[:, 2]
        self.left = np.cross(self.up, self.tangent)
        self.X_BT_axes = RotationMatrix(np.column_stack([self.tangent, self.left, self.up]))

    def local(self, p_B: np.ndarray) -> np.ndarray:
        """Along, to the left of and above the seat, (3,) m."""
        gap = p_B - self.p_BSeat
        return np.array([gap @ self.tangent, gap @ self.left, gap @ self.up])


@pytest.fixture(scope="module")
def groove() -> Groove:
    return Groove()


def pressed(groove: Groove, depth_m: float, left_m: float = 0.0) -> Drive:
    """The tool's rest point `depth_m` below and `left_m` beside the seat, its tip let go just above the groove's
    walls."""
    drive = Drive(plain_station())
    p_BT = groove.p_BSeat - depth_m * groove.up + left_m * groove.left
    X_BF = RigidTransform(groove.X_BT_axes, p_BT) @ TOOL.X_FT.inverse()
    q = nearest_solution(drive.station.arm, X_BF, Q_HOME)
    assert q is not None
    drive.place_arm(q, np.array([0.0, 0.0, depth_m + 0.0008]))
    return drive


def tip(groove: Groove, drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """The true tip in the groove's axes and its deflection in T, (3,) m each."""
    contact = drive.get("cheat.contact")
    return groove.local(contact[:3]), contact[3:]


def slide(drive: Drive, groove: Groove, duration_s: float) -> None:
    """Along the groove at the speed of a weld."""
    p_FT = np.array(TOOL.X_FT.translation())
    for _ in range(round(duration_s / 0.05)):
        _, _, J = kinematics_and_jacobian(drive.station.arm, drive.get("arm.position_measured"), p_FT)
        drive.set("arm.velocity_command", np.linalg.solve(J, [0.0, 0.0, 0.0, *(SPEED_M_S * groove.tangent)]))
        drive.run(0.05)


def test_pressed_straight_down_it_comes_to_rest_centred_and_a_little_below_a_hard_balls_seat(groove: Groove) -> None:
    drive = pressed(groove, AXIAL_M + 0.0004)
    drive.run(0.5)
    world = drive.station.world
    speed = np.abs(world.plant.GetVelocities(drive.plant, world.tool)).max()
    place, deflection = tip(groove, drive)
    assert speed < 1e-4  # what is left is the creep of the contact model's regularised friction
    assert deflection[2] == pytest.approx(AXIAL_M, abs=0.3e-3)
    assert abs(place[1]) < 0.1e-3
    assert -1.5e-3 < place[2] < 0.0


def test_it_rests_where_the_springs_balance_the_groove(groove: Groove) -> None:
    shallow, deep = pressed(groove, 0.002), pressed(groove, 0.004)
    for drive in (shallow, deep):
        drive.run(0.4)
    # Twice the load sinks it further, but by much less than the tool went down: the groove holds it.
    sunk = tip(groove, shallow)[0][2] - tip(groove, deep)[0][2]
    assert 0.0 < sunk < 0.4e-3


@pytest.fixture(scope="module")
def sliding(groove: Groove) -> tuple[np.ndarray, np.ndarray]:
    """Place and deflection of a tip that slides as in a weld: pressed down, and leaning on the left wall."""
    drive = pressed(groove, AXIAL_M + 0.0005, LATERAL_M + 0.00006)
    slide(drive, groove, 1.0)
    return tip(groove, drive)


def test_friction_drags_it_behind_and_nothing_else_does(sliding: tuple[np.ndarray, np.ndarray]) -> None:
    _, deflection = sliding
    # Coulomb friction of 0.2 on two walls at 22.5 degrees: of the axial force of 1 N some 0.2 / sin(22.5 deg) comes
    # back.
    expected = 0.2 / np.sin(np.radians(22.5)) * TOOL.axial_stiffness_N_per_m * deflection[2]
    assert -deflection[0] * TOOL.lateral_stiffness_N_per_m == pytest.approx(expected, rel=0.4)


def test_it_sits_where_its_stiffness_and_its_press_say(sliding: tuple[np.ndarray, np.ndarray]) -> None:
    place, deflection = sliding
    assert deflection[1:] == pytest.approx([-LATERAL_M, AXIAL_M], abs=0.03e-3)
    # A polyhedron of 128 tetrahedra is not quite as deep everywhere as the ball it stands for.
    assert -place[2] == pytest.approx(TOOL.seat_sink_m, abs=0.03e-3)
    assert place[1] == pytest.approx(TOOL.seat.aside_m, abs=0.01e-3)


def test_the_contact_models_ball_is_as_large_as_the_tip() -> None:
    inspector = plain_station().world.scene_graph.model_inspector()
    (ball,) = [
        inspector.maybe_get_hydroelastic_mesh(g)
        for g in inspector.GetAllGeometryIds(Role.kProximity)
        if inspector.GetName(g) == "tool::tip_contact"
    ]
    corners = np.array(ball.vertices())
    tetrahedra = [[ball.element(k).vertex(j) for j in range(4)] for k in range(ball.num_elements())]
    edges = np.array([corners[t[1:]] - corners[t[0]] for t in tetrahedra])
    volume = np.abs(np.linalg.det(edges)).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * TOOL.tip_radius_m**3, rel=1e-3)


def test_a_walls_force_is_the_pressure_over_the_disc_it_cuts_out() -> None:
    depth, r = 0.4e-3, TOOL.tip_radius_m
    s = np.linspace(0.0, np.sqrt(r**2 - (r - depth) ** 2), 4001)
    pressure = TOOL.tip_modulus_Pa * (1.0 - np.hypot(r - depth, s) / r)
    assert TOOL.wall_force(depth) == pytest.approx(np.trapezoid(2.0 * np.pi * s * pressure, s), rel=1e-5)
    assert TOOL.indentation(TOOL.wall_force(depth)) == pytest.approx(depth, abs=1e-9)


def test_a_tip_that_would_climb_out_is_refused() -> None:
    with pytest.raises(InputError, match="climbs out of its groove"):
        _ = replace(TOOL, press_lateral_m=0.005).seat


def test_as_the_finger_camera_feels_it_the_tip_sits_where_the_tools_numbers_say(groove: Groove) -> None:
    tag = TagModel(dictionary=TOOL.tag_dictionary, id=TOOL.tag_id, size_m=TOOL.tag_size_m)
    K = RenderedFingerCamera().camera().camera_matrix

    def felt(drive: Drive) -> tuple[RigidTransform, np.ndarray]:
        drive.set("finger_camera.streaming", [1.0])
        slide(drive, groove, 0.4)
        seen = measure_deformation(drive.get("finger_camera.image"), drive.get("arm.X_BF"), TOOL, tag, K).sample
        assert seen is not None
        assert seen.valid
        return seen.X_BT_at_capture, seen.deflection_T

    _, free = felt(pressed(groove, -0.006))  # the servo's zero: the tag's own bias goes with it
    points = []
    for left_m in (0.0018, 0.0020, 0.0022, 0.0024):  # the tag's edges meet the pixels differently in each
        X_BT, deflection = felt(pressed(groove, AXIAL_M + 0.0005, left_m))
        points.append(groove.local(X_BT @ (deflection - free)))
    # The tip itself is that near to the tool's numbers (above); the tag adds a hundredth (test_finger_camera.py).
    assert -np.mean(points, axis=0)[2] == pytest.approx(TOOL.seat_sink_m, abs=0.04e-3)
    assert np.mean(points, axis=0)[1] == pytest.approx(TOOL.seat.aside_m, abs=0.015e-3)
