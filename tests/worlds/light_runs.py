"""Calibrations with an imperfect scanner and arm, without rendering; from known poses, with noise drawn anew."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from pydrake.math import RigidTransform
from scipy.stats import binom, chi2

from tests.worlds.cell import scanned
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance, sigma_at
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.calibration.planning.mounting_estimate import ObservedCircle
from weldcal.calibration.planning.mounting_poses import MountingPose
from weldcal.calibration.planning.mounting_scene import MountingScene
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, jacobian, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.scanners import ScannerPreset
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner, random_pose_error
from weldcal.systems.drivers.simulated.second_arm import place_second_arm
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.jobs.mounting.config import MountingJob
from weldcal.systems.jobs.mounting.job import mounting_scene, plan_mounting
from weldcal.systems.jobs.weld.settings import feature_on_flange, plan_poses, work_point
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import make_station
from weldcal.tools.report.weld import calibration_error, true_work_point

LEVEL = 0.95
_CENTRE_M, _NORMAL_RAD = 2e-5, 1e-4  # noise of a fit, an axis, as fits of rendered PhoXi M scans state it
_FACE_M = 0.025  # a fitted normal is that of a plane through a ring of this radius


@dataclass(frozen=True, eq=False)
class LightRuns:
    """Calibrations (k).

    Scans that each took, error and expected error (m) at the work point, and whether the error lies in the stated 95 %
    region. ``rigid_m`` are the errors of the same scans without a scanner correction.
    """

    scans: Array
    error_m: Array
    expected_m: Array
    inside: Array
    rigid_m: Array

    @property
    def share_inside(self) -> float:
        """Share of the calibrations whose error lies in the stated region."""
        return float(np.mean(self.inside))

    def chance(self) -> tuple[float, float]:
        """Shares between which 95 % of such studies fall where the region is exact."""
        n = len(self.inside)
        low, high = (binom.ppf(q, n, LEVEL) / n for q in (0.025, 0.975))
        return float(low), float(high)


@dataclass(frozen=True, eq=False)
class _World:
    """One draw: the arm as it reports and as it is, the device, and its true pose."""

    arm: ArmModel
    true_arm: ArmModel
    device: ScannerPreset
    X_BC: RigidTransform
    repeatability_m: float
    X_FR: RigidTransform


def study_light_runs(scenario: Scenario, runs: int, *, seed: int = 0, progress: Progress = no_progress) -> LightRuns:
    """Calibrate ``runs`` times in the scenario's simulated world.

    Each time with a device, an arm and a mounting of its own.

    The job's own poses and stopping rule; the rendering and the flange fit are replaced by their stated noise. The
    arm's links and the scanner's warp are drawn from models that the estimator does not contain. Deterministic for
    ``seed``.

    Raises InputError for a scenario without a simulated arm and a rendered scanner in the base.
    """
    _simulated(scenario)
    station = make_station(scenario, seed)
    poses = [p.q for p in plan_poses(scenario, station, seed)]
    station.close()
    home, work = np.deg2rad(scenario.home_deg), work_point(scenario)
    X_FT = None if station.tool is None else station.tool.X_FT
    limits, rows = scenario.calibration, []
    for k in range(runs):
        progress("light calibrations", k / runs)
        rng = np.random.default_rng([seed, k])
        world = _draw(scenario, station.arm, feature_on_flange(scenario, station), rng)
        observed = [_observe(world, q, f"p{i}", rng) for i, q in enumerate(poses[: limits.maximum_scans])]
        n, estimate = _calibrate(observed, scenario, work)
        p_true = true_work_point(world.arm, world.true_arm, X_FT, work, home, poses[:n])
        p_C = world.device.measured(world.X_BC.inverse().multiply(p_true))
        error = _landed(estimate, p_C) - work
        S = point_error_covariance(estimate, work)
        inside = float(error @ np.linalg.solve(S, error)) < chi2.ppf(LEVEL, 3)
        rigid = _rigid(observed[:n], p_C) - work
        rows.append((n, np.linalg.norm(error), np.sqrt(np.trace(S)), inside, np.linalg.norm(rigid)))
    columns = np.array(rows, dtype=float).T
    return LightRuns(columns[0], columns[1], columns[2], columns[3].astype(bool), columns[4])


def _simulated(scenario: Scenario) -> tuple[SimulatedUr, RenderedScanner]:
    """Return the scenario's arm and scanner.

    Raises InputError where they are not simulated, or the scanner moves with the arm.
    """
    robot, scanner = scenario.robot, scenario.scanner_config()
    if not isinstance(robot, SimulatedUr) or not isinstance(scanner, RenderedScanner) or scanner.mounted_on != "base":
        raise InputError(
            "This study needs a simulated arm and a scanner that is fixed in the base frame. Give a scenario with"
            " robot:"
            " !SimulatedUr and scanner: !RenderedScanner, such as s_groove."
        )
    return robot, scanner


def _draw(scenario: Scenario, arm: ArmModel, X_FR: RigidTransform, rng: np.random.Generator) -> _World:
    robot, scanner = _simulated(scenario)
    nominal = scenario.calibration.mounting_guess.pose()
    error = random_pose_error(rng, 1e-3 * scanner.mounting_translation_mm, np.deg2rad(scanner.mounting_rotation_deg))
    X_BC = RigidTransform(nominal.rotation() @ error.rotation(), nominal.translation() + error.translation())
    true_arm = robot.true_arm(arm, np.deg2rad(scenario.home_deg), rng)
    return _World(arm, true_arm, scanner.device(rng), X_BC, 1e-3 * robot.repeatability_mm, X_FR)


def _observe(world: _World, q: Array, id: str, rng: np.random.Generator) -> Observation:
    """Return the observation at reported joints q (6,) rad."""
    sigma = world.repeatability_m / float(np.linalg.norm(jacobian(world.arm, q)[3:]))
    X_CR = world.X_BC.inverse() @ forward_kinematics(world.true_arm, q + sigma * rng.standard_normal(6)) @ world.X_FR
    p, n, _ = scanned(world.device.measured, X_CR, _FACE_M, rng, _CENTRE_M, _NORMAL_RAD)
    X_BR = forward_kinematics(world.arm, q) @ world.X_FR
    return Observation(id, X_BR, p, n, _CENTRE_M**2 * np.eye(3), _NORMAL_RAD)


def _calibrate(observed: Sequence[Observation], scenario: Scenario, work: Array) -> tuple[int, CalibrationEstimate]:
    """Calibrate as the job does: from the least number of scans on, until the expected error is small enough."""
    limits = scenario.calibration
    for n in range(limits.minimum_scans, len(observed) + 1):
        estimate, _ = estimate_jointly(observed[:n])
        if sigma_at(estimate, work) <= 1e-3 * limits.required_error_mm:
            break
    return n, estimate


def _landed(estimate: CalibrationEstimate, p_C: Array) -> Array:
    """Where the estimate puts a measured point (3,) m in B."""
    return np.asarray(estimate.X_BC.multiply(p_C if estimate.correction is None else estimate.correction.points(p_C)))


def _rigid(observed: Sequence[Observation], p_C: Array) -> Array:
    return np.asarray(estimate_eye_on_base(list(observed), SolveConfig(leave_one_out=False)).X_BC.multiply(p_C))


@dataclass(frozen=True, eq=False)
class MountedWorld:
    """A scene as known before the first scan, as it is, the device, and the scans (n) at the planned poses."""

    scene: MountingScene
    true: MountingScene
    device: ScannerPreset
    seen: tuple[ObservedCircle, ...]

    @property
    def truth(self) -> dict[str, RigidTransform]:
        """The true poses by the letters of the mounting's unknowns."""
        found = {"X": self.true.X_LC} | ({} if self.true.X_BD is None else {"Y": self.true.X_BD})
        return found if self.scene.target_known else found | {"Z" if self.scene.two else "Y": self.true.X_HR}


@cache
def mounted_plan(name: str) -> tuple[Scenario, MountingScene, float, tuple[MountingPose, ...]]:
    """Return a mounting's scenario by name, its scene, the radius of its circle's face (m), and the planned poses."""
    scenario = load_scenario(name)
    _, scene, circle = mounting_scene(scenario, load_arm(scenario.arm))
    return scenario, scene, 0.9 * circle.standard.outer_radius_m, plan_mounting(scenario, scene, 0)


def mounted_world(name: str, seed: int, scans: int | None = None) -> MountedWorld:
    """Draw a cell of a mounting's scenario: device, arms and mounting of its own.

    ``scans``: how many; None: the scenario's maximum.

    The arm's links, its stops and the scanner's warp are drawn from the simulation's models; a fit of the circle errs
    by its noise.
    """
    scenario, scene, radius, plan = mounted_plan(name)
    rng = np.random.default_rng([seed, 1])
    scanner, job = scenario.scanner_config(), scenario.part(MountingJob)
    assert isinstance(scanner, RenderedScanner)
    assert job is not None
    off = random_pose_error(rng, 1e-3 * scanner.mounting_translation_mm, np.deg2rad(scanner.mounting_rotation_deg))
    X_LC = RigidTransform(scene.X_LC.rotation() @ off.rotation(), scene.X_LC.translation() + off.translation())
    device = scanner.device(rng)
    true = replace(scene, X_LC=X_LC, arm=scenario.robot.true_arm(scene.arm, scene.q_home, rng))
    if job.second_arm is not None and scene.arm_2 is not None and scene.q_home_2 is not None:
        second = job.second_arm
        off = random_pose_error(rng, 1e-3 * second.placement_translation_mm, np.deg2rad(second.placement_rotation_deg))
        arm_2 = scenario.robot_2.true_arm(scene.arm_2, scene.q_home_2, rng)
        true = replace(true, X_BD=place_second_arm(second, off).X_BD, arm_2=arm_2)

    def stop(robot: object, arm: ArmModel | None, q: Array | None) -> Array | None:
        if q is None or arm is None or not isinstance(robot, SimulatedUr):
            return q
        sigma = 1e-3 * robot.repeatability_mm / float(np.linalg.norm(jacobian(arm, q)[3:]))
        return np.asarray(q + sigma * rng.standard_normal(6))

    seen = []
    for k, pose in enumerate(plan[: scans or scenario.calibration.maximum_scans]):
        q = stop(scenario.robot, scene.arm, pose.q)
        assert q is not None
        X_CR = true.seen(q, stop(scenario.robot_2, scene.arm_2, pose.q_2))
        p, n, _ = scanned(device.measured, X_CR, radius, rng, _CENTRE_M, _NORMAL_RAD)
        C = np.diag([_NORMAL_RAD**2] * 3 + [_CENTRE_M**2] * 3)
        seen.append(ObservedCircle(f"pose{k + 1:02d}", pose, scene.observation(pose.q, pose.q_2, p, n, C), 1.0))
    return MountedWorld(scene, true, device, tuple(seen))


@dataclass(frozen=True, eq=False)
class RedrawnStation:
    """What made the observations.

    Arm (its joints (n, 6) rad at each of them), how well the flange repeats (m, rms), the true X_BC, and the work point
    (3,) m in B.
    """

    arm: ArmModel
    joints: Array
    repeatability_m: float
    X_BC: RigidTransform
    p_BWork: Array


@dataclass(frozen=True, eq=False)
class Redrawn:
    """Errors (k,) of a point at the work point (m) and of the rotation (rad).

    Of calibrations whose noise was drawn anew, and of as many draws from the Gaussian that the Cramer-Rao bound allows.
    """

    at_work_m: Array
    rotation_rad: Array
    bound_at_work_m: Array
    bound_rotation_rad: Array

    def within(self, at_work_m: float, rotation_rad: float) -> tuple[float, float]:
        """Share of the calibrations, and of those at the bound, within both."""
        ours = (self.at_work_m <= at_work_m) & (self.rotation_rad <= rotation_rad)
        least = (self.bound_at_work_m <= at_work_m) & (self.bound_rotation_rad <= rotation_rad)
        return float(np.mean(ours)), float(np.mean(least))


def joints_of(observations: tuple[Observation, ...], arm: ArmModel, q_home: Array) -> Array:
    """Return joints (n, 6) rad at which a bare flange is where each observation says.

    The solution nearest to ``q_home``.
    """
    out = []
    for o in observations:
        solutions = inverse_kinematics(arm, o.X_BR)
        out.append(min(solutions, key=lambda s: float(np.abs((s - q_home + np.pi) % (2.0 * np.pi) - np.pi).sum())))
    return np.array(out)


def redraw(observations: tuple[Observation, ...], station: RedrawnStation, count: int, seed: int = 0) -> Redrawn:
    """``count`` calibrations from the poses of these observations, each with noise of its own.

    Joint offsets that displace the flange by the repeatability, and fits that err as they state. Deterministic for
    ``seed``.
    """
    rng = np.random.default_rng(seed)
    errors = np.empty((2, count))
    for k in range(count):
        drawn = [_redrawn(o, q, station, rng) for o, q in zip(observations, station.joints, strict=True)]
        estimate = estimate_eye_on_base(drawn, SolveConfig(leave_one_out=False))
        e = calibration_error(estimate.X_BC, station.X_BC, station.p_BWork)
        errors[:, k] = e.at_work_m, e.rotation_rad
    drawn_least = rng.multivariate_normal(np.zeros(6), bound_covariance(observations, station), size=count)
    turn, shift = np.linalg.norm(drawn_least[:, :3], axis=1), np.linalg.norm(drawn_least[:, 3:], axis=1)
    return Redrawn(errors[0], errors[1], shift, turn)


def joined(parts: list[Redrawn]) -> Redrawn:
    """Return all of them together."""
    names = ("at_work_m", "rotation_rad", "bound_at_work_m", "bound_rotation_rad")
    return Redrawn(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def bound_covariance(observations: tuple[Observation, ...], station: RedrawnStation) -> Array:
    """Compute the Cramer-Rao bound of a calibration from these observations of a bare flange.

    The least covariance (6, 6) [rotation rad; displacement of the work point m] that an unbiased calibration can have.

    The arm's error is six independent joint offsets that displace the flange by the repeatability (rms); the scanner's
    is what each fit states of itself. Centre and normal of a pose err together, as one offset of the joints moves both.
    """
    information = np.zeros((6, 6))
    for o, q in zip(observations, station.joints, strict=True):
        J = jacobian(station.arm, q)
        R, z = o.X_BR.rotation().matrix(), o.n_B
        across = R[:, :2].T  # the two directions in which a normal can lean
        H = np.zeros((5, 6))
        H[:3, 3:], H[3:, :3] = np.eye(3), -across @ skew(z)
        noise = _joint_sigma(station, J) ** 2 * H @ J @ J.T @ H.T
        noise[:3, :3] += np.zeros((3, 3)) if o.center_covariance is None else _in_base(o)
        noise[3:, 3:] += (o.normal_sigma or 0.0) ** 2 * np.eye(2)
        A = np.zeros((5, 6))
        A[:3, :3], A[:3, 3:], A[3:, :3] = -skew(o.p_BR - station.p_BWork), np.eye(3), -across @ skew(z)
        information += A.T @ np.linalg.solve(noise, A)
    return np.asarray(np.linalg.inv(information))


def _joint_sigma(station: RedrawnStation, J: Array) -> float:
    """Standard deviation (rad) of each joint's offset, as the simulated arm draws it."""
    return station.repeatability_m / float(np.linalg.norm(J[3:]))


def _redrawn(o: Observation, q: Array, station: RedrawnStation, rng: np.random.Generator) -> Observation:
    """Return the observation with noise of its own; the robot's reported pose stays."""
    offset = _joint_sigma(station, jacobian(station.arm, q)) * rng.standard_normal(6)
    X_CR = station.X_BC.inverse() @ forward_kinematics(station.arm, q + offset)
    z = X_CR.rotation().matrix()[:, 2]
    p, n = np.asarray(X_CR.translation()), z
    if o.center_covariance is not None:
        p = p + rng.multivariate_normal(np.zeros(3), o.center_covariance)
    if o.normal_sigma is not None:
        lean = o.normal_sigma * rng.standard_normal(3)
        n = exp_rotation(lean - z * float(z @ lean)) @ z
    return replace(o, p_CR=p, n_C=None if o.n_C is None else n)


def _in_base(o: Observation) -> Array:
    """Return the fit's covariance (3, 3) m^2: along the face's normal and across, for any orientation of the camera."""
    assert o.center_covariance is not None
    n = np.asarray(o.n_C) if o.n_C is not None else np.array([0.0, 0.0, -1.0])
    along = float(n @ o.center_covariance @ n)
    across = 0.5 * (float(np.trace(o.center_covariance)) - along)
    return np.asarray(across * np.eye(3) + (along - across) * np.outer(o.n_B, o.n_B))
