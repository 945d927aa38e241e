"""An emulated arm and an emulated scanner, for `weldcal capture --demo`: the page jogs the arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.capture.session import Advice, ArmPose
from weldcal.calibration.data.clouds import save_cloud
from weldcal.calibration.planning.mounting_scene import BASE, FLANGE, FOOT, MountingScene
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, link_frames, load_arm
from weldcal.models.arms.shape import arm_shape
from weldcal.models.errors import InputError
from weldcal.models.flanges import flange_mesh, get_flange
from weldcal.models.mesh import TriMesh, plane_mesh
from weldcal.models.robots import base_circle, get_robot
from weldcal.models.scanners import cast, get_scanner

ROBOT = "ur10e"
STEP_M, STEP_RAD = 0.05, np.radians(15.0)
HOME = np.radians([0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
_GUESS = RigidTransform(RollPitchYaw(np.radians([180.0, 0.0, -90.0])), [-0.65, 0.1, 1.25])
START_CF = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.0, 0.0, 0.68])
"""The flange before the scanner, facing it."""
_TURN_RAD, _SHIFT_M = 0.05, 0.03  # by which the scanner's true pose differs from one that a person would guess
_KNOWN = 0.3  # a choice: the share of it where a drawing of the mounting is the guess
_TABLE_M = np.array([[-1.5, -1.5], [1.5, -1.5], [1.5, 1.5], [-1.5, 1.5]])  # a choice: on which the arm stands
_COLUMNS = 824  # a quarter of the scanner's pixels: a scan in a second


class DemoCell:
    """Arm and scanner in one: `pose` and `jog` are those of the arm, `take` is that of the scanner.

    ``scene``: of a scanner that the arm carries; None: it stands beside the arm. ``X_LC``: its true pose on what
    carries it, a little off the guess.
    """

    def __init__(self, seed: int, scene: MountingScene | None = None) -> None:
        self._rng, self._scans = np.random.default_rng(seed), seed
        turn, shift = _TURN_RAD * self._rng.uniform(-1.0, 1.0, 3), _SHIFT_M * self._rng.uniform(-1.0, 1.0, 3)
        self._arm = load_arm(ROBOT) if scene is None else scene.arm
        self._target, self._carrier = flange_mesh(get_flange(get_robot(self._arm.name).flange)), FLANGE
        self._still = list[TriMesh]()
        if scene is None:
            self.words = "emulated UR10e before an emulated scanner"
            self.X_LC = RigidTransform(RollPitchYaw(turn), shift) @ _GUESS
            self._scanner, self._link = get_scanner("phoxi_m", _COLUMNS), BASE
            q = nearest_solution(self._arm, _GUESS @ START_CF, HOME)
            assert q is not None
        else:
            self.words = f"emulated {get_robot(self._arm.name).title} that carries an emulated scanner"
            self.X_LC = scene.X_LC @ RigidTransform(RollPitchYaw(_KNOWN * turn), _KNOWN * shift)
            self._scanner, self._link = get_scanner(scene.scanner.name, _COLUMNS), scene.link
            q = scene.q_home
            if scene.configuration in FOOT:
                foot = base_circle(self._arm.name)
                self._target = flange_mesh(foot.standard, foot.standard.bore_depth_m).transformed(foot.X_BR)
                self._carrier, self._still = BASE, [plane_mesh(_TABLE_M, np.array([[0, 1, 2], [0, 2, 3]]), 0.0, True)]
        self._q = self._home = q
        by_joints = self._link not in (BASE, FLANGE)
        axes = [f"J{k}" for k in range(1, 7)] if by_joints else ["x", "y", "z", "rx", "ry", "rz"]
        self.jogs = (*(sign + axis for axis in axes for sign in "+-"), "home")

    def pose(self) -> ArmPose:
        """See ArmSource."""
        return ArmPose(X_BF=forward_kinematics(self._arm, self._q), q=self._q)

    def jog(self, name: str, advice: Advice | None) -> None:
        """See JoggedArm. Raises InputError where the arm cannot reach."""
        X_BF = forward_kinematics(self._arm, self._q)
        if name == "home":
            self._q = self._home
            return
        if name == "next":
            if advice is None or advice.X_BF is None:
                raise InputError("There is no next pose yet: move the flange, tilt it, and capture.")
            q, goal = advice.q, advice.X_BF
        else:
            sign, axis = (-1.0 if name[0] == "-" else 1.0), name[1:]
            if axis[0] == "J":
                self._q = self._q + sign * STEP_RAD * np.eye(len(self._q))[int(axis[1:]) - 1]
                return
            step = sign * np.eye(3)["xyz".index(axis[-1])]
            R = RotationMatrix(RollPitchYaw(STEP_RAD * step)) if "r" in axis else RotationMatrix()
            shift = np.zeros(3) if "r" in axis else STEP_M * step
            q, goal = None, RigidTransform(R @ X_BF.rotation(), X_BF.translation() + shift)
        q = nearest_solution(self._arm, goal, self._q) if q is None else q
        if q is None:
            raise InputError("The arm does not reach that pose: jog elsewhere.")
        self._q = q

    def shape(self) -> list[TriMesh]:
        """The arm in the base, as the 3D view shows it."""
        return [mesh.transformed(body.X_BL) for body in arm_shape(self._arm, self._q) for mesh in body.meshes]

    def take(self, folder: Path) -> Path:
        """See Sensor."""
        self._scans += 1
        frames = link_frames(self._arm, self._q)
        X_BC = frames[self._link] @ self.X_LC
        scene = [*self.shape(), *self._still, self._target.transformed(frames[self._carrier])]
        points_B, X_CB = cast(scene, X_BC, self._scanner, self._scans), X_BC.inverse()
        save_cloud(folder / "scan.npz", points_B @ X_CB.rotation().matrix().T + X_CB.translation())
        return folder / "scan.npz"

    def close(self) -> None:
        """See ArmSource and Sensor."""
