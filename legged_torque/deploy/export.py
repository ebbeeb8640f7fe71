"""Export of a checkpoint for a robot: ``policy.onnx``, ``policy.pt`` and ``policy.yaml``."""

import dataclasses
import os
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor

from legged_torque import RESOURCES_DIR
from legged_torque.deploy.description import DESCRIPTION_FILE, FORMAT_VERSION, NETWORK_FILE, columns, write_description
from legged_torque.deploy.policy import (
    OBSERVATIONS,
    Policy,
    State,
    empty_memory,
    load_network,
    parts_without_function,
    run_network,
)
from legged_torque.envs.base.commands import HEADING_GAIN, UniformCommands
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.motors.config import PerturbationCfg
from legged_torque.motors.delay import ActionDelay
from legged_torque.motors.models import ModelMotor
from legged_torque.motors.motor import Motor
from legged_torque.motors.twin import MotorTwin
from legged_torque.sensors.height_scan import CLIP, OFFSET
from legged_torque.terrain.layout import Layout
from legged_torque.terrain.rough import RoughGround
from legged_torque.utils.errors import UserError, refuse, require
from legged_torque.utils.files import write_errors
from legged_torque.utils.runs import package_versions

TORCHSCRIPT_FILE = "policy.pt"
NUM_SUBSTEPS = 3  # physics steps in which motors that remember are compared
NUM_SAMPLES = 256  # random observations on which the exported networks are compared, one after another with a memory
INITIAL_STATE = {
    "trunk_place": "init_place",
    **{angle: f"init_{angle}" for angle in ("roll", "pitch", "yaw")},
    "joint_position_scale": "init_dof_pos_scale",
    "trunk_linear_velocity": "init_lin_vel",
    "trunk_angular_velocity": "init_ang_vel",
    "joint_velocity": "init_dof_vel",
}
"""The setting in ``domain_rand`` of each entry of ``initial_state``."""
TOLERANCE = 1e-5  # largest difference between an exported number and the task's; relative for numbers larger than 1
SCAN_TOLERANCE = 1e-3  # the same for the height scan: at a wall, rounding of a place is a hundred times as large


def nominal_cfg(cfg: Any) -> Any:
    """Turn off all randomization in a task's settings, in place, for :func:`export_policy`."""
    cfg.env.num_envs = 4
    cfg.domain_rand.randomize_parameters = cfg.domain_rand.push_robots = cfg.noise.add_noise = False
    cfg.motors.chain = [n for n in cfg.motors.chain if not isinstance(getattr(cfg.motors, n, None), PerturbationCfg)]
    return cfg


def export_policy(
    task: LeggedRobot,
    model: MLPModel,
    folder: Path,
    name: str,
    training: dict[str, Any],
    add: Callable[[Path], None] | None = None,
) -> tuple[float, list[str]]:
    """Write a policy with everything that is needed to run it, and check the files.

    The networks of any task are exported. What the task computes otherwise than
    :class:`~legged_torque.deploy.policy.Policy` would is listed in the section ``unsupported`` of ``policy.yaml``; a
    file with such a list is refused where it would be run without the task.

    Args:
        task: The task, with settings of :func:`nominal_cfg` and the counters of the checkpoint. Its state is changed.
        model: The policy's network. It reads the observation group "policy", then any groups of single terms.
        folder: Where to write; files of an earlier export there are replaced or removed, ``policy.yaml`` last.
        name: Name of the task.
        training: "run", "checkpoint", "iterations" and "total_steps" of the policy.
        add: Adds files of another format to an export, for its folder.

    Returns:
        Largest difference between the exported networks and the model, and what is unsupported.

    Raises:
        UserError: If the network reads other observations or images, or a package is missing.
    """
    require("onnx", "onnxruntime", "jsonschema")
    refuse(network_problems(task, model))
    description = describe(task, model, name, training)
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.exists() and not folder.is_dir():
        raise UserError(f"'{folder}' is not a folder")
    with write_errors(folder), tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
        part = Path(temporary)
        difference = write_networks(model, task.get_observations(), part, description)
        description["unsupported"] = unknown_parts(task, description) or differences(task, model, Policy(part))
        write_description(part, description)
        if add:
            add(part)
        unitree = [folder / "params/deploy.yaml", folder / "exported/policy.onnx"]
        others = (*folder.glob("leapp/*.*"), *(unitree if unitree[0].is_file() else ()))
        for file in others if (folder / DESCRIPTION_FILE).is_file() else ():  # an earlier policy in other formats
            file.unlink(missing_ok=True)
        for file in sorted(part.rglob("*.*"), key=lambda file: file.name == DESCRIPTION_FILE):
            target = folder / file.relative_to(part)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)
    return difference, description["unsupported"]


def network_problems(task: LeggedRobot, model: MLPModel) -> list[str]:
    """Return why a network cannot be exported at all."""
    if not hasattr(model, "is_recurrent"):  # which rsl_rl's models say
        return [f"{type(model).__name__} has no is_recurrent: only rsl_rl's models and their like can be exported"]
    if getattr(model, "obs_groups_2d", []):  # of rsl_rl's CNNModel
        return [f"policies that see images cannot be exported: {', '.join(model.obs_groups_2d)}"]
    further = task.observations.groups
    if model.obs_groups[:1] != ["policy"] or not further.keys() >= set(model.obs_groups[1:]):
        allowed = f"'policy', then groups of single terms ({', '.join(further) or 'here none'})"
        return [f"obs_groups.actor of an exported policy must be {allowed}, not {', '.join(model.obs_groups)}"]
    return []


def unknown_parts(task: LeggedRobot, description: dict[str, Any]) -> list[str]:
    """Return a line for each part of a task that only the task can compute, apart from observations."""
    ours = (Motor.describe, ModelMotor.describe)
    inherited = {name: link for name, link in task.motors.links.items() if type(link).describe in ours}
    problems = [f"the motor '{name}' has no describe()" for name, link in inherited.items() if not link.describe()]
    if not problems and not any(link.describe() for link in task.motors.links.values()):
        problems.append("no link of motors.chain limits torques")
    if task.terrain.map and type(task.terrain) is not RoughGround:
        problems.append(f"the ground {type(task.terrain).__name__} is not described")
    return parts_without_function(description) + problems


def export_note(task: LeggedRobot, model: MLPModel) -> str:
    """Return in a line what exports of a policy will lack, to be said before it is trained; empty if nothing is known.

    What is computed otherwise than described is only found by an export.
    """
    problems = network_problems(task, model)
    if not problems:
        description = describe(task, model, "", {})
        terms = [term["name"] for term in description["observations"]["terms"] if "supplied" in term]
        problems = unknown_parts(task, description) + [f"the robot's side must supply '{name}'" for name in terms]
    return f"exports of this policy will not be complete: {'; '.join(problems)}" if problems else ""


def write_networks(model: MLPModel, obs: TensorDict, folder: Path, description: dict[str, Any]) -> float:
    """Write the mean policy as ONNX and TorchScript, normalization of observations included, with its ``description``.

    Returns the largest difference of both from ``model.as_jit()`` on random observations, and, without memory, of that
    from the model on some observations of the task. A UserError if it is more than 1e-5, and than three times what the
    last digit of the observations makes.
    """
    network, memory = model.as_onnx(verbose=False).cpu().eval(), description["network"].get("memory", [])
    inputs, outputs = (["obs"] + [each["input"] for each in memory], ["actions"] + [each["output"] for each in memory])
    kept = [torch.zeros(each["layers"], 2, each["size"]) for each in memory]
    axes = {name: {int(name not in ("obs", "actions")): "batch"} for name in inputs + outputs}
    names: dict[str, Any] = {"input_names": inputs, "output_names": outputs, "dynamic_axes": axes}
    with warnings.catch_warnings():
        # The older exporter needs 0.3 s instead of 6, writes the same nodes, and keeps everything in one file.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.filterwarnings("ignore", "Exporting a model to ONNX with a batch_size")  # its memory is an input
        warnings.simplefilter("ignore", torch.jit.TracerWarning)  # torch checks the sizes of that
        example = (torch.zeros(2, model.obs_dim), *kept)
        torch.onnx.export(network, example, str(folder / NETWORK_FILE), **names, opset_version=17, dynamo=False)
        (folder / TORCHSCRIPT_FILE).write_bytes(torch.jit.script(model.as_jit().cpu().eval()).save_to_buffer())
    write_description(folder, description)
    steps = torch.randn(NUM_SAMPLES, model.obs_dim, generator=torch.Generator().manual_seed(0))
    original, nudged = model.as_jit().cpu().eval(), model.as_jit().cpu().eval()
    session, loaded = load_network(folder / NETWORK_FILE, description), torch.jit.load(str(folder / TORCHSCRIPT_FILE))
    remembered, difference, rounding = empty_memory(description), 0.0, 0.0
    with torch.inference_mode():
        if not memory:
            seen = torch.cat([obs[group] for group in model.obs_groups], dim=1).cpu()
            precision = torch.get_float32_matmul_precision()
            torch.set_float32_matmul_precision("highest")  # no TF32 on a GPU
            difference = _difference(original(seen).numpy(), model(obs).cpu().numpy())
            torch.set_float32_matmul_precision(precision)
        for step in steps.split(1 if memory else NUM_SAMPLES):
            expected = original(step).numpy()
            others = (run_network(session, step.numpy(), remembered), loaded(step).numpy())
            difference = max(difference, *(_difference(other, expected) for other in others))
            rounding = max(rounding, _difference(nudged(step.nextafter(step + 1.0)).numpy(), expected))
    if not difference <= min(max(TOLERANCE, 3.0 * rounding), 1e-3):
        raise UserError(f"the exported network differs from the checkpoint's by {difference:.3g}; nothing was written")
    return difference


def describe(task: LeggedRobot, model: MLPModel, name: str, training: dict[str, Any]) -> dict[str, Any]:
    """Return the contents of ``policy.yaml`` but for the network's checksum; arguments as of :func:`export_policy`."""
    cfg, asset, mj_model = task.cfg, task.cfg.asset, task.sim.mj_model
    commands: Any = cfg.commands
    clip, file = float(cfg.normalization.clip_actions), Path(asset.file)
    if file.is_absolute() and file.is_relative_to(RESOURCES_DIR):
        file = file.relative_to(RESOURCES_DIR.parent)
    joints = {}  # for comparison with other files of the robot
    for joint, axis in zip(task.dof_names, task.asset.dof_axes(), strict=True):
        own, keys = mj_model.joint(joint), ("damping", "armature", "frictionloss")
        passive = {key: float(getattr(own, key)[0]) for key in keys}
        axis = [round(float(part), 6) + 0.0 for part in axis]
        joints[joint] = {"axis": axis, **passive, "max_velocity": float(asset.max_dof_vel)}
        joints[joint] |= {"range": own.range.tolist()} if mj_model.jnt_limited[own.id] else {}
    description: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "task": name,
        "unsupported": [],
        "robot": {"name": file.stem, "file": file.as_posix(), "trunk": mj_model.body(1).name}
        | {"mass": round(float(mj_model.body_mass.sum()), 6), "self_collisions": asset.self_collisions},
        "versions": package_versions(),
        "training": training,
        "network": {"file": NETWORK_FILE, "torchscript": TORCHSCRIPT_FILE, "input": "obs", "output": "actions"}
        | {"num_observations": model.obs_dim, "num_actions": task.num_actions}
        | _memory(model),
        "joint_order": list(task.dof_names),
        "nominal_pose": _by_joint(task, task.default_dof_pos),
        "nominal_trunk_height": cfg.rewards.base_height_target,
        "observations": {"history_length": cfg.env.history_length, "terms": _observation_terms(task, model)},
        "actions": {"clip": [-clip, clip], "terms": _action_terms(task)},
        "gains": {"stiffness": _by_joint(task, task.p_gains[0]), "damping": _by_joint(task, task.d_gains[0])},
        "torque_limits": _by_joint(task, task.torque_limits.T),
        "motors": task.motors.describe(),
        "joints": joints,
        "timing": {
            "control_frequency": 1.0 / task.dt,
            "physics_frequency": 1.0 / cfg.sim.dt,
            "decimation": cfg.control.decimation,
            "refresh_torques": cfg.control.refresh_torques,
        },
        "commands": {**commands.allowed(), "resampling_probability": commands.resampling_probability}
        | ({"heading": list(commands.ranges.heading), "heading_gain": HEADING_GAIN} if commands.has_headings() else {}),
        "initial_state": {"trunk_position": list(cfg.init_state.pos)}
        | {name: list(getattr(cfg.domain_rand, setting)) for name, setting in INITIAL_STATE.items()},
        "pushes": {"set_factor": cfg.domain_rand.push_set_factor},
        "episode": {
            "length": cfg.env.episode_length_s,
            "ends_on_contact_of": list(asset.terminate_after_contacts_on) if cfg.terminations.contact else [],
        },
    }
    if task.meter.has_losses:
        description["copper_loss"] = _by_joint(task, task.meter.copper_loss)
    if latency := _latency(task, description["motors"]):
        description["latency"] = latency
    others = [f"commands.{name}" for name in ("standing_share", "zero_below") if getattr(commands, name)]
    others += ["commands.build"] if type(task.command_generator) is not UniformCommands else []
    if others := others + [f"terminations.{name}" for name in task.terminations if name != "contact"]:
        description["episode"]["not_simulated"] = others  # in sim2sim.py
    if type(task.terrain) is RoughGround:
        description["terrain"] = dataclasses.asdict(Layout.of(cfg.terrain))
    return description


def _memory(model: MLPModel) -> dict[str, Any]:
    """Return the entry ``memory`` of a network, by the names of rsl_rl's export; nothing if it remembers nothing."""
    if not model.is_recurrent:
        return {}
    network: Any = model.as_onnx(verbose=False)
    ends = zip(network.input_names[1:], network.output_names[1:], network.get_dummy_inputs()[1:], strict=True)
    return {"memory": [{"input": i, "output": o, "layers": len(h), "size": h.shape[2]} for i, o, h in ends]}


def _latency(task: LeggedRobot, motors: dict[str, Any]) -> dict[str, Any]:
    """Return what is late, and take the delay of actions out of the constants of motors."""
    latency: dict[str, Any] = {}
    delays = [name for name, link in task.motors.links.items() if type(link) is ActionDelay and name in motors]
    if len(delays) == 1:
        latency["actions"] = motors.pop(delays[0])
    if task.sensors.sensing and task.sensors.sensing.queue.is_needed:
        settings: Any = task.cfg.sensing.delay
        latency["measurements"] = settings.described()
    return latency


def _observation_terms(task: LeggedRobot, model: MLPModel) -> list[dict[str, Any]]:
    """Return the terms of the network's observations in their order, those of the group "policy" first."""
    clip, settings, result = float(task.cfg.normalization.clip_observations), task.cfg.terrain, []
    for term in task.observations.policy_terms() + [task.observations.groups[name] for name in model.obs_groups[1:]]:
        size = task.obs_buf[term.group].shape[1] if term.group else task.observations.sizes[term.name]
        scale = list(term.scale) if isinstance(term.scale, Sequence) else term.scale
        entry = {"name": term.name, "size": size, "scale": scale}
        entry |= {key: getattr(term, key) for key in ("frame", "unit", "meaning")} | {"clip": [-clip, clip]}
        if term.group:
            entry["group"] = term.group
        if term.name not in OBSERVATIONS:
            entry["supplied"] = True
        if term.name == "height_scan":
            points = {"points_x": list(settings.measured_points_x), "points_y": list(settings.measured_points_y)}
            entry["scan"] = {**points, "offset": OFFSET, "limit": CLIP, "delay": settings.measure_delay}
        result.append(entry)
    return result


def _action_terms(task: LeggedRobot) -> list[dict[str, Any]]:
    """Return the terms of the actions in their order, with the weights of the task's present counters."""
    return [
        {
            "name": term.name,
            "size": task.num_dof,
            "scale": _plain(term.scale[0, 0]),
            "unit": term.unit,
            "mixing_weight": 1.0 if term.weight is None else _plain(term.weight),
            "meaning": term.meaning,
            **({"interval": term.interval} if term.interval > 1 else {}),
        }
        for term in task.control_law.terms
    ]


def differences(task: LeggedRobot, model: MLPModel, policy: Policy) -> list[str]:
    """Return which of the exported policy's observations or torques differ from the task's in random states."""
    generator = torch.Generator().manual_seed(0)

    def draw(like: Tensor, scale: float) -> Tensor:
        """Return normal numbers of a standard deviation ``scale``."""
        return scale * torch.randn(like.shape, generator=generator)

    qpos = draw(task.sim.qpos, 1.0)
    qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
    task.commands.copy_(draw(task.commands, 3.0))
    task.actions.copy_(draw(task.actions, 3.0))
    task.reset_buf.fill_(True)  # the history starts with copies
    task.set_state(qpos, draw(task.sim.qvel, 3.0))
    supplied = [term for term in (*task.observations.terms, *task.observations.groups.values()) if not term.privileged]
    values = {term.name: term.value().cpu().clone().numpy() for term in supplied}  # as observed, before torques change
    wanted = task._compute_torques(task.actions).clone()
    task.motors.reset(task.reset_buf)
    for substep in range(NUM_SUBSTEPS):
        task.torques.copy_(task.motors.apply(wanted, task.dof_pos, task.dof_vel, substep))
    parts = (task.base_ang_vel, task.dof_pos, task.dof_vel, task.projected_gravity, task.base_pos, task.base_quat)
    obs, torques = [], []
    for world in range(task.num_envs):
        rates, angles, speeds, gravity, position, quat = (part[world].cpu().numpy() for part in parts)
        points = np.pad(policy.scan_places(position, quat), [(0, 0), (0, 1)], constant_values=position[2])
        in_world = torch.as_tensor(points, dtype=torch.float32, device=task.device)
        motors = MotorTwin(policy.description)
        measured = motors.measured(angles, speeds)
        state = State(rates, *measured, gravity)
        state.terms = {name: of_worlds[world] for name, of_worlds in values.items()}
        state.heights = task.terrain.height_above(in_world).cpu().numpy()
        policy.reset()
        policy.last_action = actions = task.actions[world].cpu().numpy()
        obs.append(policy.observation(state, task.commands[world].cpu().numpy()))
        asked = policy.wanted_torques(actions, *measured)
        torques.append([motors.apply(asked, angles, speeds) for _ in range(NUM_SUBSTEPS)][-1])
    seen, expected = np.array(obs), torch.cat([task.obs_buf[name] for name in model.obs_groups], dim=1).cpu().numpy()
    is_scan = np.array(columns(policy.description["observations"])) == "height_scan"
    compared = [
        ("observations", seen[:, ~is_scan], expected[:, ~is_scan], TOLERANCE),
        ("heights of the scan", seen[:, is_scan], expected[:, is_scan], SCAN_TOLERANCE),
        ("torques", np.array(torques), task.torques.cpu().numpy(), TOLERANCE),
    ]
    return [
        f"the {name} of {type(task).__name__} differ by {difference:.3g} from those of the terms in policy.yaml"
        for name, ours, theirs, tolerance in compared
        if not (difference := _difference(ours, theirs)) <= tolerance
    ]


def _difference(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the largest difference, relative where numbers are larger than 1."""
    return float((np.abs(ours - theirs) / np.maximum(np.abs(theirs), 1.0)).max(initial=0.0))


def _by_joint(task: LeggedRobot, values: Tensor) -> dict[str, Any]:
    """Return values by joint name."""
    return dict(zip(task.dof_names, _plain(values), strict=True))


def _plain(values: Tensor) -> Any:
    """Return a float32 tensor as nested lists of the shortest decimals that round to its numbers."""
    return [_plain(value) for value in values] if values.dim() else float(str(values.detach().cpu().numpy()))
