"""The Unitree A1: what all approaches on it share."""

from __future__ import annotations

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO


class A1Cfg(LeggedRobotCfg):
    """A1 with position control, the paper's baseline: task ``a1_position``."""

    class asset(LeggedRobotCfg.asset):
        file = "resources/robots/a1/a1.xml"
        foot_name = "foot"
        penalize_contacts_on = ["calf", "thigh", "trunk"]
        terminate_after_contacts_on = ["trunk"]

    class init_state(LeggedRobotCfg.init_state):
        default_joint_angles = {
            "FR_hip_joint": -0.1,
            "FR_thigh_joint": 0.8,
            "FR_calf_joint": -1.5,
            "FL_hip_joint": 0.1,
            "FL_thigh_joint": 0.8,
            "FL_calf_joint": -1.5,
            "RR_hip_joint": -0.1,
            "RR_thigh_joint": 1.0,
            "RR_calf_joint": -1.5,
            "RL_hip_joint": 0.1,
            "RL_thigh_joint": 1.0,
            "RL_calf_joint": -1.5,
        }


class A1CfgPPO(LeggedRobotCfgPPO):
    """Training of ``a1_position``."""

    class runner(LeggedRobotCfgPPO.runner):
        experiment_name = "a1_position"

    class algorithm(LeggedRobotCfgPPO.algorithm):
        class symmetry_cfg(LeggedRobotCfgPPO.algorithm.symmetry_cfg):
            use_data_augmentation = True
