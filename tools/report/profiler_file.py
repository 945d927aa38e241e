"""The results of `weldcal profiler` from files: calibrations, seams and beads, with first screens and pages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.profiler.features.bead_course import BeadCourse
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.models.arrays import Array
from weldcal.tools.report.first_screen import (
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    expected_error,
    limit_tolerance,
    point_covariance,
    radius_95,
    typed,
)
from weldcal.tools.report.page import Bullets, FactList, Section, Shot, TableRows, page_html
from weldcal.tools.report.pictures import OURS, error_bars, subplots, svg
from weldcal.tools.report.render import fixed, sigma_rows

_NAMES = {
    "scans": ("scans", ""),
    "touches": ("touches", ""),
    "inliers": ("points used", ""),
    "found": ("profiles that show it", ""),
    "length_mm": ("length", "mm"),
    "volume_mm3": ("volume", "mm3"),
    "model": ("model", ""),
    "model_reason": ("why this model", ""),
    "method": ("method", ""),
    "z_grows": ("z of the profiles grows", ""),
    "z_reason": ("by the profiles", ""),
    "rms_mm": ("residual, rms", "mm"),
    "reduced_chi2": ("reduced chi-square, 1 where the stated sigmas are right", ""),
    "condition": ("condition of the scans, 1 at best", ""),
    "sigma_translation_mm": ("one sigma of the position", "mm"),
    "sigma_rotation_deg": ("one sigma of the rotation", "deg"),
    "arm_mm": ("the arm's error between the poses, per axis", "mm"),
    "edge_radius_mm": ("radius of the edge's break", "mm"),
    "edge_radius_sigma_mm": ("one sigma of it", "mm"),
    "radius_of_profiles_mm": ("radius that the profiles show", "mm"),
    "mean_distance_mm": ("mean distance of the points from the edge", "mm"),
    "touch_rms_mm": ("touches off the sphere, rms", "mm"),
    "centre_before_mm": ("centres apart before the compensation", "mm"),
    "centre_after_mm": ("centres apart after the compensation", "mm"),
}

DISAGREE = "The parts disagree"
WORDS = "pose of the scan plane S in the robot's flange F"
_LOST = {
    "without_feature": "{n} of {all} profiles show no edge and were not used.",
    "without_plane": "{n} of {all} profiles show no single line and were not used.",
    "without_sphere": "{n} of {all} profiles show no sphere and were not used.",
    "without_groove": "{n} of {all} profiles show no groove.",
    "outlier_scans": "{n} of {all} points lie off the edge and were not used.",
    "wrong_scans": "{n} of {all} scans lie off the sphere and were not used.",
}
_GRAVE = {
    "without_bead": "{n} of {all} profiles show no bead: look for a gap there (bead.csv), or bad returns.",
    "wrong_sides": "The side of the sphere's centre is likely wrong in {n} of {all} scans: check their sign.",
    "unlike_profiles": "{n} of {all} profiles are unlike their neighbours: look for a gap, a bulge or spatter there.",
}
NUMBERS = (*_LOST, *_GRAVE)
"""Keys of the JSON object that hold numbers of scans or profiles."""
_UNPOSED = "No --calibration: the values are by profile number, not turned across the seam, without volume."


def pose_of(record: ProfilerRecord) -> RigidTransform:
    """X_FS of a record."""
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(record.rotation), record.translation)


def middle_error_mm(record: ProfilerRecord, points_F: Array) -> float | None:
    """Compute the error at 95 % (mm) of a point in the middle of points (n, 3) m in F; None: none is stated."""
    if record.covariance is None or not len(points_F):
        return None
    S = point_covariance(pose_of(record), record.covariance, np.asarray(points_F).mean(axis=0))
    return 1e3 * radius_95(S)


@dataclass(frozen=True, kw_only=True, eq=False)
class ProfilerFile:
    """A calibration of a profiler from a file: ``found`` are values of its JSON object.

    ``points`` (n, 2) m are those measured in the scan plane, ``held_out_mm`` (k,) the errors of scans that their
    calibration did not use.
    """

    record: ProfilerRecord
    found: Mapping[str, Any]
    points: Array
    held_out_mm: Array
    source: str
    out: Path
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen.

        The work point is the middle of the profile points; the error is the larger of two at 95 %.
        """
        own = middle_error_mm(self.record, self.record.points_F(self.points))
        held = self.held_out_mm[np.isfinite(self.held_out_mm)]
        p95 = float(np.percentile(held, 95)) if len(held) else float("nan")
        what = "error in the middle of the profiles, 95 %"
        expected, larger = expected_error(what, own, p95, len(held), "scans")
        tolerance = limit_tolerance(what, larger, self.limit_mm)
        grave, notes = scan_notes(self.found)
        warnings = self.found.get("warnings", ())
        against = [text for text in warnings if self.found.get("agree") is False and text.startswith(DISAGREE)]
        concerns = [*(text for text in warnings if text not in against), *grave]
        found = Findings(against=against, tolerance=tolerance, unseen=len(held), concerns=concerns, notes=notes)
        pose = ShownPose("X_FS", WORDS, pose_of(self.record))
        return FirstScreen(found, expected, self._next(), (pose,))

    def _next(self) -> Next:
        after = self.found.get("next_poses")
        if after:
            p, w = 1e3 * np.array(after["poses"][0][:3]), after["poses"][0][3:]
            return Next(
                f"To reduce the uncertainty, add a scan with the flange at ({p[0]:.1f}, {p[1]:.1f}, {p[2]:.1f}) mm,"
                " rotation"
                f" vector ({w[0]:.3f}, {w[1]:.3f}, {w[2]:.3f}) rad."
            )
        seam = typed("profiler seam --calibration", self.out)
        more = "" if "parts" in self.found else "; --plan 3 proposes poses to add"
        return Next(
            f"Map a groove with it and touch some of its points: run '{seam}' and name the file of its scans{more}.",
            uses=True,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class ProfilerSeam:
    """A groove mapped into the base: ``found`` are values of the JSON object, ``root_mm`` (n, 3) the root in B."""

    record: ProfilerRecord
    found: Mapping[str, Any]
    root_mm: Array
    source: str
    calibration: Path
    out: Path
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen.

        No pose is computed: X_FS is that of the calibration. No point of the groove is known otherwise.
        """
        own, n = self.found["error_95_mm"], self.found["found"]
        fit = f"{n} profiles fit their groove with {self.found['rms_mm']:.3f} mm rms (median)"
        what = "error of a mapped point, 95 %"
        if own is None:
            expected = ExpectedError(what, "not known", f"the calibration states no uncertainty; {fit}")
        else:
            expected = ExpectedError(
                what,
                f"{own:.3f} mm",
                f"of the profiler's calibration; {fit}; no point of the groove was measured otherwise",
            )
        tolerance = limit_tolerance(what, float("nan") if own is None else own, self.limit_mm)
        grave, notes = scan_notes(self.found)
        found = Findings(tolerance=tolerance, concerns=(*self.found.get("warnings", ()), *grave), notes=notes)
        after = Next(
            "Touch some points of the groove with a pointer of known length, and compare them with seam.csv.", uses=True
        )
        pose = ShownPose("X_FS", f"{WORDS}, as calibrated in {self.calibration}", pose_of(self.record))
        return FirstScreen(
            found,
            expected,
            after,
            (pose,),
            {"seam": f"{n} of {self.found['scans']} profiles show it; seam.csv holds it in the base"},
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class ProfilerBead:
    """A bead along its seam: ``found`` are values of the JSON object, ``record`` None where no pose is known."""

    record: ProfilerRecord | None
    found: Mapping[str, Any]
    course: BeadCourse
    source: str
    out: Path
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen: the error of a width is the larger of that by its sigma and that against neighbours."""
        own, held = 2.0 * self.found["width_mm"]["sigma"], np.abs(1e3 * self.course.left_out[:, 0])
        p95 = float(np.percentile(held, 95)) if np.isfinite(held).all() else float("nan")
        fit = f"samples: {own:.3f} mm, neighbours of {len(held)} profiles: {p95:.3f} mm".replace("nan mm", "not known")
        what, error = "error of a width, 95 %", float(np.fmax(own, p95))
        tolerance = limit_tolerance(what, error, self.limit_mm)
        grave, notes = scan_notes(self.found)
        alone = () if self.record else (_UNPOSED,)
        found = Findings(tolerance=tolerance, concerns=(*self.found.get("warnings", ()), *alone, *grave), notes=notes)
        step = Next("Compare some widths and heights of bead.csv with a gauge or a cut.", uses=True)
        at, rows = "station {:.1f} mm" if self.record else "profile {:.0f}", {}
        for key, (unit, _) in BEAD.items():
            of = self.found[key]
            ends = [f"{of[end]:.2f} {unit} at {at.format(of[f'{end}_at'])}" for end in ("smallest", "largest")]
            spread = f"one sigma {of['sigma']:.3f}, left out {of['left_out_rms']:.3f}".replace("nan", "not known")
            rows[key.partition("_")[0]] = f"{of['mean']:.2f} {unit}, from {' to '.join(ends)}; {spread}"
        return FirstScreen(found, ExpectedError(what, f"{error:.3f} mm", fit), step, more=rows)

    @property
    def page(self) -> str:
        """The page, as one self-contained HTML text."""
        figure, three = subplots(8.2, 6.0, 3, 1, sharex=True)
        at, odd = self.course.station * (1e3 if self.record else 1.0), self.course.unlike
        for k, (axes, (key, (unit, scale))) in enumerate(zip(three, BEAD.items(), strict=True)):
            value, sigma = scale * self.course.values[:, k], scale * self.course.sigmas[:, k]
            axes.errorbar(at, value, 3.0 * sigma, fmt=".", color=OURS, markersize=3, elinewidth=0.7)
            axes.plot(at[odd], value[odd], "o", color="#777777", markersize=9, fillstyle="none")
            axes.set(ylabel=f"{key.partition('_')[0]}, {unit}", xlabel="station, mm" if self.record else "profile")
        shot = Shot(svg(figure, *three), RINGS, "Width, height and area of the bead along its seam")
        sections = _sections(self.found, [("Along the seam", [shot, FactList(list(self.first.more.items()))])], [])
        return page_html(f"Bead measured from {self.source}", ALONG, sections, first=self.first)


BEAD = {"width_mm": ("mm", 1e3), "height_mm": ("mm", 1e3), "area_mm2": ("mm2", 1e6)}
"""What is measured of a bead, by its key in the JSON object: its unit and what turns m or m2 into it."""
ALONG = "Width from toe to toe, height over the plates, area between the toes."
RINGS = "Each profile, with three sigma. Grey rings mark profiles that are unlike their neighbours."


def scan_notes(found: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Return sentences on scans that were not used: those that question the result, and the others."""

    def said(words: Mapping[str, str]) -> list[str]:
        return [text.format(n=len(found[key]), all=found["scans"]) for key, text in words.items() if found.get(key)]

    return said(_GRAVE), said(_LOST)


def profiler_report(made: ProfilerFile) -> str:
    """Return the page of a calibration from a file, as one self-contained HTML text."""
    record = made.record
    pictures = (
        left_out("scans", "scan", [str(k) for k in range(len(made.held_out_mm))], made.held_out_mm),
        ("Where it was measured", [Shot(_seen(made.points), SEEN, "Measured points in the scan plane")]),
    )
    sigma = [] if record.covariance is None else sigma_rows(record.covariance)
    facts = [("SHA-256 of the file", record.data_sha256)] if record.data_sha256 else []
    title, subtitle = f"Profiler calibration from {made.source}", f"Method: {record.method}."
    return page_html(title, subtitle, _sections(made.found, pictures, sigma), first=made.first, facts=facts)


SEEN = (
    "Profile points in the scan plane, with their middle. The error at the top of this page is that of a point there."
)
ROOT = "One point for each profile that shows the groove. seam.csv holds root and both edges."


def seam_report(seam: ProfilerSeam) -> str:
    """Return the page of a mapped seam, as one self-contained HTML text."""
    picture = Shot(_line(seam.root_mm), ROOT, "Root of the groove from above and from the side")
    sections = _sections(seam.found, [("The groove's root in the base", [picture])], [])
    subtitle = f"In the robot's base, by the calibration {seam.calibration}."
    return page_html(f"Seam mapped from {seam.source}", subtitle, sections, first=seam.first)


def left_out(of: str, one: str, ids: list[str], held_mm: Array) -> Section:
    """Return the section of what was left out in turn, by its errors (n,) mm; it is empty where none is known."""
    known = np.isfinite(held_mm).any()
    bars = error_bars(ids, held_mm, np.ones(len(ids), bool), f"left-out {one}, mm") if known else None
    alt = f"Bar chart of errors of {of} that were left out"
    shot = Shot(bars, "Error of each under a calibration that did not use it.", alt)
    return f"{of.capitalize()} that were left out", [shot]


def _sections(
    found: Mapping[str, Any], pictures: Sequence[Section], sigma: Sequence[tuple[str, object]]
) -> list[Section]:
    lists = FactList(_lists(found), "Scans that were not used, by number")
    return [
        ("Warnings", [Bullets(found.get("warnings", ()))]),
        *pictures,
        ("Figures", [TableRows(_rows(found), text=(0, 1)), FactList(sigma), lists]),
    ]


def _rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The short values of a result, by the names of an operator."""
    rows = []
    for key, (name, unit) in _NAMES.items():
        value = found.get(key)
        if value is not None:
            text = fixed(value, 4) if isinstance(value, float) else str(value)
            rows.append((name, f"{text} {unit}".strip()))
    return rows


def _lists(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Numbers of scans that were not used, by the reason."""
    keys: Sequence[str] = [k for k, v in found.items() if isinstance(v, list) and v and k != "warnings"]
    return [(k.replace("_", " "), ", ".join(map(str, found[k]))) for k in keys if k != "next_poses"]


def _seen(points: Array) -> bytes:
    """Where in the scan plane the points (n, 2) m were measured: the calibration is good there."""
    figure, axes = subplots(8.2, 3.6)
    axes.plot(1e3 * points[:, 0], 1e3 * points[:, 1], ".", color=OURS, markersize=2.5)
    axes.plot(*(1e3 * points.mean(axis=0)), "+", color="#000000", markersize=12, markeredgewidth=1.6)
    axes.set(xlabel="x in the scan plane, mm", ylabel="z, mm")
    axes.invert_yaxis()
    axes.set_aspect("equal", adjustable="datalim")
    return svg(figure, axes)


def _line(root_mm: Array) -> bytes:
    """Return the root (n, 3) mm of a groove in the base, from above and from the side."""
    figure, both = subplots(8.2, 3.6, 1, 2)
    for axes, (i, j), title in zip(both, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        axes.plot(root_mm[:, i], root_mm[:, j], ".", color=OURS, markersize=4)
        axes.set(xlabel=f"base {'xyz'[i]}, mm", ylabel=f"base {'xyz'[j]}, mm")
        axes.set_title(title, fontsize=10, loc="left")
        axes.margins(0.1)
    return svg(figure, *both)
