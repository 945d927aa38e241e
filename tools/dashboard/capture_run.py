"""A session of captures behind its page: the buttons' wishes go to one worker, and the page reads what it has found."""

from __future__ import annotations

import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.capture.session import (
    RESULT,
    Advice,
    ArmPose,
    Capture,
    CaptureSession,
    CaptureVerdict,
    ShownProfile,
)
from weldcal.calibration.data.clouds import SUFFIXES, CloudError, read_cloud, save_cloud
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.hand_eye.pictures.search import Picture, load_grey
from weldcal.calibration.profiler.exports import TABLES
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.mesh import TriMesh
from weldcal.systems.drivers.arm_poses import ArmSource, TypedPose
from weldcal.systems.drivers.sensors.acquisition import DeviceLost, Source
from weldcal.systems.drivers.sensors.folder_source import NewFiles
from weldcal.systems.drivers.sensors.video_finger_camera import VideoFingerCamera
from weldcal.tools.dashboard.source import WIDTH_PX, depth_picture, png

ANSWER_S = 20.0  # a choice: a person who scans by hand needs some seconds from the button to the file
REST_S, LOOK_S = 1.0, 0.2  # at rest for so long the arm stands; how often it is looked at
SETTLE_S = 0.3  # a choice: a file that has not changed for so long is whole
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_MARK = (90, 25, 217)  # BGR, as of a ring on a scan
READY, TAKING, THINKING = "READY", "TAKING", "CALCULATING"


class Sensor(Protocol):
    """What takes a scan or a picture."""

    words: str

    def take(self, folder: Path) -> Path:
        """Take one, and return its file in this folder, or where another program wrote it. Raises WeldcalError."""

    def close(self) -> None:
        """Let the device go."""


@runtime_checkable
class JoggedArm(Protocol):
    """An emulated arm that the page's buttons jog."""

    jogs: tuple[str, ...]

    def shape(self) -> list[TriMesh]:
        """The arm in the base, as the 3D view shows it."""

    def jog(self, name: str, advice: Advice | None) -> None:
        """Move a step along or about an axis of the base ("+x", "-rz"), turn a joint ("+J4"), go "home", or "next" as
        advised. Raises WeldcalError."""


class SensorError(WeldcalError):
    """A sensor gives nothing; the sentence says what to do."""


class DriverSensor:
    """A scanner or camera by its driver."""

    def __init__(self, source: Source[Any], words: str) -> None:
        self._source, self.words, self._asked, self._open = source, words, 0, False

    def take(self, folder: Path) -> Path:
        """See Sensor."""
        try:
            if not self._open:
                self._source.open()
                self._open = True
            while self._source.next(0.0) is not None:
                pass  # what came before the button
            self._asked += 1
            self._source.ask(self._asked)
            until = time.monotonic() + ANSWER_S
            while time.monotonic() < until:
                got = self._source.next(LOOK_S)
                if got is not None:
                    return _written(got.datum, folder)
        except DeviceLost:  # the next capture opens it again
            self._source.close()
            self._open = False
            raise
        raise SensorError(f"{self.words} sent nothing within {ANSWER_S:g} s: trigger it, or check its cable.")

    def close(self) -> None:
        """See Sensor."""
        self._source.end()


class FolderSensor:
    """A folder into which the sensor's own program writes; the newest file since the last capture is taken."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise InputError(f"There is no folder '{folder}': name the one into which the sensor's program writes.")
        self.words = f"files in '{folder.name}'"
        self._files = NewFiles(folder, (*dict.fromkeys((*SUFFIXES, *PICTURES, *TABLES)),), SETTLE_S)
        self._files.start()
        self._new: list[Path] = []

    def fresh(self) -> bool:
        """Return whether a file has come that no capture has taken."""
        self._new += self._files.complete()
        return bool(self._new)

    def take(self, folder: Path) -> Path:
        """See Sensor. A file from before the call may be of another pose: it does not count."""
        self._files.start()
        self._new = []
        until = time.monotonic() + ANSWER_S
        while not self.fresh():
            if time.monotonic() > until:
                raise SensorError(f"No new file came within {ANSWER_S:g} s after Capture: press it, then scan.")
            time.sleep(0.05)
        return self.newest()

    def newest(self) -> Path:
        """Return the newest file that ``fresh`` found, and leave out the others."""
        found, self._new = self._new[-1], []
        return found

    def close(self) -> None:
        """See Sensor."""


def webcam(text: str) -> DriverSensor:
    """Return the camera of a number or a URL, at its own size. Raises InputError where it cannot be opened."""
    camera = cv2.VideoCapture(int(text) if text.isdigit() else text)
    good, picture = camera.read()
    camera.release()
    if not good:
        raise InputError(f"The camera '{text}' cannot be opened: look at its cable, and close programs that use it.")
    height, width = picture.shape[:2]
    return DriverSensor(VideoFingerCamera(source=text, width=width, height=height).open_source(), f"camera {text}")


def _written(datum: Any, folder: Path) -> Path:
    values = np.asarray(getattr(datum, "points_C", getattr(datum, "grey", datum)))
    if values.shape[-1] == 3 and values.dtype != np.uint8:
        save_cloud(folder / "scan.npz", values.astype(float))
        return folder / "scan.npz"
    cv2.imwrite(str(folder / "picture.png"), values)
    return folder / "picture.png"


class CaptureRun:
    """The session, its sources, and what the page shows of them; the page's process asks from other threads."""

    def __init__(self, session: CaptureSession, arm: ArmSource, sensor: Sensor, required_mm: float, title: str) -> None:
        self.session, self.arm, self.sensor, self.title = session, arm, sensor, title
        self.required_mm = required_mm
        self.files: dict[str, Path] = {}
        self.verdict = CaptureVerdict(symbol=session.task.symbol, said=())
        self.last: Capture | None = None
        self.state, self.problem, self.used = READY, "", False
        self.by_itself, self.checks = False, list[dict[str, Any]]()
        self.changed = threading.Event()
        self._png: bytes | None = None
        self._pictures = 0
        self._wishes: SimpleQueue[str] = SimpleQueue()
        self._over = threading.Event()
        self._scratch = tempfile.TemporaryDirectory(prefix="weldcal-")
        self._worker = threading.Thread(target=self._work, daemon=True, name="capture")
        self._worker.start()
        self._wishes.put("verdict")

    def close(self) -> None:
        """End the worker and let the devices go."""
        self._over.set()
        self._wishes.put("")
        self._worker.join(ANSWER_S + 1.0)
        self.arm.close()
        self.sensor.close()
        self._scratch.cleanup()

    def rows(self, *counts: int) -> dict[str, Any]:
        """The page has no plots."""
        return {"weld": [], "scans": []}

    def picture(self) -> bytes | None:
        """The newest scan or picture, with what was found drawn in."""
        return self._png

    def act(self, what: str, value: float | str | None = None) -> bool:
        """Do what a button asks: "capture", "back-ID", "by_itself", "use" or "jog-AXIS"; False for anything else."""
        if isinstance(value, str) and isinstance(self.arm, TypedPose):
            self.arm.typed = value[:2000]
        if what == "by_itself":
            self.by_itself = not self.by_itself
        elif what in ("capture", "use") or what.startswith(("back-", "jog-")):
            self._wishes.put(what)
        else:
            return False
        return True

    def values(self) -> dict[str, Any]:
        """All present values of the page."""
        v, last = self.verdict, self.last
        odd = dict(v.odd)
        captures = [{"id": c.id, "odd": odd.get(c.id, "")} for c in self.session.captures]
        error = None if v.error_95_m is None else 1e3 * v.error_95_m
        return {
            "state": self.state,
            "title": self.title,
            "arm": self.arm.words,
            "sensor": self.sensor.words,
            "waits": isinstance(self.sensor, FolderSensor),
            "typed": isinstance(self.arm, TypedPose),
            "jogs": list(self.arm.jogs) if isinstance(self.arm, JoggedArm) else [],
            "by_itself": self.by_itself,
            "problem": self.problem,
            "last": None if last is None else {"id": last.id, "refused": last.refused},
            "captures": captures,
            "picture": self._pictures,
            "symbol": v.symbol,
            "matrix": None if v.X is None else np.round(v.X.GetAsMatrix4(), 6).tolist(),
            "error_mm": error,
            "required_mm": self.required_mm,
            "said": list(v.said),
            "advice": None if v.advice is None else self._from_where() + v.advice.words,
            "hint": self.session.task.hint,
            "gain": None if v.advice is None else v.advice.gain,
            "ur_pose": None if v.advice is None else v.advice.ur,
            "checks": self.checks,
            "result": str((self.session.folder.parent / RESULT).absolute()),
            "used": self.used,
            "folder": str(self.session.folder.absolute()),
            "command": self.session.task.command(self.session.folder),
        }

    def _from_where(self) -> str:
        """Where the words of the next pose begin: at the last capture, which need not be where the arm is."""
        return f"From {self.session.captures[-1].id}: " if self.session.captures else ""

    def _work(self) -> None:
        stood, since = ArmPose(), time.monotonic()
        while not self._over.is_set():
            wish = ""
            with suppress(Empty):
                wish = self._wishes.get(timeout=LOOK_S)
            watched = self.by_itself and not isinstance(self.arm, TypedPose)
            if not wish and watched and isinstance(self.sensor, FolderSensor):
                wish = "file" if self.sensor.fresh() else ""
            elif not wish and watched:
                with suppress(WeldcalError):
                    now = self.arm.pose()
                    away = max(now.moved(stood))
                    stood, since = (now, time.monotonic()) if away > 1e-4 else (stood, since)
                    new = all(max(now.moved(c.pose)) > 1e-2 for c in self.session.captures)
                    wish = "capture" if new and time.monotonic() - since > REST_S else ""
                    since = time.monotonic() + REST_S if wish else since
            if wish:
                try:
                    self._do(wish)
                    self.problem = ""
                except WeldcalError as error:
                    self.problem = str(error)
                except Exception as error:  # a page that says so is better than one that stands still
                    self.problem = f"Internal error: {error!r}"
                self.state = READY
                self.changed.set()

    def _do(self, wish: str) -> None:
        if wish.startswith("jog-") and isinstance(self.arm, JoggedArm):
            self.arm.jog(wish.removeprefix("jog-"), self.verdict.advice)
            return
        if wish in ("capture", "file"):
            self.state = TAKING
            self._capture(wish == "file")
        elif wish.startswith("back-"):
            self.session.take_back(wish.removeprefix("back-"))
        elif wish == "use":
            self.session.task.save(self.session.folder)
            self.used, self.verdict, self.last = True, replace(self.verdict, said=(), advice=None), None
            return
        self.state = THINKING
        if not self.used:
            self.verdict = self.session.verdict()

    def _capture(self, came: bool) -> None:
        """Take one capture; ``came``: the file of the sensor is there already."""
        before = self.arm.pose()
        with tempfile.TemporaryDirectory(dir=self._scratch.name) as scratch:
            file = self.sensor.newest() if came and isinstance(self.sensor, FolderSensor) else None
            file = file or self.sensor.take(Path(scratch))
            after = None if isinstance(self.arm, TypedPose) else self.arm.pose()
            if self.used:
                one, error = self.session.check(file, before, after)
                if not one.refused:
                    self.checks.append({"id": len(self.checks) + 1, "error_mm": round(1e3 * error, 3)})
            else:
                one = self.session.take(file, before, after)
            with suppress(WeldcalError, OSError):
                self._png = drawn(file, one)
                self._pictures += 1
        self.last = one


def drawn(file: Path, one: Capture) -> bytes | None:
    """Return a scan's depths or a picture as PNG, with what was found in it drawn in."""
    if isinstance(one.found, ShownProfile):
        return png(profile_picture(one.found))
    if isinstance(one.found, Picture) or load_grey(file) is not None:
        grey = load_grey(file)
        if grey is None:
            return None
        scale = WIDTH_PX / grey.shape[1]
        shown = cv2.cvtColor(
            cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR
        )
        if isinstance(one.found, Picture):
            for p in one.found.points[np.isfinite(one.found.points[:, 0])]:
                cv2.circle(shown, (round(scale * p[0]), round(scale * p[1])), 2, _MARK, -1, cv2.LINE_AA)
        return png(np.asarray(shown, dtype=np.uint8))
    try:
        points = read_cloud(file)
    except CloudError:
        return None
    return png(depth_picture(points, one.found if isinstance(one.found, FlangeFit) else None))


def profile_picture(shown: ShownProfile) -> NDArray[np.uint8]:
    """Return a profile as a picture (h, WIDTH_PX, 3) BGR, z downwards, the target's points in colour."""
    p = shown.points[np.isfinite(shown.points).all(axis=1)]
    low, size = p.min(axis=0), max(float(np.ptp(p, axis=0).max()), 1e-6)
    picture = np.full((WIDTH_PX // 2 + 20, WIDTH_PX, 3), 40, np.uint8)
    for points, colour in ((p, (200, 200, 200)), (shown.feature, _MARK)):
        for x, z in 10.0 + (points - low) * (WIDTH_PX - 20) / size:
            cv2.circle(picture, (round(x), round(z)), 1 if colour != _MARK else 3, colour, -1, cv2.LINE_AA)
    return picture
