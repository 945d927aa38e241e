"""How near the live calibration comes to the truth with few scans, beside what its arm and scanner let any method reach."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.observation import Observation
from weldcal.calibration.rigid import skew
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import ArmModel, jacobian
from weldcal.systems.cell import make_cell, work_point
from weldcal.systems.drivers.simulated_ur import SimulatedUr
from weldcal.systems.scenario import Scenario, check_scenario, load_scenario
from weldcal.tools.outcome import calibration_error, calibration_status
from weldcal.tools.simulation import Progress, no_progress, run_cell

Array = NDArray[np.float64]

SCENARIO = "calibrate_only"
TARGET_M, TARGET_RAD = 6e-5, float(np.radians(0.01))


@dataclass(frozen=True)
class LiveRow:
    """One seed: scans used, error of a point at the work point (m) and of the rotation (rad), what the estimate expected of the
    former (rms), and the least that these poses, arm and scanner allow (rms, see `least`)."""

    seed: int
    scans: int
    at_work_m: float
    rotation_rad: float
    expected_m: float
    least_m: float
    least_rad: float


def live_scenario(repeatability_mm: float, scans: int) -> Scenario:
    """The calibration scenario with an arm that repeats no better, and exactly so many scans."""
    scenario = load_scenario(SCENARIO)
    assert isinstance(scenario.robot, SimulatedUr)
    scenario.robot.repeatability_mm = repeatability_mm
    scenario.calibration.minimum_scans = scenario.calibration.maximum_scans = scans
    check_scenario(scenario)
    return scenario


def study_live(
    seeds: int, *, first: int = 0, scans: int = 8, repeatability_mm: float = 0.05, progress: Progress = no_progress
) -> list[LiveRow]:
    """Calibrate live, through the whole Diagram, once for each seed. Raises InputError for numbers that no cell takes, and
    RuntimeError where a job was held."""
    rows = []
    for k in range(seeds):
        seed = first + k
        progress(f"calibration {k + 1} of {seeds}", k / seeds)
        scenario = live_scenario(repeatability_mm, scans)
        cell = make_cell(scenario, seed)
        with closing(cell.station):
            run = run_cell(cell)
        status, truth = calibration_status(cell, run.root), cell.station.truth.X_BC
        if status.estimate is None or truth is None or run.held:
            raise RuntimeError(f"The calibration of seed {seed} came to no end: {run.reason}")
        work = work_point(scenario)
        error = calibration_error(status.estimate.X_BC, truth, work)
        least = bound(
            status.observations, cell.station.arm, np.deg2rad(scenario.home_deg), 1e-3 * repeatability_mm, work
        )
        rows.append(
            LiveRow(
                seed, len(status.observations), error.at_work_m, error.rotation_rad, status.predicted_error_m, *least
            )
        )
    return rows


def bound(
    observations: tuple[Observation, ...], arm: ArmModel, q_home: Array, repeatability_m: float, p_BWork: Array
) -> tuple[float, float]:
    """Cramer-Rao: the least rms error of a point at the work point (m) and of the rotation (rad, about all axes) that any unbiased
    calibration from these sightings of a bare flange can have.

    The arm's error is six independent joint offsets that displace the flange by ``repeatability_m`` (rms); the scanner's is what
    each fit states of itself. Centre and normal of a pose err together, as one offset of the joints moves both.
    """
    pivot = np.mean([o.p_BR for o in observations], axis=0)
    information = np.zeros((6, 6))
    for o in observations:
        solutions = inverse_kinematics(arm, o.X_BR)
        q = min(solutions, key=lambda s: float(np.abs((s - q_home + np.pi) % (2.0 * np.pi) - np.pi).sum()))
        J = jacobian(arm, q)
        R, z = o.X_BR.rotation().matrix(), o.n_B
        across = R[:, :2].T  # the two directions in which a normal can lean
        H = np.zeros((5, 6))
        H[:3, 3:], H[3:, :3] = np.eye(3), -across @ skew(z)
        sigma_q = repeatability_m / float(np.linalg.norm(J[3:]))
        noise = sigma_q**2 * H @ J @ J.T @ H.T
        noise[:3, :3] += np.zeros((3, 3)) if o.center_covariance is None else _in_base(o)
        noise[3:, 3:] += (o.normal_sigma or 0.0) ** 2 * np.eye(2)
        A = np.zeros((5, 6))
        A[:3, :3], A[:3, 3:], A[3:, :3] = -skew(o.p_BR - pivot), np.eye(3), -across @ skew(z)
        information += A.T @ np.linalg.solve(noise, A)
    covariance = np.linalg.inv(information)
    at_work = np.hstack([-skew(np.asarray(p_BWork) - pivot), np.eye(3)])
    return float(np.sqrt(np.trace(at_work @ covariance @ at_work.T))), float(np.sqrt(np.trace(covariance[:3, :3])))


def _in_base(o: Observation) -> Array:
    """The fit's covariance (3, 3) m^2: along the face's normal and across, whatever way the camera is turned."""
    assert o.center_covariance is not None
    n = np.asarray(o.n_C) if o.n_C is not None else np.array([0.0, 0.0, -1.0])
    along = float(n @ o.center_covariance @ n)
    across = 0.5 * (float(np.trace(o.center_covariance)) - along)
    return np.asarray(across * np.eye(3) + (along - across) * np.outer(o.n_B, o.n_B))
