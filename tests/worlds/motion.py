"""A world for calibration in motion: an arm that moves or stops before a scanner, and what disturbs a watched cell.

It shares no model with the estimators: the motion is the controller's exact trapezoid, frames are rendered pixel by
pixel over their exposure, delays are skewed, stamps jitter, and all numbers in the files are rounded. The truth is a
file beside the dataset.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.worlds.moving_arm import (
    MovingScene,
    RigidBody,
    RobotPath,
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
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.depth_noise import Depth
from weldcal.models.errors import InputError
from weldcal.models.mesh import extrude
from weldcal.models.robots import get_robot
from weldcal.models.scanner_streams import ScannerStream, get_stream
from weldcal.models.scanners import ScannerPreset, depth_to_points, get_scanner
from weldcal.tools.console import Progress
from weldcal.tools.report.render import write_json

Vector = tuple[float, float, float]
_NO_MOTION: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Times in s after the start, lengths in mm in axes of the base, angles (roll, pitch, yaw) in degrees.

    Zeros: nothing happens.

    knock_s, knock_mm, knock_deg   the scanner's housing jumps: its own origin by knock_mm, its axes by knock_deg
    creep_mm_per_min               the scanner moves steadily from creep_s on base_s, base_mm, base_deg      the robot's
    base jumps: the scanner and everything that stands still move in its frame warm_up_s                      time
    constant of the scanner's own warm-up; 0: it is warm warm_up_scale, warm_up_gradient_per_m  its relative error of
    lengths, and that per metre of x, while cold; both die away
    """

    knock_s: float = 0.0
    knock_mm: Vector = _NO_MOTION
    knock_deg: Vector = _NO_MOTION
    creep_s: float = 0.0
    creep_mm_per_min: Vector = _NO_MOTION
    base_s: float = 0.0
    base_mm: Vector = _NO_MOTION
    base_deg: Vector = _NO_MOTION
    warm_up_s: float = 0.0
    warm_up_scale: float = 0.0
    warm_up_gradient_per_m: float = 0.0

    def world_in_base(self, t: float) -> RigidTransform:
        """Return the pose X_BW of the static surroundings, in the robot's base, at ``t`` s.

        The two are one before the base has moved.
        """
        if t < self.base_s or not any((*self.base_mm, *self.base_deg)):
            return RigidTransform()
        return RigidTransform(RollPitchYaw(np.radians(self.base_deg)), 1e-3 * np.array(self.base_mm)).inverse()

    def scanner_pose(self, X_BC: RigidTransform, t: float) -> RigidTransform:
        """Return the scanner's true pose in the robot's base at ``t`` s, ``X_BC`` where nothing has happened."""
        p: Array = X_BC.translation()
        R = X_BC.rotation()
        if t >= self.knock_s:
            p = p + 1e-3 * np.array(self.knock_mm)
            R = RollPitchYaw(np.radians(self.knock_deg)).ToRotationMatrix() @ R
        if t > self.creep_s:
            p = p + 1e-3 * (t - self.creep_s) / 60.0 * np.array(self.creep_mm_per_min)
        return self.world_in_base(t) @ RigidTransform(R, p)

    def device(self, scanner: ScannerPreset, t: float) -> ScannerPreset:
        """Return the scanner with its own errors at ``t`` s of its warm-up."""
        if not self.warm_up_s:
            return scanner
        cold = float(np.exp(-max(t, 0.0) / self.warm_up_s))
        noise = replace(
            scanner.noise,
            scale_error=scanner.noise.scale_error + cold * self.warm_up_scale,
            gradient_per_m=(cold * self.warm_up_gradient_per_m, 0.0),
        )
        return replace(scanner, noise=noise)

    def summary(self, start_s: float) -> dict[str, Any]:
        """Return the truth file's entry, with times on the robot's clock."""
        out: dict[str, Any] = {}
        if any((*self.knock_mm, *self.knock_deg)):
            out["knock"] = {"time_s": start_s + self.knock_s, "mm": self.knock_mm, "deg": self.knock_deg}
        if any(self.creep_mm_per_min):
            out["creep"] = {"time_s": start_s + self.creep_s, "mm_per_min": self.creep_mm_per_min}
        if any((*self.base_mm, *self.base_deg)):
            out["base"] = {"time_s": start_s + self.base_s, "mm": self.base_mm, "deg": self.base_deg}
        if self.warm_up_s:
            out["warm_up"] = {
                "time_constant_s": self.warm_up_s,
                "scale": self.warm_up_scale,
                "gradient_per_m": self.warm_up_gradient_per_m,
            }
        return out


def disturbance_of(knock: str = "", creep: str = "", base: str = "", warm_up: str = "") -> Disturbance:
    """What happens while the scanner streams, from the numbers of the command line; "" for nothing.

    Raises:
        InputError: a text is no such list of numbers.
    """
    knocked = _numbers(knock, "--knock", (4, 7))
    creeping = _numbers(creep, "--creep", (4,))
    based = _numbers(base, "--base", (4, 7))
    warming = _numbers(warm_up, "--warm-up", (2, 3))
    return Disturbance(
        knock_s=knocked[0],
        knock_mm=_vector(knocked[1:4]),
        knock_deg=_vector(knocked[4:7]),
        creep_s=creeping[0],
        creep_mm_per_min=_vector(creeping[1:4]),
        base_s=based[0],
        base_mm=_vector(based[1:4]),
        base_deg=_vector(based[4:7]),
        warm_up_s=warming[0],
        warm_up_scale=1e-6 * warming[1],
        warm_up_gradient_per_m=1e-6 * warming[2],
    )


def _numbers(text: str, name: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Seven numbers, zeros behind those given."""
    try:
        given = tuple(float(part) for part in text.split(",")) if text else ()
    except ValueError:
        given = (float("nan"),)
    if text and (len(given) not in counts or not all(abs(v) < 1e6 for v in given)):
        raise InputError(f"{name} takes {' or '.join(map(str, counts))} numbers with commas between, and is '{text}'.")
    return given + (0.0,) * (7 - len(given))


def _vector(values: tuple[float, ...]) -> Vector:
    return values[0], values[1], values[2]


_DEPTH_STEP_M = 1e-5  # of the stored depths: a tenth of the smallest noise
_POSE_DIGITS, _JOINT_DIGITS = 6, 6  # decimals of the stream's numbers


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """What is simulated. Lengths m, times s; ``size`` (width, height) resizes the scanner's image.

    ``stream_columns`` is "joints" or "pose". ``stream_jitter_s`` the standard deviation of a row's time about its
    instant. ``lead_s`` how long the stream runs before the first and after the last frame (negative: frames lie outside
    it). ``device_clock`` False leaves out the device's stamps. ``mount_mm`` and ``mount_deg`` are how far the scanner's
    true pose is off the nominal one. ``stop_and_go`` lets the arm rest for that time at each corner. ``surroundings``
    False leaves out the table and the blocks on it, which makes the files three times smaller.
    """

    robot: str = "ur5e"
    scanner: str = "motioncam_3d_stream"
    size: tuple[int, int] | None = None
    frames: int = 900
    move: str = "moveJ"
    speed: float = 0.25
    acceleration: float = 1.2
    stop_and_go: float = 0.0
    cube_m: float = 0.2
    lean_deg: float = 15.0
    noise_mm: float | None = None
    stream: ScannerStream | None = None
    stream_hz: float = 500.0
    stream_jitter_s: float = 2.0e-5
    stream_columns: str = "joints"
    lead_s: float = 0.5
    device_clock: bool = True
    robot_start_s: float = 1000.0
    mount_mm: float = 20.0
    mount_deg: float = 2.0
    exposure_samples: int = 5
    surroundings: bool = True
    disturbance: Disturbance = field(default_factory=Disturbance)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.frames < 1 or self.exposure_samples < 1:
            raise InputError("A motion dataset needs at least one frame and one sample of each exposure.")
        if not 20.0 <= self.stream_hz <= 2000.0:
            raise InputError("The stream's rate must be from 20 to 2000 Hz.")
        if self.stream_columns not in ("joints", "pose"):
            raise InputError("stream_columns must be 'joints' or 'pose'.")


@dataclass(frozen=True, eq=False)
class StreamedFrame:
    """A streamed frame: depth (H, W) m, and the truth behind it.

    The capture on the robot's clock and both poses then.
    """

    id: str
    depth: Depth
    capture_s: float
    X_BC: RigidTransform
    X_BF: RigidTransform


class MotionWorld:
    """The simulated cell. ``X_BC`` is the scanner's true pose before any disturbance."""

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
        self.path: RobotPath = path_through(
            self.arm,
            poses,
            reachable_start(self.arm, RigidTransform(up, centre)),
            move=o.move,
            speed=o.speed,
            acceleration=o.acceleration,
            dwell_s=o.stop_and_go,
        )
        bodies = [*arm_bodies(self.arm, self.flange), *(surroundings(centre) if o.surroundings else [])]
        self.scene = MovingScene(self.arm, bodies, self.scanner, self.timing)
        captures = self.timing.captures(o.frames, self._rng) + self.timing.exposure_s
        lost = self._rng.random(o.frames) < self.timing.loss
        self.captures = captures[~lost]
        self.arrivals = self.timing.arrivals(self.captures, self._rng)
        self.stamps = [self.timing.device_time(t + o.robot_start_s, self._rng) for t in self.captures]

    def joints(self, t: float) -> Array:
        """True joint angles (6,) rad at ``t`` s after the start."""
        return self.path.joints(t)

    def X_BC_at(self, t: float) -> RigidTransform:
        """Return the scanner's true pose in the robot's base at ``t`` s after the start."""
        return self.options.disturbance.scanner_pose(self.X_BC, t)

    def frames(self) -> Iterator[StreamedFrame]:
        """Every frame that arrives, rendered one after the other."""
        o = self.options
        for k, t in enumerate(self.captures):
            capture, rng = float(t), np.random.default_rng([o.seed, 17, k])
            device = o.disturbance.device(self.scanner, capture)
            # the robot's base moves with the robot: static bodies then move in the base, as the camera does
            depth = self.scene.frame(
                self.joints,
                self.X_BC_at(capture),
                capture,
                rng,
                samples=o.exposure_samples,
                scanner=device,
                X_BW=o.disturbance.world_in_base(capture),
            )
            yield StreamedFrame(
                f"{k:05d}",
                depth,
                o.robot_start_s + capture,
                self.X_BC_at(capture),
                forward_kinematics(self.arm, self.joints(capture)),
            )

    def stream(self) -> RobotStream:
        """Return the arm's state at its regular instants, rounded, with the jitter of its stamps."""
        o = self.options
        begin, end = float(self.captures[0]) - o.lead_s, float(self.arrivals[-1]) + o.lead_s
        times = np.arange(begin, end, 1.0 / o.stream_hz)
        exact_s = times + o.robot_start_s + o.stream_jitter_s * self._rng.standard_normal(len(times))
        stamped = np.maximum.accumulate(exact_s).round(6)
        exact = [self.joints(float(t)) for t in times]
        poses = np.array([forward_kinematics(self.arm, q).GetAsMatrix4() for q in exact])
        if o.stream_columns == "pose":
            poses[:, :3, 3] = poses[:, :3, 3].round(_POSE_DIGITS)
            return RobotStream(stamped, poses, None, o.robot)
        return RobotStream(stamped, poses, np.round(exact, _JOINT_DIGITS), o.robot)

    def frame_times(self) -> list[FrameTime]:
        """What frames.csv says of each frame: its arrival on the robot's clock, and the device's stamp."""
        o, stamps = self.options, self.stamps
        return [
            FrameTime(f"{k:05d}", round(o.robot_start_s + float(t), 6), round(stamps[k], 6) if o.device_clock else None)
            for k, t in enumerate(self.arrivals)
        ]

    def truth(self) -> dict[str, Any]:
        """What no estimator reads: pose, clock, and what happened when."""
        o = self.options
        t = self.captures + o.robot_start_s
        late = 1e3 * (self.arrivals - self.captures)
        offset = 1e3 * (t - np.asarray(self.stamps))
        return {
            "X_BC": self.X_BC.GetAsMatrix4().tolist(),
            "X_BC_nominal": self.X_BC_nominal.GetAsMatrix4().tolist(),
            "delay_ms": {
                "of_the_process": 1e3 * self.timing.delay_s,
                "mean": float(late.mean()),
                "sd": float(late.std()),
                "smallest": float(late.min()),
                "shortest_possible": 1e3 * self.timing.shortest_delay_s,
            },
            "device_clock": (
                None
                if not o.device_clock
                else {
                    "offset_ms_at_middle": float(np.interp(0.5 * (t[0] + t[-1]), t, offset)),
                    "offset_ms_mean": float(offset.mean()),
                    "drift_ppm": self.timing.device_drift_ppm,
                }
            ),
            "readout_ms": 1e3 * self.timing.readout_s,
            "exposure_ms": 1e3 * self.timing.exposure_s,
            "disturbance": o.disturbance.summary(o.robot_start_s),
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
        for k, frame in enumerate(world.frames()):
            progress("rendering", k / len(world.captures))
            stored = np.round(frame.depth / _DEPTH_STEP_M).astype(np.float32) * np.float32(_DEPTH_STEP_M)
            yield frame.id, depth_to_points(stored, *intrinsics)

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
