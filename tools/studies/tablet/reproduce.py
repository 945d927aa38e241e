"""`weldcal reproduce tablet`: the tablet paper's tables, the signs and the models, with targets."""

import time
from collections.abc import Iterable
from dataclasses import asdict
from typing import Annotated, Any

import numpy as np
from matplotlib.figure import Figure

from weldcal.calibration.tablet.planar_fit import fit_plane_motion, hand_over
from weldcal.calibration.tablet.published import PUBLISHED_EVALUATIONS, Sign, StageResult
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.console import Progress
from weldcal.tools.report.pictures import OURS, THEIRS, svg
from weldcal.tools.report.render import fixed
from weldcal.tools.studies.harness import Figures, Row, Study, Table
from weldcal.tools.studies.tablet.study import (
    Reproduced,
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
_TITLES = {
    ("htm", 1): "six-parameter transforms, stage 1",
    ("dh", 1): "Denavit-Hartenberg, stage 1",
    ("htm", 2): "affine pair on the transforms",
    ("dh", 2): "affine pair on Denavit-Hartenberg",
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
    return (
        run_study(call.seed, evolution_seeds, trials, call.progress, {"written_to": folder})
        .measured({}, folder)
        .outcome()
    )


def run_study(seed: int, evolution_seeds: int, trials: int, progress: Progress, more: Figures) -> Study:
    """The study with all that it computed; its JSON object ends with ``more``."""
    start = time.monotonic()
    touches = published_touches()
    progress("tables 7, 8, 10, 11", 0.0)
    stages, cost = reproduce_stages(touches, tuple(range(seed + 1, seed + 1 + evolution_seeds)))
    progress("signs and chains", 0.5)
    dh, signs = dh_by_eq_20(touches), compare_signs(touches)
    progress("one landmark left out", 0.55)
    models = compare_models(touches)
    progress("simulated trials", 0.7)
    unseen = held_out(seed, trials, min(trials, PUBLISHED_TRIALS))
    left_out = next(m.left_out_mm for m in models if m.name == CLOSED_FORM)
    targets = (
        *(
            Target(
                f"Table {TABLE_NUMBER[r.model, r.stage]}: F of stage {r.stage}, {r.model.upper()}, mm",
                "",
                r.ours.fitness.F,
                FITNESS_TARGETS[r.model, r.stage],
                "±",
                FITNESS_TOLERANCE,
            )
            for r in stages
        ),
        Target("all four together, s", "", cost.four_fits, FOUR_FITS_S, "<", decides=False),
        Target("leave one landmark out, published data, mm", "", left_out, LEFT_OUT_MM),
        Target("unseen queries, simulated, mm", "", next(u.mean_mm for u in unseen if u.name == BEST), HELD_OUT_MM),
    )
    named = {(r.model, r.stage): r.ours for r in stages}
    figures: dict[str, Any] = {
        "met": all_met(targets),
        "F1": named["htm", 1].fitness.F,
        "F2": named["htm", 2].fitness.F,
        "parameters": dict(zip(STAGE_1["htm"].names, named["htm", 1].parameters, strict=True)),
        "leave_one_out_mm": left_out,
        "seconds": cost.four_fits,
        "tables": {str(TABLE_NUMBER[r.model, r.stage]): _table(r) for r in stages},
        "touching_error_printed_mm": TOUCHING_MM,
        "targets": [{"what": t.what, "reached": t.value, "limit": limit_words(t), "met": t.met} for t in targets],
        "cost": {
            **asdict(cost),
            "published_extrapolated": PUBLISHED_EVALUATIONS * cost.one_evaluation,
            "published_in_crowds_extrapolated": PUBLISHED_EVALUATIONS * cost.crowd_evaluation,
        },
        "dh_by_eq_20": dh,
        "signs": signs,
        "models": models,
        "unseen": unseen,
        "wall_seconds": time.monotonic() - start,
    }
    return Study(
        name="tablet",
        what="The tablet paper repeated: its tables, the sign of Eq. 20, and models with smaller prediction errors.",
        figures=lambda results: {**figures, **more},
        header=("published data", "unknowns", "in sample mm", "held out mm", "largest mm"),
        rows=lambda found: [
            (m.name, str(m.unknowns), fixed(m.in_sample_mm, 3), fixed(m.left_out_mm, 3), fixed(m.worst_mm))
            for m in models
        ],
        numbers=4,
        others=lambda found: _tables(found, stages),
        targets=lambda found: targets,
        plots={"figures/residuals.svg": lambda results: sign_residuals(touches)},
        group="reproduce",
    )


def _tables(figures: Figures, stages: Iterable[Reproduced]) -> Iterable[Table]:
    unseen = [(u.name, str(u.trials), fixed(u.mean_mm, 3)) for u in figures["unseen"]]
    yield "Unseen queries", ("simulated", "trials", "unseen mm"), unseen
    yield (
        "The sign of Eq. 20, without a camera: the tablet's points against the hand",
        ("touching error", "rigid, mm per axis", "with scale, mm per axis", "held out mm"),
        [
            (SIGN_WORDS[s.sign], fixed(s.rigid_mm, 3), fixed(s.scaled_mm, 3), fixed(s.left_out_mm, 2))
            for s in figures["signs"]
        ],
    )
    for r in sorted(stages, key=lambda r: TABLE_NUMBER[r.model, r.stage]):
        title = f"Table {TABLE_NUMBER[r.model, r.stage]}: {_TITLES[r.model, r.stage]}"
        yield title, ("", "printed", "ours", "differential evolution"), table_rows(r)
    dh = [(name, fixed(f.F, 4), fixed(f.f1, 4), fixed(f.f2, 4)) for name, f in figures["dh_by_eq_20"].items()]
    yield "The error in Table 8", ("", "F, mm", "f1, mm", "f2, mm"), dh
    touching = [(f"Table {n}", *(fixed(v) for v in values)) for n, values in TOUCHING_MM.items()]
    yield "Touched again by the paper's robot, printed, mm", ("", "1", "2", "3", "4", "5"), touching
    minutes = f"{figures['cost']['published_extrapolated'] / 60.0:.0f} min, extrapolated from one"
    yield "Cost", ("", ""), [("the paper's 1e8 evaluations", minutes)]


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


def sign_residuals(touches: TabletTouches) -> bytes:
    """For each sign of Eq. 20: the nine hand positions, and by how much a similarity of the tablet and a pen miss
    them."""
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


def table_rows(r: Reproduced) -> list[Row]:
    """One of the paper's tables: name, printed, ours, by differential evolution (first seed)."""
    printed = printed_stage(r.model, r.stage)
    ours, evolved = r.ours, r.evolved[0] if r.evolved else None
    rows: list[Row] = []

    def row(name: str, digits: int, printed_value: float, our_value: float, evolved_value: float | None) -> None:
        rows.append((name, fixed(printed_value), fixed(our_value, digits), fixed(evolved_value, digits)))

    for k, name in enumerate(("F", "f1", "f2")):
        de = getattr(evolved.fitness, name) if evolved else None
        row(f"{name}, mm", 4, printed.fitness[k], getattr(ours.fitness, name), de)
    for k, name in enumerate(printed.names):
        row(name, 2, printed.parameters[k], ours.parameters[k], evolved.parameters[k] if evolved else None)
    return rows
