"""Write the page of `weldcal hand-eye`: poses with sigma, errors of every sample, comparison of methods."""

from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from weldcal.calibration.geometry.robust import radius_95
from weldcal.calibration.geometry.se3 import angle_of, as_transform
from weldcal.calibration.hand_eye.mountings import Mounting
from weldcal.calibration.hand_eye.opencv_methods import most_compared
from weldcal.calibration.hand_eye.pairs.importing import BY_MOTION
from weldcal.calibration.hand_eye.pictures.solution import PictureResult
from weldcal.calibration.hand_eye.solve import CameraScale, HandEyeHeldOut, HandEyeResult
from weldcal.calibration.recorded_hand_eye import RecordedHandEye, RecordedTogether
from weldcal.models.arrays import Array
from weldcal.tools.report.first_screen import (
    ENOUGH_UNSEEN,
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    limit_tolerance,
)
from weldcal.tools.report.page import Section, TableRows, page_html
from weldcal.tools.report.pictures import error_bars
from weldcal.tools.report.render import fixed, render

Table = tuple[str, list[tuple[str, str, str]]]


@dataclass(frozen=True, kw_only=True)
class HandEyeReport(RecordedHandEye):
    """A finished calibration, with its files."""

    files: tuple[Path, ...]
    seconds: float
    limit_mm: float | None = None
    folder: Path | None = None

    @property
    def first(self) -> FirstScreen:
        """Return the first screen. Pose pairs have no work point: the held-out error at the target takes its place."""
        r = self.result
        expected, p95, n = held_out_error(r)
        tolerance = limit_tolerance(expected.what, p95, self.limit_mm)
        outliers = int((~r.inliers).sum())
        notes = (
            [f"{outliers} of {len(r.inliers)} poses disagree with the others and were not used."] if outliers else []
        )
        notes += [*repeat_note(r), *self.read_notes]
        # a wrong scale first: no pose and no pair mends it
        concerns = sorted(r.warnings, key=lambda text: r.scale is None or text != r.scale.sentence)
        found = Findings(
            against=undetermined(r, everything=True), tolerance=tolerance, unseen=n, concerns=concerns, notes=notes
        )
        after = Next(self.advice)
        if r.scale is not None:
            after = Next(
                "Correct the target's stated size, the focal length or the robot's unit, and run the command again. Or"
                f" multiply the camera's positions by {r.scale.factor:.4f}."
            )
        elif not self.advice:
            after = Next("Record pairs that are not in the file, and verify the result with them.", uses=True)
        symbol = self.mounting.unknowns["X"].symbol
        files = {"UR and ROS 2": f"{symbol}.ur_pose.script, {symbol}.static_transform.sh"}
        return FirstScreen(found, expected, after, shown_poses(r, self.mounting), self._read_as | files)

    @property
    def _read_as(self) -> dict[str, str]:
        """A row with what the command found of the files: units that are not metres, and another order of rows."""
        lists = self.reading.items()
        parts = [f"{who} positions in {found['unit']}" for who, found in lists if found.get("unit", "m") != "m"]
        if any(found.get("paired") == BY_MOTION for _, found in lists):
            parts.append(f"rows paired {BY_MOTION} (-v: the order)")
        return {"read as": "; ".join(parts)} if parts else {}

    def summary(self) -> dict[str, object]:
        """Return the JSON object of the command."""
        r, used = self.result, held_out_used(self.result)
        out: dict[str, object] = {"state": "done", "configuration": self.mounting.name}
        for k, X in r.poses.items():
            out |= {k: X, f"{k}_is": self.mounting.unknowns[k].sentence, f"covariance_{k}": r.covariance[k]}
        if self.streams is not None:
            out |= {"clock_offset_ms": 1e3 * self.streams.offset_s, "clock_offset_sigma_ms": 1e3 * self.streams.sigma_s}
        pictures = {} if self.pictures is None else _of_pictures(self.pictures)
        return (
            out
            | pictures
            | {
                "held_out_deg": used.rms_deg,
                "held_out_mm": 1e3 * used.rms_translation,
                "held_out_of": held_out_set(r),
                "residual_deg": np.degrees(r.rotation_rad),
                "residual_mm": 1e3 * r.translation,
                "inliers": r.inliers,
                "unobservable": list(r.unobservable),
                "warnings": list(r.warnings),
                "condition": r.condition,
                "camera_scale": None if r.scale is None else _of_scale(r.scale),
                "method": r.method,
                "reading": {who: dict(found) for who, found in self.reading.items()},
                "notes": list(self.read_notes),
                "comparison": [
                    {"method": c.method, "held_out_deg": c.deg, "held_out_mm": c.mm} for c in self.comparison
                ],
                "next_pose": self.advice or None,
                "corners": self.corners or None,
                "seconds": self.seconds,
            }
        )

    def text(self) -> str:
        """What is printed before the first screen: directions, sketch, held-out errors, comparison.

        The first screen has the poses themselves, the warnings and the next pose.
        """
        r, m = self.result, self.mounting
        lines = [f"{m.name}: {m.words}   {m.equation}   ({m.source})", "", *m.sketch.splitlines(), ""]
        lines += [f"held out     {_held_out(r.held_out, 'all poses, ' if not r.inliers.all() else '')}"]
        if not r.inliers.all():
            lines += [f"             {_held_out(held_out_used(r), 'without outliers, ')}"]
        lines += [f"weighting    {r.method}"]
        if self.corners:
            lines += ["", self.corners]
        if self.comparison:
            most = most_compared(len(r.inliers))
            few = 0.8 * len(r.inliers) > most
            note = f"   (OpenCV's methods: fitted to {most} of the poses)" if few else ""
            lines += ["", f"method        held-out deg   held-out mm{note}"]
            for c in self.comparison:
                failed = not (np.isfinite(c.deg) and np.isfinite(c.mm))
                lines += [
                    f"{c.method:<12}  {'no answer':>12}" if failed else f"{c.method:<12}  {c.deg:12.4f}  {c.mm:12.3f}"
                ]
        return "\n".join(lines)


def _of_scale(scale: CameraScale) -> dict[str, object]:
    """What the JSON object has of a wrong scale: the factor, and the poses with it."""
    of = {"factor": scale.factor, "sigma": scale.sigma, "chance": scale.chance}
    return of | {f"{name}_scaled": pose for name, pose in scale.poses.items()}


def _of_pictures(found: PictureResult) -> dict[str, object]:
    """What the JSON object has of pictures."""
    b = found.bundle
    return {
        "board": str(found.board),
        "camera_matrix": b.K,
        "distortion": b.distortion,
        "camera_estimated": len(found.free) > 0,
        "camera_sigma": b.camera_sigma,
        "camera_changed": None if found.change is None else found.change.changed,
        "board_print": b.terms[:3],
        "board_sag_mm": 1e3 * b.terms[3:],
        "reprojection_px": found.reprojection_px,
        "robot_sigma_deg": float(np.degrees(b.sigma_rad)),
        "robot_sigma_mm": 1e3 * b.sigma_m,
        "pictures": [
            {
                "file": p.name,
                "used": not p.why,
                "points": p.found,
                "reprojection_px": None if p.why else p.rms_px,
                "why_not": p.why or None,
            }
            for p in found.pictures
        ],
    }


def picture_rows(found: PictureResult | None) -> list[tuple[str, str, str, str]]:
    """For each picture a data URI of its thumbnail, its name, its points and error, and why it is not used."""
    rows = []
    for p in found.pictures if found is not None else ():
        uri = f"data:image/jpeg;base64,{b64encode(p.thumbnail).decode()}" if p.thumbnail else ""
        error = "" if p.why else f", {fixed(p.rms_px, 3)} px"
        rows.append((uri, p.name, f"{p.found} points{error}", p.why))
    return rows


def _held_out(held_out: HandEyeHeldOut, of: str) -> str:
    if not np.isfinite(held_out.rms_translation):
        return "none: too few poses for cross-validation"
    return f"{held_out.rms_deg:.4f} deg   {1e3 * held_out.rms_translation:.3f} mm ({of}rms, 5 folds)"


def _sigmas(values: Array, certain: float) -> str:
    return ", ".join("open" if v > certain else f"{v:.3f}" for v in values)


def held_out_used(r: HandEyeResult) -> HandEyeHeldOut:
    """Return the held-out errors of the samples that were used."""
    return HandEyeHeldOut(r.held_out.rotation_rad[r.inliers], r.held_out.translation[r.inliers])


def held_out_set(r: HandEyeResult) -> str:
    """What the held-out errors are of, in words: the samples and poses that were used and left out in turn."""
    seen = r.inliers & np.isfinite(r.held_out.translation)
    samples, poses = int(seen.sum()), len(np.unique(r.observation[seen]))
    repeated = f" ({samples} samples)" if samples > poses else ""
    out = int((~r.inliers).sum())
    return f"{poses} pose{'s' if poses != 1 else ''}{repeated}" + (f", without {out} excluded" if out else "")


def repeat_note(r: HandEyeResult) -> list[str]:
    """Return a sentence where samples repeat poses."""
    n, poses = len(r.observation), int(r.observation.max()) + 1
    if n == poses:
        return []
    return [f"The {n} samples repeat {poses} poses: the repeats of a pose are averaged and count once."]


def undetermined(r: HandEyeResult, *, everything: bool = False) -> list[str]:
    """Sentences on what the poses do not determine of the camera's pose, or of ``everything`` that was solved for."""
    sigma = np.sqrt(np.diag(r.covariance["X"]))
    if not everything and sigma[:3].max() < 1.0 and sigma[3:].max() < r.extent:
        return []
    return [f"Not observable: {text}. Add poses that turn the hand about other axes." for text in r.unobservable]


def held_out_error(r: HandEyeResult) -> tuple[ExpectedError, float, int]:
    """Return the held-out error in words, its 95 % in mm (NaN: none) and the number of poses."""
    used = held_out_used(r)
    seen = np.isfinite(used.translation)
    held = 1e3 * used.translation[seen]
    what = "held-out error at the target, 95 %"
    if not len(held):
        return (
            ExpectedError(what, "not known", "too few poses to leave any out; it takes the place of a work point"),
            float("nan"),
            0,
        )
    p95 = float(np.percentile(held, 95))
    backing = (
        f"of {held_out_set(r)}, each unseen by its calibration; rms {used.rms_deg:.3f} degrees; in place of a work"
        " point"
    )
    return ExpectedError(what, f"{p95:.3f} mm", backing), p95, len(np.unique(r.observation[r.inliers][seen]))


def shown_poses(r: HandEyeResult, mounting: Mounting) -> tuple[ShownPose, ...]:
    """Return the poses that were solved for, with their frames in words."""
    return tuple(
        ShownPose(
            u.symbol,
            f"pose of the {u.child_words} in the {u.parent_words} frame",
            X,
            sigma=_sigma_words(r, k),
            aside=u.child_words == "target",
        )
        for k, u, X in ((k, mounting.unknowns[k], X) for k, X in r.poses.items())
    )


def _sigma_words(r: HandEyeResult, k: str) -> str:
    sigma = np.sqrt(np.diag(r.covariance[k]))
    return f"{_sigmas(1e3 * sigma[3:], 1e3 * r.extent)} mm; {_sigmas(np.degrees(sigma[:3]), 57.3)} deg"


def together_rows(found: RecordedTogether) -> list[tuple[str, str]]:
    """For each two sensors their names, and distance and angle with the 95 % radius and sigma."""
    rows, joint = [], found.together
    for i, j in combinations(range(len(joint.names)), 2):
        X, S = joint.between(i, j)
        turn = np.degrees(np.sqrt(np.trace(S[:3, :3])))
        rows.append(
            (
                f"from {joint.names[i]} to {joint.names[j]}",
                f"{1e3 * np.linalg.norm(X[:3, 3]):.3f} mm away, within {1e3 * radius_95(S[3:, 3:]):.3f} mm (95 %);"
                f" turned by {np.degrees(angle_of(X[:3, :3])):.4f} deg, one sigma {turn:.4f} deg",
            )
        )
    return rows


def together_screen(found: RecordedTogether, limit_mm: float | None) -> FirstScreen:
    """Return the first screen of several sensors: its verdict rests on the sensor with the largest held-out error."""
    joint, parts = found.together, list(zip(found.together.names, found.each, strict=True))
    expected, p95, n, name = max(
        ((*held_out_error(one.result), name) for name, one in parts), key=lambda row: np.nan_to_num(row[1], nan=np.inf)
    )
    tolerance = limit_tolerance(expected.what, p95, limit_mm)
    concerns = [f"{name}: {text}" for name, one in parts for text in one.result.warnings]
    if joint.shared < ENOUGH_UNSEEN:
        concerns.insert(
            0,
            f"Only {joint.shared} robot poses are of more than one sensor, so that the poses between sensors rest on"
            " the robot: measure with all sensors at each pose.",
        )
    notes = [f"{name}: {text}" for name, one in parts for text in one.read_notes]
    if np.isfinite(joint.together_m):
        notes.insert(
            0,
            f"At left-out poses two sensors find the target {1e3 * joint.together_m:.3f} mm apart (rms);"
            f" {1e3 * joint.apart_m:.3f} mm where each is solved by its poses alone.",
        )
    shown = [
        replace(pose, symbol=f"{pose.symbol} of {name}", aside=True)
        for name, one in parts
        for pose in shown_poses(one.result, one.mounting)[:1]
    ]
    target = shown_poses(parts[0][1].result, parts[0][1].mounting)[1]
    return FirstScreen(
        Findings(tolerance=tolerance, unseen=n, concerns=concerns, notes=notes),
        replace(expected, backing=f"{name}, the largest of {len(parts)} sensors: {expected.backing}"),
        Next("Record pairs that are not in the files, and verify each result folder with them.", uses=True),
        (*shown, replace(target, aside=True)),
        dict(together_rows(found)),
    )


def together_summary(found: RecordedTogether) -> dict[str, object]:
    """Return the JSON object of several sensors."""
    joint = found.together
    between = [(i, j, *joint.between(i, j)) for i, j in combinations(range(len(joint.names)), 2)]
    return {
        "configuration": found.each[0].mounting.name,
        "sensors": [
            {"name": name, "X": one.result.X, "covariance_X": one.result.covariance["X"], "poses": int(count)}
            for name, one, count in zip(joint.names, found.each, joint.poses, strict=True)
        ],
        "between": [
            {"parent": joint.names[i], "child": joint.names[j], "X": as_transform(X), "covariance_X": S}
            for i, j, X, S in between
        ],
        "shared_poses": joint.shared,
        "left_out_apart_mm": 1e3 * joint.apart_m,
        "left_out_together_mm": 1e3 * joint.together_m,
    }


def together_page(found: RecordedTogether, first: FirstScreen) -> str:
    """Return the report of several sensors as one self-contained HTML text."""
    joint = found.together
    sigmas = [
        (name, str(n), f"{np.degrees(w):.4f}", f"{1e3 * d:.3f}")
        for name, n, (w, d) in zip(
            ("the robot, for all sensors", *joint.names),
            (f"{joint.shared} shared", *joint.poses),
            (joint.common, *joint.noise),
            strict=True,
        )
    ]
    sections: list[Section] = [
        ("Between the sensors", [TableRows(together_rows(found), text=(0, 1))]),
        ("Errors as found", [TableRows(sigmas, ("of", "poses", "deg, per axis", "mm, per axis"))]),
    ]
    return page_html(
        "Sensors together", f"{found.each[0].mounting.name}, {len(joint.names)} sensors", sections, first=first
    )


def hand_eye_report(report: HandEyeReport, source: str, digest: str) -> str:
    """Return the whole report as one self-contained HTML text; ``digest`` is the SHA-256 of the file."""
    r, m = report.result, report.mounting
    names = [str(k) for k in range(len(r.inliers))]
    held, turned = 1e3 * r.held_out.translation, np.degrees(r.held_out.rotation_rad)
    judged = bool(np.isfinite(held).any())
    rows = [
        (name, "used" if used else "left out", fixed(a, 3), fixed(b, 4), fixed(c, 3), fixed(d, 4))
        for name, used, a, b, c, d in zip(
            names, r.inliers, held, turned, 1e3 * r.translation, np.degrees(r.rotation_rad), strict=True
        )
    ]
    most = most_compared(len(r.inliers))
    return render(
        "hand_eye.html.j2",
        first=report.first,
        name=m.name,
        source=source,
        words=m.words,
        equation=m.equation,
        paper=m.source,
        sketch=m.sketch,
        r=r,
        judged=judged,
        n=len(r.inliers),
        diversity=r.diversity.sentence(),
        held_mm=1e3 * held_out_used(r).rms_translation,
        held_deg=held_out_used(r).rms_deg,
        held_of=held_out_set(r),
        unknowns=unknown_tables(r, m, {}),
        bars=error_bars(names, held, r.inliers, "held-out error, mm") if judged else None,
        tilts=error_bars(names, turned, r.inliers, "held-out rotation, deg") if np.isfinite(turned).any() else None,
        rows=rows,
        comparison=[(c.method, fixed(c.mm, 3), fixed(c.deg, 4)) for c in report.comparison],
        few=most if 0.8 * len(r.inliers) > most else None,
        streams=None if report.streams is None else report.streams.sentence,
        corners=report.corners,
        pictures=picture_rows(report.pictures),
        seconds=report.seconds,
        digest=digest,
    )


def unknown_tables(result: HandEyeResult, mounting: Mounting, off: Mapping[str, str]) -> list[Table]:
    """Make a caption and rows (component, value, sigma) for each pose; ``off`` adds words by its symbol."""
    found = []
    for k, X in result.poses.items():
        u, sigma = mounting.unknowns[k], np.sqrt(np.diag(result.covariance[k]))
        rpy = np.degrees(X.rotation().ToRollPitchYaw().vector())
        lengths = zip(("x, mm", "y, mm", "z, mm"), 1e3 * X.translation(), 1e3 * sigma[3:], strict=True)
        angles = zip(("roll, deg", "pitch, deg", "yaw, deg"), rpy, np.degrees(sigma[:3]), strict=True)
        cells = [(name, fixed(v, 3), _spread(s, 3, 1e3)) for name, v, s in lengths]
        cells += [(name, fixed(v, 4), _spread(s, 4, 57.3)) for name, v, s in angles]
        found.append((u.sentence[0].upper() + u.sentence[1:] + off.get(u.symbol, ""), cells))
    return found


def _spread(sigma: float, digits: int, certain: float) -> str:
    return "open" if sigma > certain else fixed(float(sigma), digits)
