"""What does not change during a run and the dashboard shows: names, limits, the steps of the job."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from weldcal.calibration.planning.calibration_poses import PlannerConfig, predicted_sigma
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.cell import Cell
from weldcal.systems.jobs.job import job_of
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.settings import work_point
from weldcal.systems.messages import CalibrationStatus
from weldcal.systems.phase_words import (
    MOTION_STEPS,
    MOUNTING_STEPS,
    PROFILER_STEPS,
    STEPS,
    TABLET_STEPS,
    TOOL_SCAN_STEPS,
    TOUCH_STEPS,
    WATCH_STEPS,
)
from weldcal.welding.servo.guards import ArmGuardConfig

if TYPE_CHECKING:
    from weldcal.systems.jobs.touch.procedure import Felt

SCAN = "scan"
# About how long steps take at speed_factor 1, s; of these the moves take longer at a lower one.
_SCAN_S, _MOVES_S, _TOUCH_S, _WHOLE_SEAM_MM = 3.0, {"Park": 3.0, "Approach": 5.0, "Go home": 6.0}, 6.0, 300.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Facts:
    """Facts of a run: name and phases of each step (`steps`); lengths in mm, NaN or None where the job has none.

    `band_mm`: least and largest deflection of the tip with which the seam is followed. `gain` computes the expected
    error after the next pose from the present status. `settable_pace`: a simulation, whose pace may be chosen.
    `seconds`: about how long each step takes, and SCAN, the scan of a pose with the way to it; empty: the time left
    follows from the completed share of the run. `work_B` (3,) m: where the calibration's error is shown. `press_mm`:
    deflection of the tip at which it has touched. `height` computes how far (m) a touched face lies above the scanned
    one.
    """

    title: str = ""
    robot: str = "simulated"
    settable_pace: bool = True
    steps: tuple[tuple[str, tuple[str, ...]], ...] = ()
    required_mm: float = math.nan
    maximum_scans: int = 0
    minimum_scans: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    weld_speed_mm_s: float = math.nan
    wanted_deflection_mm: float = math.nan
    band_mm: tuple[float, float] | None = None
    sigma_slow: float = ArmGuardConfig().sigma_slow
    sigma_stop: float = ArmGuardConfig().sigma_stop
    gain: Callable[[CalibrationStatus, int], float] | None = field(default=None, repr=False)
    work_B: Array | None = field(default=None, repr=False)
    press_mm: float = math.nan
    height: Callable[[Felt], float] | None = field(default=None, repr=False)


def facts_of(cell: Cell[Any], title: str, robot: str) -> Facts:
    """Return the facts of a cell that was built and has not run yet."""
    settable = cell.station.robot.clock is None
    job, scenario = cell.job, cell.scenario
    if not isinstance(job, WeldJob):
        return _other_facts(cell, title, robot, settable)
    wanted = {"calibrate": scenario.job.calibrate, "weld": scenario.job.weld}
    steps = tuple((name, phases) for name, needs, phases in STEPS if needs is None or wanted[needs])
    c, servo = scenario.calibration, job.servo_config
    slower = 1.0 / scenario.job.speed_factor
    seam_mm = (scenario.welding.seam_length_mm or _WHOLE_SEAM_MM) + 1e3 * servo.tool.torch_offset_m
    seconds = {SCAN: _SCAN_S * slower, "Verify": c.verification_scans * _SCAN_S * slower, "Scan the part": 2.0}
    seconds |= {name: s * slower for name, s in _MOVES_S.items()}
    seconds["Weld"] = _TOUCH_S + seam_mm / (1e3 * servo.weld_speed_m_s)
    return Facts(
        title=title,
        robot=robot,
        settable_pace=settable,
        steps=steps,
        required_mm=c.required_error_mm if scenario.job.calibrate else math.nan,
        maximum_scans=c.maximum_scans,
        minimum_scans=c.minimum_scans,
        seconds=seconds,
        weld_speed_mm_s=1e3 * servo.weld_speed_m_s,
        wanted_deflection_mm=1e3 * servo.deflection.delta_d_m,
        band_mm=(1e3 * servo.contact.normal_min_m, 1e3 * servo.faults.lateral_m),
        gain=_gain_of(job),
        work_B=work_point(scenario),
    )


def _other_facts(cell: Cell[Any], title: str, robot: str, settable: bool) -> Facts:
    """Steps and limits of the jobs besides the weld; a job of another package has none."""
    job, c = cell.job, cell.scenario.calibration
    facts = partial(Facts, title=title, robot=robot, settable_pace=settable)
    match job_of(cell.scenario).key:
        case "mounting":
            return facts(
                steps=MOUNTING_STEPS,
                required_mm=c.required_error_mm,
                maximum_scans=c.maximum_scans,
                minimum_scans=c.minimum_scans,
            )
        case "motion":
            return facts(steps=MOTION_STEPS if job.monitor is None else WATCH_STEPS, maximum_scans=job.frames)
        case "tablet":
            return facts(steps=TABLET_STEPS, maximum_scans=len(job.plan.q_above))
        case "touch":
            press_mm = cell.scenario.touch.press_mm  # type: ignore[attr-defined]
            return facts(steps=TOUCH_STEPS, maximum_scans=job.points, press_mm=press_mm, height=job.height_m)
        case "tool_scan":
            return facts(steps=TOOL_SCAN_STEPS, maximum_scans=len(job.views))
        case "profiler_job":
            from weldcal.systems.jobs.profiler.procedure import PLANS

            keys = ["start", *(step for stage in job.job.stages for step in PLANS[stage]), "home"]
            return facts(steps=tuple((PROFILER_STEPS[key], (key,)) for key in keys))
    return facts()


def _gain_of(job: WeldJob) -> Callable[[CalibrationStatus, int], float]:
    """Make a function of the expected error m at the work point after one more planned pose; NaN: unknown."""
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
