"""The pictures of a run: how the calibration converged, and its weld in the form that the weld's pictures take."""

import numpy as np
from matplotlib.figure import Figure

from weldcal.models.arrays import Array
from weldcal.systems.messages import CalibrationStatus
from weldcal.tools.outcomes.weld import WeldOutcome
from weldcal.tools.report.pictures import OURS, ROBOT, THEIRS, TRUTH, millimetres, plain, svg
from weldcal.tools.report.plots_weld import WeldTrace
from weldcal.welding.record.process import path_error, speed_along, torch_angles
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase


def convergence(status: CalibrationStatus, required_m: float) -> bytes:
    """Expected and held-out error of the estimate in use and Algorithm 1's own figure, against the scans taken (Fig. 11)."""
    n, expected, held_out, figure = (np.array(c, dtype=float) for c in zip(*status.history, strict=True))
    picture = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = picture.subplots()
    axes.semilogy(n, 1e3 * expected, "o-", color=OURS, label="expected at the work point (one sigma, 3-D)")
    axes.semilogy(n, 1e3 * held_out, "s--", color=ROBOT, label="held out, at the ring (median)")
    if np.isfinite(figure).any():
        axes.semilogy(n, 1e3 * figure, "^:", color=THEIRS, label="Algorithm 1: its own ICP figure")
    axes.axhline(1e3 * required_m, color=TRUTH, lw=1.0, label="required")
    millimetres(axes)
    axes.set_xticks(n)
    plain(axes, "scans used", "error, mm")
    picture.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return svg(picture)


def weld_trace(weld: WeldOutcome, config: ServoConfig) -> WeldTrace:
    """The weld for the pictures, over the planned seam; y of the base is drawn to the right, as the cell stands."""
    log, named = weld.log, weld.log.telemetry
    keep = named["phase"] != list(Phase).index(Phase.TOUCH)  # the search has no place along the seam
    speed = speed_along(log.time, log.p_BTorch)
    work = travel = None
    if weld.planned is not None:
        up = weld.planned.up(named["s_torch"])
        work, travel = (angle[keep] for angle in torch_angles(log.R_BT, up, config.torch.work_angle_rad))
    errors = [None if e is None else (e.s, e.lateral, e.height) for e in (weld.plan_error, weld.error)]
    return WeldTrace(
        s=named["s_torch"][keep],
        torch_on=log.torch_on[keep],
        felt=named["phase"][keep] == list(Phase).index(Phase.TRACK),
        tip=log.p_BTip[keep],
        torch=log.p_BTorch[keep],
        robot=log.p_BRobot[keep],
        planned=_line(weld.planned),
        true=_line(weld.true_seam),
        plan_error=errors[0],
        torch_error=errors[1],
        delta_n=named["delta_n"][keep],
        delta_axial=named["delta_axial"][keep],
        speed=speed[keep],
        omega=named["omega"][keep],
        n_d_dot_n_t=named["n_d_dot_n_t"][keep],
        weld_speed=config.weld_speed_m_s,
        delta_d=config.deflection.delta_d_m,
        axial_d=config.deflection.axial_d_m,
        omega_max=config.limits.omega_max_rad_s,
        e_t=named["e_t"][keep],
        work=work,
        travel=travel,
        windows=(config.windows.work_rad, config.windows.travel_rad),
        axes=(1, 0),
        names=("y, mm", "x, mm"),
    )


def _line(seam: SeamCurve | None) -> Array | None:
    return None if seam is None else np.asarray(seam.position(np.linspace(0.0, seam.length, 400)))


def tip_error(weld: WeldOutcome) -> float:
    """Mean distance (m) sideways between the felt tip line and the true seam while the servo tracked."""
    felt = weld.log.telemetry["phase"] == list(Phase).index(Phase.TRACK)
    if weld.true_seam is None or not felt.any():
        return float("nan")
    return path_error(weld.log.p_BTip[felt], weld.true_seam).mean_m
