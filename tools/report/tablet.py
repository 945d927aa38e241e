"""The first screen of a tablet calibration and its page, from files or from a simulated visit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from weldcal.calibration.data.results import export_ros2, software_version
from weldcal.calibration.tablet.result import TabletResult
from weldcal.models.arrays import Array
from weldcal.systems.jobs.tablet.job import AddedVisit
from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import Run
from weldcal.tools.report.first_screen import (
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    after_hold,
    limit_tolerance,
)
from weldcal.tools.report.pictures import OURS, svg
from weldcal.tools.report.render import fixed, fixed_row, render, sigma_rows
from weldcal.tools.report.run import robot_timing

Card = tuple[str, str, str, str, str]
_MARK = (40, 60, 220)  # BGR
_MODELS = {
    "wrist": "full robot poses: touches determine tablet and pen, the image determines the camera",
    "pen": "the touches alone determine the pen; the camera is as it was calibrated before",
    "pen_and_picture": "touches and picture determine the pen; the camera is as it was calibrated before",
    "pnp": "the tablet's true size (PnP), then a rigid motion and the pen",
    "pnp_free_scale": "the tablet's size (PnP) with a free scale, then a rigid motion and the pen",
    "closed_form": "one linear least squares of six unknowns",
}
_UNITS = {"phi": ("deg", 180.0 / np.pi), "scale": ("", 1.0), "roll": ("deg", 180.0 / np.pi)}

WORDS = "pose of the camera C in the robot's flange F"
NO_KEY = "No scenario key states how exact a touch must be: compare the error with what your job allows."
NOTHING = ExpectedError("error of a touch, 95 %", "not known", "there is no calibration")


def tablet_screen(result: TabletResult, queries_mm: Array, limit_mm: float | None, no_tolerance: str) -> FirstScreen:
    """Of one visit.

    The error is that of a touch at a landmark which its fit did not use; of the file's queries (n,) mm where it has
    any.
    """
    left = np.array([v for v in result.leave_one_out_mm if v is not None])
    held, what = (queries_mm, "queries of the file") if queries_mm.size else (left, "landmarks")
    expected, tolerance = _touch(held, what, limit_mm)
    found = Findings(
        tolerance=tolerance,
        no_tolerance=no_tolerance,
        unseen=len(held),
        concerns=(*result.warnings, *result.unobservable),
    )
    poses, more = (), {"pose": "none: planar touches determine a map from the picture to the hand, in tablet.yaml"}
    if result.X_FC is not None and result.p_FP_m is not None:
        pen = ", ".join(f"{1e3 * v:.3f}" for v in result.p_FP_m)
        more = {"pen": f"its tip is at ({pen}) mm in the flange"}
        if result.model == "pen":
            more["camera"] = "as it was calibrated before; only a picture of the page (--image, --camera) can check it"
        return FirstScreen(found, expected, _next(tolerance), (ShownPose("X_FC", WORDS, result.X_FC),), more)
    return FirstScreen(found, expected, _next(tolerance), poses, more)


def visits_screen(
    held_mm: Array,
    queried: bool,
    warnings: Sequence[str],
    refused: Sequence[tuple[str, str]],
    n: int,
    limit_mm: float | None,
) -> FirstScreen:
    """Of ``n`` visits, each calibrated by itself; ``held_mm`` are the errors of all of them."""
    expected, tolerance = _touch(held_mm, f"{'queries' if queried else 'landmarks'} in {n} visits", limit_mm)
    concerns = [*(f"Visit {name} was refused: {reason}" for name, reason in refused), *warnings]
    found = Findings(tolerance=tolerance, unseen=len(held_mm), concerns=concerns)
    more = {"pose": "none for all visits together: each visit has its parameters in visits.csv"}
    return FirstScreen(found, expected, _next(tolerance), (), more)


def run_screen(first: FirstScreen | None, reason: str, found: Mapping[str, object], ended: bool = False) -> FirstScreen:
    """Make the first screen of a simulated run: its calibration's (None: held before), with the true errors."""
    if first is None:
        lost = Findings(against=[reason or "The job was held."], unseen=0)
        return FirstScreen(lost, NOTHING, after_hold(ended), more={"pose": "none was found"})
    unseen = found["unseen_touch_mm"]
    assert isinstance(unseen, Mapping)
    truth = (
        f"camera off by {found['X_FC_error_mm']:.2f} mm and {found['X_FC_error_deg']:.3f} degrees; at 50 untouched"
        f" points the pen is off by {unseen['mean']:.3f} mm on average, {unseen['max']:.3f} at most (known in"
        " simulation only)"
    )
    return replace(first, more={**first.more, "truth": truth})


def _touch(held_mm: Array, what: str, limit_mm: float | None) -> tuple[ExpectedError, Tolerance | None]:
    held = held_mm[np.isfinite(held_mm)]
    p95 = float(np.percentile(held, 95)) if len(held) else float("nan")
    name = "error of a touch, 95 %"
    tolerance = limit_tolerance(name, p95, limit_mm)
    if not len(held):
        return ExpectedError(name, "not known", "no landmark could be left out"), tolerance
    return (
        ExpectedError(
            name, f"{p95:.3f} mm", f"of {len(held)} {what} that the fit did not use; mean {held.mean():.3f} mm"
        ),
        tolerance,
    )


def _next(tolerance: Tolerance | None) -> Next:
    if tolerance is not None and not tolerance.met:
        return Next("Touch more landmarks, with the pen tilted differently at each, then calibrate again.")
    return Next("Touch a point on the tablet that is no landmark, and compare.")


_UNITS |= {"pitch": _UNITS["roll"], "yaw": _UNITS["roll"]}


@dataclass(frozen=True, eq=False)
class Shown:
    """Data of the plots: landmarks (n, 2) m of the page and in-plane residuals (n, 2) m of their touches.

    Also the names of the landmarks, and the camera's image (PNG bytes) with the detected landmarks.
    """

    landmark_m: Array
    miss_m: Array
    names: tuple[str, ...]
    picture: bytes | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Page:
    """The contents of tablet.html.j2."""

    title: str
    subtitle: str
    cards: Sequence[Card]
    provenance: Sequence[tuple[str, str]]
    notes: Sequence[str] = ()
    truth: Sequence[tuple[str, ...]] = ()
    arrows: bytes | None = None
    errors: bytes | None = None
    header: tuple[str, ...] = ()
    rows: Sequence[tuple[str, ...]] = ()
    picture: bytes | None = None
    pose_title: str = ""
    pose: Sequence[tuple[str, str]] = ()
    timing: Sequence[tuple[str, str]] = ()
    recording: bool = False


def marked_picture(grey: NDArray[np.uint8], uv_px: Array) -> bytes:
    """Return the image (h, w) as PNG with a numbered mark at each landmark (n, 2) px."""
    image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    size = max(grey.shape[1] / 640.0, 1.0)
    for k, (u, v) in enumerate(uv_px):
        at = (round(u), round(v))
        cv2.drawMarker(image, at, _MARK, cv2.MARKER_CROSS, round(14 * size), max(round(size), 1), cv2.LINE_AA)
        beside = (at[0] + round(9 * size), at[1] - round(9 * size))
        cv2.putText(
            image, str(k), beside, cv2.FONT_HERSHEY_SIMPLEX, 0.55 * size, _MARK, max(round(size), 1), cv2.LINE_AA
        )
    return cv2.imencode(".png", image)[1].tobytes()


def miss_arrows(shown: Shown) -> bytes:
    """Residuals as arrows at the landmarks, the page upright."""
    p, miss = 1e3 * shown.landmark_m, 1e3 * shown.miss_m
    extent = max(float(np.ptp(p, axis=0).max()), 1.0)
    largest = max(float(np.linalg.norm(miss, axis=1).max()), 1e-9)
    times = 10.0 ** np.floor(np.log10(0.18 * extent / largest))
    times = next(t for t in (5.0 * times, 2.0 * times, times) if t * largest <= 0.25 * extent)
    ratio = float(np.ptp(p[:, 1])) / extent
    figure = Figure(figsize=(6.4, float(np.clip(1.6 + 5.2 * ratio, 2.6, 7.0))), layout="constrained")
    axes = figure.subplots()
    axes.plot(p[:, 0], p[:, 1], "o", color="#555", markersize=4)
    axes.plot(*(p + times * miss).T, ".", alpha=0.0)  # includes the arrows' tips in the axes' limits
    axes.quiver(p[:, 0], p[:, 1], *(times * miss).T, angles="xy", scale_units="xy", scale=1, color=OURS, width=0.006)
    for name, (x, y) in zip(shown.names, p, strict=True):
        axes.annotate(name, (x, y), xytext=(6, 6), textcoords="offset points", fontsize=9, color="#333")
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.margins(0.2)
    axes.set(xlabel="page x, mm", ylabel="page y, mm")
    axes.set_title(f"residuals, enlarged {times:g} times (largest {largest:.2f} mm)", fontsize=9, loc="left")
    return svg(figure, axes)


def landmark_rows(result: TabletResult, names: Sequence[str]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Header and a row per landmark."""
    left: Sequence[float | None] = result.leave_one_out_mm or [None] * len(names)
    rows: list[tuple[str, ...]] = [
        (n, fixed(r, 3), fixed(lo, 3)) for n, r, lo in zip(names, result.residual_mm, left, strict=True)
    ]
    return ("landmark", "fit, mm", "held out, mm"), rows


def calibration_report(
    result: TabletResult, shown: Shown, first: FirstScreen, seconds: float, held_out: Mapping[str, float] | None = None
) -> str:
    """Return the page of `weldcal tablet calibrate`."""
    left = [v for v in result.leave_one_out_mm if v is not None]
    mean = float(np.mean(left)) if left else float("nan")
    header, rows = landmark_rows(result, shown.names)
    cards: list[Card] = [
        ("Held-out landmark, mean", fixed(mean, 3), "mm", "plain", "each predicted by a fit without it"),
        ("In the fit, mean", fixed(float(np.mean(result.residual_mm)), 3), "mm", "plain", "of the touches"),
        ("Landmarks", str(len(shown.names)), "", "plain", "touched and seen"),
    ]
    if held_out is not None:
        worst = f"largest {fixed(held_out['max'], 3)}; not used in the fit"
        cards.insert(0, ("The file's queries, mean", fixed(held_out["mean"], 3), "mm", "good", worst))
    return render(
        "tablet.html.j2",
        first=first,
        page=Page(
            title="Calibration of camera and pen by a tablet",
            subtitle=f"Model: {_MODELS.get(result.model, result.model)}.",
            cards=cards,
            notes=(*result.warnings, *result.unobservable),
            arrows=miss_arrows(shown),
            header=header,
            rows=rows,
            picture=shown.picture,
            pose_title="Uncertainty of camera and pen" if result.X_FC is not None else "Parameters",
            pose=_pose(result),
            provenance=[*_files(result), ("seconds", fixed(seconds, 3))],
        ),
    )


def visit_report(
    run: Run[AddedVisit],
    found: Mapping[str, Any],
    result: TabletResult | None,
    shown: Shown | None,
    *,
    first: FirstScreen,
    recording: bool,
) -> str:
    """Return the page of a run in a scenario; `result` and `shown` are None if it was held before its end."""
    scenario, job, name = run.cell.scenario, run.cell.job, str(found["scenario"])
    subtitle = f"{scenario.description.rstrip('.')}. " if scenario.description else ""
    robot = "Simulation" if found["robot"] == "simulated" else f"Rendered sensors; robot: {found['robot']}"
    provenance = [
        ("software", software_version()),
        ("scenario", name),
        ("seed", str(found["seed"])),
        ("real-time factor", fixed(float(found["real_time_factor"]), 2)),
    ]
    common: dict[str, Any] = {
        "title": "Tablet calibration in simulation",
        "subtitle": f"{subtitle}{robot}, seed {found['seed']}.",
        "timing": _timing(run),
        "recording": recording,
    }
    touched = ("Landmarks touched", str(found["n_touches"]), f"of {len(job.plan.q_above)}", "plain", "by contact")
    if result is None or shown is None:
        return render(
            "tablet.html.j2",
            first=first,
            page=Page(cards=[touched], provenance=provenance, **common),
            **robot_timing(run),
        )
    unseen = found["unseen_touch_mm"]
    header, rows = landmark_rows(result, shown.names)
    cards: list[Card] = [
        (
            "Error at untouched points",
            fixed(unseen["mean"], 3),
            "mm",
            "good",
            f"mean of 50; largest {fixed(unseen['max'], 3)}",
        ),
        ("Held-out landmark, mean", fixed(found["leave_one_out_mm"], 3), "mm", "plain", "by a fit without it"),
        (
            "True error of the camera",
            fixed(found["X_FC_error_mm"], 2),
            "mm",
            "plain",
            f"{fixed(found['X_FC_error_deg'], 3)} deg",
        ),
        ("True error of the pen", fixed(found["pen_error_mm"], 3), "mm", "plain", "its tip, on the flange"),
        touched,
    ]
    return render(
        "tablet.html.j2",
        first=first,
        **robot_timing(run),
        page=Page(
            cards=cards,
            notes=(*result.warnings, *result.unobservable),
            truth=_truth(job, found),
            arrows=miss_arrows(shown),
            header=header,
            rows=rows,
            picture=shown.picture,
            pose_title="Uncertainty of camera and pen",
            pose=_pose(result),
            provenance=[*provenance, *_files(result)],
            **common,
        ),
    )


def _truth(job: AddedVisit, found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    truth, drawn = job.truth, job.camera.nominal()
    turn = np.degrees(abs((drawn.rotation().inverse() @ truth.X_FC.rotation()).ToAngleAxis().angle()))
    off = 1e3 * float(np.linalg.norm(drawn.translation() - truth.X_FC.translation()))
    pen = 1e3 * float(np.linalg.norm(np.array(job.tablet.pen.tip_m) - truth.p_FP))
    return [
        ("camera position error, mm", fixed(off, 2), fixed(found["X_FC_error_mm"], 2)),
        ("camera rotation error, deg", fixed(float(turn), 3), fixed(found["X_FC_error_deg"], 3)),
        ("pen tip error, mm", fixed(pen, 2), fixed(found["pen_error_mm"], 3)),
        ("depth error by the tablet's plane, mm rms", "", fixed(found["depth_by_plane_mm"], 3)),
        ("depth error by the landmark's pixel, mm rms", "", fixed(found["depth_by_pixel_mm"], 3)),
    ]


def _pose(result: TabletResult) -> list[tuple[str, str]]:
    if result.X_FC is None or result.p_FP_m is None or result.p_FP_covariance is None:
        scaled = {n: _UNITS.get(n, ("mm", 1e3)) for n in result.parameters}
        return [(n, f"{fixed(scaled[n][1] * v, 4)} {scaled[n][0]}".strip()) for n, v in result.parameters.items()]
    pen = np.sqrt(np.diag(np.array(result.p_FP_covariance)))
    return [
        *sigma_rows(np.array(result.X_FC_covariance)),
        ("pen tip on the flange, mm", fixed_row(1e3 * np.array(result.p_FP_m), 3)),
        ("one sigma of the tip, mm", fixed_row(1e3 * pen, 3)),
        ("ROS 2", export_ros2(result.X_FC, "tool0", "camera_optical_frame").strip()),
    ]


def _files(result: TabletResult) -> list[tuple[str, str]]:
    return [("software", software_version()), *((f"SHA-256 of {n}", h) for n, h in result.data_sha256.items())]


def _timing(run: Run[AddedVisit]) -> list[tuple[str, str]]:
    """Simulated seconds per kind of phase."""
    ends = [*(t for _, t, _ in run.phases[1:]), run.seconds]
    spent: dict[str, float] = {}
    for (name, since, _), until in zip(run.phases, ends, strict=True):
        if name not in ("done", "held"):
            kind = phase_words(name)
            spent[kind] = spent.get(kind, 0.0) + until - since
    return [*((kind, fixed(s, 1)) for kind, s in spent.items()), ("all", fixed(run.seconds, 1))]
