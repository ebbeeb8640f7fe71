"""The viewer's page in a real browser: the robot is drawn, a slider changes its speed, and nothing is complained of."""

import importlib.util
import os
import re
import shutil
import threading
import time

import numpy as np
import pytest

CHROMIUM, DRIVER = (shutil.which("chromium") or shutil.which("google-chrome")), shutil.which("chromedriver")
PARTS = {"viser": importlib.util.find_spec("viser"), "selenium": importlib.util.find_spec("selenium")}
MISSING = [name for name, part in {**PARTS, "chromium": CHROMIUM, "chromedriver": DRIVER}.items() if not part]
if MISSING and os.environ.get("NEEDS_BROWSER"):  # where the page must be tested
    pytest.fail(f"not installed: {', '.join(MISSING)}")
if MISSING:
    pytest.skip(f"not installed: {', '.join(MISSING)}", allow_module_level=True)

from PIL import Image
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from legged_torque import resource_path
from legged_torque.envs import task_registry
from legged_torque.terrain.selection import select_tiles
from legged_torque.utils.config import flat, to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.task_registry import LoadedRun
from legged_torque.viewer.ports import free_port
from legged_torque.viewer.session import Session
from legged_torque.viewer.web import Page, watch

TIMEOUT = 120.0
"""Seconds that the page may take for something: a software renderer draws about a frame a second."""
OPTIONS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--window-size=1000,640"
)


def wait_for(condition):
    """Wait until a condition holds, and return its value."""
    end = time.monotonic() + TIMEOUT
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.1)
    raise AssertionError(f"waited in vain for {condition.__name__}")


@pytest.fixture
def session(make_task, tmp_path, request):
    """A running session of two multi-head robots that glide as they are told to, without any training.

    On a plane, or on tiles of the kinds that ``request.param`` names.
    """
    env_cfg = task_registry.get_cfgs("a1_torque_multihead")[0]
    if hasattr(request, "param"):
        env_cfg.terrain.tile_size, env_cfg.terrain.border_size = 6.0, 1.0
        select_tiles(env_cfg.terrain, request.param, [0.2, 0.5], 1)
    settings = {f"terrain.{name}": value for name, value in flat(to_dict(env_cfg.terrain)).items()}
    env = make_task("a1_torque_multihead", num_envs=2, **settings)
    runner = task_registry.make_alg_runner(env, "a1_torque_multihead", log_root=None)[0]
    runner.save(str(tmp_path / "model_0.pt"))
    run = LoadedRun(tmp_path, {}, env.cfg, task_registry.get_cfgs("a1_torque_multihead")[1], tmp_path / "model_0.pt")
    session = Session(type(env), run, "cpu")

    def glide(obs):
        """Hold the nominal pose, and move and turn the trunk by hand."""
        task = session.task
        task.base_quat.copy_(task._tensor([1.0, 0.0, 0.0, 0.0]).expand(2, 4))
        task.sim.qvel[:, :6] = 0.0
        task.sim.qvel[:, :2] = task.commands[:, :2]
        return task.actions * 0.0

    session._policy = glide
    thread = threading.Thread(target=session.run, daemon=True)
    thread.start()
    yield session
    session.stop()
    thread.join(timeout=10)


@pytest.fixture
def page(session):
    """The session's page."""
    robot = resource_path(session.task.cfg.asset.file)
    page = Page(session, robot, "a1_torque_multihead", "127.0.0.1", 8480, "no renderer in tests")
    yield page
    page.close()


@pytest.fixture
def browser(tmp_path):
    """A browser without a window, and with a profile of its own."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for option in (*OPTIONS.split(), f"--user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


def test_page(session, page, browser, tmp_path):
    """From opening the page to a robot that goes faster."""
    browser.get(page.url)
    wait_for(lambda: browser.find_elements(By.TAG_NAME, "canvas"))

    def robot_is_drawn():
        """Whether there are many colors, and dark ones in the middle: ground and sky are light."""
        browser.save_screenshot(str(tmp_path / "page.png"))
        picture = np.array(Image.open(tmp_path / "page.png").convert("RGB"))
        height, width, _ = picture.shape
        middle = picture[height // 3 : 4 * height // 5, width * 2 // 5 : width * 3 // 5]
        colors = len(np.unique(picture.reshape(-1, 3), axis=0))
        return colors > 1000 and (middle.max(axis=2) < 90).mean() > 0.01

    wait_for(robot_is_drawn)
    print(f"the page: {tmp_path / 'page.png'}")
    text = browser.find_element(By.TAG_NAME, "body").text
    for words in (
        "Feet on the ground",
        "FR",
        "ghost",
        "collision geoms",
        "model_0",
        "Command",
        "x [m/s]",
        "yaw [rad/s]",
        "Mixing weights",
        "v_x, forward [m/s]",
        "FR thigh",
    ):
        assert words in text

    def told_to_go():
        """Type a speed into the field beside the first slider."""
        field = browser.find_element(
            By.XPATH, "//label[contains(., 'x [m/s]')]/following::input[not(@type='hidden')][1]"
        )
        field.send_keys(Keys.CONTROL + "a")
        field.send_keys("0.8", Keys.TAB)
        time.sleep(0.5)
        return session.state.command and session.state.command[0] == 0.8  # the others stay as they were drawn

    wait_for(told_to_go)
    wait_for(lambda: abs(session.state.reading.velocities[:, 0] - 0.8).max() < 0.1)

    def stopped():
        """Click the button that stops."""
        browser.find_element(By.XPATH, "//button[contains(., 'Stand still')]").click()
        time.sleep(0.5)
        return session.state.command == (0.0, 0.0, 0.0)

    wait_for(stopped)
    wait_for(lambda: abs(session.state.reading.velocities[:, 0]).max() < 0.1)
    hold = ActionChains(browser)
    hold.key_down("w").key_down(Keys.ARROW_LEFT).perform()
    wait_for(lambda: session.state.command == (1.0, 0.0, 1.0))
    place = browser.find_element(By.XPATH, "//label[contains(., 'x [m/s]')]/following::input[not(@type='hidden')][1]")
    wait_for(lambda: place.get_attribute("value") == "1")
    hold.key_up("w").key_up(Keys.ARROW_LEFT).perform()
    wait_for(lambda: session.state.command == (0.0, 0.0, 0.0))
    for name in ("ghost", "collision geoms"):
        box = f"//label[normalize-space()='{name}']/following::input[1]"
        browser.execute_script("arguments[0].click()", browser.find_element(By.XPATH, box))
    handles = [page._scene.layers._ghost._handles, page._scene.layers._collision._handles]
    wait_for(lambda: all(handles) and all(handle.visible for bodies in handles for handle in bodies.values()))
    for label in ("Record", "Stop and download"):
        button = browser.find_element(By.XPATH, f"//button[contains(., '{label}')]")
        browser.execute_script("arguments[0].click()", button)
        wait_for(lambda label=label: page._recording._button.label != label)
    wait_for(lambda: "no renderer in tests" in browser.find_element(By.TAG_NAME, "body").text)
    complaints = [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert not complaints


@pytest.mark.parametrize("session", [["discrete_obstacles", "waves"]], indirect=True)
def test_rough_ground(session, page, browser, tmp_path):
    """The ground is drawn in the color of its kind, with the points of the scan; a level chosen on the page counts."""
    session.set_command((0.0, 0.0, 0.0))
    session.reset()
    browser.get(page.url)
    wait_for(lambda: browser.find_elements(By.TAG_NAME, "canvas"))

    def shares():
        """How much of the middle of the page is orange, as discrete obstacles are, and as red as the scan's points."""
        browser.save_screenshot(str(tmp_path / "ground.png"))
        picture = np.array(Image.open(tmp_path / "ground.png").convert("RGB")).astype(int)
        height, width, _ = picture.shape
        red, green, blue = picture[height // 3 :, width * 2 // 5 : width * 3 // 5].reshape(-1, 3).T
        return (red > blue + 8).mean(), ((red > 180) & (green < 90)).mean()

    wait_for(lambda: shares()[0] > 0.3 and shares()[1] > 0.001)
    print(f"the page: {tmp_path / 'ground.png'}")
    assert "discrete_obstacles, level 0 (difficulty 0.20)" in browser.find_element(By.TAG_NAME, "body").text
    path = "//label[normalize-space()='level']/following::input[not(@type='hidden')][1]"

    def is_moved():
        """Type a level into the field beside its slider."""
        field = browser.find_element(By.XPATH, path)
        field.send_keys(Keys.CONTROL + "a")
        field.send_keys("1", Keys.TAB)
        time.sleep(0.5)
        return session.task.terrain.levels.tolist() == [1, 1]

    wait_for(is_moved)
    wait_for(lambda: "level 1 (difficulty 0.50)" in browser.find_element(By.TAG_NAME, "body").text)
    assert not [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def test_token(session, browser):
    """A page for other machines opens at its printed address alone, and then without the token as well."""
    page = Page(session, resource_path(session.task.cfg.asset.file), "a1_torque_multihead", "0.0.0.0", 8490)
    address, _, token = page.url.partition("?token=")
    try:
        for url, is_open in ((address, False), (page.url, True), (address, True)):
            browser.get(url)
            if is_open:
                wait_for(lambda: "Command" in browser.find_element(By.TAG_NAME, "body").text)
            else:
                assert "with its token" in browser.find_element(By.TAG_NAME, "body").text
    finally:
        page.close()
    assert len(token) == 32 and page.server.request_share_url() is None


@pytest.mark.parametrize(("host", "is_open"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_what_is_printed(session, capsys, host, is_open):
    """The address, with a token and a warning if other machines reach it."""
    session.stop()  # so that watching ends at once
    watch(session, resource_path(session.task.cfg.asset.file), "a1_torque_multihead", host, 8495)
    printed = capsys.readouterr().out
    assert re.search(r"^See it walk: http://127\.0\.0\.1:\d+(/\?token=\w{32})? ", printed, re.MULTILINE)
    assert ("Warning: other machines reach this page" in printed) == ("?token=" in printed) == is_open


def test_taken_port(page):
    """The next free port is taken; an address that is not this machine's is told."""
    port = page.server.get_port()
    assert free_port("127.0.0.1", port) == port + 1
    with pytest.raises(UserError, match=r"cannot serve at 192\.0\.2\.1:8480"):
        free_port("192.0.2.1", 8480)
