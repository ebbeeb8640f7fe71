"""The Unitree Go2: figures of MuJoCo Menagerie and of Unitree's URDF, the same for all approaches."""

from legged_torque.envs.robots.go1 import Go1Cfg, Go1CfgPPO
from legged_torque.motors.model_config import ASSUMED_VOLTAGE, CurveCfg


class Go2Cfg(Go1Cfg):
    """Settings of the Go2; alone, of position control on a plane: task ``go2_position``.

    Names of parts, nominal angles, gains and speeds are those of the Go1.
    """

    class asset:
        file = "resources/robots/go2/go2.xml"

    class motors:
        choices = (
            {"ideal": ["delay", "ideal"], "urdf": ["delay", "ideal", "urdf"]}
            | {"unitree_train": ["delay", "ideal", "unitree_train"]}
            | {"real": ["delay", "ideal", "unitree_train"]}
        )

        class urdf:  # Unitree's URDF; of its hips and thighs, that of the Go1
            knee_speed = {"calf": 15.7, "joint": 30.1}
            no_load_speed = {"calf": 15.7, "joint": 30.1}
            driving_torque = {"calf": 45.43, "joint": 23.7}
            braking_torque = {"calf": 45.43, "joint": 23.7}

        class unitree_train(CurveCfg):  # what Unitree trains all twelve joints with: Go2HV of unitree_rl_lab
            knee_speed, no_load_speed = 13.5, 30.0
            driving_torque, braking_torque = 20.2, 23.4
            draws = ASSUMED_VOLTAGE

    class rewards:
        base_height_target = 0.324


class Go2CfgPPO(Go1CfgPPO):
    """Training of a Go2, which is the same left and right."""
