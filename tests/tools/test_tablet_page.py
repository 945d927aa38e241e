"""The tablet's page in a real browser: where a finger, a pen or a mouse touched is what it writes down, at any pixel
ratio."""

from __future__ import annotations

import csv
import http.client
import io
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.browser import Browser
from tests.places import ROOT
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.commands.tablet.serve import LARGEST_CSV, TabletServer, open_server, page, tablet_host

PAGE = ROOT / "tools/commands/tablet/tablet.html"
WIDTH, HEIGHT = 1000, 700
PX_PER_MM = 4.0


def opened(browser: Browser, ratio: float, target: Path | str = PAGE) -> None:
    """The page on a screen of that pixel ratio with nothing kept from before and a known true size."""
    browser.devtools(
        "Emulation.setDeviceMetricsOverride", width=WIDTH, height=HEIGHT, deviceScaleFactor=ratio, mobile=False
    )
    browser.open(target)
    browser.run("state.touches = []; state.seen = ''; store()")
    browser.run(f"setScale({PX_PER_MM}); document.getElementById('checked').click()")


def enter(browser: Browser) -> np.ndarray:
    """Goes to the landmarks (without full screen, which would undo the pretended pixel ratio); returns them in CSS
    pixels."""
    browser.run("document.documentElement.requestFullscreen = undefined; document.getElementById('touch').click()")
    return np.array(browser.run("return layout().points"))


def press(browser: Browser, kind: str, x: float, y: float) -> None:
    """One touch as the browser gets it from the device."""
    if kind == "touch":
        browser.devtools("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y, "force": 0.6}])
        browser.devtools("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        return
    for step in ("mousePressed", "mouseReleased"):
        browser.devtools(
            "Input.dispatchMouseEvent", type=step, x=x, y=y, button="left", clickCount=1, pointerType=kind, force=0.4
        )


def touches(browser: Browser) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(str(browser.run("return csv()")))))


@pytest.fixture(autouse=True)
def _restored(request: pytest.FixtureRequest) -> Iterator[None]:
    """The shared browser gets its own screen back."""
    yield
    if "browser" in request.fixturenames:
        request.getfixturevalue("browser").devtools("Emulation.clearDeviceMetricsOverride")


@pytest.mark.parametrize("ratio", [1.0, 1.5, 2.0, 3.0])
def test_touches_are_written_where_they_fell(browser: Browser, ratio: float) -> None:
    opened(browser, ratio)
    landmarks = enter(browser)
    assert browser.run("return devicePixelRatio") == pytest.approx(ratio)
    rng = np.random.default_rng(int(10 * ratio))
    sent = landmarks + rng.uniform(-8.0, 8.0, landmarks.shape)
    kinds = ["mouse", "pen", "touch"] * 3
    for kind, (x, y) in zip(kinds, sent, strict=True):
        press(browser, kind, x, y)
    rows = touches(browser)
    assert [row["pointer"] for row in rows] == kinds
    found = np.array([[float(row["touch_x_px"]), float(row["touch_y_px"])] for row in rows])
    assert np.abs(found - sent).max() <= 0.5
    np.testing.assert_allclose(
        [[float(r["landmark_x_px"]), float(r["landmark_y_px"])] for r in rows], landmarks, atol=1e-4
    )
    assert all(re.fullmatch(r"\d+\.\d", row["touch_x_px"]) for row in rows), "a tenth of a pixel is written"
    assert all(re.fullmatch(r"20\d\d-\d\d-\d\dT[\d:.]+Z", row["time_utc"]) for row in rows)
    assert sorted(row["time_utc"] for row in rows) == [row["time_utc"] for row in rows]
    assert float(rows[0]["mm_per_px"]) == pytest.approx(1.0 / PX_PER_MM, rel=1e-6)
    assert browser.console_messages() == []
    assert browser.outside_addresses() == []


@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_landmarks_are_drawn_where_they_are_said_to_be(browser: Browser, ratio: float, tmp_path: Path) -> None:
    opened(browser, ratio)
    browser.run(
        "document.getElementById('look').value = 'rings'; document.documentElement.requestFullscreen = undefined"
    )
    browser.run("document.getElementById('camera').click()")
    points = np.array(browser.run("return layout().points"))
    pixels = browser.screenshot(tmp_path / "camera.png")
    assert pixels.shape[:2] == (HEIGHT * ratio, WIDTH * ratio)
    dark = 1.0 - pixels.mean(axis=2)
    spacing = np.array([60.0, 38.0]) * PX_PER_MM
    np.testing.assert_allclose(points[[1, 3]] - points[0], np.diag(spacing), atol=1.0 / ratio)
    for x, y in points[1:]:
        u, v, r = int(x * ratio), int(y * ratio), int(5.0 * PX_PER_MM * ratio)
        window = dark[v - r : v + r + 1, u - r : u + r + 1]
        offset = np.arange(-r, r + 1)
        centre = np.array([(window.sum(axis=0) * offset).sum(), (window.sum(axis=1) * offset).sum()]) / window.sum()
        assert np.abs(centre).max() < 0.6, "the ring is centred on the landmark's own pixel"


def test_the_card_sets_the_true_size(browser: Browser, tmp_path: Path) -> None:
    opened(browser, 2.0)
    browser.run("const s = document.getElementById('size'); s.value = 127; s.dispatchEvent(new Event('input'))")
    width = browser.run("return document.getElementById('card').getBoundingClientRect().width")
    assert width == pytest.approx(85.60 * 127 / 25.4, abs=0.1)
    assert "Not checked" in browser.text()
    browser.run("document.getElementById('checked').click()")
    assert "Checked: 254.0 pixels per inch" in browser.text()  # of the glass: twice the page's
    browser.screenshot(tmp_path / "card.png")


def test_a_stray_touch_and_a_changed_page_are_refused(browser: Browser) -> None:
    opened(browser, 1.0)
    landmarks = enter(browser)
    press(browser, "mouse", landmarks[0, 0] + 100.0, landmarks[0, 1])
    assert touches(browser) == []
    assert "25 mm from landmark 1" in browser.text()
    press(browser, "mouse", *landmarks[0])
    browser.devtools("Emulation.setDeviceMetricsOverride", width=900, height=HEIGHT, deviceScaleFactor=1, mobile=False)
    press(browser, "mouse", *np.array(browser.run("return layout().points"))[1])
    assert len(touches(browser)) == 1
    browser.wait("innerWidth === 900")
    assert "changed its size" in browser.text()


def test_undo_takes_the_last_touch_back_and_a_reload_keeps_the_rest(browser: Browser) -> None:
    opened(browser, 1.0)
    landmarks = enter(browser)
    for k in range(3):
        press(browser, "mouse", *landmarks[k])
    browser.run("document.getElementById('undo').click()")
    assert [row["landmark"] for row in touches(browser)] == ["0", "1"]
    browser.run("window.before = true; location.reload()")
    browser.wait("!window.before && document.readyState === 'complete'")
    assert [row["landmark"] for row in touches(browser)] == ["0", "1"]


def test_landmarks_that_do_not_fit_cannot_be_shown(browser: Browser) -> None:
    opened(browser, 1.0)
    browser.run("const a = document.getElementById('across'); a.value = 150; a.dispatchEvent(new Event('input'))")
    assert "do not fit" in browser.text()
    assert browser.run("return document.getElementById('touch').disabled") is True


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390), (768, 1024)])
def test_on_a_full_screen_no_button_lies_over_a_landmark(browser: Browser, width: int, height: int) -> None:
    """A pen that pressed Back instead of the last landmark would end the visit; a ring at the frame is none to the
    camera."""
    opened(browser, 1.0)
    browser.devtools(
        "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
    )
    browser.run(
        "const [a, d] = layout().most; document.getElementById('across').value = a;"
        " document.getElementById('down').value = d;document.getElementById('across').dispatchEvent(new Event('input'))"
    )
    assert "9 landmarks fit" in browser.text()
    assert browser.run("return document.documentElement.scrollWidth") == width
    landmarks = enter(browser)
    for x, y in landmarks:
        press(browser, "pen", x, y)
    assert [row["landmark"] for row in touches(browser)] == [str(k) for k in range(9)]
    bar = float(str(browser.run("return document.getElementById('bar').getBoundingClientRect().top")))
    reach = 7.0 * PX_PER_MM  # ring of 8 mm and 3 mm of white
    assert landmarks[:, 1].max() + reach <= bar + 0.5
    assert (landmarks.min(axis=0) >= reach - 0.5).all()
    assert landmarks[:, 0].max() + reach <= width + 0.5


@pytest.fixture
def server(tmp_path: Path) -> Iterator[TabletServer]:
    """The real server on a free port of loopback."""
    made = open_server("127.0.0.1", 0, tmp_path / "sent", lambda _: None)
    worker = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
    worker.start()
    yield made
    made.shutdown()
    worker.join()
    made.server_close()


def test_touches_sent_to_the_computer_are_a_file_there(browser: Browser, server: TabletServer) -> None:
    address = server.address("127.0.0.1")
    opened(browser, 1.0, address)
    landmarks = enter(browser)
    for k in range(4):
        press(browser, "pen", *landmarks[k])
    browser.run("document.getElementById('done').click(); document.getElementById('send').click()")
    browser.wait("document.getElementById('sent').textContent.startsWith('Written')")
    (path,) = server.folder.glob("*.csv")
    assert path.read_text() == browser.run("return csv()")


TOUCHES = b"landmark,time_utc,\n"


def answered(
    server: TabletServer, method: str, path: str, body: bytes = b"", length: str | None = None, **headers: str
) -> tuple[int, str]:
    """Status and text of one request, sent as written; `Host` and `Content-Length` are right unless given."""
    port = server.server_address[1]
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    sent = {"Host": f"127.0.0.1:{port}"} | ({"Content-Length": str(len(body))} if body else {}) | headers
    for name, value in sent.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    connection.send(body)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_the_page_is_found_under_its_token_only(server: TabletServer) -> None:
    status, text = answered(server, "GET", f"/{server.token}/")
    assert status == 200
    assert "default-src 'none'" in text
    assert len(server.token) >= 20
    other = open_server("127.0.0.1", 0, server.folder, lambda _: None)
    other.server_close()
    assert other.token != server.token
    paths = (
        "/",
        "/tablet.html",
        f"/{server.token}",
        f"/{server.token}/../serve.py",
        f"/{server.token}x/",
        "/" + "x" * 22 + "/",
    )
    for path in paths:
        status, text = answered(server, "GET", path)
        assert status == 404, path
        assert server.token not in text
    for method in ("PUT", "DELETE", "OPTIONS", "HEAD", "TRACE"):
        assert answered(server, method, f"/{server.token}/")[0] == 501


def test_the_server_takes_nothing_but_touches_from_its_own_page(server: TabletServer) -> None:
    port, path = server.server_address[1], f"/{server.token}/touches"
    csv = {"Content_Type": "text/csv"}
    refused = [
        (path, TOUCHES, {"Content_Type": "text/plain"}, 415),
        (path, b"something else", csv, 400),
        ("/touches", TOUCHES, csv, 404),
        (f"/{server.token}/elsewhere", TOUCHES, csv, 404),
        (path, TOUCHES, csv | {"Origin": "http://example.org"}, 403),
        (path, TOUCHES, csv | {"Origin": "null"}, 403),
        (path, TOUCHES, csv | {"Origin": f"http://127.0.0.1:{port + 1}"}, 403),
        (path, TOUCHES, csv | {"Host": f"example.org:{port}"}, 421),
        (path, TOUCHES, csv | {"Host": "127.0.0.1"}, 421),
        (path, TOUCHES, csv | {"Host": f"0.0.0.0:{port}"}, 421),
        (path, b"", csv, 411),
        (path, b"", csv | {"Content_Length": "-1"}, 411),
        (path, b"", csv | {"Transfer_Encoding": "chunked"}, 411),
        (path, b"", csv | {"Content_Length": "0"}, 413),
        (path, b"", csv | {"Content_Length": str(LARGEST_CSV + 1)}, 413),
        (path, b"", csv | {"Content_Length": "9" * 4000}, 413),
    ]
    for where, body, headers, status in refused:
        assert answered(server, "POST", where, body, **headers)[0] == status, (where, headers)
    assert not server.folder.exists()
    for origin in ({}, {"Origin": f"http://127.0.0.1:{port}"}, {"Origin": f"http://localhost:{port}"}):
        assert answered(server, "POST", path, TOUCHES, **csv, **origin)[0] == 200
    assert answered(server, "POST", path, TOUCHES, **csv, Host=f"localhost:{port}")[0] == 200
    assert len(list(server.folder.iterdir())) == 4


def test_a_list_that_was_cut_on_its_way_is_not_written(server: TabletServer) -> None:
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=5) as line:
        head = (
            f"POST /{server.token}/touches HTTP/1.1\r\nHost: 127.0.0.1:{server.server_address[1]}\r\n"
            "Content-Type: text/csv\r\nContent-Length: 500\r\n\r\n"
        )
        line.sendall(head.encode() + TOUCHES)
        line.shutdown(socket.SHUT_WR)
        assert b" 400 " in line.recv(1000)
    assert not server.folder.exists()


def test_a_taken_port_is_one_sentence(server: TabletServer, tmp_path: Path) -> None:
    port = str(server.server_address[1])
    finished = CliRunner().invoke(app, ["tablet", "serve", "--port", port, "--out", str(tmp_path)])
    assert finished.exit_code == 1
    assert f"Port {port} is in use on 127.0.0.1. Choose another with --port." in finished.output
    with pytest.raises(InputError, match="not an address of this machine"):
        open_server("203.0.113.7", 0, tmp_path, lambda _: None)
    for host in ("999.1.1.1", "192.168.1", "my-computer", "http://127.0.0.1", "127.0.0.1 ", ""):
        with pytest.raises(InputError, match="is not an IP address"):
            open_server(host, 0, tmp_path, lambda _: None)
    with pytest.raises(InputError, match="from 0 to 65535"):
        open_server("127.0.0.1", 70000, tmp_path, lambda _: None)


def test_only_this_machine_is_let_in_unless_told_otherwise(tmp_path: Path) -> None:
    assert tablet_host("127.0.0.1") == "127.0.0.1"
    assert tablet_host("0.0.0.0") != "0.0.0.0"
    with open_server("localhost", 0, tmp_path, lambda _: None) as made:
        assert made.server_address[0] == "127.0.0.1"
        assert made.address("::1").startswith("http://[::1]:")


def test_the_page_names_no_outside_address() -> None:
    assert not re.search(r"(https?:)?//[a-z]", page().replace("// ", ""))
