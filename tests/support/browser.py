"""Chromium without a window, for tests of pages; they run with NEEDS_BROWSER=1, as .ci/run does."""

import contextlib
import ctypes.util
import importlib.util
import os
import shutil

import pytest

CHROMIUM, DRIVER = (shutil.which("chromium") or shutil.which("google-chrome")), shutil.which("chromedriver")
PARTS = {name: importlib.util.find_spec(name) for name in ("viser", "selenium", "imageio_ffmpeg")}
PARTS |= {"chromium": CHROMIUM, "chromedriver": DRIVER, "libosmesa6": ctypes.util.find_library("OSMesa")}
MISSING = [name for name, part in PARTS.items() if not part]
if not os.environ.get("NEEDS_BROWSER"):
    pytest.skip("takes minutes in Chromium: set NEEDS_BROWSER=1, as .ci/run does", allow_module_level=True)
if MISSING:
    pytest.fail(f"not installed: {', '.join(MISSING)}")

from selenium import webdriver

OPTIONS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--webgl-antialiasing-mode=none --window-size=900,600 --force-device-scale-factor=0.25"  # of 16 pixels one is drawn
)


def start(folder):
    """Return a browser with a profile of its own, that notes what pages complain of."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for option in (*OPTIONS.split(), f"--user-data-dir={folder / 'profile'}"):
        options.add_argument(option)
    options.add_experimental_option("prefs", {"download.default_directory": str(folder)})
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    driver.downloads = folder
    return driver


def complaints(browser):
    """Errors that were logged since the last call."""
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


@contextlib.contextmanager
def screen(browser, width, height, factor, mobile=False):
    """Context of another screen, with a number of pixels per unit of length."""
    size = {"width": width, "height": height, "deviceScaleFactor": factor, "mobile": mobile}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        yield
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
