"""Results of the weld study and its JSON object."""

from dataclasses import asdict, dataclass
from pathlib import Path

from weldcal.tools.studies.weld.study import CaseResult, RowResult
from weldcal.tools.studies.weld.turns import TurnResult
from weldcal.tools.worlds.weld.case import Case
from weldcal.tools.worlds.weld.metrics import RunMetrics
from weldcal.tools.worlds.weld.plant import StudyRun


@dataclass(frozen=True)
class StudyOptions:
    """Output folder, rows (all when none), how many seeds, the first of them, and whether in short form."""

    folder: Path
    rows: tuple[str, ...] = ()
    seeds: int = 10
    first_seed: int = 0
    quick: bool = False


@dataclass(frozen=True, eq=False)
class Study:
    """All runs of a study, by row, by turn and by law, and one pictured run of each seam."""

    options: StudyOptions
    rows: tuple[RowResult, ...]
    turns: tuple[TurnResult, ...]
    compared: tuple[CaseResult, ...]
    pictured: tuple[tuple[Case, StudyRun, RunMetrics], ...]
    wall_seconds: float

    @property
    def met(self) -> bool:
        """Whether every weld was completed, every target met, and every impossible turn refused."""
        return all(r.met for r in self.rows) and all(t.named and not t.stalled for t in self.turns)

    def summary(self) -> dict[str, object]:
        """The result for JSON; what could not be measured is null."""
        return {
            "state": "done",
            "met": self.met,
            "seeds": self.options.seeds,
            "first_seed": self.options.first_seed,
            "rows": {r.row.key: _row_summary(r) for r in self.rows},
            "turns": [asdict(t) | {"named": t.named, "stalled": t.stalled} for t in self.turns],
            "laws": [
                {"case": c.case.name, "law": c.case.law, "completed": c.completed, "runs": c.metrics}
                for c in self.compared
            ],
            "wall_seconds": self.wall_seconds,
            "written_to": self.options.folder,
        }


def _row_summary(row: RowResult) -> dict[str, object]:
    return {
        "label": row.row.label,
        "met": row.met,
        "runs": row.runs,
        "completed": row.completed,
        "figures": {
            r.target.figure: {
                "target": r.target.limit, "over": r.target.over, "unit": r.target.unit, "mean": r.mean, "worst": r.worst,
                "met": r.met, "worst_run": r.worst_run,
            }
            for r in row.reached
        },
    }  # fmt: skip
