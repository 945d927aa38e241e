"""The static experiment of the paper: the arm stops at a 4 x 4 grid and the scanner takes a picture in its finest mode
at each."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import FlangeFit, FlangeGuess, fit_flange
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.scanner_streams import ScannerStream
from weldcal.models.scanners import ScannerPreset, depth_to_points, get_scanner
from weldcal.tools.console import Progress
from weldcal.tools.worlds.motion import MotionWorld, facing
from weldcal.tools.worlds.moving_scene import MovingScene, arm_bodies
from weldcal.tools.worlds.robot_path import leaning

GRID, SIDE_M, HEIGHT_M, PERTURBED_M = 4, 0.2, 0.22, 0.02
_STILL = ScannerStream(exposure_s=0.0)


@dataclass(frozen=True, eq=False)
class Look:
    """One scan with its fit: points (H, W, 3) m in the camera frame, and the robot's pose then."""

    points_C: Array
    X_BF: RigidTransform
    fit: FlangeFit


class StaticMode:
    """The world's scanner in its static mode, at the same true pose."""

    def __init__(self, world: MotionWorld, width: int | None = None) -> None:
        self._world = world
        self.scanner: ScannerPreset = get_scanner("motioncam_3d_static", width)
        self._scene = MovingScene(world.arm, arm_bodies(world.arm, world.flange), self.scanner, _STILL)

    def look(self, q: Array, rng: np.random.Generator) -> Look:
        """Scan with the arm at rest at ``q`` (6,) rad. Raises FlangeNotFound."""
        w, s = self._world, self.scanner
        depth = self._scene.frame(lambda _: q, w.X_BC, 0.0, rng, samples=1)
        points = depth_to_points(depth, s.fx, s.fy, s.cx, s.cy)
        X_BF = forward_kinematics(w.arm, q)
        X_CF = w.X_BC_nominal.InvertAndCompose(X_BF)  # known with a tape measure
        guess = FlangeGuess(X_CF.translation(), 0.08, X_CF.rotation().matrix()[:, 2])
        return Look(points, X_BF, fit_flange(points, w.flange, guess=guess))

    def grid(self, seed: int, progress: Progress) -> list[Look]:
        """The scans of the grid, without those that do not show the flange."""
        w, rng = self._world, np.random.default_rng([seed, 4])
        found, q = [], w.path.waypoints[0]
        steps = SIDE_M * (np.arange(GRID) / (GRID - 1) - 0.5)
        for k, (x, y) in enumerate((x, y) for x in steps for y in steps):
            progress("static mode", k / GRID**2)
            p = np.array([w.centre[0] + x, w.centre[1] + y, HEIGHT_M + rng.uniform(-1.0, 1.0) * PERTURBED_M])
            near = nearest_solution(w.arm, leaning(p, facing(p, w.X_BC_nominal), np.radians(12.0), rng), q)
            if near is None:
                continue
            q = near
            try:
                found.append(self.look(q, rng))
            except FlangeNotFound:
                continue
        return found


def noise_of_face(points_C: Array, fit: FlangeFit, world: MotionWorld) -> tuple[float, float, int]:
    """Rms of the points of the flat face about its plane (mm), rms of its outer edge about its circle (mm), and their
    number."""
    flat = points_C.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 2])]
    d = flat - fit.center_C
    height = d @ fit.normal_C
    reach = np.linalg.norm(d - height[:, None] * fit.normal_C, axis=1)
    f = world.flange
    on = (np.abs(height) < 0.003) & (reach > f.face_inner_radius_m) & (reach < f.face_outer_radius_m)
    spread = 1e3 * float(np.sqrt(np.mean(height[on] ** 2)))
    return spread, 1e3 * fit.outer_rms_m, int(np.count_nonzero(on))
