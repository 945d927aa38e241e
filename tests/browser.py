"""A headless Chromium without a network: opens a page as an operator would and tells what it saw."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray
from selenium.common.exceptions import TimeoutException, WebDriverException
from selenium.webdriver import Chrome, ChromeOptions, ChromeService
from selenium.webdriver.support.ui import WebDriverWait

Pixels = NDArray[np.float64]

FLAGS = (
    "--headless=new",
    "--no-sandbox",  # tests also run as root in a container
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--disable-gpu-compositing",  # nor does the page need one: its drawing takes a third of the processor
    "--enable-unsafe-swiftshader",
    "--window-size=1280,800",
    "--force-device-scale-factor=1",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-default-apps",
)

# Without a graphics card a frame of a cell takes half a second of a core, and it is drawn again as long as it is open:
# frames queue up, and a screenshot waits for all of them. Once a second, with hard edges, is enough to look at.
SLOW_ANIMATION = """
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 1000);
window.cancelAnimationFrame = clearTimeout;
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, wanted) {
  return getContext.call(this, kind, { ...wanted, antialias: false });
};
"""


class Browser:
    """One headless browser; a file is opened with no network at all, a server on this machine with it."""

    def __init__(self, driver: Chrome) -> None:
        self._driver = driver
        driver.execute_cdp_cmd("Network.enable", {})
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": SLOW_ANIMATION})

    def open(
        self, page: Path | str, *, wait_for: str = "document.readyState === 'complete'", timeout_s: float = 30
    ) -> None:
        """Opens a file without any network, or the address of a server on this machine, and waits for a condition.

        Args:
            page: the path of a file, or an address on localhost.
            wait_for: a JavaScript expression that becomes true when the page is ready to be looked at.
            timeout_s: how long that may take.

        Raises:
            selenium.common.TimeoutException: if it never becomes true.
        """
        offline = isinstance(page, Path)
        conditions = {"offline": offline, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        self._driver.execute_cdp_cmd("Network.emulateNetworkConditions", conditions)
        self.console_messages()
        self._driver.get(page.resolve().as_uri() if isinstance(page, Path) else page)
        self.wait(wait_for, timeout_s)

    def rest(self) -> None:
        """Leaves the page: a 3D scene is drawn again and again as long as it is open, which takes a whole core."""
        with suppress(WebDriverException):  # one that has died is told by the next test that needs it
            self._driver.get("about:blank")

    def wait(self, condition: str, timeout_s: float = 30) -> None:
        """Waits until a JavaScript expression is true.

        Raises:
            selenium.common.TimeoutException: if it never is; it tells what the page showed instead.
        """
        try:
            WebDriverWait(self._driver, timeout_s).until(
                lambda driver: driver.execute_script(f"return Boolean({condition})")
            )
        except TimeoutException:
            shown = f"{self._driver.current_url} shows {self.text()!r}, console {self._driver.get_log('browser')}"
            raise TimeoutException(f"not in {timeout_s:g} s: {condition}; {shown}") from None

    def run(self, script: str) -> object:
        """The value that a piece of JavaScript returns."""
        return self._driver.execute_script(script)

    def devtools(self, command: str, **parameters: object) -> object:
        """What a command of the browser's own tools answers (input events, a screen's pixel ratio)."""
        return self._driver.execute_cdp_cmd(command, parameters)

    def text(self) -> str:
        """What an operator can read on the page."""
        return str(self.run("return document.body.innerText"))

    def console_messages(self, level: str = "SEVERE") -> list[str]:
        """The console messages of that level since the page was opened or this was last called (errors by default)."""
        entries = self._driver.get_log("browser")  # type: ignore[no-untyped-call]
        return [str(entry["message"]) for entry in entries if entry["level"] == level]

    def outside_addresses(self) -> list[str]:
        """The addresses outside the page's own file that it asked for."""
        script = "return performance.getEntriesByType('resource').map(entry => entry.name)"
        names = self.run(script)
        assert isinstance(names, list)
        return [name for name in names if not name.startswith(("data:", "blob:"))]

    def dark(self, wanted: bool) -> None:
        """Shows pages as an operator with a dark (or light) desktop sees them."""
        features = [{"name": "prefers-color-scheme", "value": "dark" if wanted else "light"}]
        self._driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def resize(self, width: int, height: int) -> None:
        """Makes the visible page so many CSS pixels wide and high."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def screenshot(self, path: Path, *, until: Callable[[Pixels], bool] | None = None, timeout_s: float = 20) -> Pixels:
        """Writes what is visible to a PNG file; returns its pixels, (height, width, 3) from 0 to 1.

        Args:
            path: the PNG file.
            until: if given, pictures are taken until this holds for one (3D scenes appear a few frames late).
            timeout_s: how long; the last picture is returned then, whatever it shows.
        """
        give_up = time.monotonic() + timeout_s
        while True:
            assert self._driver.save_screenshot(str(path))
            pixels = np.asarray(imread(path), dtype=float)[:, :, :3]
            if until is None or until(pixels) or time.monotonic() > give_up:
                return pixels
            time.sleep(0.1)


def colours(pixels: Pixels) -> int:
    """How many clearly different colours (of 16 levels a channel) a picture has: 1 or 2 on a blank page."""
    levels = (np.clip(pixels, 0, 1) * 15.999).astype(int)
    return int(np.unique(levels @ np.array([256, 16, 1])).size)


RUNNING = pytest.StashKey[Browser]()


@pytest.fixture(scope="session")
def browser(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One headless browser for the whole test session; tests that need it are skipped where there is none."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    chromedriver = shutil.which("chromedriver")
    if chromium is None or chromedriver is None:
        pytest.skip("chromium and chromium-driver are not installed, so no page can be looked at")
    options = ChromeOptions()
    options.binary_location = chromium
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(flag)
    driver = Chrome(options=options, service=ChromeService(chromedriver))
    try:
        request.session.stash[RUNNING] = Browser(driver)
        yield request.session.stash[RUNNING]
    finally:
        driver.quit()
