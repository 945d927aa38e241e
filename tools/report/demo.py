"""The report of a run, for someone who was not there: did it work, how well, what it looked like, where the numbers are from."""

from pathlib import Path

import numpy as np

from weldcal.calibration.data.results import export_ros2
from weldcal.systems.phase_words import phase_words
from weldcal.tools.outcomes.demo import DemoResult
from weldcal.tools.outcomes.weld import heat_input_kJ_mm
from weldcal.tools.report import plots_demo, plots_weld
from weldcal.tools.report.render import fixed, render
from weldcal.tools.report.robot_timing import robot_timing


def demo_pictures(result: DemoResult) -> dict[str, bytes]:
    """The plots of a run by name, as SVG."""
    cell, status, weld = result.run.cell, result.status, result.weld
    pictures = {}
    if status.history:
        required = cell.scenario.calibration.required_error_mm * 1e-3
        pictures["convergence"] = plots_demo.convergence(status, required)
    if weld is not None:
        trace = plots_demo.weld_trace(weld, cell.job.servo_config)
        if len(trace.s) > 1:
            pictures["seam"] = plots_weld.paths(trace)
            pictures["along"] = plots_weld.along_the_weld(trace)
    return pictures


def demo_report(result: DemoResult, pictures: dict[str, bytes], *, recording: bool) -> str:
    """The whole report as one self-contained HTML text."""
    cell, status, weld = result.run.cell, result.status, result.weld
    estimate = status.estimate
    pose = []
    if estimate is not None:
        sigma = np.sqrt(np.diag(estimate.covariance))
        pose = [
            ("one sigma of the position, mm", "  ".join(fixed(1e3 * float(v), 3) for v in sigma[3:])),
            ("one sigma of the rotation, deg", "  ".join(fixed(float(np.degrees(v)), 4) for v in sigma[:3])),
            ("ROS 2", export_ros2(estimate.X_BC).strip()),
        ]
    return render(
        "demo.html.j2",
        result=result,
        first=result.first,
        summary=result.summary(),
        scenario=cell.scenario,
        scenario_name=Path(result.options.scenario).stem,
        status=status,
        weld=weld,
        tip_error_mm=None if weld is None else 1e3 * plots_demo.tip_error(weld),
        pictures=pictures,
        planned=_planned(result),
        heat=_process(result),
        pose=pose,
        observations=_observations(result),
        timing=_timing(result),
        recording=recording,
        **robot_timing(result.run),
    )


def _observations(result: DemoResult) -> list[tuple[str, ...]]:
    status, estimate = result.status, result.status.estimate
    rows: list[tuple[str, ...]] = []
    for k, observation in enumerate(status.observations):
        if estimate is not None and k < len(estimate.inliers):
            rows.append(
                (
                    observation.id,
                    "used" if estimate.inliers[k] else "left out",
                    fixed(1e3 * float(estimate.held_out.position_m[k]), 3),
                    fixed(float(np.degrees(estimate.held_out.tilt_rad[k])), 4),
                )
            )
    rows += [
        (v.label, "verification, never used", fixed(1e3 * v.error_m, 3), fixed(float(np.degrees(v.tilt_rad)), 4))
        for v in status.verifications
    ]
    return rows + [(label, f"refused: {reason}", "", "") for label, reason in status.refused]


def _planned(result: DemoResult) -> list[tuple[str, str]]:
    """What the planner found in the scan, and how well it says that it knows the root."""
    plan = result.run.cell.job.planned_seam(result.run.root)
    if plan.seam is None:
        return []
    rows = [("planned", plan.summary[:1].upper() + plan.summary[1:])] if plan.summary else []
    if np.isfinite(plan.sigma_m):
        rows.append(
            ("sigma of the planned root, sideways", f"{fixed(1e3 * plan.sigma_m, 3)} mm, as the planner states it")
        )
        rows.append(("confidence", fixed(plan.confidence, 2)))
    return rows


def _process(result: DemoResult) -> list[tuple[str, str]]:
    """The arc as it was set, and the heat it brought in where that can be said."""
    weld, process = result.weld, result.run.cell.scenario.welding.process.process()
    if weld is None:
        return []
    if process.missing is not None:
        return [("heat input", f"not known: {process.missing}")]
    heat = heat_input_kJ_mm(weld, process)
    if heat is None:
        return []
    least, mean, most = (fixed(float(f(heat)), 3) for f in (np.min, np.mean, np.max))
    return [
        (
            "process",
            f"{process.name or 'not named'}, {process.current_A:g} A, {process.voltage_V:g} V as set; k = {process.k:g}",
        ),
        ("heat input", f"{mean} kJ/mm (mean; from {least} to {most})"),
    ]


def _timing(result: DemoResult) -> list[tuple[str, ...]]:
    """Simulated and wall seconds per phase, phases of one name added up."""
    phases = result.run.phases
    ends = [*phases[1:], ("", float(result.run.root.get_time()), result.run.wall_seconds)]
    total: dict[str, list[float]] = {}
    for (name, t0, w0), (_, t1, w1) in zip(phases, ends, strict=True):
        spent = total.setdefault(phase_words(name), [0.0, 0.0])
        spent[0] += t1 - t0
        spent[1] += w1 - w0
    rows = [(name, fixed(s, 1), fixed(w, 1)) for name, (s, w) in total.items() if s > 0.0 or w > 0.05]
    return [*rows, ("all", fixed(float(result.run.root.get_time()), 1), fixed(result.run.wall_seconds, 1))]
