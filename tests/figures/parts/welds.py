"""Welds the made parts in the simulated cell, each from its STEP file and its seam's CSV, and scores the torch."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from tests.figures.parts.planning import planning
from tests.figures.parts.registration import registration
from tests.figures.subject import one_of
from tests.worlds.parts.cells import PartTrial, write_cell
from tests.worlds.parts.step_parts import PARTS
from weldcal.models.documents import did_you_mean
from weldcal.models.errors import InputError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.render import mappings_csv, write_atomic
from weldcal.tools.report.run import RunOptions

COLUMNS = (
    "part",
    "joint",
    "seed",
    "state",
    "torch_mean_mm",
    "torch_max_mm",
    "torch_first_max_mm",
    "torch_last_max_mm",
    "plan_mean_mm",
    "plan_max_mm",
    "welded_mm",
    "refined",
    "plan_arm_sigma_mm",
    "plan_arm_turn_deg",
    "reason",
)
MEAN_TARGET_MM, MAX_TARGET_MM = 0.10, 0.40


def run_part_welds(
    out: Path,
    names: Sequence[str] | None,
    seeds: range,
    trial: PartTrial | None = None,
    progress: Progress = no_progress,
) -> Mapping[str, object]:
    """Weld each part once per seed; parts.csv grows row by row.

    Returns the worst figures and how many welds reached the targets.

    Raises:
        InputError: a part of another name, or no OpenCascade.
    """
    chosen = list(PARTS) if names is None else list(names)
    unknown = [name for name in chosen if name not in PARTS]
    if unknown:
        listed = f"choose from {', '.join(PARTS)}."
        raise InputError(f"There is no part '{unknown[0]}': {did_you_mean(unknown[0], PARTS, listed)}")
    trial = trial or PartTrial()
    rows: list[dict[str, Any]] = []
    runs = [(name, seed) for name in chosen for seed in seeds]
    for k, (name, seed) in enumerate(runs):
        part = PARTS[name]()
        folder = out / name
        cell = write_cell(part, folder, trial)

        def shown(stage: str, share: float, k: int = k, name: str = name) -> None:
            progress(f"{name}: {stage}", (k + share) / len(runs))

        options = RunOptions(scenario=str(cell), out=folder / f"seed{seed}", seed=seed, recording=False)
        result = run_scenario(trial.scenario(cell), options, shown)
        result.run.raise_if_interrupted()
        summary = result.summary()
        found = summary.get("refinement")
        refined = isinstance(found, Mapping) and found.get("accepted") is True
        rows.append({**summary, "part": name, "joint": part.joint, "seed": seed, "refined": refined})
        write_atomic(out / "parts.csv", mappings_csv(rows, COLUMNS))
    return _summed(rows)


def _summed(rows: list[dict[str, Any]]) -> dict[str, object]:
    def worst(*keys: str) -> float | None:
        return max((row[key] for row in rows for key in keys if row.get(key) is not None), default=None)

    good = [
        row["state"] == "done"
        and row.get("torch_mean_mm", np.inf) <= MEAN_TARGET_MM
        and row.get("torch_max_mm", np.inf) <= MAX_TARGET_MM
        for row in rows
    ]
    return {
        "state": "done" if all(row["state"] == "done" for row in rows) else "held",
        "welds": len(rows),
        "within_targets": int(sum(good)),
        "worst_torch_mean_mm": worst("torch_mean_mm"),
        "worst_torch_max_mm": worst("torch_max_mm"),
        "worst_ends_mm": worst("torch_first_max_mm", "torch_last_max_mm"),
        "parts": [{key: row.get(key) for key in COLUMNS if key in row} for row in rows],
    }


@command("benchmark part-welds", short_help="Weld twelve parts in four joints from STEP files.", hidden=True)
def welds(
    call: Call,
    part: Annotated[list[str] | None, option("--part", "NAME", "A part; repeat for more.", show_default="all")] = None,
    runs: Annotated[int, option("--runs", "N", "Welds of each part, seeds from --seed on.", min=1)] = 1,
    located_by: Annotated[
        str, option("--located-by", "WORD", "Where the part's pose is from: scan or drawing.")
    ] = "scan",
    seam_mm: Annotated[
        float | None, option("--seam-mm", "MM", "Weld only so much of each seam.", show_default="all of it")
    ] = None,
    refine: Annotated[
        str,
        option("--refine", "KIND", "Calibrate each cell first and refine it: none (not calibrated), joints or links."),
    ] = "none",
    arm_mm: Annotated[
        float, option("--arm-mm", "MM", "How far the true flange is from the reported one (rms).", min=0.0, max=5.0)
    ] = 0.4,
) -> Outcome:
    """Weld twelve parts in four joints in the simulated cell, each from its STEP file, and measure the torch's
    error."""
    trial = PartTrial.of(located_by, seam_mm, refine, arm_mm)
    folder = call.folder("benchmark", "part-welds")
    return Outcome(run_part_welds(folder, part, range(call.seed, call.seed + runs), trial, call.progress))


@command("benchmark parts", short_help="Measure how parts are found, planned and welded.")
@one_of("welds", welds=welds, registration=registration, seam_planning=planning)
def parts(call: Call) -> None:
    """Measure how parts are found in a scan, how their seams are planned, and how they are welded, against the
    truth."""
