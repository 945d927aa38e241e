"""Measures the real-time factor of the whole cell, phase by phase, on the S groove with the finger camera on."""

from itertools import pairwise
from pathlib import Path

from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.demo import run_scenario
from weldcal.tools.outcomes.options import RunOptions

SEAM_MM = 100.0


def run_cell_benchmark(out: Path, seed: int = 0, progress: Progress = no_progress) -> dict[str, object]:
    """Run the demo's cell on a short seam without recording; real-time factors per phase (simulated per wall seconds).

    `welding` includes contact, rendering and detection at the finger camera's rate; `share_*` are wall seconds.
    """
    scenario = load_scenario("s_groove")
    scenario.welding.seam_length_mm = SEAM_MM
    options = RunOptions(scenario="s_groove", out=out, seed=seed, recording=False)
    result = run_scenario(scenario, options, progress)
    run = result.run
    camera = scenario.finger_camera
    return {
        "state": result.state,
        "real_time_factor": run.real_time_factor(),
        "real_time_factor_welding": run.real_time_factor("weld"),
        "real_time_factor_moving": run.real_time_factor("move_to_pose"),
        "seconds_per_scan": _mean_wall(run.phases, "scan_pose"),
        "finger_camera": f"{getattr(camera, 'width', 0)} x {getattr(camera, 'height', 0)} at {getattr(camera, 'rate_hz', 0):.0f} Hz",
        "simulated_seconds": float(run.root.get_time()),
        "wall_seconds": run.wall_seconds,
    }


def _mean_wall(phases: list[tuple[str, float, float]], name: str) -> float:
    spans = [b[2] - a[2] for a, b in pairwise(phases) if a[0] == name]
    return sum(spans) / max(len(spans), 1)
