"""A robot held in its nominal pose in plain MuJoCo, before a training."""

import mujoco
import numpy as np

from legged_torque.envs.base.asset import Asset, load_asset
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.motors.config import by_joint
from legged_torque.sim.model import FLOOR
from legged_torque.utils.standing import hold_pose

GAINS = ("stiffness", "damping")
STANDING_TIME = 3.0  # for which the nominal pose is held [s]
_FAR = 10.0  # farther than any part is from the floor [m]


def standing_note(task: LeggedRobot) -> str:
    """Describe how a robot held in its nominal pose by PD control falls on a plane; empty if it stands.

    One robot is simulated for :data:`STANDING_TIME`, with the gains of the settings and the task's limits. Tasks
    without gains, or whose policies change them, are skipped. A UserError if the simulation diverges.
    """
    asset, control = load_asset(task.cfg), task.cfg.control
    pose, limits = (tensor.double().cpu().numpy() for tensor in (task.default_dof_pos, task.torque_limits))
    stiffness, damping = (np.array(by_joint(name, getattr(control, name), task.dof_names)) for name in GAINS)
    if not stiffness.any() or any(term.whole_law for term in task.control_law.terms):
        return ""
    every = 1 if control.refresh_torques else control.decimation
    ending = [asset.mj_model.geom(asset.geom_names[place]).id for place in asset.terminating]
    gains = (stiffness, damping, limits)
    result = hold_pose(_placed(asset, pose), *gains, STANDING_TIME, every=every, may_not_touch=ending)
    if not result.fall:
        return ""
    return f"the nominal pose does not stand under PD control, {result.fall}; see init_state, control.stiffness"


def _placed(asset: Asset, pose: np.ndarray) -> mujoco.MjData:
    """Return a state at rest in which the lowest part of the robot touches the floor."""
    model, data = asset.mj_model, mujoco.MjData(asset.mj_model)
    data.qpos[:7], data.qpos[7:] = (0, 0, 1, 1, 0, 0, 0), pose
    mujoco.mj_kinematics(model, data)
    floor, parts = model.geom(FLOOR).id, [model.geom(name).id for name in asset.geom_names]
    data.qpos[2] -= min(mujoco.mj_geomDistance(model, data, floor, part, _FAR, None) for part in parts)
    return data
