"""Runs the tablet study: the paper's tables, the signs, the models; writes table.json and report.html."""

import time

from weldcal.calibration.tablet.planar.linear import fit_linear
from weldcal.tools.console import Progress
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.tablet.paper import published_touches
from weldcal.tools.studies.tablet.report import tablet_report
from weldcal.tools.studies.tablet.results import TabletOptions, TabletStudy
from weldcal.tools.studies.tablet.study import compare_models, compare_signs, dh_by_eq_20, held_out, reproduce_stages

PUBLISHED_TRIALS = 20


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
        options=options,
        stages=stages,
        cost=cost,
        dh=dh,
        signs=signs,
        models=models,
        unseen=unseen,
        linear=fit_linear(touches),
        wall_seconds=time.monotonic() - start,
    )
    progress("report", 0.99)
    write_json(options.folder / "table.json", study.summary())
    write_atomic(options.folder / "report.html", tablet_report(study))
    return study
