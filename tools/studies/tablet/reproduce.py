"""`weldcal reproduce tablet`: the tablet paper's tables, the signs and the models; targets, table.json and a report page."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from weldcal.calibration.tablet.planar.fit import fit_plane_motion, hand_over
from weldcal.calibration.tablet.planar.linear import LinearFit, fit_linear
from weldcal.calibration.tablet.published.calibration import StageResult
from weldcal.calibration.tablet.published.two_stage import Fitness, Sign
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.console import Progress
from weldcal.tools.report.files import write_json
from weldcal.tools.report.pictures import OURS, THEIRS, TRUTH, svg
from weldcal.tools.report.render import fixed, render, write_atomic
from weldcal.tools.studies.harness import MISSED
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
from weldcal.tools.studies.targets import Target, all_met
from weldcal.tools.worlds.tablet import STAGE_1, TABLE_NUMBER, TOUCHING_MM, printed_stage, published_touches

PUBLISHED_TRIALS = 20
# What the reproduction must reach: mm, seconds
FITNESS_TARGETS = {("htm", 1): 1.6739, ("htm", 2): 0.9989, ("dh", 1): 7.103, ("dh", 2): 4.272}
FITNESS_TOLERANCE = 0.0015
FOUR_FITS_S = 1.0
LEFT_OUT_MM = 0.46
HELD_OUT_MM = 0.222
CLOSED_FORM, BEST = "closed form", "PnP, rigid, pen: hands rounded to 1 mm"
_LIMIT_WORDS = {"≤": "at most ", "<": "under ", "≥": "at least ", "±": ""}


_LARGER = 20.0
SIGN_WORDS = {Sign.PRINTED: "as printed (−)", Sign.NONE: "left out", Sign.CORRECTED: "reversed (+)"}


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


@command("reproduce tablet", short_help="Repeat the tablet paper: Tables 7 to 12.")
def tablet(
    call: Call,
    evolution_seeds: Annotated[
        int, option("--evolution-seeds", "N", "Seeds of differential evolution per table; each takes seconds.", min=0)
    ] = 1,
    trials: Annotated[int, option("--trials", "N", "Simulated trials for the error on unseen points.", min=1)] = 60,
) -> Outcome:
    """Repeat the tablet paper: Tables 7 to 12, the sign of Eq. 20, and models with smaller prediction errors."""
    folder = call.folder("reproduce", "tablet")
    study = run_tablet_study(TabletOptions(folder, call.seed, evolution_seeds, trials), call.progress)
    rows = {t.what: f"{t.value:.4f}  ({limit_words(t)}: {t.verdict})" for t in study.targets}
    rows["the paper's 1e8 evaluations"] = f"{study.cost.published / 60.0:.0f} min, extrapolated from one"
    return Outcome(study.summary(), values={}, rows=rows, problem="" if study.met else MISSED)


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
    study = TabletStudy(
        options=options, stages=stages, cost=cost, dh=dh, signs=signs, models=models, unseen=unseen,
        linear=fit_linear(touches), wall_seconds=time.monotonic() - start,
    )  # fmt: skip
    progress("report", 0.99)
    write_json(options.folder / "table.json", study.summary())
    write_atomic(options.folder / "report.html", tablet_report(study))
    return study


def sign_residuals(touches: TabletTouches) -> bytes:
    """For each sign of Eq. 20: the nine hand positions, and by how much a similarity of the tablet and a pen miss them."""
    picture = Figure(figsize=(9.6, 3.0), layout="constrained")
    every = picture.subplots(1, 3, sharex=True, sharey=True)
    for axes, sign in zip(every, Sign, strict=True):
        points = touches.pitch_m * (touches.landmark_px - sign * touches.delta_px)
        x = fit_plane_motion(points, touches.hand_m, touches.theta_rad, free_scale=True)
        e = 1e3 * (hand_over(x, points, touches.theta_rad) - touches.hand_m)
        hand = 1e3 * touches.hand_m
        colour = OURS if sign is Sign.CORRECTED else THEIRS
        axes.quiver(*hand.T, *e.T, angles="xy", scale_units="xy", scale=1.0 / _LARGER, color=colour, width=0.012)
        axes.plot(*hand.T, "o", color="black", ms=3)
        rms = float(np.sqrt((e**2).mean()))
        axes.set_title(f"{SIGN_WORDS[sign]}: {rms:.2f} mm per axis", fontsize=10)
        axes.set_aspect("equal")
        axes.set_xlabel("hand x, mm")
        axes.margins(0.15)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    every[0].set_ylabel("hand y, mm")
    return svg(picture)


def unseen_errors(models: tuple[ModelRow, ...], unseen: tuple[HeldOutRow, ...]) -> bytes:
    """Bars: left-out and in-sample error on the published data; error on simulated queries."""
    picture = Figure(figsize=(9.0, 0.42 * (len(models) + len(unseen)) + 1.6), layout="constrained")
    left, queries = picture.subplots(2, 1, height_ratios=[len(models), len(unseen)], sharex=True)
    y = np.arange(len(models))
    left.barh(y, [m.left_out_mm for m in models], 0.6, color=[_colour(m.name) for m in models])
    left.plot([m.in_sample_mm for m in models], y, "|", color="black", ms=14, mew=2, label="in sample")
    _label(left, y, [f"{m.name} ({m.unknowns})" for m in models], [m.left_out_mm for m in models])
    left.set_title("published data, one landmark left out (unknowns)", fontsize=10, loc="left")
    left.legend(frameon=False, fontsize=8, loc="lower right")
    y = np.arange(len(unseen))
    queries.barh(y, [u.mean_mm for u in unseen], 0.6, color=[_colour(u.name) for u in unseen])
    _label(queries, y, [u.name for u in unseen], [u.mean_mm for u in unseen])
    queries.axvline(0.222, color=TRUTH, lw=1.0, ls=":")
    queries.set_title("simulated trials, queries that no fit saw (dotted: target)", fontsize=10, loc="left")
    queries.set_xlabel("mean error of the hand, mm")
    return svg(picture)


def _colour(name: str) -> str:
    return THEIRS if name.startswith("paper") else OURS


def _label(axes: Axes, y: np.ndarray, names: list[str], values: list[float]) -> None:
    axes.set_yticks(y, names, fontsize=9)
    axes.invert_yaxis()
    for at, value in zip(y, values, strict=True):
        axes.text(value + 0.01, at, f"{value:.3f}", va="center", fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)


_TITLES = {
    ("htm", 1): "six-parameter transforms, stage 1", ("dh", 1): "Denavit-Hartenberg, stage 1",
    ("htm", 2): "affine pair on the transforms", ("dh", 2): "affine pair on Denavit-Hartenberg",
}  # fmt: skip


def table_rows(r: Reproduced) -> list[tuple[str, ...]]:
    """One of the paper's tables: name, printed, ours, by differential evolution (first seed)."""
    printed = printed_stage(r.model, r.stage)
    ours, evolved = r.ours, r.evolved[0] if r.evolved else None
    rows: list[tuple[str, ...]] = []

    def row(name: str, digits: int, printed_value: float, our_value: float, evolved_value: float | None) -> None:
        rows.append((name, fixed(printed_value), fixed(our_value, digits), fixed(evolved_value, digits)))

    for k, name in enumerate(("F", "f1", "f2")):
        de = getattr(evolved.fitness, name) if evolved else None
        row(f"{name}, mm", 4, printed.fitness[k], getattr(ours.fitness, name), de)
    for k, name in enumerate(printed.names):
        row(name, 2, printed.parameters[k], ours.parameters[k], evolved.parameters[k] if evolved else None)
    return rows


def tablet_report(study: TabletStudy) -> str:
    """The whole report as one self-contained HTML text."""
    touches = published_touches()
    tables = [
        {
            "title": f"Table {TABLE_NUMBER[r.model, r.stage]}: {_TITLES[r.model, r.stage]}",
            "rows": table_rows(r),
            "run": r,
        }
        for r in sorted(study.stages, key=lambda r: TABLE_NUMBER[r.model, r.stage])
    ]
    return render(
        "tablet_study.html.j2",
        study=study,
        tables=tables,
        targets=[(t.what, fixed(t.value, 4), limit_words(t), t.verdict) for t in study.targets],
        missed=sum(not t.met for t in study.targets),
        signs=[
            (SIGN_WORDS[s.sign], fixed(s.rigid_mm, 3), fixed(s.scaled_mm, 3), fixed(s.left_out_mm, 2))
            for s in study.signs
        ],
        dh=[(name, fixed(f.F, 4), fixed(f.f1, 4), fixed(f.f2, 4)) for name, f in study.dh.items()],
        models=[
            (m.name, m.unknowns, fixed(m.in_sample_mm, 3), fixed(m.left_out_mm, 3), fixed(m.worst_mm))
            for m in study.models
        ],
        unseen=[(u.name, u.trials, fixed(u.mean_mm, 3)) for u in study.unseen],
        touching=[(f"Table {n}", *(fixed(v) for v in values)) for n, values in TOUCHING_MM.items()],
        residuals=sign_residuals(touches),
        errors=unseen_errors(study.models, study.unseen),
    )
