"""What does not change during a run and the dashboard shows: names, limits, the steps of the job."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from weldcal.calibration.planning.calibration_poses import PlannerConfig, predicted_sigma
from weldcal.models.errors import WeldcalError
from weldcal.systems.cell import Cell
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.settings import work_point
from weldcal.systems.messages import CalibrationStatus
from weldcal.systems.viewer.phase_labels import STEPS
from weldcal.welding.servo.guards import ArmGuardConfig


@dataclass(frozen=True, eq=False)
class Facts:
    """Of a run: `steps`: name and phases of each step that the job will make; lengths in mm, NaN or None where the job has none.

    `band_mm`: least and largest deflection of the tip with which the seam is followed. `gain` computes the expected error after
    the next pose from the present status. `settable_pace`: a simulation, whose pace may be chosen.
    """

    title: str = ""
    robot: str = "simulated"
    settable_pace: bool = True
    steps: tuple[tuple[str, tuple[str, ...]], ...] = ()
    required_mm: float = math.nan
    maximum_scans: int = 0
    weld_speed_mm_s: float = math.nan
    wanted_deflection_mm: float = math.nan
    band_mm: tuple[float, float] | None = None
    sigma_slow: float = ArmGuardConfig().sigma_slow
    sigma_stop: float = ArmGuardConfig().sigma_stop
    gain: Callable[[CalibrationStatus, int], float] | None = field(default=None, repr=False)


def facts_of(cell: Cell[Any], title: str, robot: str) -> Facts:
    """The facts of a cell that was built and has not run yet."""
    settable = cell.station.robot.clock is None
    job, scenario = cell.job, cell.scenario
    if not isinstance(job, WeldJob):
        return Facts(title, robot, settable)
    wanted = {"calibrate": scenario.job.calibrate, "weld": scenario.job.weld}
    steps = tuple((name, phases) for name, needs, phases in STEPS if needs is None or wanted[needs])
    c, servo = scenario.calibration, job.servo_config
    return Facts(
        title,
        robot,
        settable,
        steps,
        c.required_error_mm if scenario.job.calibrate else math.nan,
        c.maximum_scans,
        1e3 * servo.weld_speed_m_s,
        1e3 * servo.deflection.delta_d_m,
        (1e3 * servo.contact.normal_min_m, 1e3 * servo.faults.lateral_m),
        gain=_gain_of(job),
    )


def _gain_of(job: WeldJob) -> Callable[[CalibrationStatus, int], float]:
    """A function that computes the expected error m at the work point after one more planned pose; NaN where it cannot."""
    x, y, z = (float(v) for v in work_point(job.scenario))
    config = PlannerConfig(work_point_B=(x, y, z))

    def gain(status: CalibrationStatus, index: int) -> float:
        if status.estimate is None or index >= len(job.poses):
            return math.nan
        seen = [o.X_BR for o in status.observations]
        try:
            before = predicted_sigma(seen, status.estimate.X_BC, config)
            after = predicted_sigma([*seen, job.poses[index].X_BR], status.estimate.X_BC, config)
        except (WeldcalError, np.linalg.LinAlgError):
            return math.nan
        return status.predicted_error_m * after / before if np.isfinite(before) and before > 0.0 else math.nan

    return gain
