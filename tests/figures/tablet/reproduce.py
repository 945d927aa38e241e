"""Reproduces the tablet paper: its tables, stages, signs and models, with targets; and times each calibration."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from tests.figures.harness import Row, Run, figure
from tests.figures.tablet.evolution import GENERATIONS, POPULATION, SMALL_GENERATIONS, SMALL_POPULATION, evolve
from tests.worlds.tablet import (
    STAGE_1,
    TABLE_NUMBER,
    TOUCHING_MM,
    TabletTrial,
    printed_stage,
    published_touches,
    simulate_trial,
)
from weldcal.calibration.tablet.planar_fit import PlanarConfig, fit_linear, fit_planar, fit_plane_motion, hand_over
from weldcal.calibration.tablet.published import (
    AFFINE_NONE,
    Fitness,
    Model,
    Sign,
    StageResult,
    apply_affine,
    fitness,
    hand_to_touch,
    place_landmarks,
    stage1_residuals,
    tablet_stage1,
    tablet_stage2,
)
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.models.arrays import Array
from weldcal.tools.report.pictures import OURS, THEIRS, TRUTH, plain, subplots, svg
from weldcal.tools.report.render import fixed

MODELS: tuple[Model, ...] = ("htm", "dh")


@dataclass(frozen=True)
class Reproduced:
    """One stage of one chain: the fast solver's, one by differential evolution per seed, and the seconds of both."""

    model: Model
    stage: int
    ours: StageResult
    evolved: tuple[StageResult, ...]
    seconds: float
    evolved_seconds: float


@dataclass(frozen=True)
class SignRow:
    """Hand positions against the tablet alone for one sign: rms per axis and leave-one-out mean (mm)."""

    sign: Sign
    rigid_mm: float
    scaled_mm: float
    left_out_mm: float


@dataclass(frozen=True)
class ModelRow:
    """One model on the published data: unknowns, mean error in sample and left out, largest left out (mm)."""

    name: str
    unknowns: int
    in_sample_mm: float
    left_out_mm: float
    worst_mm: float


@dataclass(frozen=True)
class HeldOutRow:
    """One model on simulated trials: mean error of the hand on unseen queries (mm)."""

    name: str
    trials: int
    mean_mm: float


def reproduce_stages(
    touches: TabletTouches,
    seeds: tuple[int, ...],
    population: int = SMALL_POPULATION,
    generations: int = SMALL_GENERATIONS,
) -> tuple[Reproduced, ...]:
    """Tables 7, 8, 10, 11: stage 2 starts from the printed stage 1, as theirs did but for the rounding."""
    evolve(touches, "htm", 1, 0, 10, 1)  # compiles it
    found = []
    for model in MODELS:
        for stage in (1, 2):
            start = time.perf_counter()
            fit = (
                tablet_stage1(touches, model)
                if stage == 1
                else tablet_stage2(touches, STAGE_1[model].parameters, model)
            )
            middle = time.perf_counter()
            evolved = tuple(evolve(touches, model, stage, seed, population, generations) for seed in seeds)
            found.append(Reproduced(model, stage, fit, evolved, middle - start, time.perf_counter() - middle))
    return tuple(found)


def dh_by_eq_20(touches: TabletTouches) -> dict[str, Fitness]:
    """Return the printed DH parameters under Eq. 20 as written and as computed, and the optimum of the written one."""
    x = STAGE_1["dh"].parameters
    return {
        "printed parameters, translation added to the error": fitness(stage1_residuals(touches, x, "dh", Sign.PRINTED)),
        "printed parameters, Eq. 20 as written": fitness(stage1_residuals(touches, x, "dh", Sign.PRINTED, False)),
        "optimum, Eq. 20 as written": tablet_stage1(touches, "dh", dh_offset_in_error=False).fitness,
    }


def compare_signs(touches: TabletTouches) -> tuple[SignRow, ...]:
    """The camera-free test: tablet points, moved by the touching error with each sign, against the hand positions."""
    n, rows = len(touches.hand_m), []
    for sign in Sign:
        points = touches.pitch_m * (touches.landmark_px - sign * touches.delta_px)

        def error(keep: NDArray[np.bool_], free: bool, p: Array = points) -> Array:
            x = fit_plane_motion(p[keep], touches.hand_m[keep], touches.theta_rad[keep], free)
            return hand_over(x, p, touches.theta_rad) - touches.hand_m

        every = np.ones(n, dtype=bool)
        left_out = [np.linalg.norm(error(np.arange(n) != i, True)[i]) for i in range(n)]
        rigid, scaled = (1e3 * float(np.sqrt((error(every, free) ** 2).mean())) for free in (False, True))
        rows.append(SignRow(sign, rigid, scaled, 1e3 * float(np.mean(left_out))))
    return tuple(rows)


def compare_models(touches: TabletTouches) -> tuple[ModelRow, ...]:
    """Leave one landmark out, published data, hand error; each model against the target of its own sign."""
    n, rows = len(touches.hand_m), []
    for sign in (Sign.PRINTED, Sign.CORRECTED):
        own = two_stage_errors(touches, np.ones(n, dtype=bool), sign)
        left_out = np.array([np.array(two_stage_errors(touches, np.arange(n) != i, sign))[:, i] for i in range(n)])
        for k, (stages, unknowns) in enumerate((("1", 12), ("1 + 2", 22))):
            title = f"paper, stage {stages}, sign {'as printed' if sign < 0 else 'corrected'}"
            rows.append(_model_row(title, unknowns, own[k], left_out[:, k]))
    planar = fit_planar(touches, PlanarConfig(free_scale=True))
    rows.append(_model_row("PnP, similarity, pen", 6 + 6, planar.residuals_m, planar.leave_one_out_m))
    linear = fit_linear(touches)
    rows.append(_model_row("closed form", 6, linear.residuals_m, linear.leave_one_out_m))
    return tuple(rows)


def two_stage_errors(touches: TabletTouches, keep: NDArray[np.bool_], sign: Sign) -> tuple[Array, Array]:
    """Compute hand errors (n, 2) m of stage 1 and of both stages at all landmarks, against their r' (Eq. 20)."""
    fitted = touches.pick(keep)
    first, second = _two_stages(fitted, sign)
    target = touches.hand_m + 1e-3 * sign * place_landmarks(touches, first, "htm").correction[0]
    asked = (
        hand_to_touch(fitted, first, affine, touches.uv_px, touches.depth_m, touches.theta_rad)
        for affine in (None, second)
    )
    of_one, of_both = (np.asarray(a - target) for a in asked)
    return of_one, of_both


def _two_stages(touches: TabletTouches, sign: Sign) -> tuple[Array, Array]:
    first = tablet_stage1(touches, "htm", sign).parameters
    return first, tablet_stage2(touches, first, "htm", sign).parameters


def _model_row(name: str, unknowns: int, own: Array, left_out: Array) -> ModelRow:
    distance = 1e3 * np.linalg.norm(left_out, axis=1)
    in_sample = 1e3 * float(np.linalg.norm(own, axis=1).mean())
    return ModelRow(name, unknowns, in_sample, float(distance.mean()), float(distance.max()))


def held_out(seed: int, trials: int, published_trials: int) -> tuple[HeldOutRow, ...]:
    """Every model on simulated trials, at 16 queries each that it did not see; the paper's scheme on the first few."""
    made = [simulate_trial((seed, k)) for k in range(trials)]
    few = made[:published_trials]

    def two_stage(sign: Sign) -> Callable[[TabletTrial], Array]:
        def asked(t: TabletTrial) -> Array:
            first, second = _two_stages(t.touches, sign)
            return hand_to_touch(t.touches, first, second, t.query_uv_px, t.query_depth_m, t.query_theta_rad)

        return asked

    def linear(t: TabletTrial) -> Array:
        return fit_linear(t.touches).hand_to_touch(t.query_rays, t.query_theta_rad)

    def planar(step_m: float) -> Callable[[TabletTrial], Array]:
        def asked(t: TabletTrial) -> Array:
            fit = fit_planar(t.touches, PlanarConfig(step_m=step_m), leave_one_out=False)
            return fit.hand_to_touch(t.query_rays, t.query_theta_rad)

        return asked

    return (
        _held_out_row("paper, both stages, sign as printed", few, two_stage(Sign.PRINTED)),
        _held_out_row("paper, both stages, sign corrected", few, two_stage(Sign.CORRECTED)),
        _held_out_row("closed form", made, linear),
        _held_out_row("PnP, rigid, pen: least squares", made, planar(0.0)),
        _held_out_row("PnP, rigid, pen: hands rounded to 1 mm", made, planar(1e-3)),
    )


def _held_out_row(name: str, trials: list[TabletTrial], asked: Callable[[TabletTrial], Array]) -> HeldOutRow:
    errors = [np.linalg.norm(asked(t) - t.query_hand_m, axis=1).mean() for t in trials]
    return HeldOutRow(name, len(trials), 1e3 * float(np.mean(errors)))


PUBLISHED_TRIALS = 20
SEEDS = 5  # of the paper's tables
_LARGER = 20.0
SIGN_WORDS = {Sign.PRINTED: "as printed (−)", Sign.NONE: "left out", Sign.CORRECTED: "reversed (+)"}
_TITLES = {
    ("htm", 1): "six-parameter transforms, stage 1",
    ("dh", 1): "Denavit-Hartenberg, stage 1",
    ("htm", 2): "affine pair on the transforms",
    ("dh", 2): "affine pair on Denavit-Hartenberg",
}


@figure("tablet", "the tablet paper repeated: Tables 7 to 12, the sign of Eq. 20, models with smaller errors")
def tablet(run: Run) -> None:
    """Repeat the tablet paper; differential evolution has the paper's size in the full form only."""
    touches, trials = published_touches(), run.size(2, 60)
    rows: Iterable[Row]
    population, generations = run.size((SMALL_POPULATION, SMALL_GENERATIONS), (POPULATION, GENERATIONS))
    seeds = tuple(range(run.seed + 1, run.seed + 1 + SEEDS))
    run.progress("differential evolution", 0.0)
    stages = reproduce_stages(touches, seeds, population, generations)
    run.progress("one landmark left out", 0.5)
    rows = (
        (m.name, str(m.unknowns), fixed(m.in_sample_mm, 3), fixed(m.left_out_mm, 3), fixed(m.worst_mm))
        for m in compare_models(touches)
    )
    run.table("", ("published data", "unknowns", "in sample mm", "held out mm", "largest mm"), rows)
    unseen = held_out(run.seed, trials, min(trials, PUBLISHED_TRIALS))
    rows = ((u.name, str(u.trials), fixed(u.mean_mm, 3)) for u in unseen)
    run.table("Unseen queries", ("simulated", "trials", "unseen mm"), rows)
    rows = (
        (SIGN_WORDS[s.sign], fixed(s.rigid_mm, 3), fixed(s.scaled_mm, 3), fixed(s.left_out_mm, 2))
        for s in compare_signs(touches)
    )
    title = "The sign of Eq. 20, without a camera: the tablet's points against the hand"
    run.table(title, ("touching error", "rigid, mm per axis", "with scale, mm per axis", "held out mm"), rows)
    ordered = sorted(stages, key=lambda r: TABLE_NUMBER[r.model, r.stage])
    for r in ordered:
        title = f"Table {TABLE_NUMBER[r.model, r.stage]}: {_TITLES[r.model, r.stage]}"
        run.table(title, ("", "printed", "ours", "differential evolution"), table_rows(r))
    rows = ((name, fixed(f.F, 4), fixed(f.f1, 4), fixed(f.f2, 4)) for name, f in dh_by_eq_20(touches).items())
    run.table("The error in Table 8", ("", "F, mm", "f1, mm", "f2, mm"), rows)
    touching = ((f"Table {n}", *(fixed(v) for v in values)) for n, values in TOUCHING_MM.items())
    run.table("Touched again by the paper's robot, printed, mm", ("", "1", "2", "3", "4", "5"), touching)
    rows = ((f"Table {TABLE_NUMBER[r.model, r.stage]}", *(fixed(e.fitness.F, 4) for e in r.evolved)) for r in ordered)
    title = f"F by differential evolution, N = {population}, G = {generations}, mm"
    run.table(title, ("seed", *map(str, seeds)), rows)
    fits, evolved = (sum(getattr(r, name) for r in stages) for name in ("seconds", "evolved_seconds"))
    rate = sum(e.evaluations for r in stages for e in r.evolved) / evolved
    run.say(
        f"The four fits take {fits:.2f} s. Differential evolution computes {1e-6 * rate:.1f} million costs a second: N = G"
        f" = 10 000 take {POPULATION * GENERATIONS / rate:.0f} s a seed, {run.size('extrapolated', 'measured')}."
    )
    run.write("residuals.svg", sign_residuals(touches))
    of = {(r.model, r.stage): r.ours.parameters for r in stages}
    run.write("tablet_fig6.svg", chain_picture(touches, of["htm", 1], None))
    run.write("tablet_fig7.svg", chain_picture(touches, STAGE_1["htm"].parameters, of["htm", 2]))


def chain_picture(touches: TabletTouches, stage1: Array, affine: Array | None) -> bytes:
    """Draw Fig. 6, or Fig. 7 with an affine pair (10,): the landmarks in the base, and the hand that touches them."""
    placed = place_landmarks(touches, stage1, "htm")
    target = 1e3 * touches.hand_m + Sign.PRINTED * placed.correction[0]
    pair = AFFINE_NONE if affine is None else affine
    seen = apply_affine(pair[None, :5], placed.seen)
    hand = apply_affine(pair[None, 5:], seen - placed.pen)[0]
    picture, (left, right) = subplots(9.6, 4.2, 1, 2)
    _pairs(left, "(a) landmarks", (seen[0], "from the image"), (placed.shown[0], "from the tablet"))
    _pairs(
        right, "(b) hand", (hand, "by Eq. 8" if affine is None else "by Eq. 8 and $A_2$"), (target, "touched, Eq. 20")
    )
    return svg(picture)


def _pairs(axes: Axes, title: str, ours: tuple[Array, str], other: tuple[Array, str]) -> None:
    """Draw two sets (n, 2) mm of points in the base with the landmarks' numbers, and their mean distance as title."""
    axes.plot(*ours[0].T, "o", color=OURS, ms=8, mfc="none", mew=1.4, label=ours[1])
    axes.plot(*other[0].T, "x", color=TRUTH, ms=6, mew=1.4, label=other[1])
    for k, at in enumerate(ours[0]):
        axes.annotate(str(k), at, (7, 5), textcoords="offset points", fontsize=8, color="#555")
    off = float(np.linalg.norm(ours[0] - other[0], axis=1).mean())
    axes.set_title(f"{title}: {off:.2f} mm apart on average", fontsize=10)
    plain(axes, "base x, mm", "base y, mm")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.12)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False, fontsize=9)


def sign_residuals(touches: TabletTouches) -> bytes:
    """Draw for each sign of Eq. 20 the hand positions, and how far a similarity of tablet and pen misses them."""
    picture, every = subplots(9.6, 3.0, 1, 3, sharex=True, sharey=True)
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
        axes.set(aspect="equal", xlabel="hand x, mm")
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
