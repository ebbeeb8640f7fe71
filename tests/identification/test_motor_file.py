"""``--motors FILE``: what cannot be in it."""

import pytest
from support.settings import BusCfg, error_of

from legged_torque.envs import task_registry
from legged_torque.envs.base.asset import load_asset
from legged_torque.utils.options import Options, simulated_latency

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


@pytest.mark.parametrize(
    ("delay", "late"),
    [
        ("{unit: milliseconds, range: [15, 15]}", 0.015),
        ("{range: [3, 3]}", 0.015),
        ("{unit: control_steps, range: [1, 1]}", 0.02),
        ("{range: [0, 0]}", 0.0),
    ],
)
def test_delay_of_a_simulated_robot(tmp_path, delay, late):
    """It is that of the file, in any unit, unless another one is given; without a file, there is none."""
    (tmp_path / "own.yaml").write_text(f"motors: {{delay: {delay}}}")
    for motors, given, expected in (("own.yaml", None, late), ("own.yaml", 7.0, 0.007), ("real", None, 0.0)):
        cfg = task_registry.get_cfgs("go2_torque")[0]
        name = str(tmp_path / motors) if "." in motors else motors
        assert simulated_latency(cfg, name, given) == pytest.approx(expected)


def test_delay_of_another_name(tmp_path):
    """That of the chain counts."""
    (tmp_path / "own.yaml").write_text("motors: {delay: {range: [0, 4]}, bus: {range: [3, 3]}}")
    assert simulated_latency(BusCfg(), str(tmp_path / "own.yaml"), None) == pytest.approx(0.015)
    (tmp_path / "own.yaml").write_text("motors: {bus: {range: [0, 4]}}")
    assert "motors.bus of" in error_of(simulated_latency, BusCfg(), str(tmp_path / "own.yaml"), None)


def test_delay_that_varies(tmp_path):
    """A simulated robot has one: it must be chosen."""
    (tmp_path / "own.yaml").write_text("motors: {delay: {range: [0, 4]}}")
    cfg = task_registry.get_cfgs("go2_torque")[0]
    assert "--latency gives one time" in error_of(simulated_latency, cfg, str(tmp_path / "own.yaml"), None)


def test_other_robot(tmp_path):
    """Joints that the robot does not have, and links that the task does not have, also for simulated robots."""
    cfg = task_registry.get_cfgs("go2_torque")[0]
    (tmp_path / "own.yaml").write_text("motors: {chain: [delay, idael]}")
    assert simulated_latency(cfg, str(tmp_path / "own.yaml"), None) == 0.0
    assert "unknown motors.chain 'idael'; did you mean 'ideal'?" in error_of(cfg.motors.describe)
    cfg.motors.joints.armature = {"knee": 0.1, "joint": 0.1}
    assert "unknown joint" in error_of(load_asset, cfg)
