"""The Unitree Go2: figures of MuJoCo Menagerie and of Unitree's URDF, the same for all approaches."""

from __future__ import annotations

from legged_torque.envs.robots.go1 import Go1Cfg, Go1CfgPPO


class Go2Cfg(Go1Cfg):
    """Settings of the Go2; alone, of position control on a plane: task ``go2_position``.

    Names of parts, nominal angles, gains and speeds are those of the Go1.
    """

    class asset:
        file = "resources/robots/go2/go2.xml"

    class rewards:
        base_height_target = 0.324


class Go2CfgPPO(Go1CfgPPO):
    """Training of a Go2, which is the same left and right."""
