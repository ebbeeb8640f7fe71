"""Figures of the A1, its PD control, contacts and mirror images by hand, random states, and ends of episodes."""

import mujoco
import numpy as np
import torch

JOINTS = [f"{leg}_{link}" for leg in ("FR", "FL", "RR", "RL") for link in ("hip", "thigh", "calf")]
NOMINAL = np.array([-0.1, 0.8, -1.5, 0.1, 0.8, -1.5, -0.1, 1.0, -1.5, 0.1, 1.0, -1.5])
RANGE = {"hip": (-0.802851, 0.802851), "thigh": (-1.0472, 4.18879), "calf": (-2.69653, -0.916298)}
LOW, HIGH = np.array([RANGE[name[3:]] for name in JOINTS]).T
TORQUE_LIMIT = 33.5
FEET = [4, 8, 12, 16]
"""Columns of the feet in the contact buffers: after the trunk, each leg has hip, thigh, calf, foot."""
LEGS = ("FR", "FL", "RR", "RL")
SENSED = ["trunk", *(f"{leg}_{part}" for leg in LEGS for part in ("hip", "thigh", "calf", "foot"))]
"""Columns of the contact buffers: all collision geoms of the robot in the order of the XML."""
WEIGHT = 12.453 * 9.81
IN_THE_AIR = {"init_state.pos": [0.0, 0.0, 2.0]}
HIGH_UP = {"init_state.pos": [0.0, 0.0, 50.0]}
"""So high up that no world falls and starts anew by itself."""
CONVERGED = {"sim.solver_iterations": 100, "sim.ls_iterations": 50}
"""Solver limits that neither MuJoCo nor MuJoCo Warp reaches, so that both find the same minimum."""

REAL_MOTORS = {
    "motors.chain": ["delay", "drive", "ideal", "lag", "urdf", "friction", "thermal"],
    "motors.drive.damping": {"hip": 0.3, "thigh": 0.0, "calf": 0.5},
    "motors.lag.time_constant": 0.003,
    "motors.urdf.knee_speed": 5.0,
    "motors.urdf.sag": 2.0,
    "motors.friction.coulomb_friction": 0.5,
    "motors.friction.activation_speed": 0.5,
    "motors.thermal.continuous_torque": 10.0,
    "motors.thermal.time_constant": 0.1,
}
"""Settings of an A1's motors with all models whose torques change continuously."""


def pd_by_hand(action, q, qd, kp=20.0, kd=0.5, scale=0.25):
    """Eq. 8 in numpy."""
    return kp * (NOMINAL + scale * action - q) - kd * qd


def random_state(task, seed=0):
    """Put joints into random angles and speeds; return them with random actions, in double precision."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(LOW, HIGH, (task.num_envs, 12))
    qd = rng.uniform(-5, 5, q.shape)
    action = rng.normal(size=(task.num_envs, task.num_actions))
    task.dof_pos.copy_(torch.tensor(q))
    task.dof_vel.copy_(torch.tensor(qd))
    return q, qd, action


def time_out(task, worlds):
    """Let the episodes of some worlds end with the next control step."""
    lengths = task.episode_length_buf.clone()
    lengths[worlds] = task.max_episode_length
    task.episode_length_buf = lengths


def mirror_joints(values):
    """Joint by joint: FR and FL change places, RR and RL do, and hips, which turn about x, change their sign."""
    legs = values.reshape(len(values), -1, 4, 3)[:, :, [1, 0, 3, 2]]
    return (legs * torch.tensor([-1.0, 1.0, 1.0])).reshape(values.shape)


def mirror_policy(obs):
    """Gravity, angular velocity, command, joint positions, joint velocities, last actions."""
    signs = torch.tensor([1.0, -1, 1, -1, 1, -1, 1, -1, -1])
    return torch.cat([obs[:, :9] * signs, *map(mirror_joints, (obs[:, 9:21], obs[:, 21:33], obs[:, 33:]))], dim=1)


def contacts_by_hand(model, data):
    """Number of contacts with the floor and net world force of each sensed geom, from MuJoCo's list of contacts."""
    found, force, wrench = np.zeros(len(SENSED)), np.zeros((len(SENSED), 3)), np.zeros(6)
    for i, contact in enumerate(data.contact):
        first, second = (model.geom(geom).name for geom in contact.geom)
        assert first == "floor"
        if second in SENSED:
            mujoco.mj_contactForce(model, data, i, wrench)
            found[SENSED.index(second)] += 1
            force[SENSED.index(second)] += contact.frame.reshape(3, 3).T @ wrench[:3]
    return found, force
