"""Table III of the paper."""

TABLE_III = {  # weight without Delta t, at the start of training
    "tracking_lin_vel": 4.0,
    "tracking_ang_vel": 0.1,
    "lin_vel_z": -2.0,
    "ang_vel_xy": -0.05,
    "orientation": -0.2,
    "dof_pos_limits": -10.0,
    "dof_acc": -2.5e-7,
    "torques": -2e-4,
    "action_rate": -1e-6,
    "collision": -1.0,
    "base_height": -30.0,
    "feet_air_time": 0.1,
    "symmetry": -0.5,
}
