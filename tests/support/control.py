"""Figures of the A1, its PD control by hand, and random states."""

import numpy as np
import torch

JOINTS = [f"{leg}_{link}" for leg in ("FR", "FL", "RR", "RL") for link in ("hip", "thigh", "calf")]
NOMINAL = np.array([-0.1, 0.8, -1.5, 0.1, 0.8, -1.5, -0.1, 1.0, -1.5, 0.1, 1.0, -1.5])
RANGE = {"hip": (-0.802851, 0.802851), "thigh": (-1.0472, 4.18879), "calf": (-2.69653, -0.916298)}
LOW, HIGH = np.array([RANGE[name[3:]] for name in JOINTS]).T
TORQUE_LIMIT = 33.5
FEET = [4, 8, 12, 16]
"""Columns of the feet in the contact buffers: after the trunk, each leg has hip, thigh, calf, foot."""
IN_THE_AIR = {"init_state.pos": [0.0, 0.0, 2.0]}
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
