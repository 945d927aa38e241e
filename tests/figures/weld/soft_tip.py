"""What creep and loss of the soft tip do to tip and torch, by material, speed and time since the weld before."""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from tests.figures.harness import Row, Run, figure
from tests.worlds.weld.budgets import NOMINAL
from tests.worlds.weld.case import RunMetrics, WeldCase, judge, study_config
from tests.worlds.weld.plant import PHASES, StudyRun, TipMemory, groove_config, simulate
from tests.worlds.weld.seams import get_seam
from weldcal.models.tools.elastomers import MATERIALS
from weldcal.tools.report.render import fixed
from weldcal.welding.record.process import path_error
from weldcal.welding.servo.state import Phase

SPEEDS_MM_S = (2.0, 5.0, 10.0, 20.0)
QUICK = [("", math.inf), ("tpu_95a", math.inf), ("tpu_95a", 2.0)]
FREE_S = (math.inf, 10.0, 2.0)  # since the weld before; without one: inf


def felt_error(run: StudyRun, clearance_m: float) -> tuple[float, float]:
    """Mean error of the tip as it is felt, against the true seam: sideways, and in height, mm, to the left and up."""
    track = run.column("phase").astype(int) == PHASES.index(Phase.TRACK)
    found = [c.diagnostics.p_BTip for c, on in zip(run.commands, track, strict=True) if on]
    error = path_error(np.array([p for p in found if p is not None]), run.torch_line.raised(-clearance_m))
    return 1e3 * float(np.mean(error.lateral)), 1e3 * float(np.mean(error.height))


def soft_weld(case: WeldCase, material: str, free_s: float, seed: int) -> tuple[RunMetrics, tuple[float, float]]:
    """Figures of one weld with a tip of a material ("" without memory), and the error of the tip as it is felt."""
    memory = TipMemory(MATERIALS[material], free_s) if material else None
    seam, config = get_seam(case.seam), groove_config(study_config(case))
    run = simulate(seam, NOMINAL, config, seed, time_limit_s=400.0, memory=memory)
    return judge(run, case.speed_m_s, case.chord_m), felt_error(run, config.clearance_m)


def rows(run: Run) -> Iterator[Row]:
    """One row for each material, time since the weld before, and speed."""
    kinds = [("", math.inf), *product(MATERIALS, FREE_S)]
    seeds, speeds = run.seeds(1, 1), run.size((5.0, 20.0), SPEEDS_MM_S)
    for (material, free_s), speed in product(run.size(QUICK, kinds), speeds):
        case = WeldCase("s_r60", speed_m_s=1e-3 * speed)
        welds = [soft_weld(case, material, free_s, seed) for seed in seeds]
        felt = np.mean([felt for _, felt in welds], axis=0)
        torch = [weld for weld, _ in welds]
        after = "first weld" if math.isinf(free_s) else f"{free_s:.0f} s after"
        yield (
            *(
                f"{material or 'no memory'}, {after}",
                f"{speed:.0f}",
                fixed(float(felt[0]), 3),
                fixed(float(felt[1]), 3),
            ),
            *(fixed(float(np.mean([w.mean_mm for w in torch])), 3), fixed(max(w.max_mm for w in torch), 2)),
            *(fixed(max(w.height_mm for w in torch), 2), f"{sum(w.completed for w in torch)} of {len(torch)}"),
        )


@figure("soft-tip", "creep and loss of the soft tip: errors of tip and torch at 2 to 20 mm/s")
def soft_tip(run: Run) -> None:
    """Print the errors; in the quick form one seed, one material and two speeds."""
    run.table(
        "",
        ("tip", "mm/s", "tip, aside mm", "tip, up mm", "torch, mean mm", "largest mm", "height mm", "completed"),
        rows(run),
    )
