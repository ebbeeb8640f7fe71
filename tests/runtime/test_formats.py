"""Formats of other programs: read back as those read them, they do what the export does."""

import numpy as np
import pytest
import yaml
from support.exports import TRAINING, export_random
from support.settings import error_of

from legged_torque.deploy.export import export_policy
from legged_torque.deploy.policy import Policy, State
from legged_torque.runtime.formats import write_deploy_yaml, write_leapp

SDK_ORDER = [f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")]


def export(make_task, name, folder, add, **changes):
    """Export a random policy with another format."""
    task, model = export_random(make_task, name, folder / "plain", True, **changes)
    export_policy(task, model, folder / "out", name, TRAINING, add)
    return Policy(folder / "out")


def random_steps(policy):
    """Random measurements, a command, and torques, positions and gains for the drives, of the policy's joints."""
    rng = np.random.default_rng(5)
    for _ in range(8):
        quaternion = rng.normal(size=4)
        state = State(3 * rng.normal(size=3), rng.normal(size=12), 9 * rng.normal(size=12), None, quaternion)
        state.quaternion /= np.linalg.norm(quaternion)
        command = rng.uniform(-0.9, 0.9, 3)
        yield state, command, policy.drive_targets(policy.act(policy.observation(state, command)))


@pytest.mark.parametrize("limits", [{}, {"normalization.clip_actions": 0.2, "normalization.clip_observations": 2.5}])
def test_deploy_yaml(make_task, tmp_path, limits):
    """Done by hand as in unitree_rl_lab's C++, the same positions and gains for each motor, also where it clips."""
    gains = {"control.stiffness": {"hip": 20.0, "thigh": 25.0, "calf": 30.0}}
    policy = export(make_task, "go2_position", tmp_path, write_deploy_yaml, **gains, **limits)
    cfg = yaml.safe_load((tmp_path / "out" / "params" / "deploy.yaml").read_text())
    network = pytest.importorskip("onnxruntime").InferenceSession(tmp_path / "out" / "exported" / "policy.onnx")
    assert network.get_inputs()[0].shape == [1, 45] and cfg["step_dt"] == pytest.approx(0.02)
    order, ids, last = [policy.joint_order.index(name) for name in SDK_ORDER], cfg["joint_ids_map"], np.zeros(12)
    ranges, action = cfg["commands"]["base_velocity"]["ranges"], cfg["actions"]["JointPositionAction"]
    for state, command, (_, position, kp, kd) in random_steps(policy):
        q, dq = state.joint_positions[order], state.joint_velocities[order]  # as the motors say them
        values = {"base_ang_vel": state.angular_velocity, "projected_gravity": state.gravity(), "last_action": last}
        values["velocity_commands"] = np.clip(command, *np.transpose(list(ranges.values())))
        values |= {"joint_pos_rel": q[ids] - cfg["default_joint_pos"], "joint_vel_rel": dq[ids]}
        obs = []
        for name, term in cfg["observations"].items():
            clipped = values[name] if term["clip"] is None else np.clip(values[name], *term["clip"])
            obs += list(clipped * term["scale"])
        last = network.run(["actions"], {"obs": np.array([obs], np.float32)})[0][0]
        targets = np.zeros(12)
        targets[ids] = np.clip(last * action["scale"] + action["offset"], *np.transpose(action["clip"]))
        told = np.array([targets, cfg["stiffness"], cfg["damping"]])
        np.testing.assert_allclose(told, np.array([position, kp, kd])[:, order], rtol=1e-5, atol=1e-5)


def test_an_earlier_policy(make_task, tmp_path):
    """It is replaced in all formats, also in those that are not asked for any more; files of others stay."""
    for add in (write_deploy_yaml, write_leapp, None):
        export(make_task, "go2_position", tmp_path, add)
    assert {path.name for path in (tmp_path / "out").rglob("*.*")} == {"policy.onnx", "policy.pt", "policy.yaml"}
    assert not [*(tmp_path / "out").glob("*/*")]
    (tmp_path / "out" / "exported" / "policy.onnx").touch()
    export(make_task, "go2_position", tmp_path, None)
    assert (tmp_path / "out" / "exported" / "policy.onnx").exists()
    (tmp_path / "out" / "policy.yaml").unlink()
    (tmp_path / "out" / "params" / "deploy.yaml").touch()
    export(make_task, "go2_position", tmp_path, None)
    assert (tmp_path / "out" / "params" / "deploy.yaml").exists()


@pytest.mark.parametrize("name", ["go2_position", "go2_torque", "a1_multihead"])
def test_leapp(make_task, tmp_path, name):
    """NVIDIA's reader makes the same targets, torques and gains, from step to step, and knows what they are."""
    leapp, torch = pytest.importorskip("leapp", reason="needs the extra 'leapp'"), pytest.importorskip("torch")
    policy = export(make_task, name, tmp_path, write_leapp, **{"normalization.clip_actions": 0.2})
    reader = leapp.InferenceManager(str(tmp_path / "out" / "leapp" / "leapp.yaml"))
    inputs = ["root_ang_vel_b", "root_quat_w", "base_velocity", "joint_pos", "joint_vel"]
    assert reader.inputs == [f"policy/{each}" for each in inputs]
    assert reader.models["policy"]["inputs"][3]["element_names"] == [policy.joint_order]
    for state, command, (tau, position, kp, kd) in random_steps(policy):
        quaternion = np.roll(state.quaternion, -1)
        given = (state.angular_velocity, quaternion, command, state.joint_positions, state.joint_velocities)
        rows = [torch.tensor(part, dtype=torch.float32)[None] for part in given]
        result = reader(dict(zip(reader.inputs, rows, strict=True)))
        expected = {} if name == "go2_position" else {"joint_torques": tau}
        expected |= {} if name == "go2_torque" else {"joint_pos_target": position, "kp": kp, "kd": kd}
        assert set(result) == {f"policy/{each}" for each in expected}
        for each, values in expected.items():
            np.testing.assert_allclose(result[f"policy/{each}"][0], values, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "add", "changes", "said"),
    [
        ("go2_torque", write_deploy_yaml, {"env.history_length": 3}, "the actions torque; a history of observations"),
        ("go2_position", write_deploy_yaml, {"normalization.clip_observations": 1.5}, "the limits of command"),
        ("g1_position", write_deploy_yaml, {}, "the joint FL_calf_joint"),
        ("a1_multihead", write_leapp, {"control.refresh_torques": False}, "control.refresh_torques: false"),
        ("go2_torque", write_leapp, {"motors.chain": ["delay", "drive", "ideal"]}, "the gains of the motors' drive"),
        ("a1_sata", write_leapp, {}, "the law of the motors' muscle"),
        ("a1_multihead_two_rates", write_leapp, {}, "position_phase; an interval of position_residual"),
    ],
)
def test_what_a_format_lacks(make_task, tmp_path, name, add, changes, said):
    """It is listed, and nothing is written."""
    assert said in error_of(export, make_task, name, tmp_path, add, **changes)
    assert [path.name for path in tmp_path.iterdir()] == ["plain"]
