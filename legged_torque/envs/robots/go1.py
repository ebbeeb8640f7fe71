"""The Unitree Go1: figures of MuJoCo Menagerie and of Unitree's URDF, the same for all approaches."""

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.motors.model_config import ASSUMED_VOLTAGE, CurveCfg


class Go1Cfg(LeggedRobotCfg):
    """Settings of the Go1; alone, of position control on a plane: task ``go1_position``."""

    class asset:
        file = "resources/robots/go1/go1.xml"
        foot_name = "foot"
        penalize_contacts_on = ["calf", "thigh", "trunk"]
        terminate_after_contacts_on = ["trunk"]
        mirrored_legs = [["FR", "FL"], ["RR", "RL"]]
        max_dof_vel = 30.1

    class init_state:
        pos = [0.0, 0.0, 0.42]
        default_joint_angles = A1Cfg.init_state.default_joint_angles

    class control:
        stiffness = 20.0
        damping = 0.5
        action_scale = 0.25
        torque_scale = 4.0

    class motors:
        choices = {"ideal": ["delay", "ideal"], "real": ["delay", "ideal", "urdf"]}

        class urdf(CurveCfg):  # Unitree's URDF, which has no knee: the whole torque up to the highest speed
            knee_speed = {"calf": 20.06, "joint": 30.1}
            no_load_speed = {"calf": 20.06, "joint": 30.1}
            driving_torque = {"calf": 35.55, "joint": 23.7}
            braking_torque = {"calf": 35.55, "joint": 23.7}
            draws = ASSUMED_VOLTAGE

    class rewards:
        base_height_target = 0.325


class Go1CfgPPO(A1CfgPPO):
    """Training of a Go1, which is the same left and right."""
