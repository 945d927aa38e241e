"""Report page of the weld study: targets, pictures of every seam, and the comparison of the laws."""

from __future__ import annotations

from weldcal.calibration.data.results import software_version
from weldcal.tools.report.plots_weld import along_the_weld, paths
from weldcal.tools.report.render import fixed, render
from weldcal.tools.studies.weld.plots import weld_trace
from weldcal.tools.studies.weld.results import Study
from weldcal.tools.studies.weld.study import study_config
from weldcal.tools.studies.weld.tables import FIGURE_NAMES, compared_lines, table_lines, turn_lines

TITLES = {
    "straight": "Straight", "s_r60": "S of radius 60 mm", "l_r20_convex": "Corner of 20 mm, convex",
    "l_r20_concave": "Corner of 20 mm, concave", "l_r5_convex": "Corner of 5 mm, convex", "l_r5_concave": "Corner of 5 mm, concave",
    "l_r1_convex": "Corner of 1 mm, convex", "l_r1_concave": "Corner of 1 mm, concave", "arc_r60_end": "Ending on an arc of 60 mm",
}  # fmt: skip
_CARDS = (("nominal", "mean_mm"), ("nominal", "max_mm"), ("hard", "max_mm"), ("r1_convex", "max_mm"))


def study_report(study: Study) -> str:
    """The whole report as one self-contained HTML text."""
    lines = table_lines(study.rows)
    missed = sum(line[5] != "met" for line in lines) + sum(not t.named or t.stalled for t in study.turns)
    total = len(lines) + len(study.turns)
    seams = [
        {
            "title": TITLES.get(case.seam, case.seam.replace("_", " ")),
            "sentence": f"{case.name}, seed {study.options.first_seed}: mean {fixed(m.mean_mm, 3)} mm, largest "
            f"{fixed(m.max_mm, 3)} mm, torch speed CV {fixed(m.cv_percent, 1)} %, turning rate up to {fixed(m.omega_rad_s, 2)} rad/s.",
            "paths": paths(trace),
            "along": along_the_weld(trace),
            "bent": trace.work is not None,
        }
        for case, trace, m in ((case, weld_trace(run, study_config(case)), m) for case, run, m in study.pictured)
    ]
    usual = any(row.row.key == key for row in study.rows for key, _ in _CARDS)
    cards = [
        (row.row.label, FIGURE_NAMES[r.target.figure], r)
        for row in study.rows
        for r in row.reached
        if ((row.row.key, r.target.figure) in _CARDS if usual else r == row.reached[0])
    ]
    return render(
        "weld_study.html.j2",
        cards=cards,
        study=study,
        lines=lines,
        missed=missed,
        total=total,
        seams=seams,
        turns=turn_lines(study.turns),
        compared=compared_lines(study.compared),
        software=software_version(),
    )
