"""Settings of torque control, see :mod:`~legged_torque.envs.approaches.torque`."""

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO


class TorqueCfg(LeggedRobotCfg):
    """Settings of torque control: those of the robot."""


class TorqueCfgPPO(LeggedRobotCfgPPO):
    """Training of torque control."""
