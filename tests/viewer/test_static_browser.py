"""The published page in a real browser, from a plain server of files: the robot walks there as in plain MuJoCo."""

import contextlib
import functools
import http.server
import threading
from pathlib import Path

import numpy as np
import pytest
import yaml
from selenium.webdriver.common.by import By
from support.browser import complaints, screen
from support.clock import wait_for as wait
from support.scripts import run_here

from legged_torque import resource_path
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.motors.twin import MotorTwin
from legged_torque.utils import devices
from legged_torque.viewer import static_page

pytestmark = pytest.mark.timeout(300)  # [s]
POLICIES = ("go2/torque_multihead", "g1/position")  # with a torque-speed curve; with position control and friction
DRIVE = {"drive": {"model": "drive", "damping": 0.5, "stiffness": 200.0}}
"""A motor that asks for more than the limits, before them."""
STEPS = 25
SCRIPTS = yaml.safe_load(Path(__file__).with_name("static_page.yaml").read_text("utf-8"))


@pytest.fixture(scope="module", params=POLICIES)
def served(request, tmp_path_factory):
    """Name of a policy and address of its page."""
    root = tmp_path_factory.mktemp("site")
    out = root / "published"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(devices, "choose_offscreen_renderer", lambda: "no video, it takes long")
        assert run_here("publish.py", request.param, root=root)[0] == 0
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=out)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with contextlib.closing(server.socket):
        yield request.param, f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def status(browser):
    """The line on how the simulation goes."""
    return browser.find_element(By.ID, "status").text


def description(name):
    """Of a policy, with :data:`DRIVE` before the motors of the first one."""
    found = Policy(name).description
    return found | {"motors": DRIVE | found["motors"]} if name == POLICIES[0] else found


def in_mujoco(name, steps):
    """Positions and torques after steps from rest, with one wanted torque each of the first policy; without latency."""
    policy = Policy(name)
    robot = MujocoRobot(resource_path(policy.description["robot"]["file"]), policy.description)
    motors, still = MotorTwin(description(name)), np.zeros(len(policy.joint_order))
    start = np.array(policy.description["initial_state"]["trunk_position"])
    robot.reset(start, np.array([1.0, 0.0, 0.0, 0.0]), policy.nominal_pose, (np.zeros(3), np.zeros(3), still))
    for _ in range(steps):
        actions = policy.act(policy.observation(robot.state(), np.array([0.5, 0.1, -0.2])))
        motors.begin()
        for i in range(policy.description["timing"]["decimation"]):
            pos, vel = robot.joint_positions(), robot.joint_velocities()
            if i == 0 or name != POLICIES[0]:
                wanted = policy.wanted_torques(actions, pos, vel)
            torques = motors.apply(wanted, pos, vel)
            robot.step(torques)
    return robot.data.qpos, torques


def test_page(browser, served):
    """It runs as MuJoCo does, walks on its own, is steered and pushed, and has no errors, at three widths."""
    name, address = served
    browser.get(address)
    wait(lambda: "real time" in status(browser), 60.0)
    browser.find_element(By.ID, "pause").click()
    motors = static_page.motors(description(name))
    qpos, torques = browser.execute_async_script(SCRIPTS["run"], STEPS, motors, name == POLICIES[0])
    expected = in_mujoco(name, STEPS)
    np.testing.assert_allclose(qpos, expected[0], atol=1e-4)
    np.testing.assert_allclose(torques, expected[1], atol=1e-2)
    browser.find_element(By.ID, "pause").click()
    before = browser.execute_script("return [simulation.time, simulation.robot.data.qpos[0]]")
    wait(lambda: browser.execute_script("return simulation.time") > before[0] + 2.0, 60.0)
    x, falls = browser.execute_script("return [simulation.robot.data.qpos[0], simulation.falls]")
    assert x > before[1] + 0.4 and falls == 0
    browser.find_element(By.ID, "push").click()
    browser.find_element(By.ID, "stop").click()
    assert browser.execute_script("return simulation.command") == [0, 0, 0]
    assert browser.execute_script(SCRIPTS["keys"]) == [[0, 0, 0], True]
    for width in (1920, 1280, 390):
        with screen(browser, width, 800, 0.1):  # few pixels are drawn
            assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    begin, end = browser.execute_script(SCRIPTS["memory"])
    assert begin == end
    assert [browser.execute_script(SCRIPTS["adapt"], time) for time in (1 / 30, 1 / 60)] == [0, 1]
    assert not complaints(browser)
