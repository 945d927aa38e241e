"""Counts which cause the doctor names first in sets with an injected one, and what it names in sets without."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Annotated

from weldcal.calibration.doctor.diagnose import diagnose
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.report.doctor import worded
from weldcal.tools.studies.harness import Cases, Figures, Results, Row, Study
from weldcal.tools.worlds.doctor import CAUSES, clean

NONE = "none"
CLEAN_SEEDS = 10_000  # sets without a cause have seeds of their own


def named_first(cause: str, seed: int) -> Mapping[str, object]:
    """The cause that the doctor names first in one set; ``cause`` none: a set without."""
    report = worded("a made set", diagnose(clean(CLEAN_SEEDS + seed) if cause == NONE else CAUSES[cause](seed)))
    return {"cause": cause, "seed": seed, "named": report.causes[0].name if report.causes else NONE}


def cases(runs: int, cleans: int, seed: int) -> Cases:
    """``runs`` sets with each cause and ``cleans`` without."""
    wanted = [(cause, s) for cause in CAUSES for s in range(seed, seed + runs)]
    wanted += [(NONE, s) for s in range(seed, seed + cleans)]
    return {f"{cause}, set {s}": {"cause": cause, "seed": s} for cause, s in wanted}


def _figures(found: Results) -> Figures:
    counts = {
        cause: Counter(str(r["named"]) for r in found.values() if r["cause"] == cause) for cause in (*CAUSES, NONE)
    }
    right, cleans = sum(counts[cause][cause] for cause in CAUSES), counts[NONE].total()
    return {
        "sets": len(found) - cleans,
        "named_first": right,
        "named_first_percent": 100.0 * right / max(len(found) - cleans, 1),
        "clean_sets": cleans,
        "false_alarms": cleans - counts[NONE][NONE],
        "named": {cause: dict(count) for cause, count in counts.items()},
    }


def _rows(figures: Figures) -> Iterable[Row]:
    for cause, count in figures["named"].items():
        others = ", ".join(f"{name} {n}" for name, n in Counter(count).most_common() if name != cause)
        yield cause, f"{count.get(cause, 0)} of {sum(count.values())}", others


STUDY = Study(
    name="doctor",
    what="The cause that `weldcal doctor` names first in simulated sets of scans with one injected cause, and without.",
    case=named_first,
    figures=_figures,
    header=("injected", "named first", "instead"),
    rows=_rows,
)


@command("benchmark doctor", short_help="Count how often the doctor names the injected cause.", options=FARM)
def doctor(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Sets with each cause.", min=1)] = 20,
    cleans: Annotated[int, option("--clean", "N", "Sets without a cause.", min=0)] = 200,
) -> Outcome:
    """Inject each cause into simulated sets of scans, and count which one `weldcal doctor` names first."""
    return STUDY.outcome(call, cases(runs, cleans, call.seed))
