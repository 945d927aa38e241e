"""Results of the profiler study, its targets, and its JSON object."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.tools.studies.profiler.edge import EdgeRow, edge_figures, edge_targets
from weldcal.tools.studies.profiler.sphere import WorldResult, sphere_figures, sphere_targets
from weldcal.tools.studies.targets import Target, all_met


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


@dataclass(frozen=True)
class Reached:
    """One figure of one seed or of the fixed files: what was reached, and the bound where there is one (mm or deg)."""

    value: float
    bound: float | None


@dataclass(frozen=True)
class TargetLine:
    """One target over the seeds."""

    what: str
    unit: str
    target: float
    seeds: tuple[Reached, ...]
    fixed: Reached | None

    @property
    def values(self) -> np.ndarray:
        """Reached (n,), seed by seed."""
        return np.array([r.value for r in self.seeds])

    @property
    def bounds(self) -> np.ndarray:
        """Bounds (n,); not a number where there is none."""
        return np.array([np.nan if r.bound is None else r.bound for r in self.seeds])

    @property
    def over_bound(self) -> float:
        """All seeds together, root of the mean squares over the bound's."""
        return float(np.sqrt(np.mean(self.values**2) / np.mean(self.bounds**2)))

    @property
    def met(self) -> int:
        """In how many seeds the target is met."""
        return int((self.values <= self.target).sum())
