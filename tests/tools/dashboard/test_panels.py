"""Every job has its steps, its live plot and its newest picture on the dashboard."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform

from tests.browser import Browser
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.planning.calibration_poses import NextBest
from weldcal.systems.jobs.motion.procedure import MotionRecord, MotionState
from weldcal.systems.jobs.mounting.procedure import MountingState, MountingStatus
from weldcal.systems.jobs.profiler.estimates import TakenProfile
from weldcal.systems.jobs.profiler.procedure import ProfilerState
from weldcal.systems.jobs.tablet.procedure import TabletState, Touched
from weldcal.systems.jobs.touch.planner import TouchPlace
from weldcal.systems.jobs.touch.procedure import Felt, TouchState
from weldcal.systems.messages import FlangeEstimate, JobCommand, Scan, VerificationResult
from weldcal.systems.motion.drift_monitor import DriftStatus
from weldcal.systems.operator import Operator
from weldcal.systems.phase_words import (
    MOTION_STEPS,
    MOUNTING_STEPS,
    PROFILER_STEPS,
    TABLET_STEPS,
    TOUCH_STEPS,
    WATCH_STEPS,
)
from weldcal.systems.viewer.live import LiveView, Moment
from weldcal.tools.dashboard.facts import Facts
from weldcal.tools.dashboard.server import Dashboard
from weldcal.tools.dashboard.source import DashboardSource, depth_picture, picture_png

FIT = FlangeFit(
    center_C=np.array([0.02, -0.03, 0.7]),
    normal_C=np.array([0.0, 0.0, -1.0]),
    center_covariance=np.eye(3),
    normal_sigma=1e-3,
    plane_rms_m=1e-4,
    rim_rms_m=1e-4,
    outer_radius_m=0.0315,
    bore_radius_m=None,
    n_points=1000,
    coverage=1.0,
)


def drifted(moved: bool) -> DriftStatus:
    """A watch of 2 s in which the error of z jumps to 1 mm, or does not."""
    recent = np.zeros((40, 6))
    recent[:, 0], recent[:, 5] = 0.05 * np.arange(40), 5.0
    recent[20:, 3] = 1e-3 * moved
    return DriftStatus(frames=40, recent=recent, threshold=60.0, alarmed=moved, X_BC=RigidTransform())


PROFILE = np.column_stack([np.linspace(-0.02, 0.02, 50), 0.08 + 0.001 * np.cos(np.arange(50))])
BEST = NextBest(np.zeros(6), RigidTransform(), 2e-4, 1e-4)
PLACE = TouchPlace(np.zeros(6), np.zeros(3), np.zeros(3), 0.0, np.zeros(3), np.zeros(3))
PROFILER = tuple((name, (key,)) for key, name in PROFILER_STEPS.items())
JOBS: dict[str, tuple[Facts, dict[str, Any], str, str]] = {
    "mounting": (
        Facts(title="eye_in_hand", steps=MOUNTING_STEPS, required_mm=0.2, maximum_scans=10),
        {
            "state": MountingState(phase="move", visit=11, purpose="verify", label="aside01"),
            "status": MountingStatus(
                sequence=7, history=((4, 9e-4), (5, 4e-4), (6, 1.8e-4)), held_out=(VerificationResult("aside01", 3e-4, 0.0),), next_best=BEST
            ),
        },
        "Verify",
        "aside01, held out: the calibration is 0.30 mm off there",
    ),
    "motion": (
        Facts(title="motion", steps=MOTION_STEPS, maximum_scans=300),
        {
            "state": MotionState(phase="collect"),
            "record": MotionRecord(2, refused=(("frame07", "no flange in the scan"),), waits_s=(0.04, 0.05)),
        },
        "Collect frames",
        "frame07: no flange in the scan",
    ),
    "monitor": (
        Facts(title="monitor", steps=WATCH_STEPS, maximum_scans=300),
        {"state": MotionState(phase="collect"), "drift": drifted(True)},
        "Watch",
        "Error of the calibration",
    ),
    "tablet": (
        Facts(title="tablet", steps=TABLET_STEPS, maximum_scans=12),
        {
            "state": TabletState(phase="descend", landmark=2, touches=(Touched(0, np.zeros(2), np.zeros(6)), Touched(1, np.array([120.0, 3.5]), np.zeros(6)))),
        },
        "Touch",
        "landmark 2 at 120.0, 3.5 px",
    ),
    "touch": (
        Facts(title="touch", steps=TOUCH_STEPS, maximum_scans=8, press_mm=1.0, height=lambda felt: 1e-3 * felt.q[0]),
        {
            "state": TouchState(
                phase="descend", places=(PLACE,) * 8, index=2, zero=np.zeros(3), frames=tuple(np.array([0.0, 0.0, 1e-4 * k]) for k in range(9)),
                felt=tuple(Felt(PLACE, np.full(6, height), np.zeros(3)) for height in (0.05, -0.12)),
            ),
        },
        "Touch",
        "place 2: the face is 0.120 mm below the scanned one",
    ),
    "profiler": (
        Facts(title="profiler_edge", steps=PROFILER),
        {"state": ProfilerState(phase="move", step="edge", taken=(TakenProfile("edge", np.zeros(6), PROFILE),))},
        "Scan the edge",
        "Last profile",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def view() -> Meshcat:
    """An empty 3D view."""
    return Meshcat(MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}"))


@pytest.fixture
def source() -> DashboardSource:
    return DashboardSource(LiveView(), Operator())


@pytest.fixture
def page(source: DashboardSource, view: Meshcat) -> Iterator[Dashboard]:
    dashboard = Dashboard(source, view.web_url())
    yield dashboard
    dashboard.close()


def told(source: DashboardSource, job: str) -> dict[str, Any]:
    """The values of a job in its middle."""
    source.facts, shown, *_ = JOBS[job]
    source.live.moment = Moment(30.0, JobCommand(phase="move"), shown)
    source.stage("does its work", 0.5)
    values = source.values()
    json.dumps(values, allow_nan=False)
    return values


@pytest.mark.parametrize("job", JOBS)
def test_every_job_has_steps_the_time_left_and_plots(source: DashboardSource, job: str) -> None:
    values = told(source, job)
    assert [step["name"] for step in values["steps"] if step["is"] == "now"] == [JOBS[job][2]]
    assert values["left_s"] == 30, "half of it took 30 s"
    assert values["line"] == "does its work"
    plots = values["panel"]["plots"]
    assert plots
    for plot in plots:
        assert plot["x"][0] < plot["x"][1]
        assert plot["y"][0] < plot["y"][1]
        for curve in plot["curves"]:
            for _, y in curve["points"]:
                assert y is None or plot["y"][0] - 1e-9 <= y <= plot["y"][1] + 1e-9 or plot["limit"] is not None


def test_a_job_of_another_package_has_neither(source: DashboardSource) -> None:
    source.live.moment = Moment(30.0, JobCommand(phase="polish"), {})
    values = source.values()
    assert values["steps"] == []
    assert values["left_s"] is None
    assert values["panel"] is None


def test_a_scanner_that_moved_is_a_warning_and_a_step_of_its_curve(source: DashboardSource) -> None:
    calm = DashboardSource(LiveView(), Operator(), Facts(steps=WATCH_STEPS))
    calm.live.moment = Moment(2.0, JobCommand(), {"state": MotionState(phase="collect"), "drift": drifted(False)})
    assert calm.values()["panel"]["warning"] == ""
    moved = told(source, "monitor")["panel"]
    assert moved["warning"]
    errors = moved["plots"][0]
    assert [curve["name"] for curve in errors["curves"]] == ["x", "y", "z"]
    assert [p[1] for p in errors["curves"][2]["points"]] == [0.0] * 20 + [1.0] * 20
    assert moved["plots"][2]["limit"] == 60.0


def test_the_page_shows_every_job_on_a_narrow_phone(browser: Browser, page: Dashboard, source: DashboardSource) -> None:
    told(source, "tablet")
    browser.resize(360, 740)
    browser.open(page.url, wait_for="document.querySelector('#panel_plots svg .frame')")
    for job, (_, _, _, words) in JOBS.items():
        told(source, job)
        browser.wait(f"document.body.innerText.toLowerCase().includes({json.dumps(words.lower())})")
        assert browser.run("return document.documentElement.scrollWidth <= innerWidth"), "nothing lies beside the page"
        drawn = browser.run("return document.querySelectorAll('#panel_plots .curve, #panel_plots .dot').length")
        assert drawn, job
    assert browser.console_messages() == []


def test_a_camera_is_picked_on_the_page_and_one_that_was_moved_is_named(
    browser: Browser, page: Dashboard, source: DashboardSource
) -> None:
    told(source, "motion")
    source.live.views.known = ("cell", "scanner")
    browser.resize(1024, 768)
    browser.open(page.url, wait_for="document.querySelector('[data-key=scanner]')")
    assert not browser.run("return document.querySelector('[data-key=seam]')"), "there is no seam"
    browser.run("document.querySelector('[data-key=scanner]').click()")
    browser.wait("document.querySelector('[data-key=scanner]').getAttribute('aria-pressed') === 'true'")
    assert source.live.views.wanted == "scanner"
    source.live.views.wanted = "moved"
    browser.wait("!document.getElementById('moved').hidden")
    assert browser.run("return document.querySelectorAll('#cameras [aria-pressed=true]').length") == 0


def organised(rows: int = 120, columns: int = 160) -> Scan:
    """A plane 0.7 m before a scanner, with a hole in its picture's corner."""
    v, u = np.mgrid[:rows, :columns]
    z = np.full(u.shape, 0.7)
    z[:20, :20] = np.nan
    rays = np.stack([(u - 79.5) / 200.0, (v - 59.5) / 200.0, np.ones(u.shape)], axis=-1)
    return Scan(3, 0.0, (rays * z[:, :, None]).astype(np.float32))


def test_the_picture_of_a_scan_has_a_ring_where_the_flange_was_found() -> None:
    scan = organised()
    plain = depth_picture(scan.points_C, None).astype(int)
    ringed = depth_picture(scan.points_C, FIT).astype(int)
    assert plain[:30, :30].max() < 60, "nothing was seen there"
    changed = np.argwhere(np.abs(ringed - plain).max(axis=2) > 40)
    scale = plain.shape[1] / 160
    expected = scale * np.array([59.5 + 200.0 * -0.03 / 0.7, 79.5 + 200.0 * 0.02 / 0.7])
    np.testing.assert_allclose(changed.mean(axis=0), expected, atol=2.0)
    np.testing.assert_allclose(np.ptp(changed[:, 1]), scale * 2 * 200.0 * 0.0315 / 0.7, atol=5.0)


def test_a_ring_belongs_to_its_own_scan() -> None:
    shown = [
        {"scan": organised()} | more
        for more in ({}, {"flange_estimate": FlangeEstimate(sequence=2, capture_time=0.0, fit=FIT)})
    ]
    assert picture_png(Moment(1.0, JobCommand(), shown[0])) == picture_png(Moment(1.0, JobCommand(), shown[1]))


def test_the_page_gets_the_newest_scan_as_a_png(page: Dashboard, source: DashboardSource) -> None:
    assert source.picture() is None
    source.live.moment = Moment(1.0, JobCommand(), {"scan": organised()})
    assert source.values()["picture"] == 6
    png = source.picture()
    assert png is not None
    assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).shape == (225, 300, 3)
