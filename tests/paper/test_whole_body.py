"""The whole-body controller: its torques against MuJoCo's dynamics, and whether robots under it stand."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from support.control import TORQUE_LIMIT, WEIGHT

from legged_torque.envs import task_registry
from legged_torque.paper.gravity.dynamics import RobotDynamics
from legged_torque.paper.gravity.pretraining import act_by_controller
from legged_torque.paper.gravity.standing import is_standing, measure_standing, place_on_ground, use_standing_trials
from legged_torque.paper.gravity.whole_body import WholeBodyController, WholeBodySettings
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import Options

FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
AT_REST = WholeBodySettings(
    position_stiffness=0.0, attitude_stiffness=0.0, joint_stiffness=0.0, foot_stiffness=0.0, task_damping=0.0
)
"""No wish but to accelerate nothing."""


def make_trial(num_envs):
    """A task that starts standing trials."""
    cfg, _ = task_registry.get_cfgs("a1_torque")
    use_standing_trials(cfg)
    cfg.env.num_envs = num_envs
    torch.manual_seed(1)
    return task_registry.make_env("a1_torque", Options(device="cpu"), cfg)[0]


def make_controller(task, num_states, settings=None):
    """A controller of the task's robot."""
    dynamics = RobotDynamics(task.sim.mj_model, num_states, "cpu", task.foot_names)
    return WholeBodyController(dynamics, task.default_dof_pos.tolist(), settings)


@pytest.fixture(scope="module")
def task():
    """A few worlds with random states in the air, moving."""
    return make_trial(16)


@pytest.fixture(scope="module")
def state(task):
    """Positions and velocities that no test changes."""
    return task.sim.qpos.clone(), task.sim.qvel.clone()


def test_torques_and_contact_forces_hold_the_robot(task, state):
    """On four feet at rest, clipped torques and contact forces balance gravity as mj_inverse says."""
    qpos, qvel = state[0].clone(), torch.zeros_like(state[1])
    qpos[:, 7:] = task.default_dof_pos + 0.1 * (qpos[:, 7:] - task.default_dof_pos)
    result = make_controller(task, 16, AT_REST)(qpos, qvel, torch.ones(16, 4, dtype=torch.bool))
    model = copy.copy(task.sim.mj_model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, jacobian = mujoco.MjData(model), np.zeros((3, 18))
    for i in range(16):
        data.qpos[:] = qpos[i]
        mujoco.mj_inverse(model, data)
        total = np.r_[np.zeros(6), result.total[i]]
        for foot, force in zip(FEET, result.contact_forces[i].numpy(), strict=True):
            geom = model.geom(foot).id
            lowest = data.geom_xpos[geom] - [0.0, 0.0, 0.02]
            mujoco.mj_jac(model, data, jacobian, None, lowest, model.geom_bodyid[geom])
            total += jacobian.T @ force
        np.testing.assert_allclose(total, data.qfrc_inverse, rtol=0, atol=0.15)
    torch.testing.assert_close(result.contact_forces.sum(1)[:, 2], torch.full((16,), WEIGHT), rtol=0, atol=0.15)
    torch.testing.assert_close(result.wrench_residual, torch.zeros(16, 6), rtol=0, atol=0.15)


def test_without_contact_only_posture_remains(task, state):
    """In the air, torques are the PD control within the limits; feet already in place are not drawn elsewhere."""
    qpos, qvel = state[0].clone(), torch.zeros_like(state[1])
    qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    qpos[:, 7:] = task.default_dof_pos
    qvel[:, 6:] = 40.0 * torch.linspace(-1.0, 1.0, 16 * 12).view(16, 12)
    nothing = torch.zeros(16, 4, dtype=torch.bool)
    result = make_controller(task, 16)(qpos, qvel, nothing)
    assert (result.task == 0.0).all() and (result.force == 0.0).all()
    torch.testing.assert_close(result.total, (-1.0 * qvel[:, 6:]).clamp(-TORQUE_LIMIT, TORQUE_LIMIT), rtol=0, atol=1e-3)
    assert (make_controller(task, 16)(*state, nothing).total.abs() <= TORQUE_LIMIT).all()


def test_place_on_ground():
    """Nothing is below the ground, and some foot is at most 2 cm above it, according to MuJoCo's distances."""
    task = make_trial(64)
    place_on_ground(task, RobotDynamics(task.sim.mj_model, 64, "cpu", FEET))
    model, clearances = task.sim.mj_model, []
    data, floor = mujoco.MjData(model), model.geom("floor").id
    parts = set(range(model.ngeom)) - {floor}
    for qpos in task.sim.qpos.double().numpy():
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        heights = {part: mujoco.mj_geomDistance(model, data, floor, part, 1.0, None) for part in parts}
        assert min(heights.values()) > -1e-5
        clearances.append(min(heights[model.geom(foot).id] for foot in FEET))
    assert max(clearances) < 0.0201 and np.ptp(clearances) > 0.01
    spread = task.sim.qpos[:, 7:].std(dim=0)
    assert (spread[1::3] > 0.1).all() and (task.sim.qvel[:, 6:].abs() > 8.0).any()
    torch.testing.assert_close(task.projected_gravity.norm(dim=1), torch.ones(64))
    assert (task.projected_gravity[:, 2] < -0.95).all() and (task.projected_gravity[:, 2] > -0.99999).any()


def test_trials_are_shorter_than_episodes(task):
    """Time to stand is within an episode; see test_standing_scripts.py for how the controller stands up."""
    with pytest.raises(UserError, match="do not fit"):
        measure_standing(task, act_by_controller(make_controller(task, 16)), 1000.0)


@pytest.mark.parametrize("name", ["a1_torque", "anymal_c_torque", "g1_torque"])
def test_is_standing(name, make_task):
    """Each of the conditions is needed; the height is a share of the robot's own: 0.25 m is high for the A1 alone."""
    task = make_task(name, 8)
    nominal = {"a1_torque": 0.303, "anymal_c_torque": 0.549, "g1_torque": 0.785}[name]
    task.base_pos[:, 2] = nominal
    task.projected_gravity[:] = torch.tensor([0.0, 0.0, -1.0])
    task.base_lin_vel[:] = 0.0
    task.contacts[:] = 0.0
    task.contacts[:, task.feet_indices] = 1.0
    task.base_pos[1, 2] = 0.49 * nominal
    task.projected_gravity[2, 2] = -0.87  # 0.52 rad
    task.base_lin_vel[3, 1] = 0.31
    task.contacts[4, task.penalized_contact_indices[1]] = 1.0
    task.base_pos[5, 2] = 0.25
    task.projected_gravity[6, 2] = -0.88  # 0.49 rad
    task.base_pos[7, 2] = torch.nan
    assert is_standing(task).tolist() == [True, False, False, False, False, name == "a1_torque", True, False]
