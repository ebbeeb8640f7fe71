"""The page in a real browser: it shows the session, and clicks, typing, keys and sticks take effect.

A software renderer takes about half a second for a frame, in which the page does nothing else. So there is one browser
for all tests, and sessions are paused, except where something must move: then nothing is drawn anew.
"""

import contextlib
import functools
import io
import os
import re
import signal
import subprocess

import imageio
import numpy as np
import pytest
from PIL import Image
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from support.browser import complaints, screen
from support.clock import wait_for
from support.scripts import COMMAND, PATHS
from support.sessions import new_session, running

from legged_torque import SCRIPTS_DIR
from legged_torque.envs import LeggedRobotCfg
from legged_torque.terrain.selection import select_tiles
from legged_torque.utils.config import flat, to_dict
from legged_torque.viewer.web import Page

pytestmark = pytest.mark.timeout(900)  # [s]


def walk(session, seconds):
    """Let the robots of a session move for some time."""
    end = session.sim_time + seconds
    session.set_paused(False)
    wait_for(lambda: session.sim_time >= end)
    session.set_paused(True)
    wait_for(lambda: session.is_paused)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A running session of two multi-head robots, with a robot of another task as companion of the first."""
    made = new_session(tmp_path_factory.mktemp("first"), "a1_torque_multihead")
    made.companion = new_session(tmp_path_factory.mktemp("other"), "a1_position", 1)
    with running(made):
        walk(made, 1.0)
        yield made


@contextlib.contextmanager
def serving(session, host="127.0.0.1"):
    """A session's page."""
    with contextlib.closing(Page(session, "a1_torque_multihead", host, 8480, "no renderer in tests")) as page:
        yield page


@pytest.fixture(scope="module")
def page(session):
    """The session's page, for other machines too."""
    with serving(session, "0.0.0.0") as served:
        yield served


def text_of(browser):
    """What can be read on the page."""
    return browser.find_element(By.TAG_NAME, "body").text


def simulated_time(browser):
    """How long the robots have walked [s]."""
    return float(re.search(r"([\d.]+) s simulated", text_of(browser))[1])


def open_page(browser, url):
    """Open a page, and wait for its controls and the robot's first picture."""
    browser.get(url)
    wait_for(lambda: "Command" in text_of(browser))
    complaints(browser)


@pytest.fixture(scope="module")
def opened(browser, page):
    """The browser with the page, for which it needs the token once."""
    address = page.server.url.partition("?token=")[0]
    browser.get(address)
    assert "with its token" in text_of(browser)
    browser.get(page.server.url)
    open_page(browser, address)
    return browser


def control(browser, label):
    """The field, slider or box with a label."""
    path = f"//label[normalize-space()='{label}']/following::input[not(@type='hidden')][1]"
    return browser.find_element(By.XPATH, path)


def click(browser, element):
    """Click an element, or the button or tab with a label, that may be scrolled out of sight."""
    if isinstance(element, str):
        element = browser.find_element(By.XPATH, f"//button[contains(., '{element}')]")
    browser.execute_script("arguments[0].click()", element)


def type_into(browser, label, value):
    """Type a number into the field with a label."""
    field = control(browser, label)
    field.send_keys(Keys.CONTROL + "a")
    field.send_keys(value, Keys.TAB)


def repeat_until(act, condition):
    """Do something on the page until a condition holds: a busy page may lose keys and clicks."""
    for _ in range(5):
        act()
        with contextlib.suppress(AssertionError):
            return wait_for(condition, 30.0)
    raise AssertionError("nothing that was done on the page took effect")


def set_pause(browser, is_on, condition):
    """Set the box to pause until a condition holds. The page sets it too, and then a click does the opposite."""
    box = control(browser, "pause")
    repeat_until(lambda: box.is_selected() == is_on or click(browser, box), condition)


def share(browser, is_meant, left=0.3, right=0.7, top=0.15, bottom=0.8):
    """The share of a part of the page, whose ends are shares, where a function accepts red, green and blue."""
    picture = np.array(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")).astype(int)
    height, width, _ = picture.shape
    part = picture[int(top * height) : int(bottom * height), int(left * width) : int(right * width)]
    return is_meant(*part.reshape(-1, 3).T).mean()


def is_dark(red, green, blue):
    """The robot is, ground and sky are not."""
    return np.maximum(np.maximum(red, green), blue) < 90


def is_orange(red, green, blue):
    """The companion is."""
    return (red > 180) & (blue < 120) & (red > green + 20)


def test_what_is_shown(opened):
    """Both robots are drawn, one of them tinted, and the panels show numbers of both."""
    wait_for(lambda: share(opened, is_dark) > 0.005)
    wait_for(lambda: share(opened, is_orange) > 0.005)
    text = text_of(opened)
    for words in (
        *("model_0", "companion: a1_position", "Command", "v_x [m/s]", "yaw rate [rad/s]", "gamepad", "Mixing weights"),
        *("v_x, forward [m/s]", "commanded", "actual", "Feet on the ground, last 5 s", "FR", "FR thigh", "/34"),
        *("contacts", "collision geoms", "ghost", "Record"),
    ):
        assert words in text, words
    assert "cost of transport" in text and "mechanical power [W]" in text
    tabs = {
        "Joints": "FR calf angle, -2.70 to -0.92 rad",
        "Rewards": "weighted, per second",
        "Walking": "v_x, forward [m/s]",
    }
    for tab, words in tabs.items():
        opened.find_element(By.XPATH, f"//*[@role='tab'][contains(., '{tab}')]").click()
        wait_for(lambda words=words: words in text_of(opened))


def test_steering(opened, session):
    """Fields, button, held keys and a gamepad's sticks choose the command, which the fields show; or it is drawn."""
    type_into(opened, "v_x [m/s]", "0.8")
    wait_for(lambda: session.command and session.command[0] == 0.8)  # the others stay as they were drawn
    opened.find_element(By.XPATH, "//button[contains(., 'Stand still')]").click()  # keys are no longer for the field
    wait_for(lambda: session.command == (0.0, 0.0, 0.0))
    for keys, command in {("w", Keys.ARROW_LEFT): (1.0, 0.0, 1.0), ("s", "d"): (-1.0, -1.0, 0.0)}.items():
        hold = ActionChains(opened)
        for key in keys:
            hold.key_down(key)
        hold.perform()
        wait_for(lambda command=command: session.command == command)
        wait_for(lambda command=command: float(control(opened, "v_x [m/s]").get_attribute("value")) == command[0])
        for key in keys:
            hold.key_up(key)
        hold.perform()
        wait_for(lambda: session.command == (0.0, 0.0, 0.0))
    pad = "navigator.getGamepads = () => [{mapping: 'standard', axes: [0, %s, 0.5, 0]}]"  # no device can be plugged in
    opened.execute_script(pad % -0.75)
    wait_for(lambda: session.command == (0.75, 0.0, -0.5))
    opened.execute_script("navigator.getGamepads = () => []")
    wait_for(lambda: session.command == (0.0, 0.0, 0.0))
    forged = "{type: 'GuiUpdateMessage', uuid: window.steering.field, updates: {value: [%s, 0, 0]}}"
    for value in ("9", "NaN", "-0.5"):
        opened.execute_script(f"window.__viserMutable.sendMessage({forged % value})")
    wait_for(lambda: session.command == (-0.5, 0.0, 0.0))
    assert not session.message.is_error  # what no key and no stick can send is dropped
    click(opened, control(opened, "random"))
    wait_for(lambda: session.command is None)
    walk(session, 0.1)
    drawn = session.snapshot.commands[0]
    np.testing.assert_array_equal(session.companion.snapshot.commands[0], drawn)
    wait_for(lambda: float(control(opened, "v_x [m/s]").get_attribute("value")) == pytest.approx(drawn[0], abs=0.006))


def test_keys_and_hints(opened, session):
    """Keys do what they do in MuJoCo's window; a hint at the pointer says what a label is for."""

    def press(key, focus="document.activeElement.blur()"):
        opened.execute_script(focus, control(opened, "contacts"))
        ActionChains(opened).send_keys(key).perform()

    for is_paused in (False, True):
        press(" ")
        wait_for(lambda is_paused=is_paused: session.is_paused == is_paused)
    session.set_command((0.5, 0.0, 0.0))
    for key, message in {"p": "pushed with 0.8 m/s", "r": "reset"}.items():
        press(key, "arguments[0].focus()")  # a box in which nobody types
        wait_for(lambda message=message: session.message.text == message)
    press("0")
    wait_for(lambda: session.command == (0.0, 0.0, 0.0))
    labels = [label for label in opened.find_elements(By.XPATH, "//label[@for]") if label.text]
    assert len(labels) > 15
    for label in labels:
        opened.execute_script("arguments[0].dispatchEvent(new Event('pointerover', {bubbles: true}))", label)
        assert label.get_attribute("title"), label.text
    click(opened, control(opened, "random"))


CURVES = """return Object.values(window.__viserTestpoints.uplots).filter(
    ({chart}) => chart.data.length > 2 && chart.scales.y.max >= 1.6)
    .map(({chart}) => [chart.axes[0].label, chart.scales.y.max, Math.max(...chart.data[2])])"""


def test_no_curve_is_cut(opened, session):
    """Scales of velocities grow with large values, and are no smaller than at first; axes of time have a label."""
    session.push(0.0, 4.0)
    walk(session, 0.2)
    wait_for(lambda: any(largest > 2.5 for *_, largest in opened.execute_script(CURVES)))
    for label, high, largest in opened.execute_script(CURVES):
        assert label == "time [s]" and high >= largest


def test_recording_without_a_renderer(opened, page):
    """The page says why there is no video."""
    click(opened, "Record")
    wait_for(lambda: "Stop and download" in text_of(opened))
    click(opened, "Stop and download")
    wait_for(lambda: "no renderer in tests" in text_of(opened))


def test_phone(opened, session):
    """The sheet is as wide as the page; the plots, at its top, can be unfolded; both robots are above it."""
    session.reset()  # on a slow machine, the tests before may let them walk apart
    walk(session, 0.1)
    with screen(opened, 390, 844, 0.25, mobile=True):
        open_page(opened, opened.current_url)
        sheet = wait_for(lambda: opened.find_element(By.CSS_SELECTOR, "[style*='max-height: 60%']"))
        wait_for(lambda: sheet.size["width"] == 390)
        plots = opened.find_element(By.CSS_SELECTOR, "[aria-label='Expand panel Walking']")
        assert plots.location["y"] < opened.find_element(By.XPATH, "//label[.='random']").location["y"]
        robots = {"left": 0.0, "right": 1.0, "top": 0.15, "bottom": 0.38}
        wait_for(lambda: share(opened, is_dark, **robots) > 0.005 and share(opened, is_orange, **robots) > 0.005)
        click(opened, plots)
        wait_for(lambda: "v_x, forward [m/s]" in text_of(opened))


def test_rough_ground(browser, tmp_path):
    """The ground is drawn in the color of its kind, with the points of the scan; a level chosen on the page counts."""
    terrain = LeggedRobotCfg.terrain()
    terrain.tile_size, terrain.border_size = 6.0, 1.0
    select_tiles(terrain, ["discrete_obstacles", "waves"], [0.2, 0.5], 1)
    settings = {f"terrain.{name}": value for name, value in flat(to_dict(terrain)).items()}
    session = new_session(tmp_path, "a1_torque_multihead", **settings)

    def is_seen():
        """Whether there is the orange of discrete obstacles, and the red of the scan's points."""
        middle = {"left": 0.4, "right": 0.6, "top": 0.33, "bottom": 1.0}
        is_orange = share(browser, lambda red, green, blue: red > blue + 8, **middle) > 0.3
        return is_orange and share(browser, lambda red, green, blue: (red > 180) & (green < 90), **middle) > 0.001

    with running(session), serving(session) as page, screen(browser, 900, 500, 1):  # points are a pixel large
        session.set_command((0.0, 0.0, 0.0))
        walk(session, 0.1)
        open_page(browser, page.server.url)
        wait_for(is_seen)
        assert "discrete_obstacles, level 0 (difficulty 0.20)" in text_of(browser)
        type_it = functools.partial(type_into, browser, "level", "1")
        repeat_until(type_it, lambda: session.task.terrain.levels.tolist() == [1, 1])
        walk(session, 0.1)
        wait_for(lambda: "level 1 (difficulty 0.50)" in text_of(browser))
    assert not [message for message in complaints(browser) if "ERR_CONNECTION" not in message]


def test_a_video_is_downloaded(browser, tmp_path):
    """From a policy to a video of it that the browser has saved."""
    environment = {**os.environ, **PATHS, "MUJOCO_GL": "osmesa"}
    how = {"cwd": tmp_path, "env": environment, "stdout": subprocess.PIPE, "text": True}
    play = [SCRIPTS_DIR / "play.py", "--policy=a1/position", "--num_envs=2", "--device=cpu"]
    play += ["--viewer=web", "--port=8495"]
    with subprocess.Popen([*COMMAND, *play], **how) as process:
        try:
            lines = iter(process.stdout.readline, "")
            open_page(browser, next(line for line in lines if "See it walk" in line).split()[3])
            set_pause(browser, True, lambda: "paused" in text_of(browser))  # else typing takes half a minute
            type_into(browser, "speed [x]", "0.05")  # few steps, since the page is slow
            click(browser, "Record")
            wait_for(lambda: "Stop and download" in text_of(browser))
            start = simulated_time(browser)
            set_pause(browser, False, lambda: simulated_time(browser) > start + 0.05)
            set_pause(browser, True, lambda: "paused" in text_of(browser))
            click(browser, "Stop and download")
            file = browser.downloads / "walking.mp4"
            wait_for(file.is_file)
            process.send_signal(signal.SIGINT)
            wait_for(lambda: " ".join(play[1:]) in text_of(browser))  # how to open it again
        finally:
            process.kill()  # it would take seconds to close its page
    frames = list(imageio.v3.imiter(file, plugin="FFMPEG"))
    assert 3 <= len(frames) <= 150 and (frames[-1].max(axis=2) < 90).mean() > 0.002
