"""weldcal reproduce tablet, from options to files: the tables, the signs, the models, and one page that tells it."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from weldcal.calibration.tablet.planar.linear import LinearFit, fit_linear
from weldcal.calibration.tablet.published.calibration import StageResult
from weldcal.calibration.tablet.published.two_stage import Fitness
from weldcal.tools.console import Progress, plain
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.tablet.paper import STAGE_1, STAGE_2, TABLE_NUMBER, TOUCHING_MM, published_touches
from weldcal.tools.studies.tablet.study import (
    Cost,
    HeldOutRow,
    ModelRow,
    Reproduced,
    SignRow,
    compare_models,
    compare_signs,
    dh_by_eq_20,
    held_out,
    reproduce_stages,
)

# What the reproduction must reach: mm, seconds
FITNESS_TARGETS = {("htm", 1): 1.6739, ("htm", 2): 0.9989, ("dh", 1): 7.103, ("dh", 2): 4.272}
FITNESS_TOLERANCE = 0.0015
FOUR_FITS_S = 1.0
LEFT_OUT_MM = 0.46
HELD_OUT_MM = 0.222
PUBLISHED_TRIALS = 20
CLOSED_FORM, BEST = "closed form", "PnP, rigid, pen: hands rounded to 1 mm"


@dataclass(frozen=True)
class TabletOptions:
    """Where to write; from which seed on; how many seeds differential evolution runs with; how many simulated trials."""

    folder: Path
    seed: int = 0
    evolution_seeds: int = 1
    trials: int = 60


@dataclass(frozen=True, eq=False)
class TabletStudy:
    """Everything that the study found; ``targets`` (what, reached, limit, met)."""

    options: TabletOptions
    stages: tuple[Reproduced, ...]
    cost: Cost
    dh: dict[str, Fitness]
    signs: tuple[SignRow, ...]
    models: tuple[ModelRow, ...]
    unseen: tuple[HeldOutRow, ...]
    linear: LinearFit
    wall_seconds: float

    @property
    def targets(self) -> tuple[tuple[str, float, str, bool], ...]:
        """Each target: what, the value reached, the limit in words, and whether it is met."""
        rows = []
        for r in self.stages:
            wanted, F = FITNESS_TARGETS[r.model, r.stage], r.ours.fitness.F
            name = f"Table {TABLE_NUMBER[r.model, r.stage]}: F of stage {r.stage}, {r.model.upper()}, mm"
            rows.append((name, F, f"{wanted} ± {FITNESS_TOLERANCE}", abs(F - wanted) <= FITNESS_TOLERANCE))
        rows.append(
            ("all four together, s", self.cost.four_fits, f"under {FOUR_FITS_S:g}", self.cost.four_fits < FOUR_FITS_S)
        )
        left = next(m.left_out_mm for m in self.models if m.name == CLOSED_FORM)
        rows.append(("leave one landmark out, published data, mm", left, f"at most {LEFT_OUT_MM}", left <= LEFT_OUT_MM))
        unseen = next(u.mean_mm for u in self.unseen if u.name == BEST)
        rows.append(("unseen queries, simulated, mm", unseen, f"at most {HELD_OUT_MM}", unseen <= HELD_OUT_MM))
        return tuple(rows)

    @property
    def met(self) -> bool:
        """Whether every target is met."""
        return all(row[3] for row in self.targets)

    def summary(self) -> dict[str, object]:
        """The result for JSON: lengths in mm, angles in degrees."""
        named = {(r.model, r.stage): r for r in self.stages}
        return {
            "state": "done",
            "met": self.met,
            "F1": named["htm", 1].ours.fitness.F,
            "F2": named["htm", 2].ours.fitness.F,
            "parameters": dict(zip(STAGE_1["htm"].names, named["htm", 1].ours.parameters.tolist(), strict=True)),
            "leave_one_out_mm": next(m.left_out_mm for m in self.models if m.name == CLOSED_FORM),
            "seconds": self.cost.four_fits,
            "tables": {str(TABLE_NUMBER[r.model, r.stage]): _table(r) for r in self.stages},
            "touching_error_printed_mm": {str(n): v for n, v in TOUCHING_MM.items()},
            "targets": [{"what": w, "reached": v, "limit": n, "met": m} for w, v, n, m in self.targets],
            "cost": {
                **asdict(self.cost),
                "published_extrapolated": self.cost.published,
                "published_in_crowds_extrapolated": self.cost.published_in_crowds,
            },
            "dh_by_eq_20": {name: asdict(f) for name, f in self.dh.items()},
            "signs": [asdict(s) for s in self.signs],
            "models": [asdict(m) for m in self.models],
            "unseen": [asdict(u) for u in self.unseen],
            "wall_seconds": self.wall_seconds,
            "written_to": self.options.folder,
        }


def _table(r: Reproduced) -> dict[str, object]:
    printed = (STAGE_1 if r.stage == 1 else STAGE_2)[r.model]

    def one(fit: StageResult) -> dict[str, object]:
        parameters = dict(zip(printed.names, fit.parameters.tolist(), strict=True))
        return {**asdict(fit.fitness), "parameters": parameters, "evaluations": fit.evaluations}

    return {
        "printed": {
            "F": printed.fitness,
            "parameters": dict(zip(printed.names, printed.parameters.tolist(), strict=True)),
        },
        "ours": {**one(r.ours), "seconds": r.seconds},
        "differential_evolution": [one(e) for e in r.evolved],
        "differential_evolution_seconds": r.evolved_seconds,
    }


def run_tablet_study(options: TabletOptions, progress: Progress) -> TabletStudy:
    """Run the study and write table.json and report.html."""
    start = time.monotonic()
    touches = published_touches()
    progress("tables 7, 8, 10, 11", 0.0)
    seeds = tuple(range(options.seed + 1, options.seed + 1 + options.evolution_seeds))
    stages, cost = reproduce_stages(touches, seeds)
    progress("signs and chains", 0.5)
    dh, signs = dh_by_eq_20(touches), compare_signs(touches)
    progress("one landmark left out", 0.55)
    models = compare_models(touches)
    progress("simulated trials", 0.7)
    unseen = held_out(options.seed, options.trials, min(options.trials, PUBLISHED_TRIALS))
    study = TabletStudy(options, stages, cost, dh, signs, models, unseen, fit_linear(touches), time.monotonic() - start)
    progress("report", 0.99)
    from weldcal.tools.studies.tablet.report import tablet_report

    write_atomic(options.folder / "table.json", json.dumps(plain(study.summary()), allow_nan=False, indent=1) + "\n")
    write_atomic(options.folder / "report.html", tablet_report(study))
    return study
