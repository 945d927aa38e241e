"""Report page of the tablet study: targets, the paper's tables and ours, the sign, the models."""

from __future__ import annotations

from weldcal.calibration.data.results import software_version
from weldcal.tools.report.render import fixed, render
from weldcal.tools.studies.tablet.paper import TABLE_NUMBER, TOUCHING_MM, printed_stage, published_touches
from weldcal.tools.studies.tablet.plots import SIGN_WORDS, sign_residuals, unseen_errors
from weldcal.tools.studies.tablet.results import TabletStudy, limit_words
from weldcal.tools.studies.tablet.study import Reproduced

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
        missed=sum(not t.met for t in study.targets if t.decides),
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
