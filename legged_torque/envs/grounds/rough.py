"""Rough ground: tiles of growing difficulty, on which robots walk away from where they start."""

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO


class RoughCfg(LeggedRobotCfg):
    """Settings of rough ground for a blind policy; the critic sees the ground."""

    class terrain:
        mesh_type = "heightfield"

    class commands:
        heading_command = True

    class domain_rand:
        init_place = [-1.0, 1.0]


class RoughScanCfg(RoughCfg):
    """The same for a policy that sees the ground as well."""

    class terrain:
        measure_heights = True


class RoughCfgPPO(LeggedRobotCfgPPO):
    """Training on rough ground."""

    class runner:
        total_steps = 300_000_000
