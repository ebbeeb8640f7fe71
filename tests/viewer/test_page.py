"""The page without a browser: robots of all kinds, and errors that must not end it."""

import contextlib
import os
import re
import threading
from collections import deque

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from support.clock import Clock, wait_for
from support.robot_files import urdf
from support.scripts import run_here
from support.sessions import new_session, running
from support.visitor import visitor

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO
from legged_torque.importer.mjcf import mjcf
from legged_torque.importer.robot import import_robot
from legged_torque.importer.settings import settings
from legged_torque.utils.policies import POLICIES_DIR, name_of, policy_names
from legged_torque.viewer import scene, web
from legged_torque.viewer.access import TOKEN
from legged_torque.viewer.plots import gait_html, joints_by_leg
from legged_torque.viewer.video import VideoRecorder
from legged_torque.viewer.web import RECORD, Page, watch


def imported_task(folder):
    """The name of a new task of a robot that has been imported into a folder."""
    (folder / "paged.urdf").write_text(urdf())
    robot = import_robot(folder / "paged.urdf")
    (folder / "paged.xml").write_text(mjcf(robot)[0])
    parts = {"__name__": "paged"}
    exec(compile(settings(robot, str(folder / "paged.xml")), "paged.py", "exec"), parts)
    kinds = {kind: parts[f"Paged{kind}"]() for kind in ("Cfg", "CfgPPO")}
    assert isinstance(kinds["Cfg"], LeggedRobotCfg) and isinstance(kinds["CfgPPO"], LeggedRobotCfgPPO)
    task_registry.register("imported", "legged_torque.envs.base.legged_robot:LeggedRobot", *kinds.values())
    return "imported"


@contextlib.contextmanager
def serving(folder, name):
    """The page of a running session."""
    ground = {"curriculum": False} if "rough" in name else None
    session = new_session(folder, imported_task(folder) if name == "imported" else name, ground=ground)
    with running(session), contextlib.closing(Page(session, "title", "127.0.0.1", 8460)) as page:
        page.session = session
        session.set_paused(False)
        yield page
    task_registry._tasks.pop("imported", None)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of a robot on rough ground."""
    with serving(tmp_path_factory.mktemp("run"), "a1_rough_position") as page:
        yield page


def status(page):
    """What stands above the controls."""
    return page.status.content


def control(page, label):
    """The control with a label."""
    return next(handle for handle in page.server.gui._gui_input_handle_from_uuid.values() if handle.label == label)


def moves(page):
    """Whether the robots on the page move on."""
    before = np.array(page._scene._root.position)
    return wait_for(lambda: not np.array_equal(page._scene._root.position, before))


@pytest.mark.parametrize("name", ["a1_rough_position", "imported"])
def test_page_goes_on(page, tmp_path, name):
    """Time passes, robots on rough ground and strangers' move, each foot has its gait."""
    with serving(tmp_path, name) if name == "imported" else contextlib.nullcontext(page) as page:
        wait_for(lambda: page.session.sim_time > 0.5)
        wait_for(lambda: "lt-error" not in status(page) and not status(page).count("> 0.0 s simulated"))
        assert moves(page) and not page.errors.visible
        feet = page.session.snapshot.feet
        assert page._plots._gait.content.count("<svg") == len(feet) == len(page._plots._feet)


@pytest.mark.parametrize(("owner", "name"), [("_plots", "update"), ("_scene", "update"), ("session", "push")])
def test_error_of_a_part(page, monkeypatch, capsys, owner, name):
    """It is shown in red until it is over, whatever it is; robots and commands are not concerned."""

    def fail(*args):
        raise ValueError("a <b> of a part")

    page.session.set_command(None)
    wait_for(lambda: control(page, "random").value is True)
    with visitor(page.server) as send, monkeypatch.context() as patch:
        push = {"type": "GuiUpdateMessage", "uuid": control(page, "Push")._impl.uuid, "updates": {"value": True}}
        patch.setattr(getattr(page, owner) if owner else page, name, fail)
        send(**push)
        wait_for(lambda: page.errors.visible and "ValueError: a &lt;b&gt; of a part" in page.errors.content)
        assert "lt-error" in page.errors.content
        assert owner == "_scene" or moves(page)
        page.session.set_command((0.25, 0.0, 0.0))
        wait_for(lambda: page.session.command == (0.25, 0.0, 0.0))
        wait_for(lambda: control(page, "random").value is False)
        patch.undo()
        send(**push)
        wait_for(lambda: not page.errors.visible)
    assert moves(page)
    assert capsys.readouterr().err.count("Traceback") == 1  # not with every picture


def test_choice_of_a_policy(page):
    """A bundled policy's page offers all of them; a choice ends the session and is handed on."""
    session, chosen = page.session, []
    session.policy, session.stop = name_of(POLICIES_DIR / "go2" / "position"), chosen.append
    with contextlib.closing(Page(session, "title", "127.0.0.1", 8460)) as other, visitor(other.server) as send:
        dropdown = control(other, "policy")
        assert list(dropdown.options) == policy_names()
        wait_for(lambda: dropdown.value == "go2/position")
        send(type="GuiUpdateMessage", uuid=dropdown._impl.uuid, updates={"value": "g1/position"})
        wait_for(lambda: chosen == ["g1/position"])
    del session.stop


def test_recording(page, monkeypatch):
    """The button tells how far the drawing is, until the video is there; then it can be used again."""
    go_on = threading.Event()

    def write(self, file, no_renderer, on_frame):
        on_frame(3, 70)
        assert len(self.steps) > 3 and go_on.wait(60.0)
        file.write_bytes(b"video")

    monkeypatch.setattr(VideoRecorder, "write", write)
    button = page._record
    button.value = True
    wait_for(lambda: page._recorder and len(page._recorder.steps) > 3)
    button.value = True
    wait_for(lambda: "3 of 70" in button.label and button.disabled)
    go_on.set()
    wait_for(lambda: button.label == RECORD and not button.disabled)
    assert not page.errors.visible


def test_controls_follow_the_session(page):
    """A choice that was refused, or made elsewhere, does not stay on the page."""
    dropdown, session = control(page, "checkpoint"), page.session
    dropdown.value = "7"
    wait_for(lambda: dropdown.value == "0")
    session.load_checkpoint(7)
    wait_for(lambda: "model_7.pt" in status(page) and "lt-error" in status(page))
    session.set_paused(True)
    wait_for(lambda: "paused" in status(page))
    session.set_paused(False)
    session.reset()
    wait_for(lambda: "lt-error" not in status(page))


def test_sliders_show_what_is_commanded(tmp_path):
    """They do beyond the ranges of the training too: moving one of them changes no other component of the command."""
    ranges = {"commands.ranges.lin_vel_x": [0.3, 1.0]}
    session = new_session(tmp_path, "a1_position", 1, clock=Clock(), **ranges)
    page = Page(session, "title", "127.0.0.1", 8460)
    forward, turning = control(page, "v_x [m/s]"), control(page, "yaw rate [rad/s]")

    def choose(control, value):
        send(type="GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": value})
        wait_for(lambda: session.requests)
        session.tick()
        return session.snapshot.commands[0].tolist()

    with visitor(page.server) as send:
        for v_x in (3.0, 0.0):
            session.set_command((v_x, 0.0, 0.0))
            session.tick()
            wait_for(lambda v_x=v_x: (forward.value, turning.value) == (v_x, 0.0))
            assert forward.min <= 0.0 and forward.max >= v_x
            assert choose(turning, 0.5) == [v_x, 0.0, 0.5]
        for share, v_x in ((1.0, 1.0), (-1.0, 0.0)):  # keys and sticks stay within the ranges of the training
            assert choose(page._field, (share, 0.0, 0.0)) == [v_x, 0.0, 0.0]
    page.close()


@pytest.mark.parametrize(("host", "is_open"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_what_is_printed(page, monkeypatch, capsys, host, is_open):
    """The address, with a token and a warning if other machines reach it."""
    monkeypatch.setattr(page.session, "run", lambda: None)
    monkeypatch.setenv(TOKEN, "")
    port = watch(page.session, "title", host, 8470, "play.py")
    printed = capsys.readouterr().out
    found = re.search(r"^See it walk: http://127\.0\.0\.1:(\d+)(?:/\?token=(\w{32}))? ", printed, re.MULTILINE)
    assert found.groups("") == (str(port), os.environ[TOKEN])
    assert ("Warning: other machines reach this page" in printed) == ("?token=" in printed) == is_open


class Cleared(deque):
    """A history that is cleared as soon as it has been read."""

    def __iter__(self):
        """Read and clear it."""
        steps = list(super().__iter__())
        self.clear()
        return iter(steps)


def test_another_policy(tmp_path, monkeypatch):
    """It comes at the same address and on the same device, however often."""
    started = []

    def choose(session, **_):
        """Choose a policy on a page whose port was not the one that was asked for."""
        session.stop("go2/position")
        return 8491

    monkeypatch.setattr(web, "watch", choose)
    monkeypatch.setattr(os, "execv", lambda _, words: started.append(words))
    play = ["--policy=a1/position", "--viewer=web", "--num_envs=1", "--device=cpu", "--host=127.0.0.2", "--port=8490"]
    assert run_here("play.py", *play, root=tmp_path)[0] == 0
    assert run_here("demo.py", *started[0][2:], root=tmp_path)[0] == 0
    for words in started:
        assert {*words[2:]} == {"go2/position", "--host=127.0.0.2", "--port=8491", "--device=cpu"}


def test_metrics(tmp_path):
    """Power and cost of transport on the page are those of all physics steps, and of speed and weight."""
    session = new_session(tmp_path, "a1_position", 1, clock=Clock())
    page, task, power, speed = Page(session, "title", "127.0.0.1", 8460), session.task, [], []
    physics_step = task.sim.step

    def step(sense):
        physics_step(sense)
        power.append(float((task.torques[0] * task.dof_vel[0]).abs().sum()))

    task.sim.step = step
    for _ in range(20):
        session.tick()
        speed.append(float(task.base_lin_vel[0, :2].norm()))
    page._plots.update()
    rows = dict(re.findall(r"<td>([^<]*)</td><td>([^<]*)</td>", page._plots._metrics.content))
    assert float(rows["mechanical power [W]"]) == pytest.approx(np.mean(power), rel=0.01)
    weight = 9.81 * task.sim.mj_model.body_mass.sum()
    cost = float(rows["cost of transport "])
    assert cost == pytest.approx(np.mean(power) / (weight * np.mean(speed)), rel=0.01)
    page.close()
    before, page._plots._metrics.content, session.history = page._plots._metrics.content, "", Cleared(session.history)
    page._plots.update()
    assert page._plots._metrics.content == before


def test_two_robots(tmp_path, monkeypatch):
    """In wide and high pictures, a camera sees both, with a third of a metre around them, also if far apart.

    Errors of both are shown.
    """
    session = new_session(tmp_path / "first", "a1_position", 1)
    session.companion = new_session(tmp_path / "other", "a1_position", 1)
    monkeypatch.setattr(scene, "SIDE", 1.9)
    page = Page(session, "title", "127.0.0.1", 8460)

    def are_in_sight(client, aspect):
        """Whether both are drawn apart and between the picture's edges, as seen by a pinhole camera."""
        ahead = client.camera.look_at - client.camera.position
        sideways = np.cross(ahead, [0.0, 0.0, 1.0])
        axes = np.array([axis / np.linalg.norm(axis) for axis in (ahead, sideways, np.cross(sideways, ahead))])
        robots = page._scene._robots
        places = np.array([robots[name]._handles[0].batched_positions[0] for name in ("robot", "companion")])
        apart = np.linalg.norm(places[0] - places[1]) > 1.7
        depth, right, up = axes @ (places + page._scene._root.position - client.camera.position).T
        half = np.tan(0.5 * client.camera.fov) * depth
        return apart and (abs(right) + 0.33 < half * aspect).all() and (abs(up) + 0.33 < half).all()

    for aspect in (1.6, 0.46):
        with visitor(page.server, (2.0, -1.5, 1.0), aspect):
            client = list(page.server.get_clients().values())[-1]
            session.tick()
            wait_for(lambda: page._scene._robots["companion"]._handles)
            wait_for(lambda client=client, aspect=aspect: are_in_sight(client, aspect))
    for walking, number in ((session, 7), (session.companion, 8)):
        walking.load_checkpoint(number)
    session.tick()
    wait_for(lambda: re.findall(r'lt-error">[^<]*(model_.\.pt)', status(page)) == ["model_7.pt", "model_8.pt"])
    page.close()


def test_gait():
    """Dark from the step where a foot lands to the one where it lifts off, now at the right; shares of the time."""
    contacts = np.zeros((100, 2))
    contacts[20:70, 0] = contacts[90:, 0] = 1.0
    text = gait_html(["FR", "FL"], contacts, 250, 5.0)
    assert 'd="M170 0V1H220V0zM240 0V1H250V0z"' in text and 'd=""' in text
    assert "60 %" in text and "0 %" in text and "last 5 s" in text


def test_joints_by_leg():
    """Legs follow from the robot's settings, whatever their number of joints; joints of no leg are "other" ones."""
    joints = ["R_hip", "R_knee", "waist", "L_hip", "L_knee", "L_ankle"]
    assert joints_by_leg(joints, [["R", "L"]]) == {"R": [0, 1], "other": [2], "L": [3, 4, 5]}
    assert joints_by_leg(joints[:2], []) == {"other": [0, 1]}
