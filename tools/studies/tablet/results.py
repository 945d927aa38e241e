"""Results of the tablet study, its targets, and its JSON object."""

from dataclasses import asdict, dataclass
from pathlib import Path

from weldcal.calibration.tablet.planar.linear import LinearFit
from weldcal.calibration.tablet.published.calibration import StageResult
from weldcal.calibration.tablet.published.two_stage import Fitness
from weldcal.tools.studies.tablet.paper import STAGE_1, TABLE_NUMBER, TOUCHING_MM, printed_stage
from weldcal.tools.studies.tablet.study import Cost, HeldOutRow, ModelRow, Reproduced, SignRow
from weldcal.tools.studies.targets import Target, all_met

# What the reproduction must reach: mm, seconds
FITNESS_TARGETS = {("htm", 1): 1.6739, ("htm", 2): 0.9989, ("dh", 1): 7.103, ("dh", 2): 4.272}
FITNESS_TOLERANCE = 0.0015
FOUR_FITS_S = 1.0
LEFT_OUT_MM = 0.46
HELD_OUT_MM = 0.222
CLOSED_FORM, BEST = "closed form", "PnP, rigid, pen: hands rounded to 1 mm"
_LIMIT_WORDS = {"≤": "at most ", "<": "under ", "≥": "at least ", "±": ""}


@dataclass(frozen=True)
class TabletOptions:
    """Output folder, first seed, seeds of differential evolution, and simulated trials."""

    folder: Path
    seed: int = 0
    evolution_seeds: int = 1
    trials: int = 60


@dataclass(frozen=True, eq=False, kw_only=True)
class TabletStudy:
    """Everything that the study computed."""

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
    def leave_one_out_mm(self) -> float:
        """Error of the closed form on the published data, one landmark left out."""
        return next(m.left_out_mm for m in self.models if m.name == CLOSED_FORM)

    @property
    def targets(self) -> tuple[Target, ...]:
        """Each target with the value reached; the wall time does not decide."""
        unseen = next(u.mean_mm for u in self.unseen if u.name == BEST)
        return (
            *(
                Target(
                    f"Table {TABLE_NUMBER[r.model, r.stage]}: F of stage {r.stage}, {r.model.upper()}, mm",
                    "",
                    r.ours.fitness.F,
                    FITNESS_TARGETS[r.model, r.stage],
                    "±",
                    FITNESS_TOLERANCE,
                )
                for r in self.stages
            ),
            Target("all four together, s", "", self.cost.four_fits, FOUR_FITS_S, "<", decides=False),
            Target("leave one landmark out, published data, mm", "", self.leave_one_out_mm, LEFT_OUT_MM),
            Target("unseen queries, simulated, mm", "", unseen, HELD_OUT_MM),
        )

    @property
    def met(self) -> bool:
        """Whether every target that decides is met."""
        return all_met(self.targets)

    def summary(self) -> dict[str, object]:
        """The result for JSON: lengths in mm, angles in degrees."""
        named = {(r.model, r.stage): r.ours for r in self.stages}
        return {
            "state": "done",
            "met": self.met,
            "F1": named["htm", 1].fitness.F,
            "F2": named["htm", 2].fitness.F,
            "parameters": dict(zip(STAGE_1["htm"].names, named["htm", 1].parameters, strict=True)),
            "leave_one_out_mm": self.leave_one_out_mm,
            "seconds": self.cost.four_fits,
            "tables": {str(TABLE_NUMBER[r.model, r.stage]): _table(r) for r in self.stages},
            "touching_error_printed_mm": TOUCHING_MM,
            "targets": [
                {"what": t.what, "reached": t.value, "limit": limit_words(t), "met": t.met} for t in self.targets
            ],
            "cost": {
                **asdict(self.cost),
                "published_extrapolated": self.cost.published,
                "published_in_crowds_extrapolated": self.cost.published_in_crowds,
            },
            "dh_by_eq_20": self.dh,
            "signs": self.signs,
            "models": self.models,
            "unseen": self.unseen,
            "wall_seconds": self.wall_seconds,
            "written_to": self.options.folder,
        }


def limit_words(target: Target) -> str:
    """The bound in words, such as "at most 0.46"."""
    return _LIMIT_WORDS[target.bound] + target.wanted.removeprefix(target.bound).strip()


def _table(r: Reproduced) -> dict[str, object]:
    printed = printed_stage(r.model, r.stage)

    def one(fit: StageResult) -> dict[str, object]:
        parameters = dict(zip(printed.names, fit.parameters, strict=True))
        return {**asdict(fit.fitness), "parameters": parameters, "evaluations": fit.evaluations}

    return {
        "printed": {"F": printed.fitness, "parameters": dict(zip(printed.names, printed.parameters, strict=True))},
        "ours": {**one(r.ours), "seconds": r.seconds},
        "differential_evolution": [one(e) for e in r.evolved],
        "differential_evolution_seconds": r.evolved_seconds,
    }
