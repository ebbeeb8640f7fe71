"""An exported policy in the formats of other programs: Unitree's deploy.yaml and NVIDIA's LEAPP."""

import logging
from pathlib import Path
from typing import Any

import numpy as np

from legged_torque.deploy.description import NETWORK_FILE, holds_gains, laws_of_motors, not_understood, read
from legged_torque.runtime.interface import JOINT_ORDER
from legged_torque.utils.errors import refuse, require
from legged_torque.utils.plain_yaml import dump_yaml

UNITREE = {"angular_velocity": "base_ang_vel", "projected_gravity": "projected_gravity", "command": "velocity_commands"}
UNITREE |= {"joint_position": "joint_pos_rel", "joint_velocity": "joint_vel_rel", "last_action": "last_action"}
"""The observations that both formats have, with Unitree's names."""


def _read(folder: Path, known_actions: set[str]) -> tuple[dict[str, Any], list[str]]:
    """Return the description of an export, and what of it neither format has."""
    description, _ = read(folder)
    problems = [*description.get("unsupported", []), *not_understood(description, UNITREE, known_actions)]
    motors = description.get("motors", {}).items()
    problems += [f"the gains of the motors' {name}" for name, motor in motors if motor.get("model") == "drive"]
    problems += laws_of_motors(description) + (["control.refresh_torques: false"] if holds_gains(description) else [])
    return description, problems


def write_deploy_yaml(folder: Path) -> None:
    """Add ``params/deploy.yaml`` and ``exported/policy.onnx`` to an export, for Unitree's C++ (unitree_rl_lab).

    That clips observations before it scales them, commands to their ranges alone, and runs networks of one robot. A
    UserError lists what it lacks.
    """
    import onnx

    description, problems = _read(folder, {"position_residual"})
    joints, action = description["joint_order"], description["actions"]["terms"][0]
    limits, pose = np.array(description["actions"]["clip"]), [description["nominal_pose"][joint] for joint in joints]
    named = {"lin_vel_x": "lin_vel_x", "lin_vel_y": "lin_vel_y", "ang_vel_z": "ang_vel_yaw"}
    ranges = {theirs: description["commands"][ours] for theirs, ours in named.items()}
    observations = {}
    for term in description["observations"]["terms"]:
        name, scale, clip = term["name"], np.broadcast_to(term["scale"], term["size"]), np.array(term["clip"])
        reached = scale * np.transpose(list(ranges.values())) if name == "command" else clip
        is_same = (np.clip(reached, *clip) == reached).all() and (name == "command" or (scale == scale[0]).all())
        problems += [] if is_same else [f"the limits of {name}"]
        before = np.clip(clip / scale[0], *limits) if name == "last_action" else clip / scale[0]  # not clipped there
        entry = {"clip": None if name == "command" else before.tolist(), "scale": scale.tolist(), "history_length": 1}
        observations[UNITREE.get(name)] = {"params": {}, **entry}
    problems += [f"the joint {joint}" for joint in sorted({*joints} ^ {*JOINT_ORDER})]
    problems += [f"a weight of {action['mixing_weight']:g}"] if action["mixing_weight"] != 1.0 else []
    refuse(problems, "deploy.yaml has no place for")
    position = {"clip": [(limits * action["scale"] + angle).tolist() for angle in pose], "joint_names": [".*"]}
    content = {
        "joint_ids_map": [JOINT_ORDER.index(joint) for joint in joints],
        "step_dt": 1.0 / description["timing"]["control_frequency"],
        **{gain: [values[joint] for joint in JOINT_ORDER] for gain, values in description["gains"].items()},
        "default_joint_pos": pose,
        "commands": {"base_velocity": {"ranges": ranges}},
        "actions": {"JointPositionAction": position | {"scale": [action["scale"]] * len(joints), "offset": pose}},
        "observations": observations,
    }
    model = onnx.load(folder / NETWORK_FILE)
    for end in (*model.graph.input, *model.graph.output):
        end.type.tensor_type.shape.dim[0].dim_value = 1
    for name in ("exported", "params"):
        (folder / name).mkdir()
    onnx.save(model, folder / "exported" / NETWORK_FILE)
    text = dump_yaml(content, width=120, default_flow_style=None)
    (folder / "params" / "deploy.yaml").write_text(text, encoding="utf-8")


def write_leapp(folder: Path) -> None:
    """Add ``leapp/`` to an export: a graph from measurements to targets of joints, which NVIDIA's ``leapp`` reads.

    Orientations are (x, y, z, w), as in Isaac Lab. A UserError lists what the format lacks.
    """
    require("leapp", extra="leapp")
    import torch
    from leapp import GraphConfigs, TensorSemantics, annotate, compile_graph, start, stop
    from leapp import InputKindEnum as Given
    from leapp import OutputKindEnum as Wanted

    description, problems = _read(folder, {"position_residual", "torque"})
    refuse(problems, "leapp.yaml has no place for")
    joints, actions, terms = description["joint_order"], description["actions"], description["observations"]["terms"]
    by_joint = (description["nominal_pose"], *description["gains"].values())
    pose, *gains = (torch.tensor([[values[joint] for joint in joints]]) for values in by_joint)
    given = {
        "angular_velocity": ("root_ang_vel_b", torch.zeros(1, 3), Given.BODY_ANGULAR_VELOCITY, ["x", "y", "z"]),
        "quaternion": ("root_quat_w", torch.eye(4)[3:], Given.BODY_ROTATION, ["qx", "qy", "qz", "qw"]),
        "command": ("base_velocity", torch.zeros(1, 3), Given.COMMAND_BODY_VELOCITY, ["lin_x", "lin_y", "ang_z"]),
        "joint_position": ("joint_pos", pose.clone(), Given.JOINT_POSITION, joints),
        "joint_velocity": ("joint_vel", 0.0 * pose, Given.JOINT_VELOCITY, joints),
    }
    logging.disable()  # it would name a temporary folder
    start("leapp", save_path=str(folder))
    inputs = annotate.input_tensors("policy", [TensorSemantics(*each) for each in given.values()])
    network = torch.jit.load(str(folder / description["network"]["torchscript"]))
    before = {"last_action": torch.zeros(1, description["network"]["num_actions"])}
    values = dict(zip(given, inputs, strict=True)) | {"last_action": annotate.state_tensors("policy", before)}
    x, y, z, w = (values["quaternion"][:, i : i + 1] for i in range(4))
    values["projected_gravity"] = torch.cat([2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1], dim=1)
    values["joint_position"] = values["joint_position"] - pose
    parts = [(values[term["name"]] * torch.tensor(term["scale"])).clamp(*term["clip"]) for term in terms]
    acted = network(torch.cat(parts, dim=1)).clamp(*actions["clip"])
    annotate.update_state("policy", {"last_action": acted})
    wanted, constant = [], []
    for term, part in zip(actions["terms"], acted.split(len(joints), dim=1), strict=True):
        scaled, weight = term["scale"] * part, term["mixing_weight"]
        if term["name"] == "torque":
            wanted.append(("joint_torques", weight * scaled, Wanted.JOINT_TORQUES))
        else:
            wanted.append(("joint_pos_target", pose + scaled, Wanted.JOINT_POSITION))
            by_kind = zip((Wanted.KP, Wanted.KD), gains, strict=True)
            constant = [(kind.value, weight * gain, kind) for kind, gain in by_kind]
    outputs, constants = ([TensorSemantics(*each, joints) for each in part] for part in (wanted, constant))
    annotate.output_tensors("policy", outputs, static_outputs=constants or None, export_with="onnx-torchscript")
    stop()
    compile_graph(visualize=False, graph_configs=GraphConfigs(frequency=description["timing"]["control_frequency"]))
    logging.disable(logging.NOTSET)
    (folder / "leapp" / "log.txt").unlink()


WRITERS = {"deploy_yaml": write_deploy_yaml, "leapp": write_leapp}  # by the names of the formats
