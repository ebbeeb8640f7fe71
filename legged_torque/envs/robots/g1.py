"""The Unitree G1 with 12 joints in its legs: figures of Unitree's MJCF, the same for all approaches."""

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO
from legged_torque.motors.model_config import ASSUMED_VOLTAGE, CurveCfg


class G1Cfg(LeggedRobotCfg):
    """Settings of the G1; alone, of position control on a plane: task ``g1_position``."""

    class asset:
        file = "resources/robots/g1/g1.xml"
        foot_name = "foot"
        penalize_contacts_on = ["shin", "thigh", "hand", "pelvis", "torso", "head"]
        terminate_after_contacts_on = ["shin", "thigh", "hand", "pelvis", "torso", "head"]
        mirrored_legs = [["right", "left"]]
        max_dof_vel = 20.0

    class init_state:
        pos = [0.0, 0.0, 0.82]
        default_joint_angles = (
            {"left_hip_pitch_joint": -0.1, "left_hip_roll_joint": 0.0, "left_hip_yaw_joint": 0.0}
            | {"left_knee_joint": 0.3, "left_ankle_pitch_joint": -0.2, "left_ankle_roll_joint": 0.0}
            | {"right_hip_pitch_joint": -0.1, "right_hip_roll_joint": 0.0, "right_hip_yaw_joint": 0.0}
            | {"right_knee_joint": 0.3, "right_ankle_pitch_joint": -0.2, "right_ankle_roll_joint": 0.0}
        )

    class control:
        stiffness = {"hip": 100.0, "knee": 150.0, "ankle": 40.0}
        damping = {"hip": 2.0, "knee": 4.0, "ankle": 2.0}
        action_scale = 0.25
        torque_scale = 10.0

    class motors:
        choices = {"ideal": ["delay", "ideal"], "real": ["delay", "ideal", "unitree", "friction"]}

        class unitree(CurveCfg):
            """By type of motor, of unitree_rl_lab: N7520-22.5, N7520-14.3, and two N5020-16 for each ankle joint."""

            knee_speed = {"hip_roll": 14.5, "knee": 14.5, "hip": 22.63, "ankle": 30.86}
            no_load_speed = {"hip_roll": 22.7, "knee": 22.7, "hip": 35.52, "ankle": 40.13}
            driving_torque = {"hip_roll": 111.0, "knee": 111.0, "hip": 71.0, "ankle": 2 * 24.8}
            braking_torque = {"hip_roll": 131.0, "knee": 131.0, "hip": 83.3, "ankle": 2 * 31.9}
            armature = {"hip_roll": 0.0251, "knee": 0.0251, "hip": 0.01018, "ankle": 2 * 0.00361}
            draws = ASSUMED_VOLTAGE

        class friction:
            """Of the same motors, but smoother: with Unitree's 0.01 rad/s, joints tremble in physics steps of 5 ms."""

            static_friction = {"hip_roll": 2.4, "knee": 2.4, "hip": 1.6, "ankle": 2 * 0.6}
            coulomb_friction = {"hip_roll": 2.4, "knee": 2.4, "hip": 1.6, "ankle": 2 * 0.6}
            viscous_friction = {"hip_roll": 0.24, "knee": 0.24, "hip": 0.16, "ankle": 2 * 0.06}
            activation_speed = 0.1

    class domain_rand:
        init_roll = [-0.1, 0.1]
        init_pitch = [-0.1, 0.1]
        trunk_mass = {"add": [-2.0, 2.0], "scale": [0.8, 1.2]}
        dof_damping = {"set": [0.0, 0.4]}
        dof_armature = {"set": [0.008, 0.02]}
        dof_stiffness = {"set": [0.0, 0.4]}
        dof_frictionloss = {"set": [0.0, 0.8]}

    class commands:
        class ranges:
            lin_vel_x = [-0.6, 1.0]
            lin_vel_y = [-0.4, 0.4]

    class rewards:
        base_height_target = 0.785
        feet_air_time_target = 0.4
        tracking_temperature = 10.0
        held_joints = ["hip_roll", "hip_yaw"]

        class scales:
            tracking_lin_vel = 2.0
            tracking_ang_vel = 2.0
            orientation = -2.0
            dof_pos_limits = -5.0
            dof_acc = -1e-7
            torques = -1e-5
            action_rate = -0.01
            collision = 0.0
            base_height = -10.0
            feet_air_time = 1.0
            dof_deviation = -0.2
            alive = 0.2

    def perturbations(self) -> dict[str, dict]:
        """Return the perturbations, with joints at the start of an episode that two legs can catch."""
        named = super().perturbations()
        for name in named.keys() - {"none"}:
            named[name]["domain_rand"]["init_dof_vel"] = [-1.0, 1.0]
        return named


class G1CfgPPO(LeggedRobotCfgPPO):
    """Training of a G1, which is the same left and right and learns for longer than four legs."""

    class runner:
        total_steps = 220_000_000

    class algorithm:
        class symmetry_cfg:
            use_data_augmentation = True
