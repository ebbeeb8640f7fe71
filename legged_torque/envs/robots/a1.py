"""The Unitree A1: figures of its URDF and of the paper, the same for all approaches."""

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO
from legged_torque.motors.model_config import ASSUMED_VOLTAGE, CurveCfg


class A1Cfg(LeggedRobotCfg):
    """Settings of the A1; alone, of position control on a plane: task ``a1_position``."""

    class asset:
        file = "resources/robots/a1/a1.xml"
        foot_name = "foot"
        penalize_contacts_on = ["calf", "thigh", "trunk"]
        terminate_after_contacts_on = ["trunk"]
        mirrored_legs = [["FR", "FL"], ["RR", "RL"]]
        max_dof_vel = 21.0

    class init_state:
        pos = [0.0, 0.0, 0.4]
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

    class motors:
        choices = {"ideal": ["delay", "ideal"], "real": ["delay", "ideal", "urdf"]}

        class urdf(CurveCfg):  # Unitree's URDF, which has no knee: the whole torque up to the highest speed
            knee_speed = 21.0
            no_load_speed = 21.0
            driving_torque = 33.5
            braking_torque = 33.5
            draws = ASSUMED_VOLTAGE

    class domain_rand:
        trunk_mass = {"add": [-1.0, 1.0]}
        foot_radius = {"set": [0.019, 0.021]}
        dof_damping = {"set": [0.0, 0.2]}
        dof_armature = {"set": [0.008, 0.02]}
        dof_stiffness = {"set": [0.0, 0.2]}
        dof_frictionloss = {"set": [0.0, 0.4]}

    class rewards:
        base_height_target = 0.303

    def hard_ranges(self) -> dict[str, dict]:
        """Return the hard ranges, with those of this robot's parts."""
        hard = super().hard_ranges()
        hard["domain_rand"] |= {
            "trunk_mass": {"add": [-2.0, 2.0]},
            "dof_damping": {"set": [0.0, 2.0]},
            "dof_armature": {"set": [0.008, 0.05]},
            "dof_stiffness": {"set": [0.0, 0.5]},
            "dof_frictionloss": {"set": [0.0, 1.0]},
        }
        return hard


class A1CfgPPO(LeggedRobotCfgPPO):
    """Training of an A1, which is the same left and right."""

    class algorithm:
        class symmetry_cfg:
            use_data_augmentation = True
