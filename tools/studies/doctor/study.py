"""Counts which cause the doctor names first in sets with an injected one, and what it names in sets without."""

from collections import Counter
from collections.abc import Mapping

from weldcal.calibration.doctor.diagnose import diagnose
from weldcal.tools.commands.doctor import worded
from weldcal.tools.farm.run import Farm
from weldcal.tools.studies.doctor.world import CAUSES, clean
from weldcal.tools.studies.output import markdown_table

NONE = "none"
CLEAN_SEEDS = 10_000  # sets without a cause have seeds of their own


def named_first(cause: str, seed: int) -> Mapping[str, object]:
    """The cause that the doctor names first in one set; ``cause`` none: a set without."""
    report = worded("a made set", diagnose(clean(CLEAN_SEEDS + seed) if cause == NONE else CAUSES[cause](seed)))
    return {"cause": cause, "seed": seed, "named": report.causes[0].name if report.causes else NONE}


def run_doctor_study(farm: Farm, runs: int, cleans: int, seed: int) -> tuple[dict[str, object], str]:
    """``runs`` sets with each cause and ``cleans`` without: the JSON object and a table in Markdown."""
    wanted = [(cause, s) for cause in CAUSES for s in range(seed, seed + runs)]
    wanted += [(NONE, s) for s in range(seed, seed + cleans)]
    found = farm.run(named_first, {f"{cause}, set {s}": {"cause": cause, "seed": s} for cause, s in wanted})
    counts = {
        cause: Counter(str(r["named"]) for r in found.values() if r["cause"] == cause) for cause in (*CAUSES, NONE)
    }
    right = sum(counts[cause][cause] for cause in CAUSES)
    alarms = cleans - counts[NONE][NONE]
    rows = []
    for cause, count in counts.items():
        others = ", ".join(f"{name} {n}" for name, n in count.most_common() if name != cause)
        rows.append((cause, f"{count[cause]} of {sum(count.values())}", others))
    summary: dict[str, object] = {
        "state": "done",
        "sets": len(wanted) - cleans,
        "named_first": right,
        "named_first_percent": 100.0 * right / max(len(wanted) - cleans, 1),
        "clean_sets": cleans,
        "false_alarms": alarms,
        "named": {cause: dict(count) for cause, count in counts.items()},
    }
    return summary, markdown_table(("injected", "named first", "instead"), rows)
