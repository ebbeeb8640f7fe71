"""The ANYbotics ANYmal C: figures of MuJoCo Menagerie and of ANYbotics' URDF, the same for all approaches."""

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO


class AnymalCCfg(LeggedRobotCfg):
    """Settings of the ANYmal C; alone, of position control on a plane: task ``anymal_c_position``."""

    class asset:
        file = "resources/robots/anymal_c/anymal_c.xml"
        foot_name = "FOOT"
        penalize_contacts_on = ["SHANK", "THIGH", "base"]
        terminate_after_contacts_on = ["base"]
        mirrored_legs = [["RF", "LF"], ["RH", "LH"]]
        max_dof_vel = 7.5

    class init_state:
        pos = [0.0, 0.0, 0.65]
        default_joint_angles = (
            {"LF_HAA": 0.0, "LF_HFE": 0.4, "LF_KFE": -0.8}
            | {"RF_HAA": 0.0, "RF_HFE": 0.4, "RF_KFE": -0.8}
            | {"LH_HAA": 0.0, "LH_HFE": -0.4, "LH_KFE": 0.8}
            | {"RH_HAA": 0.0, "RH_HFE": -0.4, "RH_KFE": 0.8}
        )

    class control:
        stiffness = 80.0
        damping = 2.0
        action_scale = 0.5
        torque_scale = 15.0

    class domain_rand:
        trunk_mass = {"add": [-4.0, 4.0], "scale": [0.8, 1.2]}
        foot_radius = {"set": [0.0285, 0.0315]}
        dof_damping = {"set": [0.0, 0.6]}
        dof_armature = {"set": [0.05, 0.1]}
        dof_stiffness = {"set": [0.0, 0.6]}
        dof_frictionloss = {"set": [0.0, 1.2]}

    class rewards:
        base_height_target = 0.549

        class scales:
            torques = -2e-5


class AnymalCCfgPPO(LeggedRobotCfgPPO):
    """Training of an ANYmal C, which is the same left and right."""

    class algorithm:
        class symmetry_cfg:
            use_data_augmentation = True
