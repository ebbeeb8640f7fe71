"""Settings of multi-head control, see :mod:`~legged_torque.envs.approaches.multi_head`."""

from __future__ import annotations

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO, LinearChange
from legged_torque.utils.config import Section
from legged_torque.utils.limits import Count, Sizes


class TorqueMultiHeadCfg(LeggedRobotCfg):
    """Settings of multi-head control whose PD part fades to 0."""

    class control:
        class mixing(Section):
            update_interval: Count = 64_000  # [total steps]; weights change between rollouts only

            class pd(LinearChange):
                start, end = 1.0, 0.0
                t_start, t_end = 0, 50_000_000

            class torque(LinearChange):
                start, end = 1.0, 1.0
                t_start, t_end = 0, 50_000_000


class MultiHeadCfg(TorqueMultiHeadCfg):
    """Settings of multi-head control whose PD part fades to 0.1."""

    class control:
        class mixing:
            class pd:
                end = 0.1


class MultiHeadCfgPPO(LeggedRobotCfgPPO):
    """Training of multi-head control."""

    class actor:
        class_name = "legged_torque.learning.multi_head:MultiHeadModel"  # Figure 2
        hidden_dims = [512, 256]  # shared by both heads
        head_hidden_dims: Sizes = [128]  # of either head
