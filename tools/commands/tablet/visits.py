"""Calibrates each visit of a file by itself, with the model that has the smallest held-out error over all of them."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import software_version
from weldcal.calibration.tablet.planar.files import PlanarFile
from weldcal.calibration.tablet.published.two_stage import Sign
from weldcal.calibration.tablet.wrist.files import file_hash
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.tools.commands.tablet.planar import NAMES, VisitFits, best_model, fit_visit
from weldcal.tools.outcomes.calibration import error_summary
from weldcal.tools.outcomes.first_screen import FirstScreen
from weldcal.tools.outcomes.tablet import visits_screen
from weldcal.tools.report.files import mappings_csv
from weldcal.tools.report.pictures import error_bars
from weldcal.tools.report.render import fixed, render, write_atomic
from weldcal.tools.report.tablet import Page


@dataclass(frozen=True, eq=False, kw_only=True)
class ManyVisits:
    """The fits of all visits, the refused visits with the reason, and the model chosen for all."""

    file: Path
    visits: tuple[VisitFits, ...]
    refused: tuple[tuple[str, str], ...]
    model: str
    errors_mm: dict[str, float]
    step_m: float
    seconds: float = 0.0
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen: of all visits together."""
        held = self.held_out_mm(self.model)
        queried = bool(held.size)
        if not queried:
            held = np.concatenate([v.left_out_mm(self.model) for v in self.visits])
        warnings = [f"Visit {v.visit.name}: {text}" for v in self.visits for text in v.warnings]
        return visits_screen(held[np.isfinite(held)], queried, warnings, self.refused, len(self.visits), self.limit_mm)

    def held_out_mm(self, model: str) -> Array:
        """Errors at the queries of all visits, mm; empty where there are none."""
        return np.concatenate([v.held_out_mm(model) for v in self.visits])

    def summary(self) -> dict[str, object]:
        """The JSON object of `tablet calibrate` for such a file."""
        others = {m: error_figures(self.held_out_mm(m)) for m in self.errors_mm if m != self.model}
        warnings = sorted({text for v in self.visits for text in v.warnings})
        return {
            "state": "done",
            "model": self.model,
            "n_visits": len(self.visits),
            "refused": [{"id": name, "reason": reason} for name, reason in self.refused],
            "leave_one_out_mm": _number(self.errors_mm[self.model]),
            "leave_one_out_of_other_models_mm": {m: _number(e) for m, e in self.errors_mm.items() if m != self.model},
            "held_out_mm": error_figures(self.held_out_mm(self.model)),
            "held_out_of_other_models_mm": {m: f["mean"] for m, f in others.items() if f is not None},
            "hand_step_mm": 1e3 * self.step_m,
            "n_warnings": len(warnings),
            "visits": [self._visit(v) for v in self.visits],
            "seconds": self.seconds,
        }

    def _visit(self, v: VisitFits) -> dict[str, Any]:
        fit, left, held = v.fits[self.model], v.left_out_mm(self.model), v.held_out_mm(self.model)
        return {
            "id": v.visit.name,
            "n_landmarks": len(left),
            "parameters": dict(zip(NAMES[self.model], fit.parameters.tolist(), strict=True)),
            "residual_mm": 1e3 * float(np.linalg.norm(fit.residuals_m, axis=1).mean()),
            "leave_one_out_mm": float(np.nanmean(left)) if np.isfinite(left).any() else None,
            "held_out_mm": float(held.mean()) if held.size else None,
            "warnings": list(v.warnings),
        }

    def write(self, folder: Path) -> None:
        """Write visits.json, visits.csv and report.html, each whole or not at all."""
        found = self.summary()
        provenance = {
            "schema": 1,
            "software": software_version(),
            "data_sha256": {self.file.name: file_hash(self.file)},
        }
        write_atomic(folder / "visits.json", json.dumps({**provenance, **found}, indent=1, allow_nan=False) + "\n")
        write_atomic(folder / "visits.csv", _csv([self._visit(v) for v in self.visits]))
        write_atomic(folder / "report.html", self._report())

    def _report(self) -> str:
        held, left = error_figures(self.held_out_mm(self.model)), self.errors_mm[self.model]
        cards = [("Held-out landmark, mean", fixed(left, 3), "mm", "plain", "each predicted by a fit without it")]
        if held is not None:
            worst = f"largest {fixed(held['max'], 3)}; not used in the fit"
            cards.insert(0, ("The file's queries, mean", fixed(held["mean"], 3), "mm", "good", worst))
        cards.append(("Visits", str(len(self.visits)), "", "plain", f"{len(self.refused)} refused"))
        rows = [
            (v["id"], fixed(v["held_out_mm"], 3), fixed(v["leave_one_out_mm"], 3), fixed(v["residual_mm"], 3), str(v["n_landmarks"]))
            for v in map(self._visit, self.visits)
        ]  # fmt: skip
        warnings = [f"Visit {v.visit.name}: {text}" for v in self.visits for text in v.warnings]
        models = ", ".join(f"{m} {fixed(e, 3)} mm" for m, e in self.errors_mm.items())
        return render(
            "tablet.html.j2",
            first=self.first,
            page=Page(
                title="Calibration of camera and pen by a tablet: all visits",
                subtitle=f"{self.file.name}: {len(self.visits)} visits. Held-out landmarks by model: {models}.",
                cards=cards,
                notes=[*(f"Visit {name} was refused: {reason}" for name, reason in self.refused), *warnings],
                errors=error_bars(
                    [v.visit.name for v in self.visits],
                    np.array([np.nan if (e := self._visit(v)["leave_one_out_mm"]) is None else e for v in self.visits]),
                    np.ones(len(self.visits), bool),
                    "held-out landmark, mean, mm",
                ),
                header=("visit", "queries, mm", "held out, mm", "fit, mm", "landmarks"),
                rows=rows,
                provenance=[
                    ("software", software_version()),
                    (f"SHA-256 of {self.file.name}", file_hash(self.file)),
                    ("seconds", fixed(self.seconds, 2)),
                ],
            ),
        )  # fmt: skip


def error_figures(errors_mm: Array) -> dict[str, float] | None:
    """Median, mean, 95th percentile and maximum of errors (n,) mm; None where there are none."""
    return error_summary(errors_mm) if errors_mm.size else None


def fit_many(file: Path, read: PlanarFile, sign: Sign, step_m: float) -> ManyVisits:
    """Fit every visit by itself; a visit that cannot be fitted is refused with the reason.

    Raises:
        WeldcalError: no visit can be fitted; the first refusal.
    """
    fitted, refused, first = [], list(read.refused), None
    for visit in read.visits:
        try:
            fitted.append(fit_visit(visit, sign, step_m, thorough=False))
        except WeldcalError as problem:
            refused.append((visit.name, str(problem)))
            first = first or problem
    if first is not None and not fitted:
        raise first
    model, errors = best_model(fitted)
    return ManyVisits(
        file=file, visits=tuple(fitted), refused=tuple(refused), model=model, errors_mm=errors, step_m=step_m
    )


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _csv(visits: Sequence[dict[str, Any]]) -> str:
    left_out = ("parameters", "warnings")
    return mappings_csv([{k: v for k, v in x.items() if k not in left_out} | x["parameters"] for x in visits])
