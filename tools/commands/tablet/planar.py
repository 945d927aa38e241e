"""Fits planar touches of a tablet: one visit, or each of many by itself and all together."""

import dataclasses as dc
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.results import software_version, statistics
from weldcal.calibration.tablet.planar_files import PlanarFile, PlanarVisit
from weldcal.calibration.tablet.planar_fit import (
    LINEAR_NAMES,
    PLANAR_NAMES,
    LinearFit,
    PlanarConfig,
    PlanarFit,
    fit_linear,
    fit_planar,
)
from weldcal.calibration.tablet.touches import TabletTouches, same_landmark
from weldcal.calibration.tablet.wrist.files import file_hash
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools.report.first_screen import FirstScreen
from weldcal.tools.report.pictures import error_bars
from weldcal.tools.report.render import fixed, mappings_csv, render, write_atomic
from weldcal.tools.report.tablet import Page, visits_screen

PNP, FREE, LINEAR = "pnp", "pnp_free_scale", "closed_form"
NAMES = {PNP: PLANAR_NAMES, FREE: PLANAR_NAMES, LINEAR: LINEAR_NAMES}

_SCALE_SIGMAS = 3.0  # a scale is reported if it differs from 1 by more than this and by a quarter of a percent
_SCALE_LEAST = 2.5e-3
_OTHER_UNIT = 5.0  # lengths that differ by more than this factor are in different units
_BETTER = 0.4  # a changed sign is reported if the residuals fall below this share
_BAD_M = 2e-3  # residuals above this are not noise
_CONTRADICTION = 0.1  # residuals of this share of the landmarks' spread: refused
_LIKE_A_UNIT = 0.2  # in the logarithm: a factor this near a ratio of units
_ONE_ORDER = "check that uv, hand, theta_deg, delta_px and tablet_px hold the landmarks in one order"
_LEAST_FOR_OUTLIER = 6  # landmarks, so that five remain without one
_LEAST_OUTLIER_M = 0.5e-3  # residuals below this are noise


@dc.dataclass(frozen=True, eq=False)
class VisitFits:
    """The fits of one visit by model, and the warnings about it; `step_m`: rounding step of the hand, 0 for none."""

    visit: PlanarVisit
    fits: dict[str, PlanarFit | LinearFit]
    warnings: tuple[str, ...]
    step_m: float

    def in_page(self, hand_m: Array) -> Array:
        """Differences of hand positions (n, 2) m in the axes of the page."""
        phi = self.fits[PNP].parameters[0]
        return np.asarray(hand_m @ np.array([[np.cos(phi), np.sin(phi)], [np.sin(phi), -np.cos(phi)]]))

    def left_out_mm(self, model: str) -> Array:
        """Error of each held-out landmark, (n,) mm; NaN where it could not be held out."""
        return np.asarray(1e3 * np.linalg.norm(self.fits[model].leave_one_out_m, axis=1))

    def held_out_mm(self, model: str) -> Array:
        """Errors at the queries, (q,) mm; empty where there are none."""
        queries, touches = self.visit.queries, self.visit.touches
        if queries is None:
            return np.zeros(0)
        rays = (queries.uv_px - touches.centre_px) / touches.focal_px
        hand = self.fits[model].hand_to_touch(rays, queries.theta_rad)
        return np.asarray(1e3 * np.linalg.norm(hand - queries.hand_m, axis=1))


def fit_visit(visit: PlanarVisit, step_m: float, *, thorough: bool = True) -> VisitFits:
    """Fit every model; `thorough` cross-validates the interval fit too, else least squares only (twenty times faster).

    Raises:
        InputError: lengths are in different units; others as check_touches and tablet_pose.
    """
    touches = visit.touches
    fits: dict[str, PlanarFit | LinearFit] = {}
    config = PlanarConfig(step_m=step_m)
    planar = _fit_planar(touches, config, thorough)
    _same_units(planar)
    fits[PNP], fits[LINEAR] = planar, fit_linear(touches)
    scale, deviation = planar.free_scale
    warnings = []
    if abs(scale - 1.0) > max(_SCALE_SIGMAS * deviation, _SCALE_LEAST):
        fits[FREE] = _fit_planar(touches, dc.replace(config, free_scale=True), thorough)
        warnings.append(
            f"Tablet and robot differ by {100 * (scale - 1.0):+.1f} % in length (sigma {100 * deviation:.1f} %). Check"
            " the page's size with a card, or the tablet's pixels per inch."
        )
    if visit.excluded:
        rows = ", ".join(map(str, visit.excluded))
        warnings.append(f"Not used, because a number is not finite: landmark {rows}.")
    odd = _other_signs(touches, planar.sigma_m) + _odd_landmarks(visit, planar, config)
    _refuse_contradictions(fits, touches, odd)
    odd = odd or _mirrored(touches)
    if planar.sigma_m > _BAD_M and not odd:
        odd = [f"The touches fit to {1e3 * planar.sigma_m:.1f} mm only; {_ONE_ORDER}."]
    warnings += odd
    return VisitFits(visit, fits, tuple(warnings), step_m)


def best_model(visits: Sequence[VisitFits]) -> tuple[str, dict[str, float]]:
    """Choose the model of least held-out error over all visits; also every model's mean error (mm; NaN: none).

    A free scale is a candidate only if every visit needs it. Only landmarks that every model could hold out are
    compared; with four landmarks there are none, and PnP is chosen.
    """
    models = [m for m in (PNP, LINEAR, FREE) if all(m in v.fits for v in visits)]
    left = {m: np.concatenate([v.left_out_mm(m) for v in visits]) for m in models}
    common = np.isfinite(np.array(list(left.values()))).all(axis=0)
    errors = {m: float(left[m][common].mean()) if common.any() else float("nan") for m in models}
    return min(models, key=lambda m: errors[m] if common.any() else 0.0), errors


def _fit_planar(touches: TabletTouches, config: PlanarConfig, thorough: bool) -> PlanarFit:
    if thorough or config.step_m == 0.0:
        return fit_planar(touches, config)
    squares = fit_planar(touches, dc.replace(config, step_m=0.0))
    return dc.replace(fit_planar(touches, config, leave_one_out=False), leave_one_out_m=squares.leave_one_out_m)


def _same_units(planar: PlanarFit) -> None:
    scale = planar.free_scale[0]
    if not 1.0 / _OTHER_UNIT < scale < _OTHER_UNIT:
        unit = min(abs(np.log(scale * k)) for k in (1e3, 1e-3, 10.0, 0.1, 25.4, 1 / 25.4)) < _LIKE_A_UNIT
        raise InputError(
            f"The hand moved {scale:.3g} times as far as the distance of the tablet's landmarks. Write hand and"
            " hand_capture in millimetres, and mm_per_px in millimetres per pixel of tablet_px."
            if unit
            else f"Hands and landmarks do not fit (the hand moved {scale:.3g} times as far); {_ONE_ORDER}."
        )


def _refuse_contradictions(
    fits: Mapping[str, PlanarFit | LinearFit], touches: TabletTouches, causes: Sequence[str]
) -> None:
    """Refuses touches that no model fits, with the first of the ``causes`` where there are any.

    Raises:
        InputError: the residuals are a large share of the landmarks' spread.
    """
    left, spread = min(fit.sigma_m for fit in fits.values()), _spread_m(touches)
    if left > _CONTRADICTION * spread:
        raise InputError(
            f"The touches contradict each other: they fit to {1e3 * left:.0f} mm only, with landmarks"
            f" {1e3 * spread:.0f} mm from their centre. {causes[0] if causes else f'Please {_ONE_ORDER}, x before y.'}"
        )


def _mirrored(touches: TabletTouches) -> list[str]:
    """Detects a mirrored image: a camera sees the page from its front, so orientations are preserved."""
    page = np.column_stack([touches.landmark_px, np.ones(len(touches.landmark_px))])
    turned = np.linalg.det(np.linalg.lstsq(page, touches.uv_px, rcond=None)[0][:2])
    return [
        "uv shows a mirrored page: u and v are exchanged, or one of them has the wrong sign. Check the file."
    ] * bool(turned < 0.0)


def _spread_m(touches: TabletTouches) -> float:
    return float(np.sqrt(((touches.landmark_m - touches.landmark_m.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _other_signs(touches: TabletTouches, sigma_m: float) -> list[str]:
    """Sentences on signs whose reversal fits far better."""
    flip = np.array([1.0, -1.0])
    extent = touches.landmark_px.max(axis=0) + touches.landmark_px.min(axis=0)
    turned = {
        "theta_deg counted the other way: the hand's turn is positive as Eq. 7 of the paper has it": dc.replace(
            touches, theta_rad=-touches.theta_rad
        ),
        "delta_px reversed: it is the landmark minus the touched point": dc.replace(
            touches, delta_px=-touches.delta_px
        ),
        "tablet_px counted up the page: y goes down it, as the image's does": dc.replace(
            touches, landmark_px=touches.landmark_px * flip + [0.0, extent[1]], delta_px=touches.delta_px * flip
        ),
    }
    found = []
    for what, other in turned.items():
        left = fit_planar(other, PlanarConfig(), leave_one_out=False).sigma_m
        if left < min(_BETTER * sigma_m, _CONTRADICTION * _spread_m(touches)):
            found.append(
                f"The touches fit to {1e3 * left:.2f} mm instead of {1e3 * sigma_m:.2f} with {what}. Check the file."
            )
    return found


def _odd_landmarks(visit: PlanarVisit, planar: PlanarFit, config: PlanarConfig) -> list[str]:
    """Return a landmark without which all the others fit far better: touched or read wrongly."""
    touches, number = visit.touches, same_landmark(visit.touches.landmark_px)
    if number.max() + 1 < _LEAST_FOR_OUTLIER:
        return []
    squares = dc.replace(config, step_m=0.0)
    left = []
    for k in range(number.max() + 1):
        try:
            left.append(fit_planar(touches.pick(number != k), squares, leave_one_out=False).sigma_m)
        except WeldcalError:  # it alone spans the plane, or turns the hand
            left.append(np.inf)
    worst = int(np.argmin(left))
    if left[worst] > _BETTER * planar.sigma_m or planar.sigma_m < _LEAST_OUTLIER_M:
        return []
    row = visit.rows[int(np.nonzero(number == worst)[0][0])]
    return [
        f"Without landmark {row} the others fit to {1e3 * left[worst]:.2f} mm instead of {1e3 * planar.sigma_m:.2f}:"
        " touch it again, or remove it."
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
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
        """Return the JSON object of `tablet calibrate` for such a file."""
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
            (
                v["id"],
                fixed(v["held_out_mm"], 3),
                fixed(v["leave_one_out_mm"], 3),
                fixed(v["residual_mm"], 3),
                str(v["n_landmarks"]),
            )
            for v in map(self._visit, self.visits)
        ]
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
        )


def error_figures(errors_mm: Array) -> dict[str, float] | None:
    """Median, mean, 95th percentile and maximum of errors (n,) mm; None where there are none."""
    return statistics(errors_mm) if errors_mm.size else None


def fit_many(file: Path, read: PlanarFile, step_m: float) -> ManyVisits:
    """Fit every visit by itself; a visit that cannot be fitted is refused with the reason.

    Raises:
        WeldcalError: no visit can be fitted; the first refusal.
    """
    fitted, refused, first = [], list(read.refused), None
    for visit in read.visits:
        try:
            fitted.append(fit_visit(visit, step_m, thorough=False))
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
