"""The dashboard in a real browser: state, hold, go on, end, plots; what it refuses; what a phone and the network
see."""

from __future__ import annotations

import http.client
import json
import math
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform

from tests.browser import Browser, Pixels, colours
from weldcal.systems.jobs.weld.iterative_calibrator import PoseRequest
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import CalibrationStatus, JobCommand, PlannedSeam
from weldcal.systems.operator import Operator
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.viewer.live import LiveView, Moment, ScanRow, WeldRow
from weldcal.tools.commands.run import JobRun, run_job
from weldcal.tools.dashboard.facts import Facts
from weldcal.tools.dashboard.server import Dashboard
from weldcal.tools.dashboard.source import DashboardSource
from weldcal.tools.report.first_screen import ExpectedError, Findings, FirstScreen, Next, ShownPose, Tolerance
from weldcal.tools.report.run import RunOptions
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.state import Diagnostics, Phase, WeldingCommand

STEPS = (("Calibrate", ("scan_pose", "move_to_pose")), ("Weld", ("weld",)), ("Go home", ("home",)))
SECONDS = {"scan": 3.0, "Weld": 20.0, "Go home": 6.0}
FACTS = Facts(
    title="s_groove",
    robot="simulated",
    settable_pace=True,
    steps=STEPS,
    required_mm=0.15,
    maximum_scans=12,
    minimum_scans=6,
    seconds=SECONDS,
    weld_speed_mm_s=8.0,
    wanted_deflection_mm=2.0,
    band_mm=(0.4, 5.0),
)
SEAM = SeamCurve.from_points(np.linspace([0.5, 0.0, 0.0], [0.6, 0.0, 0.0], 40))
RESULT = FirstScreen(
    Findings(tolerance=Tolerance("the error", 0.2, 0.3, "--limit-mm"), unseen=8),
    ExpectedError("error at the work point, 95 %", "0.213 mm", "8 unseen poses"),
    Next("See it again."),
    (ShownPose("X_BC", "pose of the scanner C in the robot's base B", RigidTransform([0.65, 0.0, 0.95])),),
    {"torch": "0.025 mm (95 % of the weld)"},
)
SIZES = {"desktop": (1440, 900), "tablet": (1024, 768), "phone": (390, 844)}


def calibrating(live: LiveView) -> None:
    """After three scans, on the way to the next."""
    status = CalibrationStatus(
        sequence=4, calibration_scans=3, predicted_error_m=0.21e-3, refused=(("pose02", "no flange in the scan"),)
    )
    shown = {"calibration_status": status, "next_pose": PoseRequest(4, 4, "pose05", np.zeros(6))}
    live.moment = Moment(12.0, JobCommand(phase="move_to_pose", mode="move"), shown)
    live.scans[:] = [ScanRow(1, math.inf, math.nan), ScanRow(2, 0.6e-3, 0.5e-3), ScanRow(3, 0.21e-3, 0.2e-3)]


def welding(live: LiveView, sigma_min: float = 0.3) -> None:
    """In the middle of a seam of 100 mm."""
    now = Diagnostics(e_t=0.04e-3, s_torch=0.05, delta_n=1.9e-3)
    command = WeldingCommand(np.zeros(6), True, Phase.TRACK, None, now)
    report = ServoReport(
        phase="TRACK", torch_on=True, reason=None, command=command, state=None, time=40.0, X_BT=RigidTransform()
    )
    shown = {"servo_report": report, "planned_seam": PlannedSeam(sequence=1, seam=SEAM)}
    live.moment = Moment(40.0, JobCommand(phase="weld", mode="weld"), shown, sigma_min)
    s = np.linspace(0.0, 0.05, 60)
    live.weld[:] = [
        WeldRow(
            time=30.0 + 100.0 * x,
            s_torch=x,
            s_tip=x + 0.03,
            offset=4e-4 * math.sin(60.0 * x),
            deflection=1.9e-3,
            speed=8e-3,
            torch_on=True,
        )
        for x in s
    ]


@pytest.fixture
def source() -> DashboardSource:
    return DashboardSource(LiveView(), Operator(), FACTS)


@pytest.fixture(scope="module")
def view() -> Meshcat:
    """An empty 3D view."""
    return Meshcat(MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}"))


@pytest.fixture
def page(source: DashboardSource, view: Meshcat) -> Iterator[Dashboard]:
    dashboard = Dashboard(source, view.web_url(), share=True)
    yield dashboard
    dashboard.close()


def run_takes_seconds_for_each_of_its_own(
    source: DashboardSource, monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    """Let the source's wall clock, and no other, follow the run: the time left is then that of the wall clock."""
    begun = time.monotonic()
    clock = SimpleNamespace(monotonic=lambda: begun + seconds * source.live.moment.time)
    monkeypatch.setattr("weldcal.tools.dashboard.source.time", clock)
    source.values()  # the clock begins here


def opened(browser: Browser, url: str, state: str) -> None:
    browser.open(url, wait_for=f"document.getElementById('state')?.textContent === '{state}'")


def click(browser: Browser, button: str) -> None:
    browser.run(f"document.getElementById('{button}').click()")


def ask(url: str, what: str, **headers: str) -> tuple[int, Any]:
    """POST as a program, or a foreign page, would."""
    host = url.split("/")[2]
    connection = http.client.HTTPConnection(host, timeout=5)
    connection.request("POST", f"/act/{what}", "{}", {"Content-Type": "application/json", **headers})
    answer = connection.getresponse()
    body = answer.read()
    return answer.status, json.loads(body) if answer.status == 200 else None


# --- a real run ----------------------------------------------------------------------------------------------------------

MOVE_ONLY = """
scanner: !RenderedScanner {mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}
job: {calibrate: false, X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}
"""


@pytest.fixture
def page_is_open() -> threading.Event:
    """Set when the browser shows the page."""
    return threading.Event()


@pytest.fixture
def run_in_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, page_is_open: threading.Event
) -> Callable[[], tuple[str, threading.Thread, list[JobRun]]]:
    """Starts a run of some seconds, in real time; the page's address, the thread, and where its outcome comes to lie.

    The run waits for `page_is_open`: a busy computer may open the browser later than such a run ends.
    """

    def start() -> tuple[str, threading.Thread, list[JobRun]]:
        addresses: queue.Queue[str] = queue.Queue()
        monkeypatch.setattr("webbrowser.open", addresses.put)
        # A page whose run is over turns to the next run at its address: that of a test beside this one.
        monkeypatch.setattr("weldcal.tools.dashboard.server.PORTS", ())
        scenario, found = load_scenario("straight_groove", MOVE_ONLY), []
        scenario.job.weld, scenario.job.speed_factor = False, 0.15
        options = RunOptions(scenario="straight_groove", out=tmp_path, browser=True, realtime=True)

        def wait(*_: object) -> None:
            if not addresses.empty() or told.is_set():
                page_is_open.wait(60)

        thread = threading.Thread(target=lambda: found.append(run_job(scenario, options, wait)), daemon=True)
        thread.start()
        address = addresses.get(timeout=60)
        told.set()
        return address, thread, found

    told = threading.Event()
    return start


def test_a_run_is_held_goes_on_when_a_person_says_so_and_is_marked_as_a_replay_when_it_is_over(
    run_in_thread: Callable[[], tuple[str, threading.Thread, list[JobRun]]],
    browser: Browser,
    tmp_path: Path,
    page_is_open: threading.Event,
) -> None:
    url, thread, found = run_in_thread()
    browser.resize(*SIZES["desktop"])
    browser.open(url, timeout_s=60)
    page_is_open.set()
    browser.wait("!document.getElementById('hold').disabled", 60)
    click(browser, "hold")
    browser.wait("document.getElementById('state').textContent === 'HELD'")
    assert "by the dashboard" in browser.text().lower()
    held_at = browser.run("return document.getElementById('clock').textContent")
    time.sleep(0.5)
    assert thread.is_alive()
    assert browser.run("return document.getElementById('clock').textContent") == held_at, "no time passes"
    assert not browser.run("return document.getElementById('replay').offsetHeight")
    click(browser, "go_on")
    browser.wait("document.getElementById('state').textContent === 'DONE'", 120)
    assert browser.run("return document.getElementById('replay').offsetHeight"), "an arm that moves now is a replay"
    assert browser.run("return document.getElementById('hold').disabled")

    def scene(picture: Pixels) -> Pixels:
        return picture[:, : int(0.65 * picture.shape[1])]

    pixels = browser.screenshot(tmp_path / "done.png", until=lambda picture: colours(scene(picture)) > 60)
    assert colours(scene(pixels)) > 60, "the 3D view is in the page"
    thread.join(timeout=30)
    (finished,) = found
    assert finished.run.reason is None
    assert finished.run.held_by_person == 1
    assert browser.run("return document.getElementById('state').textContent") == "DONE"
    outside = [a for a in browser.outside_addresses() if not a.startswith(("http://127.0.0.1", "http://localhost"))]
    assert outside == []


# --- the page ------------------------------------------------------------------------------------------------------------


def test_end_asks_once_more_and_escape_holds(browser: Browser, page: Dashboard, source: DashboardSource) -> None:
    calibrating(source.live)
    opened(browser, page.url, "RUNNING")
    click(browser, "end")
    assert "Really end?" in browser.text()
    assert not source.operator.ends
    browser.run("document.dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
    browser.wait("document.getElementById('state').textContent === 'STOPPING'")
    assert source.operator.holds
    click(browser, "end")
    browser.wait("document.getElementById('line').textContent.startsWith('ended by the dashboard')")
    assert source.operator.ends


@pytest.mark.parametrize("size", SIZES)
def test_what_a_person_needs_is_on_the_page_at_every_size(
    browser: Browser,
    page: Dashboard,
    source: DashboardSource,
    size: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run_takes_seconds_for_each_of_its_own(source, monkeypatch, 1.5)
    browser.resize(*SIZES[size])
    calibrating(source.live)
    opened(browser, page.url, "RUNNING")
    text = browser.text()
    for words in (
        "calibrate: to the next pose",
        "0.21 mm",
        "pose02: not used, no flange in the scan",
        "pose05",
        "3 scans",
        "about 57 s left",  # 1.5 times 3 scans of 4 s, a seam of 20 s and 6 s home
    ):
        assert words in text.lower(), words
    assert browser.run("return document.querySelectorAll('#plot_error circle').length") == 2
    welding(source.live)
    browser.wait("document.getElementById('seam').textContent.startsWith('50 of 100 mm, torch on')")
    for words in ("the torch is 0.04 mm beside", "0.06 mm", "1.90 mm", "8.0 mm/s", "about 18 s left"):
        assert words in browser.text().lower(), words
    assert "Steering margin" not in browser.text()
    welding(source.live, sigma_min=0.04)
    browser.wait("document.body.innerText.includes('Steering margin 10 %')")
    fits = "return document.documentElement.scrollWidth <= innerWidth"
    assert browser.run(fits), "nothing lies beside the page"
    for button in ("hold", "go_on", "end"):
        box = browser.run(
            f"const b = document.getElementById('{button}').getBoundingClientRect(); return [b.height, b.left, b.right]"
        )
        assert isinstance(box, list)
        assert box[0] >= 44, "a thumb meets it"
        assert 0 <= box[1] < box[2] <= SIZES[size][0]
    share = browser.run("return document.querySelector('.view').getBoundingClientRect().width / innerWidth")
    assert share == pytest.approx(1.0 if size == "phone" else 0.65, abs=0.01)
    browser.screenshot(tmp_path / f"{size}.png")
    assert browser.console_messages() == []


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_the_page_keeps_result_report_and_replay_when_the_program_has_ended(
    browser: Browser, source: DashboardSource, size: str, tmp_path: Path
) -> None:
    view = Meshcat(MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}"))
    (tmp_path / "recording.html").write_text(view.StaticHtml())
    (tmp_path / "report.html").write_text("<html><body><h1>The report</h1><script>var ran = 1;</script></body></html>")
    dashboard = Dashboard(source, view.web_url())
    browser.resize(*SIZES[size])
    welding(source.live)
    opened(browser, dashboard.url, "RUNNING")
    assert not browser.run("return document.getElementById('result').offsetHeight")
    source.end(held=False, reason=None, replays=True)
    source.conclude(RESULT, tmp_path)
    dashboard.close()
    del view
    browser.wait("document.getElementById('pages')?.children.length === 2 && chosen === 'recording.html'")
    text = browser.text()
    for words in ("use it", "the error is 0.200 mm", "torch", "0.025 mm", "x_bc", str(tmp_path).lower(), "replay"):
        assert words in text.lower(), words
    assert browser.run("return document.getElementById('state').textContent") == "DONE"
    assert not browser.run("return document.getElementById('live_view').offsetHeight"), "its server is gone"
    bar = (
        "const r = document.querySelector('.replay').getBoundingClientRect(); const f ="
        " loaded['recording.html'].getBoundingClientRect();"
    )
    assert browser.run(bar + "return r.bottom <= f.top + 1 && f.height > 200"), "nothing covers REPLAY"
    pixels = browser.screenshot(tmp_path / f"done_{size}.png", until=lambda picture: colours(picture) > 60)
    assert colours(pixels) > 60, "the replay is drawn"
    browser.run("choose('report.html')")
    assert browser.run(
        "return loaded['report.html'].contentWindow.ran === 1 && loaded['report.html'].offsetHeight > 200"
    )
    assert browser.run("return document.documentElement.scrollWidth <= innerWidth")
    browser.screenshot(tmp_path / f"report_{size}.png")
    browser.rest()


def test_the_time_left_follows_the_pace_that_was_asked_for(source: DashboardSource) -> None:
    welding(source.live)
    assert source.values()["left_s"] == 12
    source.operator.ask_pace(0.1)
    assert source.values()["left_s"] == 120


def test_the_time_left_is_that_of_the_wall_clock(source: DashboardSource, monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulation that takes four seconds for each of its own has four times as much left; a hold counts as none."""
    welding(source.live)
    assert source.values()["left_s"] == 12
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 4.0 * source.live.moment.time)
    assert source.values()["left_s"] == pytest.approx(48, abs=1)
    source.operator.stands = True
    monkeypatch.setattr(time, "monotonic", lambda: now + 9.0 * source.live.moment.time)
    assert source.values()["left_s"] == pytest.approx(48, abs=1)
    assert source.values()["wall_s"] == pytest.approx(4.0 * source.live.moment.time, abs=1.0)


def test_a_page_that_hears_nothing_says_so(browser: Browser, page: Dashboard, source: DashboardSource) -> None:
    calibrating(source.live)
    opened(browser, page.url, "RUNNING")
    browser.run("events.close()")
    browser.wait("document.getElementById('state').textContent === 'NO CONNECTION'", timeout_s=8)
    assert browser.run("return document.getElementById('hold').disabled")
    assert "look at the arm" in browser.text()


# --- who may do what -----------------------------------------------------------------------------------------------------


def test_only_the_page_itself_can_act(page: Dashboard, source: DashboardSource) -> None:
    key = _key(page)
    source.operator.hold()
    port = page.url.split(":")[2].strip("/")
    foreign = {
        "no key": {},
        "a wrong key": {"X-Weldcal-Key": "x" * len(key)},
        "a foreign page": {"X-Weldcal-Key": key, "Origin": "http://elsewhere.example"},
        "a foreign name": {"X-Weldcal-Key": key, "Host": f"elsewhere.example:{port}"},
    }
    for who, headers in foreign.items():
        assert ask(page.url, "go_on", **headers) == (403, None), who
        assert source.operator.holds, who
    assert ask(page.url, "go_on", **{"X-Weldcal-Key": key}) == (200, {"done": True})
    assert not source.operator.holds
    assert ask(page.url, "go_on", **{"X-Weldcal-Key": key}) == (200, {"done": False}), "there is nothing to go on with"
    assert ask(page.url, "pace", **{"X-Weldcal-Key": key}) == (200, {"done": False}), "without a number"
    source.end(held=False, reason=None, replays=True)
    assert ask(page.url, "hold", **{"X-Weldcal-Key": key}) == (200, {"done": False}), "the run is over"


def test_the_network_reads_with_a_token_and_cannot_act(
    browser: Browser, page: Dashboard, source: DashboardSource
) -> None:
    assert page.shared_url is not None
    port, token = page.shared_url.split(":")[2].split("/")[:2]
    url = f"http://127.0.0.1:{port}/"
    for path in ("", "values", "events", "act/hold", "0" * len(token) + "/"):
        assert _status(url + path) == 404, path
    assert ask(url, "hold")[0] == 404
    calibrating(source.live)
    opened(browser, url + token + "/", "RUNNING")
    assert "Read-only" in browser.text()
    assert browser.run("return document.querySelectorAll('button, input, iframe').length") == 0
    assert browser.console_messages() == []


def test_a_page_that_is_over_answers_nothing_on_connections_that_a_browser_keeps(
    source: DashboardSource, view: Meshcat
) -> None:
    """The next run's page may have the same port: a request on such a connection would be answered by the page before
    it."""
    dashboard = Dashboard(source, view.web_url())
    address = dashboard.url.split("/")[2].split(":")
    with socket.create_connection((address[0], int(address[1])), timeout=5) as kept:
        assert _status(dashboard.url) == 200
        dashboard.close()
        with suppress(ConnectionError):
            kept.sendall(b"GET /values HTTP/1.1\r\nHost: 127.0.0.1:1\r\n\r\n")
            assert kept.recv(1000) == b""


def _key(page: Dashboard) -> str:
    connection = http.client.HTTPConnection(page.url.split("/")[2], timeout=5)
    connection.request("GET", "/")
    text = connection.getresponse().read().decode()
    return text.split('name="weldcal-key" content="')[1].split('"')[0]


def _status(url: str) -> int:
    connection = http.client.HTTPConnection(url.split("/")[2], timeout=5)
    connection.request("GET", "/" + url.split("/", 3)[3])
    return connection.getresponse().status
