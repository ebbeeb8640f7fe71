"""A leg of a Go2 on a fixed trunk in plain MuJoCo, with known numbers."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np

from legged_torque import resource_path
from legged_torque.envs import task_registry
from legged_torque.identification.recording import Recording
from legged_torque.runtime.controller import Mode
from legged_torque.runtime.interface import MotorCommand, Received, RobotState
from legged_torque.runtime.log import Log
from tools.coverage import simulate

PERIOD, NOISE = 0.002, np.array([[5e-4], [0.05]])  # [s]; [rad, rad/s]
TILT = np.array([0.98, 0.1, -0.15, 0.08]) / np.linalg.norm([0.98, 0.1, -0.15, 0.08])  # of the trunk
POSE = {"FR_hip_joint": -0.1, "FR_thigh_joint": 0.8, "FR_calf_joint": -1.5}
TRUTH = np.array([[0.015, 0.024, 0.008], [0.19, 0.08, 0.1], [0.34, 0.19, 0.24], [-0.047, 0.055, 0.04], [0.005] * 3])
"""Armature, viscous and Coulomb friction, bias and delay of the joints."""
NUMBERS = np.append(TRUTH[:4].ravel(), TRUTH[4, 0])


def one_leg(folder):
    """Settings of a task whose robot has one leg; in the folder, ``fixed.xml`` has the known numbers."""
    cfg = task_registry.get_cfgs("go2_torque")[0]
    tree = ElementTree.parse(resource_path(cfg.asset.file))
    trunk = tree.find("worldbody/body")
    for owner in (trunk, tree.find("actuator"), tree.getroot()):
        for part in [*owner.findall("body"), *owner.findall("motor"), *owner.findall("keyframe")]:
            if not part.get("name", "").startswith("FR"):
                owner.remove(part)
    tree.write(folder / "leg.xml")
    cfg.asset.file, cfg.asset.mirrored_legs = str(folder / "leg.xml"), []
    cfg.init_state.default_joint_angles = dict(POSE)
    trunk.set("quat", " ".join(map(str, TILT)))
    trunk.remove(trunk.find("freejoint"))
    for joint, numbers in zip(trunk.iter("joint"), TRUTH.T, strict=True):
        joint.attrib |= dict(zip(("armature", "damping", "frictionloss"), map(str, numbers), strict=False))
    tree.write(folder / "fixed.xml")
    return cfg


def fixed_file(leg):
    """The file of the leg on a fixed trunk."""
    return leg.asset.file.replace("leg.xml", "fixed.xml")


def fixed(leg, step):
    """The specification of the leg on a fixed trunk, which touches nothing."""
    spec = mujoco.MjSpec.from_file(fixed_file(leg))
    spec.option.timestep, spec.option.disableflags = step, mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec


def sweep(seconds, last=10.0, amplitude=0.25):
    """Targets of the joints: two sweeps from 0.1 Hz. Shape: (ticks, joints)."""
    times = np.arange(round(seconds / PERIOD)) * PERIOD
    length = seconds * np.where(times < 0.8 * seconds, 0.8, 0.2)
    times, rise = np.where(times < 0.8 * seconds, times, times - 0.8 * seconds), (last - 0.1) / length
    size = np.minimum(amplitude, 1.0 / (0.1 + rise * times)) * np.clip(np.minimum(times, length - times) / 0.3, 0, 1)
    phase = 2 * np.pi * (0.1 * times + 0.5 * rise * times**2)
    return np.array(list(POSE.values())) + size[:, None] * np.sin(phase[:, None] + 2.4 * np.arange(3))


def record(leg, targets):
    """The recording of a leg without noise."""
    commands = np.zeros((len(targets), 5, 3))
    commands[:, 1], commands[:, 3], commands[:, 4] = targets, 20.0, 0.5
    measured = simulate(Path(fixed_file(leg)), list(POSE), commands, TRUTH)
    return Recording(list(POSE), PERIOD, TILT, commands, measured)


def noisy(recording, seed=0):
    """The same with noise of the encoders, and three ticks without a state."""
    measured = recording.measured + NOISE * np.random.default_rng(seed).normal(size=recording.measured.shape)
    measured[[700, 701, 1900]] = np.nan
    return replace(recording, measured=measured)


def write_log(file, recording, task, modes=None, times=None):
    """Write a log as deploy.py does; the quaternion may be one for each tick."""
    policy = SimpleNamespace(description={"network": {"sha256": "chirp"}, "task": task})
    about = {"policy": policy, "joints": SimpleNamespace(names=recording.joint_order), "period": PERIOD}
    controller = SimpleNamespace(**about, reason="", velocity_command=np.zeros(3), policy_step=None)
    log, nothing = Log(file, controller), np.zeros(len(recording.joint_order))
    quaternions = np.broadcast_to(recording.quaternion, (len(recording.commands), 4))
    for tick, (command, (pos, vel)) in enumerate(zip(recording.commands, recording.measured, strict=True)):
        controller.mode = modes[tick] if modes else Mode.POLICY
        state = RobotState(tick, quaternions[tick], np.zeros(3), pos, vel, nothing, nothing, nothing)
        received = Received(None if np.isnan(pos).any() else state)
        log.add(times[tick] if modes else PERIOD * tick, False, received, MotorCommand(*command))
    log.close()
