"""MuJoCo's own window, and messages where it or the page cannot be shown."""

from unittest.mock import MagicMock

import mujoco
import pytest
from support.sessions import new_session

from legged_torque.viewer import native
from legged_torque.viewer.drawing import Drawing


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session of torque control."""
    return new_session(tmp_path_factory.mktemp("run"), "a1_torque")


def test_keys(session):
    """They change commands within the limits of the training, push, pause and reset."""
    session.set_command(None)
    keyboard = native.Keyboard(session)
    for key, count in ((265, 3), (264, 1), (44, 15), (46, 1), (263, 2), (262, 3)):
        for _ in range(count):
            keyboard.press(key)
    session.tick()
    assert session.command == pytest.approx((0.2, 0.9, -0.1))
    for key in "0PA":  # A means nothing
        keyboard.press(ord(key))
    session.tick()
    assert session.command == (0.0, 0.0, 0.0) and "pushed" in session.message.text
    keyboard.press(ord(" "))
    keyboard.press(ord("R"))
    session.tick()
    assert session.is_paused and session.message.text == "reset"
    keyboard.press(ord(" "))
    session.tick()
    assert not session.is_paused


def test_command_of_the_command_line(session):
    """It holds until keys change it, one component each, also beyond the limits of the training."""
    session.set_command((3.0, 0.0, 0.25))
    keyboard = native.Keyboard(session)
    for key, command in ((0, (3.0, 0.0, 0.25)), (265, (3.0, 0.0, 0.25)), (263, (3.0, 0.0, 0.35))):
        keyboard.press(key)
        session.tick()
        assert session.snapshot.commands[0].tolist() == pytest.approx(command)


def test_what_is_drawn(session):
    """The state of the first world, its commanded velocity as an arrow, and both velocities as numbers."""
    drawing = Drawing.of_task(session.task)
    window = MagicMock(opt=mujoco.MjvOption(), user_scn=mujoco.MjvScene(drawing.model, 10))
    session.set_command((0.5, 0.0, 0.0))
    session.tick()
    native.draw(session, window, drawing)
    assert drawing.data.qpos.tolist() == session.snapshot.qpos[0].tolist()
    assert window.user_scn.geoms[0].type == mujoco.mjtGeom.mjGEOM_ARROW
    ((_, _, _, numbers),) = window.set_texts.call_args.args
    assert numbers.split("\n")[1].startswith("+0.50 ")
