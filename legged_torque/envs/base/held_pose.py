"""Whether a robot stands in its nominal pose, tried in plain MuJoCo before a training."""

from __future__ import annotations

import mujoco
import numpy as np

from legged_torque.envs.base.asset import Asset, load_asset
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.sim.model import CONTACT_DATA, FLOOR
from legged_torque.utils.errors import UserError
from legged_torque.utils.standing import LEAST_HEIGHT, stands

STANDING_TIME = 3.0  # for which the nominal pose is held [s]
_FAR = 10.0  # farther than any part is from the floor [m]


def standing_note(task: LeggedRobot) -> str:
    """Return how the robot falls that is put on a plane in its nominal pose, held by PD control; empty if it stands.

    One robot is simulated for :data:`STANDING_TIME`, with the task's gains and limits. Nothing is
    told of a task without gains. A UserError if the simulation diverges.
    """
    asset = load_asset(task.cfg)
    numbers = (task.default_dof_pos, task.p_gains[0], task.d_gains[0], *task.torque_limits)
    pose, stiffness, damping, lowest, highest = (tensor.double().cpu().numpy() for tensor in numbers)
    if not stiffness.any():
        return ""
    model, data = asset.mj_model, _placed(asset, pose)
    height = float(data.qpos[2])
    for step in range(round(STANDING_TIME / model.opt.timestep)):
        if step % task.cfg.control.decimation == 0 or task.cfg.control.refresh_torques:
            wanted = stiffness * (pose - data.qpos[7:]) - damping * data.qvel[6:]
            data.ctrl[:] = np.clip(wanted, lowest, highest)
        mujoco.mj_step(model, data)
        if any(warning.number for warning in data.warning):
            raise UserError(f"'{task.cfg.asset.file}' diverges under PD control: check masses, gains and sim.dt")
        fate = _fall(asset, data, height)
        if fate:
            after = f"after {(step + 1) * model.opt.timestep:.2f} s {fate}"
            return f"the nominal pose does not stand under PD control, {after}; see init_state, control.stiffness"
    return ""


def _placed(asset: Asset, pose: np.ndarray) -> mujoco.MjData:
    """Return a state at rest in which the lowest part of the robot touches the floor."""
    model, data = asset.mj_model, mujoco.MjData(asset.mj_model)
    data.qpos[:7], data.qpos[7:] = (0, 0, 1, 1, 0, 0, 0), pose
    mujoco.mj_kinematics(model, data)
    floor, parts = model.geom(FLOOR).id, [model.geom(name).id for name in asset.geom_names]
    data.qpos[2] -= min(mujoco.mj_geomDistance(model, data, floor, part, _FAR, None) for part in parts)
    return data


def _fall(asset: Asset, data: mujoco.MjData, height: float) -> str:
    """Return why a robot does not stand: a part that ends episodes touches the ground, the trunk is tilted or has sunk.

    ``height`` is that at which the trunk started [m].
    """
    touching = data.sensordata.reshape(-1, CONTACT_DATA)[:, 0] > 0
    ending = [asset.geom_names[geom] for geom in asset.terminating if touching[geom]]
    if ending:
        return f"'{ending[0]}' touches the ground"
    tilt = np.arccos(np.clip(1.0 - 2.0 * (data.qpos[4] ** 2 + data.qpos[5] ** 2), -1.0, 1.0))
    if stands(data.qpos[2], height, tilt):
        return ""
    if data.qpos[2] <= LEAST_HEIGHT * height:
        return f"the trunk has sunk from {height:.2f} to {data.qpos[2]:.2f} m"
    return f"the trunk is tilted by {tilt:.2f} rad"
