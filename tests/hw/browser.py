"""A real browser without a window, that reaches nothing but this machine."""

from __future__ import annotations

import shutil
import time
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
OPTIONS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-default-apps",
    "--disable-extensions", "--disable-dev-shm-usage", "--force-device-scale-factor=1",
    # Every name leads nowhere; addresses other than loopback are looked for in the log.
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)  # fmt: skip


def chromium() -> tuple[str, str]:
    """Paths of the browser and of its driver; skips the test where either is missing."""
    browser = next((path for name in NAMES if (path := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("chromium and chromium-driver are not installed")
    return browser, driver


@contextmanager
def browsing(folder: Path, size: tuple[int, int] = (720, 480)) -> Iterator:
    """A selenium driver of a fresh profile in a folder."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    from selenium.webdriver.chrome.service import Service

    path, driver = chromium()
    options = webdriver.ChromeOptions()
    options.binary_location = path
    # Whoever asks waits for what the page says, or by open_page.
    options.page_load_strategy = "none"
    for option in (*OPTIONS, f"--user-data-dir={folder}", f"--window-size={size[0]},{size[1]}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield browser
    finally:
        browser.quit()


def open_page(browser, url: str, timeout_s: float = 180.0) -> None:
    """Go there, and return when that page is loaded; until then the one before it may answer."""
    browser.get(url)
    deadline = time.monotonic() + timeout_s
    ready = [url, "complete"]
    while browser.execute_script("return [document.URL, document.readyState]") != ready:
        assert time.monotonic() < deadline, f"{url} was not loaded"
        time.sleep(0.05)


def addresses(browser) -> set[str]:
    """Hosts that the page asked for, or opened a socket to, since this was asked last.

    The browser's own pages (a new tab) are not what is asked about.
    """
    import json
    from urllib.parse import urlparse

    hosts = set()
    for entry in browser.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        asked = message["params"].get("request", message["params"]).get("url", "")
        if asked.startswith(("chrome:", "chrome-untrusted:")):
            continue
        if message["method"] in ("Network.requestWillBeSent", "Network.webSocketCreated"):
            hosts.add(urlparse(asked).hostname)
    return hosts - {None}


def screenshot(browser) -> bytes:
    """What the page looks like, PNG; a page drawn without a graphics processor may take long."""
    told = browser.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})
    return b64decode(told["data"])


def pixels(browser) -> np.ndarray:
    """What the page looks like, (rows, columns, 3) uint8."""
    from PIL import Image

    return np.asarray(Image.open(BytesIO(screenshot(browser))).convert("RGB"))
