"""Converts a simulated weld to the trace that the weld pictures take."""

import math

import numpy as np

from weldcal.tools.report.plots_weld import WeldTrace
from weldcal.tools.worlds.weld.plant import PHASES, StudyRun
from weldcal.welding.record.process import path_error, speed_along
from weldcal.welding.seam.chord_map import chord_map
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase

_EVERY = 4  # ticks per plotted point: 0.26 mm at 8 mm/s
_BENT_RAD = math.radians(1.0)  # a surface whose normal turns by less is flat


def weld_trace(run: StudyRun, config: ServoConfig) -> WeldTrace:
    """The run for the pictures, over the true seam; angles only where the surface bends."""
    phase = run.column("phase").astype(int)
    moving = np.flatnonzero((phase != PHASES.index(Phase.TOUCH)) & np.isfinite(run.column("n_d_dot_n_t")))
    keep = moving[::_EVERY]
    torch, line = run.points("torch"), run.torch_line
    off = path_error(torch[keep], line)
    on = (off.s >= 0.0) & (off.s <= line.length)
    plan = run.planned.position(np.linspace(0.0, run.planned.length, 400))
    plan_off = path_error(plan, line)
    work = travel = predicted = None
    up = line.up(np.clip(off.s, 0.0, line.length))
    if float(np.min(up @ up[0], initial=1.0)) < math.cos(_BENT_RAD):
        seen = on & (off.s <= line.length - config.tool.torch_offset_m)
        lean, pitch = run.angles(keep, up)
        chart = chord_map(
            line, config.tool.torch_offset_m, config.weld_speed_m_s, spacing=1e-3, tip_left=config.deflection.delta_d_m
        )
        work, travel = (np.where(seen, angle, np.nan) for angle in (lean, pitch))
        predicted = np.where(seen, chart.travel_at(off.s), np.nan)
    speed = speed_along(run.column("time_s")[moving], torch[moving])[::_EVERY]
    return WeldTrace(
        s=off.s,
        torch_on=run.column("torch_on")[keep] > 0.5,
        felt=phase[keep] == PHASES.index(Phase.TRACK),
        tip=run.points("tip")[keep],
        torch=torch[keep],
        robot=run.points("robot")[keep],
        planned=np.asarray(plan),
        true=np.asarray(line.position(np.linspace(0.0, line.length, 400))),
        plan_error=(plan_off.s, plan_off.lateral, plan_off.height),
        torch_error=(off.s[on], off.lateral[on], off.height[on]),
        delta_n=run.column("delta_n_m")[keep],
        delta_axial=run.column("delta_axial_m")[keep],
        speed=speed,
        omega=run.column("omega_rad_s")[keep],
        n_d_dot_n_t=run.column("n_d_dot_n_t")[keep],
        weld_speed=config.weld_speed_m_s,
        delta_d=config.deflection.delta_d_m,
        axial_d=config.deflection.axial_d_m,
        omega_max=config.limits.omega_max_rad_s,
        work=work,
        travel=travel,
        predicted=predicted,
        windows=(config.windows.work_rad, config.windows.travel_rad),
    )
