"""Counts what the doctor and the fleet name in simulated sets and cells, disturbed and undisturbed."""

from collections import Counter

from tests.figures.harness import Run, figure
from tests.worlds.doctor import CAUSES, FAULTS, clean, write_fleet
from weldcal.calibration.doctor.diagnose import diagnose
from weldcal.tools.commands.fleet import run_fleet
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.doctor import worded
from weldcal.tools.report.fleet import FINE, LOOK, VISIT

NONE = "none"
CLEAN_SEEDS = 10_000  # sets without a cause have seeds of their own


@figure("doctor", "the cause that `weldcal doctor` names first in sets of scans with one injected cause, and without")
def doctor(run: Run) -> None:
    """Inject each cause into simulated sets of scans, and count which one the doctor names first."""
    rows = []
    for k, cause in enumerate((*CAUSES, NONE)):
        named: Counter[str] = Counter()
        for seed in run.seeds(2, 200) if cause == NONE else run.seeds(1, 20):
            run.progress(cause, k / (len(CAUSES) + 1))
            made = clean(CLEAN_SEEDS + seed) if cause == NONE else CAUSES[cause](seed)
            causes = worded("a made set", diagnose(made)).causes
            named[causes[0].name if causes else NONE] += 1
        others = ", ".join(f"{name} {n}" for name, n in named.most_common() if name != cause)
        rows.append((cause, f"{named[cause]} of {named.total()}", others))
    run.table("", ("injected", "named first", "instead"), rows)


@figure("fleet", "what `weldcal fleet` says of cells that are fine, moved, drift or are broken")
def fleet(run: Run) -> None:
    """Write made cells, some of which move, drift or break, and count what `weldcal fleet` says of them."""
    faults = write_fleet(run.out / "cells", run.size(3, 25), run.size(3, 8), run.seed)
    report = run_fleet(run.out / "cells", Farm(run.out / "page", progress=run.progress), seed=run.seed)
    states = {cell.name: cell.state for cell in report.cells}
    said = Counter((fault, states[name]) for name, fault in faults.items())
    header = (VISIT, LOOK, FINE)
    run.table("", ("fault", *header), ((fault, *(str(said[fault, state]) for state in header)) for fault in FAULTS))
