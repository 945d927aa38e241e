"""The pictures of one simulated weld: who went where (the paper's Fig. 13), and how it went along the seam."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from weldcal.tools.report.plots_demo import OURS, PLANNED, ROBOT, TORCH, TRUTH, svg
from weldcal.tools.studies.plant import PHASES, StudyRun
from weldcal.welding.process import path_error
from weldcal.welding.servo_state import Phase

_EVERY = 4  # ticks per plotted point: 0.26 mm at 8 mm/s


def paths(run: StudyRun) -> bytes:
    """Planned seam, tip, torch and robot from above, and the torch's and the plan's offset from the true line."""
    phase = run.column("phase").astype(int)
    moving = phase != PHASES.index(Phase.TOUCH)
    felt = (phase == PHASES.index(Phase.TRACK)) & moving
    torch, robot, tip = (run.points(n) for n in ("torch", "robot", "tip"))
    plan = run.planned.position(np.linspace(0.0, run.planned.length, 400))
    true = run.torch_line.position(np.linspace(0.0, run.torch_line.length, 400))
    reach = np.ptp(np.vstack([robot[moving], torch[moving]]), axis=0)
    height = float(np.clip(6.4 * reach[1] / max(reach[0], 1e-6) + 1.2, 2.0, 6.0))
    picture = Figure(figsize=(7.2, height + 2.2), layout="constrained")
    above, error = picture.subplots(2, 1, height_ratios=[height, 2.0])
    above.plot(1e3 * plan[:, 0], 1e3 * plan[:, 1], color=PLANNED, lw=3.0, label="planned")
    above.plot(1e3 * true[:, 0], 1e3 * true[:, 1], color="black", lw=1.0, ls="--", label="true seam")
    above.plot(*(1e3 * robot[moving][::_EVERY, :2]).T, color=ROBOT, lw=1.0, label="robot (rest point of the tip)")
    above.plot(*(1e3 * tip[felt][::_EVERY, :2]).T, color=OURS, lw=1.0, label="tip")
    above.plot(*(1e3 * torch[moving][::_EVERY, :2]).T, color=TORCH, lw=1.6, label="torch")
    above.set_aspect("equal")
    above.set(xlabel="x, mm", ylabel="y, mm")
    off = path_error(torch[moving][::_EVERY], run.torch_line)
    plan_off = path_error(plan, run.torch_line)
    on = (off.s >= 0.0) & (off.s <= run.torch_line.length)
    error.plot(1e3 * plan_off.s, 1e3 * plan_off.lateral, color=PLANNED, lw=3.0, label="plan")
    error.plot(1e3 * off.s[on], 1e3 * off.lateral[on], color=TORCH, lw=1.2, label="torch")
    error.set(xlabel="true seam, mm", ylabel="off the seam, mm")
    for axes in (above, error):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    picture.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=8)
    return svg(picture)


def along_the_weld(run: StudyRun, weld_speed_m_s: float) -> bytes:
    """Deformation of the tip, torch speed in its +-25 % band, turning rate and n_d . n_t, over the torch's arc length."""
    phase = run.column("phase").astype(int)
    moving = (phase != PHASES.index(Phase.TOUCH)) & np.isfinite(run.column("n_d_dot_n_t"))
    s = 1e3 * path_error(run.points("torch")[moving][::_EVERY], run.torch_line).s
    picture = Figure(figsize=(7.2, 7.6), layout="constrained")
    deformation, speed, omega, measure = picture.subplots(4, 1, sharex=True)
    for name, colour, label in (("delta_n_m", OURS, "normal"), ("delta_axial_m", ROBOT, "axial")):
        deformation.plot(s, 1e3 * run.column(name)[moving][::_EVERY], color=colour, lw=1.0, label=label)
    deformation.legend(frameon=False, fontsize=8, ncols=2)
    deformation.set_ylabel("deformation, mm")
    time, p = run.column("time_s")[moving], run.points("torch")[moving]
    even = np.arange(time[0], time[-1], 0.05)
    q = np.column_stack([np.interp(even, time, p[:, k]) for k in range(3)])
    middle = 0.5 * (even[1:] + even[:-1])
    band = 1e3 * weld_speed_m_s
    speed.axhspan(0.75 * band, 1.25 * band, color=TORCH, alpha=0.10)
    v = 1e3 * np.linalg.norm(np.diff(q, axis=0), axis=1) / 0.05
    speed.plot(np.interp(middle, time[::_EVERY], s), v, color=TORCH, lw=1.2)
    speed.set_ylim(0.0, max(2.0 * band, 1.05 * float(v.max(initial=0.0))))
    speed.set_ylabel("torch speed, mm/s")
    omega.plot(s, run.column("omega_rad_s")[moving][::_EVERY], color=OURS, lw=1.0)
    omega.axhline(0.8, color="black", lw=0.6, ls=":")
    omega.axhline(-0.8, color="black", lw=0.6, ls=":")
    omega.set_ylabel("turning rate, rad/s")
    measure.plot(s, run.column("n_d_dot_n_t")[moving][::_EVERY], color=TRUTH, lw=1.0)
    measure.axhline(0.0, color="black", lw=0.8, ls=":")
    measure.set(xlabel="torch along the true seam, mm (negative: before it)", ylabel="n_d · n_t")
    for axes in (deformation, speed, omega, measure):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    return svg(picture)
