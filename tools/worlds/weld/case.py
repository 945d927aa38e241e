"""One weld of the kinematic world by name: seam, budget, chord, speed and law, with its servo settings and figures."""

import math
from dataclasses import dataclass, replace

from weldcal.tools.worlds.weld.budgets import BUDGETS, Budget
from weldcal.tools.worlds.weld.metrics import RunMetrics, judge
from weldcal.tools.worlds.weld.plant import StudyRun, simulate
from weldcal.tools.worlds.weld.seams import get_seam
from weldcal.welding.seam.feasibility import SeamWindows
from weldcal.welding.servo.settings import ServoConfig, ToolGeometry, TouchOnConfig


@dataclass(frozen=True)
class WeldCase:
    """One weld to be repeated over the seeds: seam, budget, chord m, torch speed m/s, gaps (from, to) m, law."""

    seam: str
    budget: str = "nominal"
    chord_m: float = 0.060
    speed_m_s: float = 0.008
    gaps: tuple[tuple[float, float], ...] = ()
    law: str = "guarded"

    @property
    def errors(self) -> Budget:
        """The error budget by its name."""
        return BUDGETS[self.budget]

    @property
    def name(self) -> str:
        """Short and unique: also the name of its CSV files."""
        parts = [self.seam, f"d{1e3 * self.chord_m:.0f}"]
        parts += [f"{1e3 * self.speed_m_s:.0f}mms"] if self.speed_m_s != 0.008 else []
        parts += [f"gap{1e3 * (b - a):.0f}" for a, b in self.gaps]
        return "-".join([*parts, self.budget, *([self.law] if self.law != "guarded" else [])])


def study_config(case: WeldCase) -> ServoConfig:
    """The servo's settings for a case: everything at its default but chord, speed, law and the touch-on calibration.

    The paper's laws watch neither the torch's place nor its angles, so these are set wide open: they are to show what
    they do.
    """
    config = ServoConfig(
        tool=ToolGeometry(torch_offset_m=case.chord_m),
        touch=TouchOnConfig(calibrate_gain=True, zero_frames=30, feel_start=True),
        weld_speed_m_s=case.speed_m_s,
        law=case.law,
    )
    if case.law == "guarded":
        return config
    open_wide = SeamWindows(travel_rad=math.pi, work_rad=math.pi)
    return replace(
        config,
        torch=replace(config.torch, ignition_error_m=1.0),
        faults=replace(config.faults, torch_error_m=1.0),
        windows=open_wide,
    )


def run_case(case: WeldCase, seed: int) -> tuple[StudyRun, RunMetrics]:
    """One weld and its figures."""
    run = simulate(get_seam(case.seam), case.errors, study_config(case), seed, case.gaps)
    return run, judge(run, case.speed_m_s, case.chord_m, case.gaps)
