"""Settings of multi-head control, see :mod:`~legged_torque.envs.approaches.multi_head`."""

from typing import Any

from legged_torque.envs.approaches.fast_config import FastCfg, FastCfgPPO
from legged_torque.envs.approaches.torque_curriculum_config import TorqueCurriculumCfg
from legged_torque.envs.base.clocks import whole_steps
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


class CurriculumMultiHeadCfg(TorqueMultiHeadCfg, TorqueCurriculumCfg):
    """Settings of torque multi-head control with the rewards of the torque curriculum."""


class MultiHeadTwoRatesCfg(FastCfg, MultiHeadCfg):
    """Settings of multi-head control with torques at 200 Hz and positions at 50 Hz, the paper's future work."""

    class control:
        position_interval: Count = 4  # control steps for which position actions are held

    def set_clocks(self, policy_hz: float | None, physics_hz: float | None) -> float:
        """Set the rates; position actions are held for the same time."""
        ratio = super().set_clocks(policy_hz, physics_hz)
        held = self.control.position_interval * ratio
        self.control.position_interval = whole_steps("control.position_interval", held)
        return ratio


class MultiHeadCfgPPO(LeggedRobotCfgPPO):
    """Training of multi-head control."""

    class actor:
        class_name = "legged_torque.learning.multi_head:MultiHeadModel"  # Figure 2
        hidden_dims = [512, 256]  # shared by both heads
        head_hidden_dims: Sizes = [128]  # of either head

    def presets(self) -> dict[str, dict[str, Any]]:
        """Return those of other approaches; on a laptop, heads are small and the PD part fades earlier.

        An A1 on two cores walks before it fades, and ``algorithm.annealing_start`` makes steps small afterwards.
        """
        named = super().presets()
        laptop, fading = named["laptop"], {"t_start": 4_000_000, "t_end": 10_000_000}
        laptop["actor"] |= {"head_hidden_dims": [64]}
        laptop["runner"] |= {"walks_after": 4_000_000}  # the latest of twelve seeds of the A1, docs/tried.md
        laptop["control"] = {"mixing": {"pd": fading}}
        return named


class MultiHeadTwoRatesCfgPPO(FastCfgPPO, MultiHeadCfgPPO):
    """Training of multi-head control with two rates."""
