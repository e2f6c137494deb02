"""A picture of the live view in the course of an acquisition on the emulated bench.

Runs ``jaxcal-hw acquire --bench --view``, opens the page that it names in chromium without a
window, and takes the picture after the ninth of 20 images; the acquisition is then ended by Ctrl-C.
Writes docs/images/live-view.png. Bench seed 3; minutes. Needs chromium, its driver and selenium.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

from jaxcal.io.atomic import atomic_path

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "live-view.png"
SIZE, IMAGES, AFTER = (1240, 770), 20, 9
COMMAND = ("acquire", "--bench", "--bench-seed", "3", "--view", "--speed", "3", "--images")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
OPTIONS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage", "--force-device-scale-factor=1", "--hide-scrollbars",
)  # fmt: skip

CLOSE = "document.querySelectorAll('[class*=Notification-closeButton]').forEach(b => b.click())"
"""Closes viser's message that no graphics card draws the page."""


def screenshot(url: str, lines: Iterator[str], profile: str) -> bytes:
    """The page as PNG, after the image that :data:`AFTER` counts."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = next(path for name in BROWSERS if (path := shutil.which(name)))
    for option in (*OPTIONS, f"--user-data-dir={profile}"):
        options.add_argument(option)
    browser = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        # What is seen has this size, whatever the browser's own bars take.
        browser.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False},
        )
        browser.get(url)
        for line in lines:
            if re.match(rf"image \d+ \({AFTER} of {IMAGES}\)", line):
                break
        browser.execute_script(CLOSE)
        time.sleep(3.0)  # the page changes ten times a second, a software renderer less often
        return browser.get_screenshot_as_png()
    finally:
        browser.quit()


def main() -> None:
    """Take the picture."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "hw", *COMMAND, str(IMAGES), f"{folder}/rec.h5"]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as acquisition:
            assert acquisition.stderr is not None
            try:
                lines = iter(acquisition.stderr)
                found = (re.search(r"view: (http://\S+)", line) for line in lines)
                url = next(match[1] for match in found if match)
                seen = screenshot(url, lines, f"{folder}/profile")
            finally:
                acquisition.send_signal(signal.SIGINT)
                for _ in acquisition.stderr:
                    pass
    with atomic_path(PICTURE) as path:
        Image.open(BytesIO(seen)).convert("RGB").save(path, format="PNG", optimize=True)
    print(PICTURE)


if __name__ == "__main__":
    main()
