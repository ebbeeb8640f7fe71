"""``--motors FILE``: what cannot be in it."""

import pytest
from support.settings import error_of

from legged_torque.envs import task_registry
from legged_torque.envs.base.asset import load_asset
from legged_torque.utils.options import Options

REFUSED = {
    "rewards: {alive: 1.0}": "unknown section of",
    "motors: {joints: {armatur: 0.1}}": "did you mean 'motors.joints.armature'",
    "motors: {joints: {damping: -0.1}}": "motors.joints.damping must be",
    "motors: {ideal: {_motor_class: 'os:system'}}": "unknown config key 'motors.ideal._motor_class'",
    "domain_rand: {init_yaw: far}": "domain_rand.init_yaw",
    "- 1": "must hold the sections motors and domain_rand",
    "motors: {": "not valid YAML",
}


@pytest.mark.parametrize("text", REFUSED)
def test_refused(tmp_path, text):
    """Anything but known settings, values that are not allowed, a file that is not there."""
    options = Options(device="cpu", motors=str(tmp_path / "own.yaml"))
    assert "own.yaml" in error_of(task_registry.get_cfgs, "go2_torque", options)
    (tmp_path / "own.yaml").write_text(text)
    assert REFUSED[text] in error_of(task_registry.get_cfgs, "go2_torque", options)


def test_other_robot():
    """Joints that the robot does not have."""
    cfg = task_registry.get_cfgs("go2_torque")[0]
    cfg.motors.joints.armature = {"knee": 0.1, "joint": 0.1}
    assert "unknown joint" in error_of(load_asset, cfg)
