"""Results of the profiler study with their targets, and its report page: both papers' tables compared with ours, and pictures."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.tools.report.render import fixed, render
from weldcal.tools.studies.profiler import edge, plots, sphere
from weldcal.tools.studies.profiler.edge import EdgeRow, edge_figures, edge_targets
from weldcal.tools.studies.profiler.fixed import figure_text
from weldcal.tools.studies.profiler.sphere import WorldResult, sphere_figures, sphere_targets
from weldcal.tools.studies.targets import Target, all_met

Lines = list[tuple[str, ...]]


@dataclass(frozen=True)
class ProfilerStudyOptions:
    """Output folder; folder of the fixed files, or None to make trials from `seed`; whether in short form."""

    folder: Path
    data: Path | None = None
    seed: int = 0
    quick: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerStudy:
    """Everything that the study computed.

    Attributes:
        names: the sets of edge trials.
        ball: (n, m, 3) m, profiles of a ball, brought into one frame by the joint method.
        fixed: targets of what only the fixed files hold.
    """

    options: ProfilerStudyOptions
    names: tuple[str, ...]
    edge: tuple[EdgeRow, ...]
    sphere: tuple[WorldResult, ...]
    ball: np.ndarray
    fixed: tuple[Target, ...]
    wall_seconds: float

    def of(self, method: str) -> list[WorldResult]:
        """A method's results over the worlds."""
        return [r for r in self.sphere if r.method == method]

    def targets(self) -> list[Target]:
        """Every target; the limits were set on the fixed files."""
        reached = sphere_figures(self.sphere)
        for r in self.edge:
            if r.met is not None:
                reached |= edge_figures(r.name, (r.rotation_deg, r.translation_mm))
        wanted = [*edge_targets(self.names), *sphere_targets()]
        return [*(Target(what, unit, reached[what], limit) for what, unit, limit in wanted), *self.fixed]

    @property
    def met(self) -> bool:
        """Whether all targets are met."""
        return all_met(self.targets())

    def summary(self) -> dict[str, object]:
        """The result for JSON."""
        return {
            "state": "done",
            "met": self.met,
            "data": "fixed files" if self.options.data else f"seed {self.options.seed}",
            "targets": [
                {"what": t.what, "unit": t.unit, "reached": t.value, "target": t.limit, "verdict": t.verdict}
                for t in self.targets()
            ],
            "edge": self.edge,
            "sphere": [
                {
                    "world": r.world,
                    "method": r.method,
                    "points_mm": r.points_mm,
                    "seam_mm": r.seam_mm,
                    "boss": r.boss_error,
                }
                for r in self.sphere
            ],
            "wall_seconds": self.wall_seconds,
            "written_to": self.options.folder,
        }


def target_lines(study: ProfilerStudy) -> Lines:
    """What, reached, target, verdict."""
    return [(t.what, figure_text(t.value, t.unit), t.wanted, t.verdict) for t in study.targets()]


def criteria_lines(study: ProfilerStudy) -> tuple[Lines, Lines, Lines]:
    """Tables 1 to 3 of the edge paper, over 10 to 25 rotations: as printed for its three objects, then every set and method."""
    n = edge.COUNTS

    def pair(mean: float, std: float, digits: int) -> str:
        return f"{fixed(mean, digits)} ± {fixed(std, digits)}"

    tables: tuple[Lines, Lines, Lines] = ([], [], [])
    for j, thing in enumerate(("bar", "scale", "blade")):
        alpha = (pair(edge.PRINTED_ALPHA[k][j], edge.PRINTED_ALPHA_STD[k][j], 2) for k in n)
        d = (pair(edge.PRINTED_D[k][j], edge.PRINTED_D_STD[k][j], 2) for k in n)
        radius = (fixed(edge.PRINTED_RADIUS[k][j], 2) for k in n)
        for table, cells in zip(tables, (alpha, d, radius), strict=True):
            table.append(("printed" if j == 0 else "", thing, *cells))
    for name in study.names:
        for method in edge.METHODS:
            by = {x.rotations: x for x in study.edge if (x.name, x.method) == (name, method)}
            rows = [by[k] for k in n]
            alpha = (pair(r.alpha_mean_deg, r.alpha_std_deg, 2) for r in rows)
            d = (pair(r.d_mean_mm, r.d_std_mm, 3) for r in rows)
            for table, cells in zip(tables, (alpha, d, (fixed(r.radius_mm, 3) for r in rows)), strict=True):
                table.append((edge.TITLES[name] if method == edge.METHODS[0] else "", method, *cells))
    return tables


def error_lines(study: ProfilerStudy) -> Lines:
    """The calibration's own error, which the criteria hardly show."""
    lines: Lines = []
    for name in study.names:
        for n in edge.COUNTS:
            p, j = (
                next(r for r in study.edge if (r.name, r.rotations, r.method) == (name, n, m)) for m in edge.METHODS
            )
            lines.append(
                (edge.TITLES[name] if n == edge.COUNTS[0] else "", str(n), f"{fixed(p.rotation_deg, 3)} / {fixed(p.translation_mm, 3)}",
                 f"{fixed(j.rotation_deg, 3)} / {fixed(j.translation_mm, 3)}", f"{fixed(j.crb_deg, 3)} / {fixed(j.crb_mm, 3)}")
            )  # fmt: skip
    return lines


def sphere_lines(study: ProfilerStudy) -> tuple[Lines, Lines, Lines]:
    """Tables 1 to 3 of the sphere paper."""
    points: Lines = []
    seam: Lines = []
    boss: Lines = []
    for method in sphere.METHODS:
        results = study.of(method)
        printed = sphere.PRINTED_POINTS.get(method)
        mean = np.mean([r.points_mm for r in results], axis=0)
        points.append(
            (
                method,
                *([fixed(v, 3) for v in printed] if printed else ["–"] * 3),
                *(fixed(v, 3) for v in mean),
                fixed(float(mean.mean()), 3),
            )
        )
        s = [r.seam_mm for r in results if r.seam_mm is not None]
        shown = [fixed(v, 3) for v in sphere.PRINTED_SEAM] if method == "compensated" else ["–"] * 3
        seam.append((method, *shown, *(fixed(v, 3) for v in np.mean(s, axis=0))))
        b = [r.boss_error for r in results if r.boss_error is not None]
        shown = [fixed(v, 3) for v in sphere.PRINTED_BOSS] if method == "compensated" else ["–"] * 2
        boss.append((method, *shown, *(f"{fixed(min(v), 3)} to {fixed(max(v), 3)}" for v in zip(*b, strict=True))))
    return points, seam, boss


def profiler_report(study: ProfilerStudy) -> str:
    """The whole report as one self-contained HTML text."""
    lines = target_lines(study)
    alpha, d, radius = criteria_lines(study)
    points, seam, boss = sphere_lines(study)
    rows = list(study.edge)
    with_boss = next(r for r in study.of(sphere.METHODS[3]) if r.boss is not None)
    fixed_files = study.options.data is not None
    return render(
        "profiler_study.html.j2",
        study=study,
        source="the fixed files" if fixed_files else f"worlds made from seed {study.options.seed}",
        lines=lines,
        papers=len(lines) - len(study.fixed),
        missed=sum(line[3] != "met" for line in lines),
        alpha=alpha, d=d, radius=radius, errors=error_lines(study), points=points, seam=seam, boss=boss,
        fig_alpha=plots.against_rotations(rows, study.names, "alpha", "deg", _short()),
        fig_d=plots.against_rotations(rows, study.names, "d", "mm", _short()),
        fig_error=plots.true_error(rows, study.names, _short()),
        fig_ball=plots.ball(study.ball),
        fig_seam=plots.seam(list(study.sphere)),
        fig_boss=plots.frustum(with_boss),
        command="weldcal reproduce profiler" + (" --data FOLDER" if fixed_files else f" --seed {study.options.seed}") + (" --quick" if study.options.quick else ""),
    )  # fmt: skip


def _short() -> dict[str, str]:
    return {name: title.replace("noise as in the paper", "paper noise") for name, title in edge.TITLES.items()}
