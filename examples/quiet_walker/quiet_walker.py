"""Torque control that is rewarded for quiet joints: its settings, registered as the task a1_quiet_walker."""

from legged_torque.envs import A1TorqueCfg, A1TorqueCfgPPO, task_registry


class QuietWalkerCfg(A1TorqueCfg):
    """The A1 with torques, and a cost of fast joints."""

    class rewards:
        class scales:
            dof_vel: float = -1e-4  # a setting that no base has is declared with its type


class QuietWalkerCfgPPO(A1TorqueCfgPPO):
    """Its training."""


task_registry.register("a1_quiet_walker", "quiet_robot:QuietRobot", QuietWalkerCfg(), QuietWalkerCfgPPO())
