"""An emulated arm before an emulated scanner, for `weldcal capture --demo`, jogged by the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.capture.session import ArmPose
from weldcal.calibration.data.clouds import save_cloud
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arms.shape import arm_shape
from weldcal.models.errors import InputError
from weldcal.models.flanges import flange_mesh, get_flange
from weldcal.models.mesh import TriMesh
from weldcal.models.robots import get_robot
from weldcal.models.scanners import cast, get_scanner

ROBOT = "ur10e"
STEP_M, STEP_RAD = 0.05, np.radians(15.0)
HOME = np.radians([0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
_GUESS = RigidTransform(RollPitchYaw(np.radians([180.0, 0.0, -90.0])), [-0.65, 0.1, 1.25])
START_CF = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.0, 0.0, 0.68])
"""The flange before the scanner, facing it."""
_TURN_RAD, _SHIFT_M = 0.05, 0.03  # by which the scanner's true pose differs from one that a person would guess
_COLUMNS = 824  # a quarter of the scanner's pixels: a scan in a second


class DemoCell:
    """Arm and scanner in one: `pose` and `jog` are those of the arm, `take` is that of the scanner."""

    words = "emulated UR10e before an emulated scanner"

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        turn = RotationMatrix(RollPitchYaw(_TURN_RAD * rng.uniform(-1.0, 1.0, 3)))
        self.X_BC = RigidTransform(turn, _SHIFT_M * rng.uniform(-1.0, 1.0, 3)) @ _GUESS
        self._arm, self._scanner, self._rng = load_arm(ROBOT), get_scanner("phoxi_m", _COLUMNS), rng
        self._flange = flange_mesh(get_flange(get_robot(ROBOT).flange))
        q = nearest_solution(self._arm, _GUESS @ START_CF, HOME)
        assert q is not None
        self._q = self._home = q
        self._scans = seed

    def pose(self) -> ArmPose:
        """See ArmSource."""
        return ArmPose(X_BF=forward_kinematics(self._arm, self._q), q=self._q)

    def jog(self, name: str, goal: RigidTransform | None) -> None:
        """See JoggedArm. Raises InputError where the arm cannot reach."""
        X_BF = forward_kinematics(self._arm, self._q)
        if name == "home":
            self._q = self._home
            return
        if name != "next":
            sign, axis = (-1.0 if name[0] == "-" else 1.0), "xyz".index(name[-1])
            step = sign * np.eye(3)[axis]
            R = RotationMatrix(RollPitchYaw(STEP_RAD * step)) if "r" in name else RotationMatrix()
            shift = np.zeros(3) if "r" in name else STEP_M * step
            goal = RigidTransform(R @ X_BF.rotation(), X_BF.translation() + shift)
        if goal is None:
            raise InputError("There is no next pose yet: move the flange, tilt it, and capture.")
        q = nearest_solution(self._arm, goal, self._q)
        if q is None:
            raise InputError("The arm does not reach that pose: jog elsewhere.")
        self._q = q

    def shape(self) -> list[TriMesh]:
        """The arm in the base, as the 3D view shows it."""
        return [mesh.transformed(body.X_BL) for body in arm_shape(self._arm, self._q) for mesh in body.meshes]

    def take(self, folder: Path) -> Path:
        """See Sensor."""
        self._scans += 1
        X_BF = forward_kinematics(self._arm, self._q)
        points_B = cast([*self.shape(), self._flange.transformed(X_BF)], self.X_BC, self._scanner, self._scans)
        X_CB = self.X_BC.inverse()
        save_cloud(folder / "scan.npz", points_B @ X_CB.rotation().matrix().T + X_CB.translation())
        return folder / "scan.npz"

    def close(self) -> None:
        """See ArmSource and Sensor."""
