"""The 3D view's cameras: cell, scanner's eye and seam.

They follow the phase until the user moves the camera or picks one.
"""

from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus

from weldcal.models.arrays import Array
from weldcal.models.tool import WeldingTool
from weldcal.systems.jobs.weld.settings import work_point
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, JobCommand, PlannedSeam
from weldcal.systems.motion.spine import JobPorts
from weldcal.systems.viewer.kept import keep
from weldcal.systems.wiring import Wiring
from weldcal.welding.seam.curve import SeamCurve

CELL, SCANNER, SEAM = "cell", "scanner", "seam"
FOLLOW, MOVED = "follow", "moved"
CAMERAS = {FOLLOW: "Follow the job", CELL: "Cell", SCANNER: "Scanner's eye", SEAM: "Seam"}
"""The cameras in words."""
VIEW_OF_PHASE = {
    "move_to_verify": SCANNER,
    "scan_verify": SCANNER,
    "scan_workpiece": SCANNER,
    "approach_above": SEAM,
    "approach": SEAM,
    "weld": SEAM,
    "retract": SEAM,
}
"""Which camera shows a phase; the others: the cell."""
ZOOM = {CELL: 1.0, SCANNER: 1.7, SEAM: 1.0}
PERIOD_S = 0.1  # a choice: 10 Hz is smooth where steps are STEP_M; 20 Hz doubles the messages to each browser
MOVED_M, STEP_M = 0.01, 0.002
"""Farther than this from where it was put, the user has moved it; the seam's camera moves by such steps."""
START_M = np.array([(0.0, -3.0, 1.0), (3.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
"""Where a page's camera is until Meshcat's own values reach it, (n, 3) m: a page that reports one has just been opened
or reloaded."""
SEAM_VIEW_M = 0.17  # of the seam's camera from what it looks at
_EYE_M, _LOOKS_M = 0.12, 0.75  # along the scanner's axis: in front of its drawn axes, and where it looks
_LEAN = 0.05  # off a vertical axis, which a viewer cannot look along
_PLACES = 40  # remembered: a browser answers late


class CameraPlace(NamedTuple):
    """Place camera `view` at `eye`, looking at `target`, (3,) m in the world, from `time` s on."""

    time: float
    view: str
    eye: tuple[float, float, float]
    target: tuple[float, float, float]


class Views:
    """Which camera the user wants and which one shows; one thread directs, others read and pick.

    Both are single assignments.
    """

    def __init__(self) -> None:
        self.wanted = FOLLOW
        self.showing = CELL
        self.known: tuple[str, ...] = (CELL,)
        self.places: list[CameraPlace] = []

    def pick(self, name: str) -> bool:
        """Pick a camera, or FOLLOW; False where there is none of that name."""
        if name != FOLLOW and name not in self.known:
            return False
        self.wanted = name
        return True


class CameraDirector(LeafSystem):
    """Places the viewer's camera at 10 Hz, where it changes; holds no state of the simulation.

    .. pydrake_system::

        name: CameraDirector
        input_ports:
        - job

    Each of `shown` has an input port of its own besides; `calibration_status`, `planned_seam` and `servo_report` are
    read. Everything is computed in B; `X_WB` is the base in the viewer's world. `X_BC_guess` None: there is no
    scanner's eye.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        views: Views,
        cell: tuple[Array, Array],
        shown: Mapping[str, AbstractValue],
        X_WB: RigidTransform,
        X_BC_guess: RigidTransform | None = None,
        tool: WeldingTool | None = None,
        work_B: Array | None = None,
    ) -> None:
        super().__init__()
        self._meshcat, self._views, self._cell, self._X_WB = keep(meshcat), views, cell, X_WB
        self._X_BC_guess, self._tool, self._work_B = X_BC_guess, tool, work_B
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        read = ("calibration_status", "planned_seam", "servo_report")
        self._shown = {n: self.DeclareAbstractInputPort(n, m) for n, m in shown.items() if n in read}
        views.known = (CELL, *((SCANNER,) if X_BC_guess is not None else ()), *((SEAM,) if work_B is not None else ()))
        self._put: deque[Array] = deque(maxlen=_PLACES)
        self._reported: Array | None = None
        self._last: tuple[str, Array, Array] | None = None
        self.DeclarePeriodicPublishEvent(PERIOD_S, 0.0, self._direct)

    def _direct(self, context: Context) -> EventStatus:
        views, phase = self._views, self._job.Eval(context).phase
        following = VIEW_OF_PHASE.get(phase, CELL)
        following = following if following in views.known else CELL
        shown = {name: port.Eval(context) for name, port in self._shown.items()}
        self._note(context.get_time(), following, *self._place(following, shown))
        report = self._report()
        if report is not None and views.wanted != MOVED and self._moved(report):
            views.wanted = MOVED
        elif report is not None and views.wanted == MOVED and self._reloaded(report):
            views.wanted = FOLLOW
        if views.wanted == MOVED:
            self._last = None
            return EventStatus.Succeeded()
        wanted = following if views.wanted == FOLLOW else views.wanted
        self._show(wanted, *self._place(wanted, shown))
        return EventStatus.Succeeded()

    def _show(self, view: str, eye: Array, target: Array) -> None:
        last = self._last
        if last is not None and last[0] == view and np.linalg.norm(target - last[2]) < STEP_M:
            return
        if last is None or last[0] != view:
            self._meshcat.SetProperty("/Cameras/default/rotated/<object>", "zoom", ZOOM[view])
        self._meshcat.SetCameraPose(eye, target)
        self._put.append(eye)
        self._last, self._views.showing = (view, eye, target), view

    def _report(self) -> Array | None:
        """Return the camera (3,) m of the browser that changed last.

        None where no browser has reported since the last call.
        """
        X_WCamera = self._meshcat.GetTrackedCameraPose()
        if X_WCamera is None:
            return None
        p = np.array(X_WCamera.translation())
        if self._reported is not None and np.linalg.norm(p - self._reported) < 1e-6:
            return None
        self._reported = p
        return p

    def _moved(self, p: Array) -> bool:
        """Return whether the camera at `p` (3,) m is neither where one was put nor where a page begins."""
        return bool(self._put) and float(np.linalg.norm([*self._put, *START_M] - p, axis=1).min()) > MOVED_M

    def _reloaded(self, p: Array) -> bool:
        """Return whether the only browser shows a camera at `p` (3,) m that Meshcat gave it.

        Its page was reloaded after it was moved.
        """
        given = [*START_M, *([self._put[-1]] if self._put else [])]
        only = self._meshcat.GetNumActiveConnections() <= 1
        return only and float(np.linalg.norm(given - p, axis=1).min()) < 1e-3

    def _note(self, time: float, view: str, eye: Array, target: Array) -> None:
        """Keep the followed camera for the recording."""
        places = self._views.places
        if not places or places[-1].view != view or np.linalg.norm(target - np.array(places[-1].target)) > 5 * STEP_M:
            places.append(CameraPlace(time, view, tuple(eye.round(4).tolist()), tuple(target.round(4).tolist())))

    def _place(self, view: str, shown: Mapping[str, Any]) -> tuple[Array, Array]:
        """Eye and target (3,) m of a camera in the world."""
        if view == SCANNER and self._X_BC_guess is not None:
            status = shown.get("calibration_status")
            found = status.X_BC if isinstance(status, CalibrationStatus) else None
            eye, target = scanner_view(found or self._X_BC_guess)
        elif view == SEAM and self._work_B is not None:
            planned, report = shown.get("planned_seam"), shown.get("servo_report")
            seam = planned.seam if isinstance(planned, PlannedSeam) else None
            X_BT = getattr(report, "X_BT", None)
            at = None if X_BT is None or self._tool is None else 0.5 * (X_BT @ self._tool.p_TW + X_BT.translation())
            eye, target = seam_view(seam, at, self._work_B)
        else:
            eye, target = self._cell
        return self._X_WB @ np.asarray(eye), self._X_WB @ np.asarray(target)


def scanner_view(X_BC: RigidTransform) -> tuple[Array, Array]:
    """Eye and target (3,) m in B of the scanner's own view.

    A little aside, so that the picture's upper edge is up: a viewer cannot look straight down.
    """
    R, target = X_BC.rotation().matrix(), np.asarray(X_BC @ np.array([0.0, 0.0, _LOOKS_M]))
    along = R[:, 2]
    if abs(along[2]) > 0.95:
        up = -R[:, 1] * np.array([1.0, 1.0, 0.0])
        along = _LEAN * up / float(np.linalg.norm(up)) + np.array([0.0, 0.0, np.sign(along[2])])
    return target - (_LOOKS_M - _EYE_M) * along / float(np.linalg.norm(along)), target


def seam_view(seam: SeamCurve | None, at: Array | None, work_B: Array) -> tuple[Array, Array]:
    """Eye and target (3,) m in B of the camera at the seam.

    Square to its chord, on the side away from the robot, above it.

    Before there is a seam it looks at `work_B`; before the tool is at the seam (`at` None), at the seam's middle.
    """
    if seam is None:
        target = np.asarray(at if at is not None else work_B)
        aside = np.array([0.8, -0.6, 0.0])
    else:
        first, last = np.asarray(seam.position(0.0)), np.asarray(seam.position(seam.length))
        middle = np.asarray(seam.position(0.5 * seam.length))
        target = middle if at is None else np.asarray(at)
        chord = (last - first) / max(float(np.linalg.norm(last - first)), 1e-9)
        aside = np.cross(chord, [0.0, 0.0, 1.0])
        aside = aside / max(float(np.linalg.norm(aside)), 1e-9)
        aside = aside if aside @ target > 0.0 else -aside  # away from the base's origin
    up = np.array([0.0, 0.0, 0.75])
    return target + SEAM_VIEW_M * (aside + up) / float(np.linalg.norm(aside + up)), target


def add_cameras(wiring: Wiring, ports: JobPorts, cell: tuple[Array, Array], views: Views) -> CameraDirector:
    """Add the director of the viewer's camera.

    The scanner's eye where it is fixed in the base, the seam's camera where one is welded.
    """
    assert wiring.meshcat is not None
    station, scenario = wiring.station, wiring.scenario
    models = {name: port.Allocate() for name, port in ports.shown.items()}
    scanner = scenario.scanner_config()
    eye = scanner is not None and scanner.mounted_on == "base"
    director = CameraDirector(
        meshcat=wiring.meshcat,
        views=views,
        cell=cell,
        shown=models,
        X_WB=scenario.base.pose(),
        X_BC_guess=scenario.calibration.mounting_guess.pose() if eye else None,
        tool=station.tool,
        work_B=work_point(scenario) if "servo_report" in ports.shown and scenario.job.weld else None,
    )
    wiring.add("camera_director", director)
    read = {name: port for name, port in ports.shown.items() if director.HasInputPort(name)}
    wiring.connect(director, job=ports.commands[0], **read)
    return director
