"""Files of an export that are damaged, changed or do not belong together are refused in one line."""

import copy
import dataclasses
import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.exports import change
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.deploy.description import check, write_description
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.simulation import evaluate
from legged_torque.envs import LeggedRobotCfg
from legged_torque.terrain.layout import Layout
from legged_torque.utils import devices

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


def test_descriptions_of_older_exports(description):
    """Those of d8439d6 lack the list of what is unsupported."""
    older = copy.deepcopy(description)
    del older["unsupported"]
    check(older)


def test_notes_of_strangers(exported, description, tmp_path, monkeypatch):
    """Names in what publish.py notes do not change a terminal."""
    folder, changed = shutil.copytree(exported, tmp_path / "copy"), copy.deepcopy(description)
    changed["episode"]["ends_on_contact_of"] = ["\x1b[31m"]
    write_description(folder, changed)
    monkeypatch.setattr(devices, "choose_offscreen_renderer", lambda: "no video, it takes long")
    shorter = lambda walks, *_: evaluate(walks, 1, 2, 1)  # noqa: E731 - 2 steps, not 8000
    monkeypatch.setattr("legged_torque.deploy.simulation.evaluate", shorter)
    status, output, _ = run_here("publish.py", str(folder), root=tmp_path)
    assert status == 0 and "note: no geom's name contains \\x1b[31m" in output
    changed["robot"]["file"] = "/home/me/a1.xml"
    write_description(folder, changed)
    refused = run_here("publish.py", str(folder), "--out=other", root=tmp_path)
    assert_told_in_one_line(refused, "'/home/me/a1.xml' is a path of this machine: export anew with --set asset.file=")


def test_one_file_is_enough(exported, description, tmp_path):
    """A network holds all of policy.yaml, under any name: the same actions, and sim2sim.py runs."""
    file = shutil.copy(exported / "policy.onnx", tmp_path / "walk.onnx")
    alone, both = Policy(file), Policy(exported)
    assert alone.description == both.description == description
    obs = np.random.default_rng(0).normal(size=57)
    assert alone.act(obs).tobytes() == both.act(obs).tobytes()
    status, output, _ = run_here("sim2sim.py", str(file), "--steps=2", "--robots=1", root=tmp_path)
    assert status == 0 and "  speed " in output and "+-" not in output  # of one robot


@pytest.mark.parametrize("kept", [(), ("joint_order", "nominal_pose", "observations", "actions")])
def test_networks_that_do_not_describe_themselves(exported, description, tmp_path, kept):
    """Those of older exports need policy.yaml; without any meaning of inputs and outputs, a network is refused."""
    onnx = pytest.importorskip("onnx")
    folder = shutil.copytree(exported, tmp_path / "out")
    network = onnx.load(folder / "policy.onnx")
    meaning = {entry.key: entry.value for entry in network.metadata_props}
    assert meaning.keys() == description.keys()
    onnx.helper.set_model_props(network, {key: meaning[key] for key in kept})
    onnx.save(network, folder / "policy.onnx")
    description = copy.deepcopy(description)
    description["network"]["sha256"] = hashlib.sha256((folder / "policy.onnx").read_bytes()).hexdigest()
    description["gains"]["stiffness"]["FR_hip_joint"] = 25.0
    (folder / "policy.yaml").write_text(yaml.safe_dump(description))
    if kept:
        assert Policy(folder).stiffness[0] == 25.0
    else:
        assert "another policy.yaml, which was changed in: " in error_of(Policy, folder)
    (folder / "policy.yaml").unlink()
    assert "policy.onnx' does not describe itself" in error_of(Policy, folder)


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [("network", "3", "not describe itself"), ("gains", "{", "gains in"), ("timing", "{}", "'control_frequency'")],
)
def test_damaged_metadata(exported, tmp_path, key, text, message):
    """What a network says of itself is checked as policy.yaml is."""
    onnx = pytest.importorskip("onnx")
    network = onnx.load(exported / "policy.onnx")
    next(entry for entry in network.metadata_props if entry.key == key).value = text
    onnx.save(network, tmp_path / "walk.onnx")
    assert message in error_of(Policy, tmp_path / "walk.onnx")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("policy.onnx", b"network", "policy.onnx' is not a readable network"),
        ("policy.onnx", None, "there is no network"),
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
