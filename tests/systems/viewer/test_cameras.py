"""The cameras follow the phase, stay where the user moved them, and frame what they are named after."""

from __future__ import annotations

import time

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw

from tests.browser import Browser
from weldcal.systems.messages import JobCommand, PlannedSeam
from weldcal.systems.viewer.cameras import (
    CELL,
    FOLLOW,
    MOVED,
    SCANNER,
    SEAM,
    START_M,
    CameraDirector,
    Views,
    scanner_view,
    seam_view,
)
from weldcal.welding.seam.curve import SeamCurve

X_BC = RigidTransform(RollPitchYaw(np.pi, 0.0, -np.pi / 2), [0.65, 0.0, 0.95])
WORK = np.array([0.65, 0.0, 0.02])
CELL_VIEW = (np.array([1.3, -0.6, 0.8]), np.array([0.5, 0.0, 0.4]))
SEAM_CURVE = SeamCurve.from_points(np.column_stack([np.full(30, 0.65), np.linspace(-0.1, 0.1, 30), np.zeros(30)]))
HALF_FIELD = np.deg2rad(37.5)  # of Meshcat's camera


class Viewer:
    """Stands for Meshcat: notes where the camera is put, and reports where the user has moved it."""

    def __init__(self) -> None:
        self.eye, self.target = np.zeros(3), np.zeros(3)
        self.puts, self.browsers = 0, 1
        self.reported: RigidTransform | None = None

    def SetCameraPose(self, eye: np.ndarray, target: np.ndarray) -> None:
        self.eye, self.target, self.puts = eye, target, self.puts + 1
        self.reported = RigidTransform(eye)

    def SetProperty(self, path: str, name: str, value: float) -> None:
        assert name == "zoom"

    def GetTrackedCameraPose(self) -> RigidTransform | None:
        return self.reported

    def GetNumActiveConnections(self) -> int:
        return self.browsers


class Job:
    """A director and the phases that it is told."""

    def __init__(self) -> None:
        self.viewer, self.views = Viewer(), Views()
        shown = {"planned_seam": AbstractValue.Make(PlannedSeam())}
        self.director = CameraDirector(
            meshcat=self.viewer,
            views=self.views,
            cell=CELL_VIEW,
            shown=shown,
            X_WB=RigidTransform(),
            X_BC_guess=X_BC,
            tool=None,
            work_B=WORK,  # type: ignore[arg-type]
        )
        self.context = self.director.CreateDefaultContext()
        self.director.GetInputPort("planned_seam").FixValue(
            self.context, AbstractValue.Make(PlannedSeam(sequence=1, seam=SEAM_CURVE))
        )

    def phase(self, name: str) -> str:
        self.director.GetInputPort("job").FixValue(self.context, AbstractValue.Make(JobCommand(phase=name)))
        for _ in range(3):
            self.director._direct(self.context)
        return self.views.showing


def test_the_camera_follows_the_phase_and_is_put_only_where_that_is_a_change() -> None:
    job = Job()
    assert [job.phase(p) for p in ("scan_pose", "scan_verify", "weld", "home")] == [CELL, SCANNER, SEAM, CELL]
    assert job.viewer.puts == 4
    assert [place.view for place in job.views.places] == [CELL, SCANNER, SEAM, CELL]


def test_a_camera_that_was_moved_stays_until_one_is_picked() -> None:
    job = Job()
    job.phase("scan_pose")
    job.viewer.reported = RigidTransform(job.viewer.eye + np.array([0.05, 0.0, 0.0]))
    job.phase("weld")
    assert job.views.wanted == MOVED
    assert job.viewer.puts == 1
    assert job.views.pick(SCANNER)
    assert job.phase("weld") == SCANNER
    assert job.phase("home") == SCANNER, "picked, it does not follow"
    assert job.views.pick(FOLLOW)
    assert job.phase("weld") == SEAM
    assert not job.views.pick("under the table")


@pytest.mark.parametrize("start", START_M)
def test_a_page_that_opens_or_reloads_has_not_moved_the_camera(start: np.ndarray) -> None:
    job = Job()
    job.phase("scan_pose")
    job.viewer.reported = RigidTransform(start)
    job.viewer.browsers = 2
    assert job.phase("weld") == SEAM
    assert job.views.wanted == FOLLOW


@pytest.mark.parametrize(("browsers", "wanted"), [(1, FOLLOW), (2, MOVED)])
def test_a_reload_after_a_move_follows_again(browsers: int, wanted: str) -> None:
    job = Job()
    job.phase("scan_pose")
    job.viewer.reported = RigidTransform(job.viewer.eye + np.array([0.05, 0.0, 0.0]))
    job.phase("scan_pose")
    assert job.views.wanted == MOVED
    job.viewer.reported, job.viewer.browsers = RigidTransform(job.viewer.eye), browsers
    job.phase("weld")
    assert job.views.wanted == wanted, "a second browser leaves the first one's camera alone"


def test_a_real_page_may_be_reloaded(browser: Browser) -> None:
    meshcat, views = Meshcat(MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}")), Views()
    director = CameraDirector(meshcat, views, CELL_VIEW, {}, RigidTransform())
    context = director.CreateDefaultContext()
    director.GetInputPort("job").FixValue(context, AbstractValue.Make(JobCommand()))
    reported: set[tuple[float, ...]] = set()
    for opened in range(2):
        browser.open(meshcat.web_url() + "/?tracked_camera=on")
        until, at_eye = time.monotonic() + 8.0, False
        while time.monotonic() < until and not (at_eye and len(reported) > 1):
            director._direct(context)
            X = meshcat.GetTrackedCameraPose()
            at_eye = X is not None and np.allclose(X.translation(), CELL_VIEW[0], atol=1e-3)
            reported |= {tuple(X.translation().round(3))} if X is not None else set()
            time.sleep(0.01)
        assert at_eye
        assert views.wanted == FOLLOW, f"opened {opened + 1} times, with cameras at {reported}"
        reported.clear()
    browser.rest()


def test_a_real_meshcat_takes_the_cameras() -> None:
    meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    director = CameraDirector(meshcat, Views(), CELL_VIEW, {}, RigidTransform())
    context = director.CreateDefaultContext()
    director.GetInputPort("job").FixValue(context, AbstractValue.Make(JobCommand()))
    director._direct(context)
    assert director._views.known == (CELL,)


@pytest.mark.parametrize("at", [None, np.array([0.65, 0.05, 0.0])])
def test_the_seam_fills_its_camera(at: np.ndarray | None) -> None:
    eye, target = seam_view(SEAM_CURVE, at, WORK)
    assert eye[0] > target[0], "from the side away from the robot"
    assert eye[2] > target[2] + 0.05
    high = 2.0 * np.linalg.norm(eye - target) * np.tan(HALF_FIELD)
    assert 0.15 < high < 0.30, "of a groove and the tools above it, m"


def test_the_scanners_eye_looks_along_its_axis_with_its_picture_upright() -> None:
    eye, target = scanner_view(X_BC)
    along = (target - eye) / np.linalg.norm(target - eye)
    assert along @ X_BC.rotation().matrix()[:, 2] > 0.99
    up = -X_BC.rotation().matrix()[:, 1]
    assert along @ up > 0.03, "the picture's upper edge is up, not whatever a tilt of the estimate makes of it"
