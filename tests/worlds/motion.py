"""A world for calibration in motion: an arm that moves or stops before a scanner.

It shares no model with the estimators: the motion is the controller's exact trapezoid, frames are rendered pixel by
pixel over their exposure, delays are skewed, stamps jitter, and all numbers in the files are rounded. The truth is a
file beside the dataset.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.worlds.moving_arm import (
    MovingScene,
    RigidBody,
    arm_bodies,
    cube_poses,
    leaning,
    path_through,
    reachable_start,
)
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.motion_dataset import FrameTime, RobotStream, save_motion_dataset
from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import FlangeFit, FlangeGuess, fit_flange
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.depth_noise import Depth
from weldcal.models.mesh import extrude
from weldcal.models.robots import get_robot
from weldcal.models.scanner_streams import ScannerStream, get_stream
from weldcal.models.scanners import ScannerPreset, depth_to_points, get_scanner
from weldcal.tools.console import Progress
from weldcal.tools.report.render import write_json

_DEPTH_STEP_M = 1e-5  # of the stored depths: a tenth of the smallest noise
_JOINT_DIGITS = 6  # decimals of the stream's numbers


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """What is simulated. Lengths m, times s; ``size`` (width, height) resizes the scanner's image.

    ``stream_jitter_s`` the standard deviation of a row's time about its
    instant. ``lead_s`` how long the stream runs before the first and after the last frame (negative: frames lie outside
    it). ``mount_mm`` and ``mount_deg`` are how far the scanner's
    true pose is off the nominal one. ``surroundings``
    False leaves out the table and the blocks on it, which makes the files three times smaller.
    """

    robot: str = "ur5e"
    scanner: str = "motioncam_3d_stream"
    size: tuple[int, int] | None = None
    frames: int = 900
    move: str = "moveJ"
    speed: float = 0.25
    acceleration: float = 1.2
    cube_m: float = 0.2
    lean_deg: float = 15.0
    noise_mm: float | None = None
    stream: ScannerStream | None = None
    stream_hz: float = 500.0
    stream_jitter_s: float = 2.0e-5
    lead_s: float = 0.5
    robot_start_s: float = 1000.0
    mount_mm: float = 20.0
    mount_deg: float = 2.0
    exposure_samples: int = 5
    surroundings: bool = True
    seed: int = 0


class MotionWorld:
    """The simulated cell. ``X_BC`` is the scanner's true pose."""

    def __init__(self, options: MotionOptions) -> None:
        self.options = o = options
        self._rng = np.random.default_rng([o.seed, 16])
        self.arm: ArmModel = load_arm(o.robot)
        self.flange = get_robot(o.robot).standard
        self.scanner = _scanner(o)
        self.timing = o.stream if o.stream is not None else get_stream(o.scanner)
        centre, nominal = layout(o.robot, self.scanner)
        self.X_BC_nominal = nominal
        self.X_BC = _mounted(nominal, o.mount_mm * 1e-3, np.radians(o.mount_deg), self._rng)
        up = facing(centre, nominal)
        self.centre, self.towards = centre, up
        poses = cube_poses(centre, o.cube_m, up, np.radians(o.lean_deg), self._rng)
        self.path = path_through(
            self.arm,
            poses,
            reachable_start(self.arm, RigidTransform(up, centre)),
            o.move,
            speed=o.speed,
            acceleration=o.acceleration,
        )
        bodies = [*arm_bodies(self.arm, self.flange), *(surroundings(centre) if o.surroundings else [])]
        self.scene = MovingScene(self.arm, bodies, self.scanner, self.timing)
        captures = self.timing.captures(o.frames, self._rng) + self.timing.exposure_s
        lost = self._rng.random(o.frames) < self.timing.loss
        self.captures = captures[~lost]
        self.arrivals = self.timing.arrivals(self.captures, self._rng)
        self.stamps = [self.timing.device_time(t + o.robot_start_s, self._rng) for t in self.captures]

    def pose(self, t: float) -> RigidTransform:
        """True pose X_BF of the flange at ``t`` s after the start."""
        return as_transform(self.path.at(np.array(t)))

    def joints(self, t: float) -> Array:
        """True joint angles (6,) rad at ``t`` s after the start."""
        return np.asarray(self.path.joints(np.array([t]))[0])

    def frames(self) -> Iterator[tuple[str, Depth]]:
        """Id and depth (H, W) m of every frame that arrives, rendered one after the other."""
        for k, t in enumerate(self.captures):
            rng = np.random.default_rng([self.options.seed, 17, k])
            samples = self.options.exposure_samples
            yield f"{k:05d}", self.scene.frame(self.joints, self.X_BC, float(t), rng, samples=samples)

    def stream(self) -> RobotStream:
        """Return the arm's state at its regular instants, rounded, with the jitter of its stamps."""
        o = self.options
        begin, end = float(self.captures[0]) - o.lead_s, float(self.arrivals[-1]) + o.lead_s
        times = np.arange(begin, end, 1.0 / o.stream_hz)
        exact_s = times + o.robot_start_s + o.stream_jitter_s * self._rng.standard_normal(len(times))
        stamped = np.maximum.accumulate(exact_s).round(6)
        exact = self.path.joints(times)
        poses = self.path.at(times)
        return RobotStream(stamped, poses, np.round(exact, _JOINT_DIGITS), o.robot)

    def frame_times(self) -> list[FrameTime]:
        """What frames.csv says of each frame: its arrival on the robot's clock, and the device's stamp."""
        o, stamps = self.options, self.stamps
        return [
            FrameTime(f"{k:05d}", round(o.robot_start_s + float(t), 6), round(stamps[k], 6))
            for k, t in enumerate(self.arrivals)
        ]

    def truth(self) -> dict[str, Any]:
        """What no estimator reads: pose and clock."""
        t = self.captures + self.options.robot_start_s
        offset = 1e3 * (t - np.asarray(self.stamps))
        middle = float(np.interp(0.5 * (t[0] + t[-1]), t, offset))
        return {
            "X_BC": self.X_BC.GetAsMatrix4().tolist(),
            "device_clock": {"offset_ms_at_middle": middle},
            "capture_s": {f"{k:05d}": round(float(v), 7) for k, v in enumerate(t)},
        }


def write_motion_dataset(world: MotionWorld, folder: Path, truth: Path, progress: Progress) -> None:
    """Write the dataset to ``folder`` and the truth to the file ``truth``, which lies outside of it."""
    o, s = world.options, world.scanner
    header = DatasetHeader(
        robot=o.robot,
        flange=world.flange.designation,
        scanner=s.name,
        configuration="eye_on_base",
        note="simulated: an arm through the corners of a cube",
    )
    intrinsics = (s.fx, s.fy, s.cx, s.cy)

    def clouds() -> Iterator[tuple[str, Array]]:
        for k, (id, depth) in enumerate(world.frames()):
            progress("rendering", k / len(world.captures))
            stored = np.round(depth / _DEPTH_STEP_M).astype(np.float32) * np.float32(_DEPTH_STEP_M)
            yield id, depth_to_points(stored, *intrinsics)

    save_motion_dataset(folder, header, world.stream(), world.frame_times(), clouds(), intrinsics=intrinsics)
    write_json(truth, world.truth())


def _scanner(o: MotionOptions) -> ScannerPreset:
    preset = get_scanner(o.scanner)
    preset = preset if o.size is None else preset.resized(*o.size)
    return preset if o.noise_mm is None else replace(preset, noise=replace(preset.noise, sigma_m=1e-3 * o.noise_mm))


def layout(robot: str, scanner: ScannerPreset) -> tuple[Array, RigidTransform]:
    """Return the cube's centre (3,) m in the base and the scanner's nominal pose X_BC, at its optimum distance from it.

    The scanner looks down at the cube from the side that is away from the arm (Fig. 4 of the paper), so that the
    forearm does not stand in its view.
    """
    big = get_robot(robot).reach_m > 1.0
    centre = np.array([0.70 if big else 0.45, -0.10, 0.32])
    lean = np.radians(20.0)
    z = np.array([-np.sin(lean), 0.0, -np.cos(lean)])
    y = np.array([0.0, -1.0, 0.0])
    R = RotationMatrix(np.column_stack([np.cross(y, z), y, z]) @ RotationMatrix.MakeZRotation(0.5 * np.pi).matrix())
    return centre, RigidTransform(R, centre - scanner.optimum_m * z)


def facing(centre: Array, X_BC: RigidTransform) -> RotationMatrix:
    """Return a flange rotation R_BF whose outward normal points from ``centre`` to the scanner."""
    z = X_BC.translation() - centre
    z = z / np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return RotationMatrix(np.column_stack([x, np.cross(z, x), z]))


def surroundings(centre: Array) -> list[RigidBody]:
    """Return the table and blocks in the scanner's view: they separate a moved scanner from a moved robot."""
    blocks = []
    for x, y, top in ((-0.16, 0.22, 0.24), (0.10, 0.24, 0.18), (0.16, -0.25, 0.22), (-0.10, -0.26, 0.14)):
        place = centre + np.array([x, y, 0.0])
        size = np.array([[-0.03, -0.04], [0.03, -0.04], [0.03, 0.04], [-0.03, 0.04]]) + place[:2]
        blocks.append(RigidBody(None, extrude(size, 0.0, top)))
    table = extrude(np.array([[-0.3, -0.8], [1.6, -0.8], [1.6, 0.8], [-0.3, 0.8]]), -0.03, 0.0)
    return [*blocks, RigidBody(None, table)]


def _mounted(X: RigidTransform, translation_m: float, rotation_rad: float, rng: np.random.Generator) -> RigidTransform:
    """Return a pose off the nominal one by up to a length and an angle in random directions."""
    off = rng.uniform(-1.0, 1.0, 6)
    turn = RollPitchYaw(*(rotation_rad * off[:3])).ToRotationMatrix()
    return RigidTransform(X.rotation() @ turn, X.translation() + translation_m * off[3:])


GRID, SIDE_M, HEIGHT_M, PERTURBED_M = 4, 0.2, 0.22, 0.02
_SHARP = ScannerStream(exposure_s=0.0)


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
        self._scene = MovingScene(world.arm, arm_bodies(world.arm, world.flange), self.scanner, _SHARP)

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
        """Return the scans of the grid, without those that do not show the flange."""
        w, rng = self._world, np.random.default_rng([seed, 4])
        found, q = [], w.path.q[0]
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
    """Compute the rms (mm) of the face's points about its plane and of its outer edge about its circle.

    With the number of points of the flat face.
    """
    flat = points_C.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 2])]
    d = flat - fit.center_C
    height = d @ fit.normal_C
    reach = np.linalg.norm(d - height[:, None] * fit.normal_C, axis=1)
    f = world.flange
    on = (np.abs(height) < 0.003) & (reach > f.face_inner_radius_m) & (reach < f.face_outer_radius_m)
    spread = 1e3 * float(np.sqrt(np.mean(height[on] ** 2)))
    return spread, 1e3 * fit.outer_rms_m, int(np.count_nonzero(on))
