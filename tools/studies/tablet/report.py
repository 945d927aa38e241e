"""The tablet study's report page: targets, the paper's tables beside ours, the sign, the models."""

from __future__ import annotations

from typing import TYPE_CHECKING

from weldcal.calibration.data.results import software_version
from weldcal.tools.report.render import fixed, render
from weldcal.tools.studies.tablet.paper import STAGE_1, STAGE_2, TABLE_NUMBER, TOUCHING_MM, published_touches
from weldcal.tools.studies.tablet.plots import SIGN_WORDS, sign_residuals, unseen_errors
from weldcal.tools.studies.tablet.study import Reproduced

if TYPE_CHECKING:
    from weldcal.tools.studies.tablet.command import TabletStudy

_TITLES = {
    ("htm", 1): "six-parameter transforms, stage 1", ("dh", 1): "Denavit-Hartenberg, stage 1",
    ("htm", 2): "affine pair on the transforms", ("dh", 2): "affine pair on Denavit-Hartenberg",
}  # fmt: skip


def table_rows(r: Reproduced) -> list[tuple[str, ...]]:
    """One of the paper's tables: name, printed, ours, by differential evolution (first seed)."""
    printed = (STAGE_1 if r.stage == 1 else STAGE_2)[r.model]
    ours, evolved = r.ours, r.evolved[0] if r.evolved else None
    rows: list[tuple[str, ...]] = []
    for k, name in enumerate(("F", "f1", "f2")):
        de = fixed(getattr(evolved.fitness, name), 4) if evolved else "–"
        rows.append((f"{name}, mm", fixed(printed.fitness[k]), fixed(getattr(ours.fitness, name), 4), de))
    for k, name in enumerate(printed.names):
        de = fixed(float(evolved.parameters[k]), 2) if evolved else "–"
        rows.append((name, fixed(float(printed.parameters[k])), fixed(float(ours.parameters[k]), 2), de))
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
        targets=[
            (what, fixed(value, 4), limit, "met" if met else "MISSED") for what, value, limit, met in study.targets
        ],
        missed=sum(not met for *_, met in study.targets),
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
        software=software_version(),
    )
