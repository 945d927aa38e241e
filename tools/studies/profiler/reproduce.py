"""`weldcal reproduce profiler`: the tables of both papers and the joint method, with targets."""

import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.console import Progress
from weldcal.tools.report.render import fixed
from weldcal.tools.studies.harness import Figures, Row, Study, Table, Target, all_met
from weldcal.tools.studies.profiler import papers
from weldcal.tools.studies.profiler.fixed import figure_text, fixed_lines, published_lines, require_files
from weldcal.tools.studies.profiler.papers import (
    EdgeRow,
    WorldResult,
    edge_figures,
    edge_rows,
    edge_targets,
    measure,
    sphere_figures,
    sphere_targets,
)
from weldcal.tools.worlds.edge_trials import SETS, EdgeTrial, fixed_edge_trials, made_edge_trials
from weldcal.tools.worlds.profiler_parts import fixed_worlds, made_worlds

TRIALS, WORLDS, GROOVES, BOSSES = 10, 8, 3, 2
QUICK_SETS = ("xy_paper", "tilt_nominal")


@command("reproduce profiler", short_help="Repeat both papers on laser profilers.")
def profiler(
    call: Call,
    data: Annotated[
        Path | None, option("--data", "FOLDER", "The fixed files. Without them, worlds generated from the seed.")
    ] = None,
    quick: Annotated[bool, switch("--quick", "Two sets of edges and two or three worlds.")] = False,
) -> Outcome:
    """Repeat both papers on laser profilers: their tables with ours for comparison."""
    folder = STUDY.folder(call)
    figures = compute(data, call.seed, quick, call.progress)
    return STUDY.measured({"all": figures | {"written_to": folder}}, folder).outcome()


def compute(data: Path | None, seed: int, quick: bool, progress: Progress) -> dict[str, Any]:
    """Run it, on the fixed files in the folder ``data`` or on trials made from the seed.

    Raises:
        InputError: the fixed files are not in the folder named.
    """
    start = time.monotonic()
    if data is not None and not data.is_dir():
        raise InputError(f"There is no folder '{data}': give the one with edge_features.npz and sphere.npz.")
    whole = None if quick else data
    if whole is not None:
        require_files(whole)
    names = QUICK_SETS if quick else SETS
    worlds = (2 if data is None else 3) if quick else WORLDS

    def trials_of(name: str) -> Iterator[EdgeTrial]:
        return made_edge_trials(name, TRIALS, seed) if data is None else fixed_edge_trials(data, name)

    rows: list[EdgeRow] = []
    for k, name in enumerate(names):

        def tell(share: float, k: int = k) -> None:
            progress(f"edge {names[k]}", 0.4 * (k + share) / len(names))

        rows += edge_rows(name, trials_of(name), tell)
    made = made_worlds(worlds, seed, GROOVES, BOSSES) if data is None else fixed_worlds(data, worlds)
    results: list[WorldResult] = []
    for k, world in enumerate(made):
        progress(f"sphere, world {k}", 0.4 + 0.4 * k / worlds)
        results += measure(k, world)
    reached = sphere_figures(results)
    for r in rows:
        if r.met is not None:
            reached |= edge_figures(r.name, (r.rotation_deg, r.translation_mm))
    wanted = [*edge_targets(names), *sphere_targets()]
    targets = [Target(what, unit, reached[what], limit) for what, unit, limit in wanted]
    if whole is not None:
        targets += published_lines(results)
        targets += fixed_lines(whole, lambda name, share: progress(name, 0.8 + 0.2 * share))
    return {
        "met": all_met(targets),
        "data": "fixed files" if data else f"seed {seed}",
        "targets": [
            {"what": t.what, "unit": t.unit, "reached": t.value, "target": t.limit, "verdict": t.verdict}
            for t in targets
        ],
        "edge": rows,
        "sphere": results,
        "wall_seconds": time.monotonic() - start,
    }


def _lines(figures: Figures) -> Iterable[Row]:
    for t in figures["targets"]:
        yield t["what"], figure_text(t["reached"], t["unit"]), f"≤ {t['target']:g}", t["verdict"]


def _missed(figures: Figures) -> list[Target]:
    """The targets were set for the fixed files: other worlds may be harder, and decide nothing."""
    missed = sum(t["verdict"] != "met" for t in figures["targets"])
    return [Target("missed targets", "", missed, 0.0, decides=figures["data"] == "fixed files")]


def _edge_tables(rows: Iterable[EdgeRow]) -> Iterable[Table]:
    """Tables 1 to 3 of the edge paper, over 10 to 25 rotations, as printed for its three objects and of every set and
    method; and the calibration's own error, which those criteria hardly show."""
    n = papers.COUNTS
    by = {(r.name, r.method, r.rotations): r for r in rows}
    names = list(dict.fromkeys(name for name, _, _ in by))

    def pair(mean: float, std: float, digits: int) -> str:
        return f"{fixed(mean, digits)} ± {fixed(std, digits)}"

    tables: tuple[list[Row], list[Row], list[Row]] = ([], [], [])
    for j, thing in enumerate(("bar", "scale", "blade")):
        alpha = (pair(papers.PRINTED_ALPHA[k][j], papers.PRINTED_ALPHA_STD[k][j], 2) for k in n)
        d = (pair(papers.PRINTED_D[k][j], papers.PRINTED_D_STD[k][j], 2) for k in n)
        radius = (fixed(papers.PRINTED_RADIUS[k][j], 2) for k in n)
        for table, cells in zip(tables, (alpha, d, radius), strict=True):
            table.append(("printed", thing, *cells))
    errors: list[Row] = []
    for name in names:
        for method in papers.EDGE_METHODS:
            found = [by[name, method, k] for k in n]
            alpha = (pair(r.alpha_mean_deg, r.alpha_std_deg, 2) for r in found)
            d = (pair(r.d_mean_mm, r.d_std_mm, 3) for r in found)
            for table, cells in zip(tables, (alpha, d, (fixed(r.radius_mm, 3) for r in found)), strict=True):
                table.append((papers.TITLES[name], method, *cells))
        for k in n:
            p, q = (by[name, m, k] for m in papers.EDGE_METHODS)
            three = ((p.rotation_deg, p.translation_mm), (q.rotation_deg, q.translation_mm), (q.crb_deg, q.crb_mm))
            errors.append((papers.TITLES[name], str(k), *(f"{fixed(deg, 3)} / {fixed(mm, 3)}" for deg, mm in three)))
    yield "Edge: true errors, deg / mm", ("set", "rotations", "paper", "joint", "Cramér-Rao bound"), errors
    counts = tuple(f"{k} rotations" for k in n)
    for title, lines in zip(("1: angle, deg", "2: distance, mm", "3: radius, mm"), tables, strict=True):
        yield f"Edge paper, Table {title}", ("set", "method", *counts), lines


def _sphere_tables(results: Iterable[WorldResult]) -> Iterable[Table]:
    """Tables 1 to 3 of the sphere paper."""
    points: list[Row] = []
    seam: list[Row] = []
    boss: list[Row] = []
    for method in papers.SPHERE_METHODS:
        found = [r for r in results if r.method == method]
        printed = papers.PRINTED_POINTS.get(method)
        mean = np.mean([r.points_mm for r in found], axis=0)
        points.append((method, *_printed(printed), *(fixed(v, 3) for v in (*mean, float(mean.mean())))))
        best = method == "compensated"
        s = np.mean([r.seam_mm for r in found if r.seam_mm is not None], axis=0)
        seam.append((method, *_printed(papers.PRINTED_SEAM if best else None), *(fixed(v, 3) for v in s)))
        b = zip(*(r.boss for r in found if r.boss is not None), strict=True)
        shown = _printed(papers.PRINTED_BOSS if best else None, 2)
        boss.append((method, *shown, *(f"{fixed(min(v), 3)} to {fixed(max(v), 3)}" for v in b)))
    three = ("point 1", "point 2", "point 3")
    for title, names, lines in (
        ("1: sensed to touched, mm", (*(f"printed, {p}" for p in three), *three, "mean"), points),
        ("2: seam, mm", (*(f"printed, {p}" for p in papers.SEAM_FEATURES), *papers.SEAM_FEATURES), seam),
        ("3: frustum", ("printed, length mm", "printed, angle deg", "length mm", "angle deg"), boss),
    ):
        yield f"Sphere paper, Table {title}", ("method", *names), lines


def _printed(values: Iterable[float] | None, count: int = 3) -> list[str]:
    return ["–"] * count if values is None else [fixed(v, 3) for v in values]


STUDY = Study(
    name="profiler",
    what="Both papers on laser profilers: their methods and the joint method, against targets set on the fixed files.",
    figures=lambda results: results["all"],
    header=("figure", "reached", "target", ""),
    rows=_lines,
    targets=_missed,
    others=lambda figures: [*_edge_tables(figures["edge"]), *_sphere_tables(figures["sphere"])],
    group="reproduce",
)
