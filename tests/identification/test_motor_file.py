"""``--motors FILE``: settings of motors from a file reach every simulation, and nothing else can be in it."""

import numpy as np
import pytest
from support.settings import error_of

from legged_torque import resource_path
from legged_torque.envs import task_registry
from legged_torque.envs.base.asset import load_asset
from legged_torque.runtime.sim_robot import SimRobot
from legged_torque.utils.options import Options

FIELDS = ("armature", "damping", "frictionloss")
TEXT = """
motors:
  joints:
    armature: {hip: 0.011, thigh: 0.012, FR_calf: 0.013, calf: 0.014}
    damping: 0.1
    frictionloss: {FR_hip: 0.3, joint: 0.4}
  delay: {unit: milliseconds, range: [5, 5]}
domain_rand: {keep_fixed: [dof_armature], joint_offset: {add: [-0.02, 0.02]}}
"""


def settings(tmp_path, text):
    """Settings of a Go2 with the motors of a file."""
    (tmp_path / "own.yaml").write_text(text)
    return task_registry.get_cfgs("go2_torque", Options(device="cpu", motors=str(tmp_path / "own.yaml")))[0]


def test_file(tmp_path):
    """Joints have the file's numbers in training and in the simulated robot; the delay and what is drawn follow."""
    cfg = settings(tmp_path, TEXT)
    names = list(cfg.init_state.default_joint_angles)
    expected = np.array([[0.011, 0.012, 0.014] * 4, [0.1] * 12, [0.4] * 12])
    expected[0, 2], expected[2, 0] = 0.013, 0.3
    for model in (
        load_asset(cfg).mj_model,
        SimRobot(resource_path(cfg.asset.file), names, 500.0, motors=cfg.motors).model,
    ):
        dofs = [model.joint(name).dofadr[0] for name in names]
        np.testing.assert_array_equal([getattr(model, f"dof_{field}")[dofs] for field in FIELDS], expected)
    delay = cfg.motors.delay
    assert (delay.unit, delay.range, cfg.domain_rand.keep_fixed) == ("milliseconds", [5, 5], ["dof_armature"])
    assert cfg.domain_rand.joint_offset == {"add": [-0.02, 0.02]} and cfg.motors.chain == ["delay", "ideal"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("rewards: {alive: 1.0}", "unknown section of"),
        ("motors: {joints: {armatur: 0.1}}", "did you mean 'motors.joints.armature'"),
        ("motors: {joints: {damping: -0.1}}", "motors.joints.damping must be"),
        ("motors: {ideal: {_motor_class: 'os:system'}}", "unknown config key 'motors.ideal._motor_class'"),
        ("domain_rand: {init_yaw: far}", "domain_rand.init_yaw"),
        ("- 1", "must hold the sections motors and domain_rand"),
        ("motors: {", "not valid YAML"),
    ],
)
def test_refused(tmp_path, text, words):
    """Anything but known settings, and values that are not allowed."""
    assert words in error_of(settings, tmp_path, text)


def test_missing_file():
    """A file that is not there, and a joint that is not on the robot."""
    options = Options(device="cpu", motors="nowhere.yaml")
    assert "nowhere.yaml" in error_of(task_registry.get_cfgs, "go2_torque", options)
    cfg = task_registry.get_cfgs("go2_torque")[0]
    cfg.motors.joints.armature = {"knee": 0.1, "joint": 0.1}
    assert "unknown joint" in error_of(load_asset, cfg)
