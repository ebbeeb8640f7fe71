"""Files of an export that are damaged, changed or do not belong together are refused in one line."""

import copy
import dataclasses
import hashlib
import shutil
from pathlib import Path

import pytest
import yaml
from support.exports import change
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.deploy.policy import Policy
from legged_torque.envs import LeggedRobotCfg
from legged_torque.terrain.layout import Layout

GROUND = dataclasses.asdict(Layout.of(LeggedRobotCfg.terrain()))
ENDLESS = {"control_frequency": 1e-6, "physics_frequency": 100.0, "decimation": 10**8, "refresh_torques": True}
DAMAGE = [
    *yaml.safe_load(Path(__file__).with_name("damage.yaml").read_text("utf-8"))["damage"],
    ("commands.lin_vel_x", [0, 10**300], "commands.lin_vel_x.1"),
    ("commands.lin_vel_x", [0, 10**400], "larger than settings are"),
    ("timing", ENDLESS, "timing.decimation"),
    ("terrain", GROUND | {"difficulty_range": [0.0, 1.5]}, "terrain.difficulty_range.1"),
]


@pytest.mark.parametrize(("path", "value", "message"), DAMAGE)
def test_damaged_descriptions(exported, description, tmp_path, path, value, message):
    """A description that does not fit itself or its network is refused in one line that names the entry."""
    folder, damaged = shutil.copytree(exported, tmp_path / "copy"), copy.deepcopy(description)
    change(path, value)(damaged)
    (folder / "policy.yaml").write_text(yaml.safe_dump(damaged, sort_keys=False))
    assert message in error_of(Policy, folder)


def test_network_without_meaning(exported, description, tmp_path):
    """A network that does not say what its inputs and outputs mean is refused, even with its own checksum."""
    onnx = pytest.importorskip("onnx")
    folder = shutil.copytree(exported, tmp_path / "out")
    network = onnx.load(folder / "policy.onnx")
    assert {entry.key for entry in network.metadata_props} == {"joint_order", "nominal_pose", "observations", "actions"}
    del network.metadata_props[:]
    onnx.save(network, folder / "policy.onnx")
    description = copy.deepcopy(description)
    description["network"]["sha256"] = hashlib.sha256((folder / "policy.onnx").read_bytes()).hexdigest()
    (folder / "policy.yaml").write_text(yaml.safe_dump(description))
    assert "was exported with other joint_order than those of its policy.yaml" in error_of(Policy, folder)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("policy.onnx", b"network", "policy.onnx' is not a readable network"),
        ("policy.onnx", None, "there is no network"),
        ("policy.yaml", None, "there is no policy.yaml in"),
        ("policy.yaml", b"\xff\xfe", "is not valid YAML"),
        ("policy.yaml", b"3", "is not of type 'object'"),
    ],
)
def test_damaged_files(exported, tmp_path, name, content, message):
    """A policy that is not whole is refused in one line."""
    folder = shutil.copytree(exported, tmp_path / "copy")
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    result = run_here("sim2sim.py", str(folder), "--steps=5", root=tmp_path)
    assert_told_in_one_line(result, message)
    assert result[1] == ""
