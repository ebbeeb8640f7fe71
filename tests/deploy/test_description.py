"""Files of an export that are damaged, changed or do not belong together are refused in one line."""

import copy
import hashlib
import shutil

import pytest
import yaml
from support.exports import change, export_random
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.deploy.description import check
from legged_torque.deploy.policy import Policy

DAMAGE = [
    ("format_version", 2, "format_version"),
    ("task", None, "'task' is a required property"),
    ("gain", {}, "'gain' was unexpected"),
    ("nominal_pose.FR_knee_joint", 0.1, "unknown joint in nominal_pose of policy.yaml 'FR_knee_joint'"),
    ("nominal_pose.FR_hip_joint", None, "nominal_pose lacks the joint 'FR_hip_joint'"),
    ("nominal_pose.FR_hip_joint", "left", "nominal_pose.FR_hip_joint: 'left' is not of type 'number'"),
    ("nominal_pose.FR_hip_joint", float("nan"), "nominal_pose.FR_hip_joint is not a finite number"),
    ("joint_order.0", "FR_thigh_joint", "non-unique"),
    ("joint_order.0", "FR_knee_joint", "did you mean"),
    ("gains.stiffness.FR_hip_joint", -1.0, "less than the minimum"),
    ("gains.damping.FR_hip_joint", None, "gains.damping lacks the joint 'FR_hip_joint'"),
    ("torque_limits.FR_hip_joint", [33.5], "torque_limits.FR_hip_joint"),
    ("torque_limits.FR_hip_joint", [33.5, -33.5], "must be [lowest, highest]"),
    ("observations.terms.3.size", 11, "the term 'joint_position' must have size 12, not 11"),
    ("observations.terms.2.scale", [2.0, 2.0], "the term 'command' must have one scale or 3, not 2"),
    ("observations.terms.2.name", 3, "observations.terms.2.name"),
    ("joints", None, "'joints' is a required property"),
    ("pushes.set_factor", -1.0, "pushes.set_factor: -1.0 is less than the minimum of 0"),
    ("observations.terms.4", None, "network.num_observations is 57, but the terms have 45 numbers"),
    ("observations.history_length", 2, "network.num_observations is 57, but the terms have 114 numbers"),
    ("actions.terms.1", None, "the term 'last_action' must have size 12, not 24"),
    ("actions.terms.1.name", "position_residual", "the term 'position_residual' occurs more than once"),
    ("actions.clip", [1.0, -1.0], "actions.clip must be [lowest, highest]"),
    ("timing.decimation", 0, "timing.decimation"),
    ("timing.decimation", 4.0, "timing.decimation: 4.0 is not of type 'integer'"),
    ("timing.decimation", 5, "timing.physics_frequency is not control_frequency times decimation"),
    ("timing.refresh_torques", "often", "timing.refresh_torques"),
    ("commands.resampling_probability", 1.5, "commands.resampling_probability"),
]


@pytest.mark.parametrize(("path", "value", "message"), DAMAGE)
def test_damaged_descriptions(description, path, value, message):
    """A description that does not fit is refused in one line that names the entry."""
    damaged = copy.deepcopy(description)
    change(path, value)(damaged)
    assert message in error_of(check, damaged)


@pytest.mark.parametrize("text", ["task: [", "walk", "", "3"])
def test_no_description(exported, tmp_path, text):
    """A file that holds something else is refused."""
    folder = shutil.copytree(exported, tmp_path / "copy")
    (folder / "policy.yaml").write_text(text)
    assert "policy.yaml'" in error_of(Policy, folder)


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


def damage_onnx(folder):
    """Half of the network."""
    content = (folder / "policy.onnx").read_bytes()
    (folder / "policy.onnx").write_bytes(content[: len(content) // 2])


def edit_yaml(old, new):
    """A change of the description's text."""

    def edit(folder):
        text = (folder / "policy.yaml").read_text()
        assert old in text
        (folder / "policy.yaml").write_text(text.replace(old, new, 1))

    return edit


def longer_history(folder):
    """A description that is valid in itself, of another network."""
    description = yaml.safe_load((folder / "policy.yaml").read_text())
    description["observations"]["history_length"] = 2
    description["network"]["num_observations"] *= 2
    (folder / "policy.yaml").write_text(yaml.safe_dump(description))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (damage_onnx, "policy.onnx' is not a readable network"),
        (lambda folder: (folder / "policy.onnx").write_bytes(b""), "policy.onnx' is not a readable network"),
        (lambda folder: (folder / "policy.onnx").unlink(), "there is no network"),
        (lambda folder: (folder / "policy.yaml").unlink(), "there is no policy.yaml in"),
        (lambda folder: (folder / "policy.yaml").write_bytes(b"\xff\xfe"), "is not valid YAML"),
        (edit_yaml("decimation: 4", "decimation: four"), "timing.decimation: 'four' is not of type 'integer'"),
        (edit_yaml("FR_hip_joint: 20.0", "FR_hip_joint: -20.0"), "gains.stiffness.FR_hip_joint"),
        (edit_yaml("sha256: ", "sha256: 0"), "network.sha256"),
        (longer_history, "has the input and output [('obs', [57]), ('actions', [24])], not [('obs', [114])"),
    ],
)
def test_damaged_files(exported, tmp_path, damage, message):
    """A policy that is not whole is refused in one line."""
    folder = shutil.copytree(exported, tmp_path / "copy")
    damage(folder)
    result = run_here("sim2sim.py", str(folder), "--steps=5", root=tmp_path)
    assert_told_in_one_line(result, message)
    assert result[1] == ""


def test_another_network(exported, tmp_path, make_task):
    """A network of the right size that is not the exported one is refused."""
    export_random(make_task, "a1_multihead", tmp_path / "other", True)
    shutil.copy(exported / "policy.onnx", tmp_path / "other")
    assert "is not the network that was exported" in error_of(Policy, tmp_path / "other")
