"""Pass a run's state to its page, and the buttons' wishes to the run; used by the server's threads."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.flange.fit import FlangeFit
from weldcal.models.arrays import Array
from weldcal.systems.jobs.tablet.config import WristPicture
from weldcal.systems.messages import FlangeEstimate, Scan
from weldcal.systems.operator import Operator
from weldcal.systems.phase_words import phase_words
from weldcal.systems.viewer.live import LiveView, Moment
from weldcal.tools.dashboard.facts import Facts
from weldcal.tools.dashboard.panels import panel, stage_of
from weldcal.tools.dashboard.values import (
    DONE,
    ENDED,
    HELD,
    RUNNING,
    STARTING,
    STOPPING,
    left_s,
    scan_rows,
    scan_values,
    scene_values,
    steps,
    weld_rows,
    weld_values,
)
from weldcal.tools.report.first_screen import FirstScreen

WIDTH_PX = 300
_FOUND, _NOTHING = (90, 25, 217), (40, 34, 30)  # BGR
_RING_POINTS = 48


def picture_number(moment: Moment) -> int:
    """The number of the newest picture; 0 where there is none. A page asks for a picture when its number is new."""
    seen, estimate = moment.shown.get("scan"), moment.shown.get("flange_estimate")
    if isinstance(seen, Scan) and seen.points_C.size:
        fitted = isinstance(estimate, FlangeEstimate) and estimate.sequence == seen.sequence
        return 2 * seen.sequence + fitted
    picture = moment.shown.get("picture")
    return picture.sequence if isinstance(picture, WristPicture) else 0


def picture_png(moment: Moment) -> bytes | None:
    """Return the newest picture as a PNG of WIDTH_PX; None where there is none."""
    scan, picture = moment.shown.get("scan"), moment.shown.get("picture")
    if isinstance(scan, Scan) and scan.points_C.size:
        estimate = moment.shown.get("flange_estimate")
        fit = estimate.fit if isinstance(estimate, FlangeEstimate) and estimate.sequence == scan.sequence else None
        shown = depth_picture(np.asarray(scan.points_C, dtype=float), fit)
    elif isinstance(picture, WristPicture) and picture.sequence:
        shown = _small(picture.grey)
    else:
        return None
    return png(shown)


def png(shown: NDArray[np.uint8]) -> bytes:
    """Return a picture as the bytes of a PNG file."""
    return bytes(cv2.imencode(".png", shown)[1].tobytes())


def depth_picture(points_C: Array, fit: FlangeFit | None) -> NDArray[np.uint8]:
    """Return the depths of a scan as a picture (h, WIDTH_PX, 3) BGR, near bright; around a flange in it a ring.

    Args:
        points_C: (H, W, 3) m; an unordered cloud (N, 3) is shown as its own directions lie.
        fit: the flange that was found in it.
    """
    if points_C.ndim == 2:
        points_C = _in_grid(points_C)
    step = max(1, points_C.shape[1] // WIDTH_PX)
    points = points_C[::step, ::step]
    z = points[:, :, 2]
    seen = np.isfinite(z)
    grey = np.zeros(z.shape, dtype=np.uint8)
    if seen.any():
        near, far = np.percentile(z[seen], [1.0, 99.0])
        grey[seen] = (235.0 - 165.0 * np.clip((z[seen] - near) / max(far - near, 1e-3), 0.0, 1.0)).astype(np.uint8)
    shown = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    shown[~seen] = _NOTHING
    scale = WIDTH_PX / shown.shape[1]
    size = (WIDTH_PX, max(1, round(shown.shape[0] * scale)))
    shown = np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
    if fit is not None and fit.outer_radius_m is not None:
        at = _pixels_of(np.asarray(points, dtype=float), _ring(fit.center_C, fit.normal_C, fit.outer_radius_m))
        if at is not None:
            cv2.polylines(shown, [(scale * at).round().astype(np.int32)], True, _FOUND, 2, cv2.LINE_AA)
    return np.asarray(shown, dtype=np.uint8)


def _in_grid(points: Array) -> Array:
    """Points (n, 3) as a picture (h, WIDTH_PX, 3) by their own directions; NaN where none is."""
    p = points[np.isfinite(points[:, 2]) & (points[:, 2] > 0.0)]
    uv = p[:, :2] / p[:, 2:]
    low, size = np.percentile(uv, 1.0, axis=0), np.ptp(np.percentile(uv, [1.0, 99.0], axis=0), axis=0)
    shape = max(1, round(WIDTH_PX * float(size[1] / size[0]))), WIDTH_PX
    at = ((uv - low) / size * [shape[1] - 1, shape[0] - 1]).round().astype(int)
    inside = ((at >= 0) & (at < [shape[1], shape[0]])).all(axis=1)
    grid = np.full((*shape, 3), np.nan)
    grid[at[inside, 1], at[inside, 0]] = p[inside]
    return grid


def _ring(center: Array, normal: Array, radius_m: float) -> Array:
    """Points (n, 3) m of a circle."""
    u = np.cross(normal, [1.0, 0.0, 0.0])
    u /= np.linalg.norm(u)
    angle = np.linspace(0.0, 2.0 * np.pi, _RING_POINTS, endpoint=False)[:, None]
    return np.asarray(center + radius_m * (np.cos(angle) * u + np.sin(angle) * np.cross(normal, u)))


def _pixels_of(points: Array, ring: Array) -> Array | None:
    """Map points to pixels (n, 2) by the organised cloud's own projection u = a x / z + b; None for few points."""
    v, u = np.nonzero(np.isfinite(points[:, :, 2]))
    if len(u) < 50:
        return None
    p = points[v, u]
    found: list[Any] = []
    for pixel, axis in ((u, 0), (v, 1)):
        ratio = p[:, axis] / p[:, 2]
        factor, *_ = np.linalg.lstsq(np.column_stack([ratio, np.ones(len(ratio))]), pixel.astype(float), rcond=None)
        found.append(factor[0] * ring[:, axis] / ring[:, 2] + factor[1])
    return np.column_stack(found)


def _small(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = max(1, round(grey.shape[0] * WIDTH_PX / grey.shape[1]))
    return np.asarray(cv2.resize(grey, (WIDTH_PX, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


BY = "the dashboard"
PAGES = ("recording.html", "report.html")
"""What the page shows of a run that has ended."""
LEFT_OUT = ("verdict", "next", "rotation vector", "quaternion wxyz", "4 x 4, m")
"""Rows of the first screen that the page shows elsewhere, or leaves to the report."""
PACE_OVER_S = 2.0


class DashboardSource:
    """Reads the run's live view and the operator's wishes.

    It never waits for the Diagram, and the Diagram never for it.
    """

    def __init__(self, live: LiveView, operator: Operator, facts: Facts | None = None) -> None:
        self.live, self.operator = live, operator
        self.facts = Facts() if facts is None else facts
        self._stage, self._share = "", 0.0
        self._ended: tuple[str, str | None] | None = None
        self.replays = False
        self.result: dict[str, Any] | None = None
        self.files: dict[str, Path] = {}
        self._worked_s, self._looked = 0.0, time.monotonic()
        self._paces: deque[tuple[float, float]] = deque(maxlen=50)

    def stage(self, text: str, share: float) -> None:
        """Take the present step in words and the completed share of the run, 0 to 1."""
        if not text.startswith("held by"):  # that is for the terminal
            self._stage, self._share = text, share

    def end(self, held: bool, reason: str | None, replays: bool) -> None:
        """Take how the run ended, and whether the 3D view repeats it from now on."""
        self.replays = replays
        self._ended = (HELD if held and not self.operator.ends else ENDED if held else DONE, reason)

    def conclude(self, first: FirstScreen | None, folder: Path | None) -> None:
        """Take the result: the first screen, and the folder of report.html and recording.html (None: none)."""
        if folder is not None:
            self.files = {name: folder / name for name in PAGES if (folder / name).exists()}
        rows = {} if first is None else {n.strip(): t for n, t in first.rows().items() if n.strip() not in LEFT_OUT}
        self.result = {
            "verdict": None if first is None else first.verdict,
            "tone": "" if first is None else first.tone,
            "reason": "" if first is None else first.reason,
            "rows": [[name, text] for name, text in rows.items()],
            "files": list(self.files),
            "folder": "" if folder is None else str(folder.absolute()),
        }

    @property
    def ended(self) -> bool:
        """Whether the run has ended."""
        return self._ended is not None

    def act(self, what: str, value: float | None = None) -> bool:
        """Do what a button asks: "hold", "go_on", "end", "pace", "camera-NAME"; False where there is no such button."""
        operator = self.operator
        if self.ended:
            return False
        if what == "hold":
            operator.hold(BY)
        elif what == "go_on" and operator.holds and not operator.ends:
            operator.go_on()
        elif what == "end":
            operator.end(BY)
        elif what.startswith("camera-"):
            return self.live.views.pick(what.removeprefix("camera-"))
        elif what == "pace" and value is not None and self.facts.settable_pace:
            operator.ask_pace(value)
        else:
            return False
        return True

    def rows(self, weld: int, scans: int) -> dict[str, Any]:
        """Return the rows of the plots from these numbers on."""
        return {"weld": weld_rows(self.live.weld[weld:]), "scans": scan_rows(self.live.scans[scans:])}

    def values(self) -> dict[str, Any]:
        """Return all present values of the page."""
        moment, facts, operator = self.live.moment, self.facts, self.operator
        state, line = self._state()
        weld = weld_values(facts, moment, self.live.weld)
        running = not self.ended
        return {
            "state": state,
            "line": line,
            "replay": self.replays,
            "result": self.result,
            "title": facts.title,
            "robot": facts.robot,
            "can": {
                "hold": running and not operator.holds and not operator.ends,
                "go_on": running and operator.holds and not operator.ends,
                "end": running and not operator.ends,
                "pace": running and facts.settable_pace,
            },
            "steps": steps(facts, "done" if state == DONE else stage_of(moment)),
            "share": round(self._share, 3) if running else 1.0,
            "wall_s": round(self._work(moment), 1),
            "left_s": self._left_s(moment) if running else None,
            "time_s": round(moment.time, 1),
            "pace": {"asked": operator.pace or 0.0, "now": self._pace(moment.time)},
            "weld": weld,
            "calibration": scan_values(facts, moment),
            "panel": panel(facts, moment),
            "scene": scene_values(facts, moment, self.live.views),
            "picture": picture_number(moment),
            "limits": {
                "speed": facts.weld_speed_mm_s if weld else None,
                "deflection": facts.wanted_deflection_mm if weld else None,
                "band": facts.band_mm if weld else None,
            },
        }

    def _left_s(self, moment: Moment) -> float | None:
        """Seconds of the wall clock that are left, about, at the pace so far or at the slower one asked for."""
        left = left_s(self.facts, moment, self._share)
        slower = 1.0 / self.operator.pace if self.operator.pace else 0.0
        so_far = self._worked_s / moment.time if self._worked_s > PACE_OVER_S else min(1.0, slower or 1.0)
        return None if left is None else round(left * max(so_far, slower))

    def _work(self, moment: Moment) -> float:
        """Seconds of the wall clock since the run began, without those in which an operator held it."""
        before, self._looked = self._looked, time.monotonic()
        if moment.time > 0.0 and not self.operator.stands:
            self._worked_s += self._looked - before
        return self._worked_s

    def _state(self) -> tuple[str, str]:
        """Return the state in large letters, and the line under it: by whom and why, or what the arm does."""
        moment, operator = self.live.moment, self.operator
        doing = self._doing()
        if self._ended is not None:
            state, reason = self._ended
            return state, reason or "The job is complete."
        if operator.ends:
            return STOPPING, f"ended by {operator.ended_by}; the process goes off and the arm comes to rest"
        if operator.stands and operator.question:
            return HELD, f"{operator.question} Go on is yes, End is no: no arc is lit."
        if operator.stands:
            return HELD, f"by {operator.held_by}, during: {doing}. {self._go_on_line()}"
        if operator.holds:
            return STOPPING, f"held by {operator.held_by}; the process goes off and the arm comes to rest"
        report = moment.shown.get("servo_report")
        if getattr(report, "phase", "") == "BACK":
            return RUNNING, "on the way back along the seam; the torch is off"
        return (RUNNING, doing) if moment.time > 0.0 else (STARTING, self._stage)

    def _doing(self) -> str:
        """What the job does now, in words: the phase's own, or what the job says."""
        moment = self.live.moment
        if moment.time <= 0.0:
            return self._stage
        return phase_words(moment.command.phase) if "calibration_status" in moment.shown else self._stage

    def picture(self) -> bytes | None:
        """Return the newest scan or picture as a PNG, or None."""
        return picture_png(self.live.moment)

    def _go_on_line(self) -> str:
        """What Go on does."""
        report = self.live.moment.shown.get("servo_report")
        back = getattr(report, "way_back_m", 0.0)
        if back > 0.0:
            return f"Go on: {1e3 * back:.1f} mm back along the seam (violet in the 3D view), then the arc starts again."
        return "Go on: the arm moves on along the rest of its path."

    def _pace(self, simulated: float) -> float | None:
        """Seconds of the run per second of the wall clock over the last seconds; None before they are known."""
        now = time.monotonic()
        if not self._paces or now - self._paces[-1][0] > 0.05:
            self._paces.append((now, simulated))
        while len(self._paces) > 2 and now - self._paces[0][0] > PACE_OVER_S:
            self._paces.popleft()
        wall = now - self._paces[0][0]
        return round((simulated - self._paces[0][1]) / wall, 2) if wall > 0.5 else None
