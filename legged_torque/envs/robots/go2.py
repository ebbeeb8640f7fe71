"""The Unitree Go2: figures of MuJoCo Menagerie and of Unitree's URDF, the same for all approaches."""

from __future__ import annotations

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO


class Go2Cfg(LeggedRobotCfg):
    """Settings of the Go2; alone, of position control on a plane: task ``go2_position``."""

    class asset:
        file = "resources/robots/go2/go2.xml"
        foot_name = "foot"
        penalize_contacts_on = ["calf", "thigh", "trunk"]
        terminate_after_contacts_on = ["trunk"]
        mirrored_legs = [["FR", "FL"], ["RR", "RL"]]
        max_dof_vel = 30.1

    class init_state:
        pos = [0.0, 0.0, 0.42]
        default_joint_angles = (
            {"FR_hip_joint": -0.1, "FR_thigh_joint": 0.8, "FR_calf_joint": -1.5}
            | {"FL_hip_joint": 0.1, "FL_thigh_joint": 0.8, "FL_calf_joint": -1.5}
            | {"RR_hip_joint": -0.1, "RR_thigh_joint": 1.0, "RR_calf_joint": -1.5}
            | {"RL_hip_joint": 0.1, "RL_thigh_joint": 1.0, "RL_calf_joint": -1.5}
        )

    class control:
        stiffness = 20.0
        damping = 0.5
        action_scale = 0.25
        torque_scale = 4.0

    class rewards:
        base_height_target = 0.324


class Go2CfgPPO(LeggedRobotCfgPPO):
    """Training of a Go2, which is the same left and right."""

    class algorithm:
        class symmetry_cfg:
            use_data_augmentation = True
