"""The page without a browser: robots of all kinds, and errors that must not end it."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from support.clock import wait_for
from support.sessions import new_session, running

from legged_torque.viewer.plots import foot_labels, gait_html, joints_by_leg
from legged_torque.viewer.web import Page, watch


@pytest.fixture(scope="module", params=["g1_torque_multihead", "go2_rough_torque"])
def page(request, tmp_path_factory):
    """The page of a running session: of a robot with several geoms per foot, and one of rough ground."""
    ground = {"curriculum": False} if "rough" in request.param else None
    session = new_session(tmp_path_factory.mktemp("run"), request.param, ground=ground)
    with running(session):
        page = Page(session, "title", "127.0.0.1", 8460)
        page.session = session
        session.set_paused(False)
        yield page
        page.close()


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


def test_page_goes_on(page):
    """Time passes, robots move, the gait has a row per foot, and there is no error."""
    wait_for(lambda: page.session.sim_time > 0.5)
    wait_for(lambda: "lt-error" not in status(page) and not status(page).count("> 0.0 s simulated"))
    assert moves(page) and not page._errors
    feet = page.session.snapshot.feet
    assert page._plots._gait.content.count("<svg") == len(feet) == len(page._plots._feet)


def test_error_of_a_part(page, monkeypatch, capsys):
    """It is shown in red until it is over; robots and commands are not concerned."""

    def fail():
        raise ValueError("a <b> of the plots")

    with monkeypatch.context() as patch:
        patch.setattr(page._plots, "update", fail)
        wait_for(lambda: "lt-error" in status(page))
        assert "plots: ValueError: a &lt;b&gt; of the plots" in status(page)
        page.session.set_command((0.25, 0.0, 0.0))
        assert moves(page)
        wait_for(lambda: page.session.command == (0.25, 0.0, 0.0))
        wait_for(lambda: control(page, "random").value is False)
    wait_for(lambda: "lt-error" not in status(page))
    assert capsys.readouterr().err.count("Traceback") == 1  # not with every picture


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


@pytest.mark.parametrize(("host", "is_open"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_what_is_printed(page, monkeypatch, capsys, host, is_open):
    """The address, with a token and a warning if other machines reach it."""
    monkeypatch.setattr(page.session, "run", lambda: None)
    watch(page.session, "title", host, 8470)
    printed = capsys.readouterr().out
    assert re.search(r"^See it walk: http://127\.0\.0\.1:\d+(/\?token=\w{32})? ", printed, re.MULTILINE)
    assert ("Warning: other machines reach this page" in printed) == ("?token=" in printed) == is_open


def test_gait():
    """Dark from the step where a foot lands to the one where it lifts off, now at the right; shares of the time."""
    contacts = np.zeros((100, 2))
    contacts[20:70, 0] = contacts[90:, 0] = 1.0
    text = gait_html(["FR", "FL"], contacts, 250, 5.0)
    assert 'd="M170 0V1H220V0zM240 0V1H250V0z"' in text and 'd=""' in text
    assert "60 %" in text and "0 %" in text and "last 5 s" in text


def test_foot_labels(make_task):
    """One per foot, also of feet with several geoms."""
    assert foot_labels(make_task("a1_torque", num_envs=1).asset) == ["FR", "FL", "RR", "RL"]
    assert foot_labels(make_task("g1_torque", num_envs=1).asset) == ["left", "right"]
    same = SimpleNamespace(foot_of=[0, 1, 1], foot_names=["foot_r", "foot_l", "foot_l2"])
    assert foot_labels(same) == ["foot_r", "foot_l"]


def test_joints_by_leg():
    """Legs follow from the robot's settings, whatever their number of joints; joints of no leg are "other" ones."""
    joints = ["R_hip", "R_knee", "waist", "L_hip", "L_knee", "L_ankle"]
    assert joints_by_leg(joints, [["R", "L"]]) == {"R": [0, 1], "other": [2], "L": [3, 4, 5]}
    assert joints_by_leg(joints[:2], []) == {"other": [0, 1]}
