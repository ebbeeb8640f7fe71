"""The viewer's page in a real browser: what it shows is the session's, and what is clicked, typed or held takes effect.

A software renderer takes about half a second for a frame, in which the page does nothing else. So there is one browser
for all tests, and sessions are paused, except where something must move: then nothing is drawn anew.
"""

import contextlib
import ctypes.util
import importlib.util
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

CHROMIUM, DRIVER = (shutil.which("chromium") or shutil.which("google-chrome")), shutil.which("chromedriver")
PARTS = {name: importlib.util.find_spec(name) for name in ("viser", "selenium", "imageio_ffmpeg")}
PARTS |= {"chromium": CHROMIUM, "chromedriver": DRIVER, "libosmesa6": ctypes.util.find_library("OSMesa")}
MISSING = [name for name, part in PARTS.items() if not part]
if not os.environ.get("NEEDS_BROWSER"):
    pytest.skip("takes two minutes in Chromium: set NEEDS_BROWSER=1, as .ci/run does", allow_module_level=True)
if MISSING:
    pytest.fail(f"not installed: {', '.join(MISSING)}")

import imageio
from PIL import Image
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from legged_torque import SCRIPTS_DIR, resource_path
from legged_torque.envs import task_registry
from legged_torque.terrain.selection import select_tiles
from legged_torque.utils.config import flat, to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.task_registry import LoadedRun
from legged_torque.viewer.ports import free_port
from legged_torque.viewer.session import Session
from legged_torque.viewer.web import Page, watch

TIMEOUT = 90.0  # seconds that the page may take for something
OPTIONS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--window-size=1280,800"
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


def glide(session):
    """Let the robots of a session move and turn by hand, in the nominal pose."""

    def act(obs):
        task = session.task
        task.base_quat.copy_(task._tensor([1.0, 0.0, 0.0, 0.0]).expand(task.num_envs, 4))
        task.sim.qvel[:, :6] = 0.0
        task.sim.qvel[:, :2] = task.commands[:, :2]
        return task.actions * 0.0

    session._policy = act
    return session


def make_session(make_task, folder, name, num_envs, **settings):
    """A session of robots that glide as they are told to, without any training."""
    env = make_task(name, num_envs=num_envs, **settings)
    task_registry.make_alg_runner(env, name, log_root=None)[0].save(str(folder / "model_0.pt"))
    run = LoadedRun(folder, {"task": name}, env.cfg, task_registry.get_cfgs(name)[1], folder / "model_0.pt")
    return glide(Session(type(env), run, "cpu"))


@contextlib.contextmanager
def running(session):
    """Run a session in a thread, paused."""
    session.set_paused(True)
    thread = threading.Thread(target=session.run, daemon=True)
    thread.start()
    yield session
    session.stop()
    thread.join(timeout=10)


def walk(session, seconds):
    """Let the robots of a session move for some time."""
    end = session.state.time + seconds
    session.set_paused(False)
    wait_for(lambda: session.state.time >= end)
    session.set_paused(True)
    wait_for(lambda: session.state.is_paused)


@pytest.fixture(scope="module")
def session(make_task, tmp_path_factory):
    """A running session of two multi-head robots, with a robot of another task beside the first."""
    made = make_session(make_task, tmp_path_factory.mktemp("first"), "a1_torque_multihead", 2)
    made.companion = make_session(make_task, tmp_path_factory.mktemp("other"), "a1_position", 1)
    with running(made):
        walk(made, 1.0)
        yield made


@contextlib.contextmanager
def serving(session, host="127.0.0.1"):
    """A session's page."""
    robot = resource_path(session.task.cfg.asset.file)
    page = Page(session, robot, "a1_torque_multihead", host, 8480, "no renderer in tests")
    try:
        yield page
    finally:
        page.close()


@pytest.fixture(scope="module")
def page(session):
    """The session's page, for other machines too."""
    with serving(session, "0.0.0.0") as served:
        yield served


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A browser without a window, with a profile of its own, that notes what pages complain of."""
    folder, options = tmp_path_factory.mktemp("browser"), webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for option in (*OPTIONS.split(), f"--user-data-dir={folder / 'profile'}"):
        options.add_argument(option)
    options.add_experimental_option("prefs", {"download.default_directory": str(folder)})
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    driver.downloads = folder
    yield driver
    driver.quit()


def text_of(browser):
    """What can be read on the page."""
    return browser.find_element(By.TAG_NAME, "body").text


def complaints(browser):
    """Errors that were logged since the last call."""
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def open_page(browser, url):
    """Open a page, and wait for its controls and the robot's first picture."""
    browser.get(url)
    wait_for(lambda: "Command" in text_of(browser))
    complaints(browser)


@pytest.fixture(scope="module")
def opened(browser, page):
    """The browser with the page; its address without the token has been refused."""
    address = page.url.partition("?token=")[0]
    browser.get(address)
    assert "with its token" in text_of(browser)
    open_page(browser, page.url)
    return browser


def picture_of(png):
    """The pixels of a picture. Shape: (height, width, 3)."""
    return np.array(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def control(browser, label):
    """The field, slider or box with a label."""
    path = f"//label[normalize-space()='{label}']/following::input[not(@type='hidden')][1]"
    return browser.find_element(By.XPATH, path)


def click(browser, element):
    """Click something that may be scrolled out of sight."""
    browser.execute_script("arguments[0].click()", element)


def click_button(browser, label):
    """Click a button or a tab."""
    click(browser, browser.find_element(By.XPATH, f"//button[contains(., '{label}')]"))


def type_into(browser, label, value):
    """Type a number into the field with a label."""
    field = control(browser, label)
    field.send_keys(Keys.CONTROL + "a")
    field.send_keys(value, Keys.TAB)


def dark_share(browser, left, right, low):
    """How much of a part of the page is as dark as the robot is, and ground and sky are not; ends are shares."""
    picture = picture_of(browser.get_screenshot_as_png())
    height, width, _ = picture.shape
    return (picture[height // 6 : int(low * height), int(left * width) : int(right * width)].max(axis=2) < 90).mean()


def test_what_is_shown(opened):
    """The robot is drawn, and beside it stands what is known of it and of the robot that it is compared with."""
    wait_for(lambda: dark_share(opened, 0.3, 0.7, 0.8) > 0.01)
    text = text_of(opened)
    for words in (
        *("model_0", "beside: a1_position", "Command", "x [m/s]", "yaw [rad/s]", "gamepad", "Mixing weights"),
        *("v_x, forward [m/s]", "commanded", "actual", "Feet on the ground, last 5 s", "FR", "FR thigh", "/34"),
        *("contacts", "collision geoms", "ghost", "Record"),
    ):
        assert words in text, words
    for tab, words in {"Joints": "angle of FR calf [rad]", "Rewards": "weighted, per second"}.items():
        opened.find_element(By.XPATH, f"//*[@role='tab'][contains(., '{tab}')]").click()
        wait_for(lambda words=words: words in text_of(opened))
    opened.find_element(By.XPATH, "//*[@role='tab'][contains(., 'Walking')]").click()


def test_token(browser, opened, page):
    """The address with its token has let this browser in, which needs none after that."""
    address, _, token = page.url.partition("?token=")
    open_page(browser, address)
    assert len(token) == 32 and page.server.request_share_url() is None


def test_steering(opened, session):
    """Fields, the button, held keys and a gamepad's sticks choose the command, which the fields show."""
    type_into(opened, "x [m/s]", "0.8")
    wait_for(lambda: session.state.command and session.state.command[0] == 0.8)  # the others stay as they were drawn
    opened.find_element(By.XPATH, "//button[contains(., 'Stand still')]").click()  # keys are no longer for the field
    wait_for(lambda: session.state.command == (0.0, 0.0, 0.0))
    for keys, command in {("w", Keys.ARROW_LEFT): (1.0, 0.0, 1.0), ("s", "d"): (-1.0, -1.0, 0.0)}.items():
        hold = ActionChains(opened)
        for key in keys:
            hold.key_down(key)
        hold.perform()
        wait_for(lambda command=command: session.state.command == command)
        wait_for(lambda command=command: float(control(opened, "x [m/s]").get_attribute("value")) == command[0])
        for key in keys:
            hold.key_up(key)
        hold.perform()
        wait_for(lambda: session.state.command == (0.0, 0.0, 0.0))
    pad = "navigator.getGamepads = () => [{mapping: 'standard', axes: [0, %s, 0.5, 0]}]"  # no device can be plugged in
    opened.execute_script(pad % -0.75)
    wait_for(lambda: session.state.command == (0.75, 0.0, -0.5))
    opened.execute_script("navigator.getGamepads = () => []")
    wait_for(lambda: session.state.command == (0.0, 0.0, 0.0))


def test_random_commands(opened, session):
    """Fields follow commands that are drawn at random; the robot beside is given the same."""
    click(opened, control(opened, "random"))
    wait_for(lambda: session.state.command is None)
    walk(session, 0.1)
    drawn = session.state.reading.commands[0]
    np.testing.assert_array_equal(session.companion.state.reading.commands[0], drawn)
    wait_for(lambda: float(control(opened, "x [m/s]").get_attribute("value")) == pytest.approx(drawn[0], abs=0.006))


def test_layers(opened, page):
    """Collision geoms are drawn in purple and the ghost in green, once they are wanted."""

    def shares():
        picture = picture_of(opened.get_screenshot_as_png())
        red, green, blue = picture[:, picture.shape[1] // 4 : picture.shape[1] * 3 // 4].reshape(-1, 3).T
        return ((red > green + 10) & (blue > green + 10)).mean(), ((green > red + 10) & (green > blue + 5)).mean()

    before = shares()
    click(opened, control(opened, "collision geoms"))
    wait_for(lambda: shares()[0] > before[0] + 0.002)
    click(opened, control(opened, "collision geoms"))
    click(opened, control(opened, "ghost"))
    wait_for(lambda: shares()[1] > before[1] + 0.002)
    click(opened, control(opened, "ghost"))


def test_recording_without_a_renderer(opened, page):
    """Who asks for a video is told why there is none."""
    for label in ("Record", "Stop and download"):
        click_button(opened, label)
        wait_for(lambda label=label: page._recording._button.label != label)
    wait_for(lambda: "no renderer in tests" in text_of(opened))


def test_phone(opened, page):
    """On a narrow screen the robot is seen above the controls."""
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    open_page(opened, page.url)
    wait_for(lambda: dark_share(opened, 0.0, 1.0, 0.4) > 0.01)
    opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert not complaints(opened)


def test_rough_ground(make_task, browser, tmp_path):
    """The ground is drawn in the color of its kind, with the points of the scan; a level chosen on the page counts."""
    env_cfg = task_registry.get_cfgs("a1_torque_multihead")[0]
    env_cfg.terrain.tile_size, env_cfg.terrain.border_size = 6.0, 1.0
    select_tiles(env_cfg.terrain, ["discrete_obstacles", "waves"], [0.2, 0.5], 1)
    settings = {f"terrain.{name}": value for name, value in flat(to_dict(env_cfg.terrain)).items()}
    session = make_session(make_task, tmp_path, "a1_torque_multihead", 2, **settings)

    def shares():
        """How much of the page is orange, as discrete obstacles are, and as red as the scan's points."""
        picture = picture_of(browser.get_screenshot_as_png())
        height, width, _ = picture.shape
        red, green, blue = picture[height // 3 :, width * 2 // 5 : width * 3 // 5].reshape(-1, 3).T
        return (red > blue + 8).mean(), ((red > 180) & (green < 90)).mean()

    with running(session), serving(session) as page:
        session.set_command((0.0, 0.0, 0.0))
        walk(session, 0.1)
        open_page(browser, page.url)
        wait_for(lambda: shares()[0] > 0.3 and shares()[1] > 0.001)
        assert "discrete_obstacles, level 0 (difficulty 0.20)" in text_of(browser)
        type_into(browser, "level", "1")
        wait_for(lambda: session.task.terrain.levels.tolist() == [1, 1])
        walk(session, 0.1)
        wait_for(lambda: "level 1 (difficulty 0.50)" in text_of(browser))
    assert not [message for message in complaints(browser) if "ERR_CONNECTION" not in message]


def test_a_video_is_downloaded(browser, tmp_path):
    """From a run to a video of it that the browser has saved."""
    train = ["--task=a1_torque_multihead", "--num_envs=2", "--max_iterations=1", "--set", "runner.num_steps_per_env=4"]
    words = ["--log_root=.", "--device=cpu"]
    environment = {**os.environ, "MUJOCO_GL": "osmesa"}
    how = {"cwd": tmp_path, "env": environment, "stdout": subprocess.PIPE, "text": True}
    subprocess.run([sys.executable, SCRIPTS_DIR / "train.py", *train, *words], check=True, **how)
    play = [sys.executable, SCRIPTS_DIR / "play.py", *train[:1], "--viewer=web", "--port=8495", *words]
    with subprocess.Popen(play, **how) as process:
        try:
            lines = iter(process.stdout.readline, "")
            open_page(browser, next(line for line in lines if "See it walk" in line).split()[3])
            pause, record = control(browser, "pause"), browser.find_element(By.XPATH, "//button[contains(., 'Record')]")
            click(browser, pause)
            wait_for(lambda: "paused" in text_of(browser))
            for element in (record, pause, pause, record):  # some steps, and the page is slow
                click(browser, element)
                time.sleep(0.2)
            file = browser.downloads / "walking.mp4"
            wait_for(file.is_file)
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate()
    frames = list(imageio.v3.imiter(file, plugin="FFMPEG"))
    assert 3 <= len(frames) <= 150 and (frames[-1].max(axis=2) < 90).mean() > 0.002


def test_taken_port(page):
    """The next free port is taken; an address that is not this machine's is told."""
    port = page.server.get_port()
    assert free_port("127.0.0.1", port) == port + 1
    with pytest.raises(UserError, match=r"cannot serve at 192\.0\.2\.1:8480"):
        free_port("192.0.2.1", 8480)


@pytest.mark.parametrize(("host", "is_open"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_what_is_printed(session, capsys, host, is_open):
    """The address, with a token and a warning if other machines reach it."""
    session.stop()  # so that watching ends at once, and the last of these tests
    watch(session, resource_path(session.task.cfg.asset.file), "a1_torque_multihead", host, 8500)
    printed = capsys.readouterr().out
    assert re.search(r"^See it walk: http://127\.0\.0\.1:\d+(/\?token=\w{32})? ", printed, re.MULTILINE)
    assert ("Warning: other machines reach this page" in printed) == ("?token=" in printed) == is_open
